"""Reconstructors, one file each."""

from collections.abc import Callable
from typing import Any

from srtomo_srtc.reconstructors.implicit import implicit

METHODS: dict[str, Callable[..., Any]] = {
    "implicit": implicit,
}
"""By the name that ``srtomo reconstruct --method`` knows: ``method(system, layout=None, *, label, noise_gain, progress,
...)`` returns a Reconstructor and its G."""

__all__ = ["METHODS", "implicit"]
