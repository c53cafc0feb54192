"""The slopes of one exposure, put together from messages: of whole sensors, of several, or packets of one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.wire import SlopeFrame

Floats = NDArray[np.float32]

MAX_FRAME = 2**62
"""Frame numbers are below this: they also travel as signed 64-bit numbers, with a delay taken off or added."""


def subaperture_starts(layout: Layout) -> tuple[int, ...]:
    """(n_sensors + 1,) first valid sub-aperture of each sensor; the last entry is their total."""
    return tuple(int(start) // 2 for start in layout.slope_start)


def fits(message: SlopeFrame, starts: Sequence[int]) -> bool:
    """Whether a message with the right fingerprint is whole sensors, or a packet of one, and can be a frame at all."""
    first, n = message.sensor, message.n_sensors
    if n < 1 or first + n >= len(starts) or message.session == 0 or message.frame >= MAX_FRAME:
        return False
    valid = starts[first + n] - starts[first]
    if n == 1:
        return message.n_subapertures > 0 and message.first_subaperture + message.n_subapertures <= valid
    return message.first_subaperture == 0 and message.n_subapertures == valid


class Exposure:
    """What has come of one exposure. Memory is allocated once and used again after :meth:`clear`.

    Attributes:
        slopes: of each sensor, (n_slopes_w,) rad.
        begun: whether anything has come.
        arrived: bit w set once all of sensor w has come.
        mirror: (mirror_frame, mirror_frame_before, mirror_fraction) as the message with the first sub-aperture of all
            says, so that it does not depend on the order of arrival.
        stamp: (seconds, nanoseconds) of the first message.
    """

    def __init__(self, starts: Sequence[int]) -> None:
        self._starts = tuple(starts)
        self._counts = tuple(b - a for a, b in pairwise(starts))
        self.slopes = tuple(np.zeros(2 * n, np.float32) for n in self._counts)
        self._filled = np.zeros(starts[-1], bool)
        self._missing = list(self._counts)
        self.mirror: tuple[int, int, float] = (-1, -1, 1.0)
        self.clear()

    def clear(self) -> None:
        """Nothing has come."""
        self._filled[:] = False
        self._missing[:] = self._counts
        self.begun = False
        self.arrived = 0
        self.stamp = (0, 0)

    def put(self, message: SlopeFrame) -> bool:
        """Put a message that :func:`fits` in its place; False, and nothing done, if any of it was here before."""
        start = self._starts[message.sensor] + message.first_subaperture
        span = self._filled[start : start + message.n_subapertures]
        if span.any():
            return False
        span[:] = True
        if not self.begun:
            self.begun = True
            self.stamp = (message.stamp_sec, message.stamp_nanosec)
        if start == 0:
            self.mirror = (message.mirror_frame, message.mirror_frame_before, message.mirror_fraction)
        first, taken = message.first_subaperture, 0
        for sensor in range(message.sensor, message.sensor + message.n_sensors):
            n = self._counts[sensor]
            count = message.n_subapertures if message.n_sensors == 1 else n
            own = self.slopes[sensor]
            own[first : first + count] = message.slopes[taken : taken + count]
            own[n + first : n + first + count] = message.slopes[taken + count : taken + 2 * count]
            taken += 2 * count
            self._missing[sensor] -= count
            if self._missing[sensor] == 0:
                self.arrived |= 1 << sensor
        return True
