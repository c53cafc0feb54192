"""A swap that the SRTC asks the HRTC for: as soon as the HRTC can, and only in the place of what was judged."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from srtomo_core.reconstructor import Reconstructor


class Step(enum.Enum):
    """What is to be done about an order."""

    WAIT = "wait"
    CALL = "call"
    DONE = "done"
    DROP = "drop"
    FAIL = "fail"


@dataclass
class Order:
    """A swap that is to be made.

    Attributes:
        reconstructor: that the loop is to run.
        roll_back: to the HRTC's previous reconstructor; otherwise a commit of its staged one.
        instead: id of the reconstructor that was judged, and that alone is to be replaced.
        until: when it is given up, s of the monotonic clock.
        called: the HRTC was asked.
    """

    reconstructor: Reconstructor
    roll_back: bool
    instead: int
    until: float
    called: bool = False

    @property
    def text(self) -> str:
        """What it is."""
        return f"{'roll back to' if self.roll_back else 'commit'} {self.reconstructor.id:016x}"

    def step(self, running: int, staged: int, previous: int, now: float) -> Step:
        """What is to be done.

        Args:
            running, staged, previous: the HRTC's reconstructors, by id.
            now: s of the monotonic clock.

        Returns:
            DROP: somebody else has chosen what the loop runs. FAIL: the HRTC does not hold it.
        """
        if running == self.reconstructor.id:
            return Step.DONE
        if running != self.instead:
            return Step.DROP
        if self.reconstructor.id == (previous if self.roll_back else staged):
            return Step.CALL
        return Step.FAIL if now > self.until else Step.WAIT
