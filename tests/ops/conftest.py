"""What tests of several nodes share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:  # there may be no ROS
    from srtomo_ops.operator import Operator


@pytest.fixture
def close_on_the_file() -> Callable[[Operator], None]:
    """Brings the HRTC up, closes its loop on the SRTC's "file", and starts the plant once the recorder hears it."""

    def close(operator: Operator) -> None:
        operator.transition("configure")
        operator.transition("activate")
        identity, sha256 = operator.publish("file")
        operator.wait_staged(identity)
        operator.commit(identity, sha256)
        operator.close_loop(True)
        while operator.recorder is None or operator.recorder.slope_publishers == 0:
            operator.spin(0.1)
        operator.start_sim()

    return close
