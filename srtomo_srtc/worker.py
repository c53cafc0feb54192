"""A thread of its own for what takes long."""

from __future__ import annotations

import queue
import threading

from srtomo_srtc.learner import Judgement, Learner, Outcome
from srtomo_srtc.telemetry import Statistics


class Worker(threading.Thread):
    """Calls a :class:`Learner`, which is from then on this thread's alone.

    Attributes:
        judgements: what came of the windows given.
    """

    def __init__(self, learner: Learner) -> None:
        super().__init__(name="learner", daemon=True)
        self._learner = learner
        self._inbox: queue.SimpleQueue[Statistics | int | None] = queue.SimpleQueue()
        self.judgements: queue.SimpleQueue[Judgement] = queue.SimpleQueue()

    def judge(self, window: Statistics) -> None:
        """Have a window judged. Any thread."""
        self._inbox.put(window)

    def running(self, identity: int) -> None:
        """Tell what the loop runs. Any thread."""
        self._inbox.put(identity)

    def finish(self) -> None:
        """End the thread when it is done with what it does; whoever ends the process need not wait for that."""
        self._inbox.put(None)

    def run(self) -> None:
        """The thread's body."""
        while (item := self._inbox.get()) is not None:
            if isinstance(item, int):
                self._learner.running(item)
                continue
            try:
                judgement = self._learner.judge(item)
            except Exception as error:  # whatever it is: this window gives no reconstructor, and the reason is told
                judgement = Judgement(item).ended(Outcome.FAILED, f"{type(error).__name__}: {error}")
            self.judgements.put(judgement)
