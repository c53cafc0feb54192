"""A small instrument under a small sky: screens of seconds become screens of milliseconds."""

from __future__ import annotations

import pytest

from srtomo_core.system import System, load_system


@pytest.fixture(scope="session")
def mini() -> System:
    """``mini`` with an outer scale of 8 m."""
    return load_system("mini", {"atmosphere.outer_scale": 8.0})
