"""Telemetry off the wire: slopes and commands, taken in batches from a node that no executor spins."""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

from msgs_schema.msg import DmCommand, SlopeFrame
from rclpy.node import Node
from rclpy.qos import QoSProfile

from srtomo_core import wire
from srtomo_srtc.telemetry import NoWindow, Recent, Statistics, Telemetry

_PERIOD = 0.01  # s between visits
_BRIDGED = 5.0  # s of messages that wait while a window's statistics are put together, or others have the machine
_ROUND = 16  # frames of each topic that are taken before the other one's turn: far less than the matcher's horizon


class Listener(threading.Thread):
    """Feeds :class:`Telemetry`, and hands out its windows when asked. All methods may be called from any thread.

    Args:
        node: plain node, not in any executor; the caller destroys it after :meth:`finish`.
        telemetry: from then on this thread's alone.
        rate: frames a second.
        n_sensors: of the instrument: so many messages a frame there are at most, packets aside.

    Attributes:
        windows: what :meth:`ask` asked for; or why there is none.
        recent: what :meth:`look` asked for.
        failure: what ended the thread before :meth:`finish`; empty while it goes on.
    """

    def __init__(self, node: Node, telemetry: Telemetry, rate: float, n_sensors: int) -> None:
        super().__init__(name="listener", daemon=True)
        self._telemetry = telemetry
        self._taps: list[tuple[Any, type, Any, int]] = []
        for kind, topic, put, per_frame in (
            (SlopeFrame, wire.SLOPES, telemetry.add_slopes, n_sensors),
            (DmCommand, wire.COMMAND, telemetry.add_command, 1),
        ):
            qos = QoSProfile(**topic.qos(max(topic.depth, round(_BRIDGED * rate * per_frame))))
            subscription = node.create_subscription(kind, topic.name, lambda _: None, qos, raw=True)
            self._taps.append((subscription, kind, put, _ROUND * per_frame))
        self.windows: queue.SimpleQueue[Statistics | NoWindow] = queue.SimpleQueue()
        self.recent: queue.SimpleQueue[Recent] = queue.SimpleQueue()
        self.failure = ""
        self._given = 0, -1  # session and last frame of the window that was given last
        self._asked = threading.Event()
        self._looked = threading.Event()
        self._stopped = threading.Event()

    def ask(self) -> None:
        """Have the window as it stands put into :attr:`windows`."""
        self._asked.set()

    def look(self) -> None:
        """Have the latest held-out frames put into :attr:`recent`."""
        self._looked.set()

    def finish(self) -> None:
        """End the thread."""
        self._stopped.set()
        self.join()

    @property
    def counts(self) -> dict[str, int]:
        """What became of the frames, by name."""
        return dict(vars(self._telemetry.tally))

    def run(self) -> None:
        """The thread's body."""
        try:
            self._listen()
        except Exception as error:  # whatever it is: nothing is learned any more, and the reason is told
            self.failure = f"telemetry has ended: {type(error).__name__}: {error}"
            self.windows.put(NoWindow(self.failure, *self._given))

    def _listen(self) -> None:
        answered, came = self._telemetry.newest, time.monotonic()
        while not self._stopped.is_set():
            while any([self._take(*tap) for tap in self._taps]):
                pass
            if self._telemetry.newest != answered:
                answered, came = self._telemetry.newest, time.monotonic()
            self._telemetry.age(time.monotonic() - came)
            if self._looked.is_set():
                self._looked.clear()
                self.recent.put(self._telemetry.recent())
            if self._asked.is_set():
                self._asked.clear()
                self.windows.put(self._window())
            time.sleep(_PERIOD)

    def _window(self) -> Statistics | NoWindow:
        """The window as it stands, once."""
        try:
            window = self._telemetry.statistics()
        except NoWindow as why:
            return why
        except MemoryError as error:  # there may be some for the next one
            return self._telemetry.refusal(f"MemoryError: {error}")
        last = window.session, window.last_frame
        if last == self._given:
            return self._telemetry.refusal("no new frame to count")
        self._given = last
        return window

    @staticmethod
    def _take(subscription: Any, kind: type, put: Any, most: int) -> bool:
        """Take up to ``most`` messages; whether there may be more."""
        with subscription.handle:
            for _ in range(most):
                taken = subscription.handle.take_message(kind, True)
                if taken is None:
                    return False
                put(taken[0])
        return True
