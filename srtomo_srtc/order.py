"""A swap that the SRTC asks the HRTC for: as soon as the HRTC can, and only in the place of what was judged."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from srtomo_core.reconstructor import Reconstructor


class Step(enum.Enum):
    """What is to be done about an order."""

    WAIT = "wait"
    PUBLISH = "publish"
    COMMIT = "commit"
    ROLL_BACK = "roll back"
    DONE = "done"
    DROP = "drop"
    FAIL = "fail"


@dataclass
class Order:
    """A swap that is to be made.

    Attributes:
        reconstructor: that the loop is to run.
        instead: id of the reconstructor that was judged, and that alone is to be replaced.
        until: when it is given up, s of the monotonic clock.
        back: to what the loop ran before; the HRTC keeps one such, and any older one has to be published again.
        published: the HRTC was sent it.
        called: the HRTC was asked.
        refused: to roll back was refused: what it kept was another one by then.
    """

    reconstructor: Reconstructor
    instead: int
    until: float
    back: bool = False
    published: bool = False
    called: bool = False
    refused: bool = False

    @property
    def text(self) -> str:
        """What it is."""
        return f"{'go back to' if self.back else 'commit'} {self.reconstructor.id:016x}"

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
        if self.reconstructor.id == previous and not self.refused:
            return Step.ROLL_BACK
        if self.reconstructor.id == staged:
            return Step.COMMIT
        if not self.published:
            return Step.PUBLISH
        return Step.FAIL if now > self.until else Step.WAIT
