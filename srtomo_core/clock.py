"""Times of arrival that a step of the system's clock does not move."""

from __future__ import annotations

import time
from collections.abc import Callable

_STEP = 5_000_000  # ns by which the system's clock has to be set to be noticed; slewing moves both clocks alike
_TORN = 1_000_000  # ns between readings of the two clocks above which they do not belong together
_WAITING = 10_000_000_000  # ns that messages of before a step may wait


class ArrivalClock:
    """Turns the middleware's stamps, which are of the system's clock, into monotonic time. One thread at a time.

    The system's clock may be set while messages wait: a stamp is then of before or of after, and whichever puts the
    arrival latest without putting it into the future is right, unless the message waited longer than the step is large.

    Args:
        system, monotonic: the clocks, ns.

    Attributes:
        start: system's clock less monotonic clock at the beginning, ns.
    """

    def __init__(
        self, system: Callable[[], int] = time.time_ns, monotonic: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._system, self._monotonic = system, monotonic
        self._before: list[int] = []  # offsets before the latest steps
        self._stepped, self._offset = self._look()
        self.start = self._offset

    def _look(self) -> tuple[int, int]:
        """The monotonic time now, and what the system's clock is ahead of it."""
        while True:
            begin, system, end = self._monotonic(), self._system(), self._monotonic()
            if end - begin <= _TORN:
                return end, system - end

    def monotonic(self, stamp: int) -> int:
        """The monotonic time, ns, of an arrival that was stamped with the system's clock, ns."""
        now, offset = self._look()
        if abs(offset - self._offset) > _STEP:
            self._before.append(self._offset)
            self._stepped, self._offset = now, offset
        elif now - self._stepped > _WAITING:
            self._before.clear()
        times = [stamp - offset for offset in (self._offset, *self._before)]
        return max((arrival for arrival in times if arrival <= now), default=now)
