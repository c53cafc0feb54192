"""Tip and tilt that the mirrors take off, for the telescope to take over. No ROS, and not on the hot path.

From the commands that the loop remembers: what a telescope's control offloads is their mean over a second, not a frame.
Any thread but the loop's may call these; what the loop remembers is only read.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_rtc.loop import HISTORY, Loop

_SECONDS = 1.0


def tilt_of_commands(layout: Layout, G_cal: NDArray[np.floating]) -> NDArray[np.float64]:
    """(2, n_commands) rad of wavefront tilt a metre, along x and y of the pupil, as the sensors see it.

    The mean over all sub-apertures of the gradients in G_cal (n_slopes, n_commands, rad/m), a rotated sensor's turned
    back from its own axes. Mirrors that no sensor sees have none. Not a plane through the commands: influence functions
    overlap, so that their sum is more than one.
    """
    tilt = np.zeros((2, layout.n_commands))
    for w, sensor in enumerate(layout.sensors):
        own = G_cal[layout.slopes_of(w)].reshape(2, sensor.n_valid, -1).sum(axis=1, dtype=np.float64)
        c, s = math.cos(sensor.rotation), math.sin(sensor.rotation)
        tilt += np.array([[c, -s], [s, c]]) @ own
    return np.asarray(tilt / sum(sensor.n_valid for sensor in layout.sensors))


class Offload:
    """The mean tip and tilt of the last second's commands. One thread, any but the loop's.

    Args:
        tilt: of unit commands, as from :func:`tilt_of_commands`.
        clock: s.
    """

    def __init__(self, tilt: NDArray[np.float64], clock: Callable[[], float] = time.monotonic) -> None:
        self._tilt = tilt
        self._clock = clock
        self._session = 0
        self._seen = -1
        self._sums: deque[tuple[float, int, NDArray[np.float64]]] = deque()

    def look(self, loop: Loop, session: int) -> tuple[float, float]:
        """Take what was answered since the last call: rad of wavefront tilt along x and y.

        To be called so often that the loop remembers everything since, or else some frames are not in the mean. While
        no frames come the mean of the last ones stands; (0, 0) before the first.
        """
        if session != self._session or loop.answered < self._seen:
            self._sums.clear()
            self._session, self._seen = session, loop.first_frame - 1
        answered = loop.answered
        # the oldest of those remembered may be written over meanwhile
        if (new := min(answered - self._seen, HISTORY - 4)) > 0:
            commands = loop.history(new)
            self._seen = answered
            self._sums.append((self._clock(), len(commands), self._tilt @ commands.sum(axis=0, dtype=np.float64)))
        while len(self._sums) > 1 and self._sums[0][0] <= self._sums[-1][0] - _SECONDS:
            self._sums.popleft()
        frames = sum(n for _, n, _ in self._sums)
        if frames == 0:
            return 0.0, 0.0
        tip, tilt = np.sum([total for _, _, total in self._sums], axis=0) / frames
        return float(tip), float(tilt)
