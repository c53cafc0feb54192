"""One end of the whole path as a process: an HRTC node that notes when the middleware received its slopes.

``python -m srtomo_ops.bench.path_node FILE ROS-ARGUMENTS``: FILE (.npy) has the frame and the time, ns of the system's
clock, of each message (n, 2), once the process was told to end. Without a reconstructor it is the echo: the same path,
with nothing to multiply.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from srtomo_rtc import node
from srtomo_rtc.hot import HotEndpoints
from srtomo_rtc.hrtc import Hrtc

_ROOM = 4_000_000  # messages


def main(words: Sequence[str]) -> int:
    """Run it, and write what was noted."""
    file = Path(words[0])

    class Noting(HotEndpoints):
        room = _ROOM

        def run(self, hrtc: Hrtc) -> None:
            """As the loop's thread does, then write what was noted."""
            super().run(hrtc)
            np.save(file, self.received)

    node.HotEndpoints = Noting  # type: ignore[misc]
    return node.main(words[1:])


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
