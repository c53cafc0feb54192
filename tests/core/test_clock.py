"""Times of arrival through steps of an injected clock."""

from collections import deque

import pytest

from srtomo_core.clock import ArrivalClock

SECOND = 1_000_000_000


class Clocks:
    """A monotonic clock, and a system's clock that can be set."""

    def __init__(self) -> None:
        self.now = 5000 * SECOND
        self.ahead = 1_700_000_000 * SECOND
        self.arrivals = ArrivalClock(lambda: self.now + self.ahead, lambda: self.now)

    def stamp(self) -> int:
        return self.now + self.ahead


@pytest.mark.parametrize("step", [3600, -3600, 1, -1, 0.02, -0.02, 86400 * 365])
@pytest.mark.parametrize("waiting", [0, 1, 3])
def test_arrivals_go_on_through_a_step(step: float, waiting: int) -> None:
    """Messages every 5 ms are read ``waiting`` messages after they came: also those of before the step after it."""
    clocks = Clocks()
    queue: deque[tuple[int, int]] = deque()
    assert clocks.arrivals.start == clocks.ahead
    for k in range(5000):
        clocks.now += SECOND // 200
        if k in (1000, 3500):
            clocks.ahead += round((step if k == 1000 else -step) * SECOND)
        queue.append((clocks.stamp(), clocks.now))
        if len(queue) > waiting:
            stamp, came = queue.popleft()
            assert clocks.arrivals.monotonic(stamp) == came, k
    assert clocks.arrivals.start == 1_700_000_000 * SECOND


def test_readings_that_do_not_belong_together_are_no_step() -> None:
    """The machine stops between the reading of one clock and that of the other."""
    clocks = Clocks()
    stops = deque([0, 3 * SECOND, 0, 0])

    def system() -> int:
        now = clocks.stamp()
        clocks.now += stops.popleft() if stops else 0
        return now

    arrivals = ArrivalClock(system, lambda: clocks.now)
    stamp, came = clocks.stamp(), clocks.now
    assert arrivals.monotonic(stamp) == came


def test_no_arrival_is_in_the_future() -> None:
    clocks = Clocks()
    assert clocks.arrivals.monotonic(clocks.stamp() + SECOND) == clocks.now
