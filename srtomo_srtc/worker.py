"""A thread of its own for what takes long."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from srtomo_srtc.learner import Judgement, Outcome
from srtomo_srtc.telemetry import Recent, Statistics

Telemetry = TypeVar("Telemetry", Statistics, Recent)


class Worker(threading.Thread, Generic[Telemetry]):
    """Has telemetry judged by one method of a :class:`Learner`, which nobody else calls from then on.

    Attributes:
        judgements: what came of the telemetry given, each in its turn; None: nothing.
    """

    def __init__(self, name: str, method: Callable[[Telemetry], Judgement | None]) -> None:
        super().__init__(name=name, daemon=True)
        self._method: Callable[[Telemetry], Judgement | None] = method
        self._inbox: queue.SimpleQueue[Telemetry | None] = queue.SimpleQueue()
        self.judgements: queue.SimpleQueue[Judgement | None] = queue.SimpleQueue()

    def judge(self, telemetry: Telemetry) -> None:
        """Have it judged. Any thread."""
        self._inbox.put(telemetry)

    def finish(self) -> None:
        """End the thread when it is done with what it does; whoever ends the process need not wait for that."""
        self._inbox.put(None)

    def run(self) -> None:
        """The thread's body."""
        while (telemetry := self._inbox.get()) is not None:
            try:
                judgement = self._method(telemetry)
            except Exception as error:  # whatever it is: nothing comes of this telemetry, and the reason is told
                judgement = Judgement(telemetry).ended(Outcome.FAILED, f"{type(error).__name__}: {error}")
            self.judgements.put(judgement)
