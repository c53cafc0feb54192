"""The hot endpoints: raw slopes in, raw commands out, on a node that no executor spins.

An executor would take most of their messages itself. The loop's thread waits, takes and publishes in ``native/ros.c``,
where the interpreter cannot hold it up, or, where that cannot be loaded or is not wanted, here; the bytes are the same.
"""

from __future__ import annotations

import ctypes
import os
import time
from types import TracebackType
from typing import Any

import numpy as np
from msgs_schema.msg import DmCommand, SlopeFrame
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_rtc import native
from srtomo_rtc.hrtc import Hrtc
from srtomo_rtc.realtime import Outcome

_TIMEOUT = 100_000_000  # ns between looks at what was posted when nothing comes
_POLL = 20_000_000  # ns without a message after which polling gives way to blocking
_LAST_WORD = Duration(nanoseconds=200_000_000)  # for readers of the last command
_FRAMES_WAITING = 8  # as many as may be in assembly: any more would be skipped
_CORES_TO_POLL = 4  # the middleware's threads, the executor's and the system's have to find another core


def slopes_depth(layout: Layout) -> int:
    """Messages that may wait at the HRTC: some frames', should each row of a sensor be a packet of its own."""
    return max(wire.SLOPES.depth, _FRAMES_WAITING * sum(len(sensor.mask) for sensor in layout.sensors))


class HotEndpoints:
    """Slopes' subscription and commands' publisher. Entered by the loop's thread, which holds both handles meanwhile:
    destroying one under it would be a segmentation fault.

    Args:
        node: plain node, not in any executor.
        slopes_depth: depth of the slopes' reader, messages.
        command_depth: depth of the command's writer, messages.
        compiled: run out of the interpreter, if that can be.
        waiting: ``blocking``, ``polling`` while slopes come, or ``auto``: by the number of cores.

    Attributes:
        outcome: how the loop's thread waits, takes and publishes, and why so.
        poll_ns: how long it looks for slopes without sleeping after some came.
        received: (n, 2) for measurements: frame and time (ns, the system's clock) at which the middleware received each
            of the first n messages that fit; n is ``room``. Only out of the interpreter.
    """

    room = 0

    def __init__(
        self, node: Node, slopes_depth: int, command_depth: int, compiled: bool = True, waiting: str = "auto"
    ) -> None:
        cores = len(os.sched_getaffinity(0))
        polling = waiting == "polling" or (waiting == "auto" and cores >= _CORES_TO_POLL)
        self._library: Any = None
        self.poll_ns = _POLL if polling else 0
        self._ros = native.Ros(poll_ns=self.poll_ns)
        how = f"{'polling' if polling else 'blocking'} ({waiting}, {cores} cores)"
        if not compiled:
            self.outcome = Outcome("frame path", True, "rclpy, blocking (asked for)")
        else:
            try:
                self._library = native.load_ros()
                self.outcome = Outcome("frame path", True, f"compiled, {how}")
            except ImportError as error:
                self.outcome = Outcome("frame path", False, f"compiled; rclpy is used instead ({error})")
        self._received = np.zeros((self.room, 2), np.int64)
        self._subscription = node.create_subscription(
            SlopeFrame, wire.SLOPES.name, lambda _: None, QoSProfile(**wire.SLOPES.qos(slopes_depth)), raw=True
        )
        self._publisher = node.create_publisher(
            DmCommand, wire.COMMAND.name, QoSProfile(**wire.COMMAND.qos(command_depth))
        )
        self._guard = node.create_guard_condition(lambda: None)
        self._wait_set = rclpy_implementation.WaitSet(1, 1, 0, 0, 0, 0, node.context.handle)
        self._node = node

    def __enter__(self) -> HotEndpoints:
        self._subscription.handle.__enter__()
        self._publisher.handle.__enter__()
        self._guard.handle.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._guard.handle.__exit__(kind, value, trace)
        self._publisher.handle.__exit__(kind, value, trace)
        self._subscription.handle.__exit__(kind, value, trace)

    def run(self, hrtc: Hrtc) -> None:
        """Wait, take and answer until ``hrtc.stopping``; then publish flat. The loop's thread.

        Raises:
            RuntimeError: the middleware failed.
        """
        with self:
            if self._library is None:
                self._run_here(hrtc)
            else:
                self._run_compiled(hrtc)
            # what is destroyed before its last message was read takes that with it
            self._publisher.wait_for_all_acked(_LAST_WORD)

    def _run_compiled(self, hrtc: Hrtc) -> None:
        ros = self._ros
        context: Any = self._node.context.handle
        ros.context, ros.wake = context.pointer, self._guard.handle.pointer
        ros.slopes, ros.commands = self._subscription.handle.pointer, self._publisher.handle.pointer
        ros.received, ros.received_room = self._received.ctypes.data, len(self._received)
        if self._library.srt_run(hrtc.gate, ros) != 0:
            text = ctypes.create_string_buffer(1024)
            self._library.srt_ros_error(text, len(text))
            raise RuntimeError(text.value.decode(errors="replace"))

    def _run_here(self, hrtc: Hrtc) -> None:
        hrtc.start()
        looked = time.monotonic_ns()
        while not hrtc.stopping:
            self.wait(_TIMEOUT)
            look = time.monotonic_ns()
            while (taken := self.take()) is not None:
                message, stamp = taken
                looked = native.lib.srt_received(stamp, looked) + 1
                hrtc.offer(message, looked)
                look = time.monotonic_ns()
            looked = max(look, looked)
            hrtc.advance()
            hrtc.idle(time.monotonic_ns())
        if hrtc.not_flat:
            hrtc.flatten()

    @property
    def received(self) -> NDArray[np.int64]:
        """See the class. Once the loop's thread has left."""
        return self._received[: self._ros.received_count]

    def wait(self, timeout_ns: int) -> None:
        """Block until slopes came, :meth:`wake` was called, or the time is over. The loop's thread."""
        self._wait_set.clear_entities()
        self._wait_set.add_subscription(self._subscription.handle)
        self._wait_set.add_guard_condition(self._guard.handle)
        self._wait_set.wait(timeout_ns)

    def take(self) -> tuple[bytes, int] | None:
        """The next serialised SlopeFrame and when the middleware received it (ns of the system's clock), or None.

        The loop's thread.
        """
        taken = self._subscription.handle.take_message(SlopeFrame, True)
        return None if taken is None else (taken[0], taken[1]["received_timestamp"])

    def publish(self, message: bytes) -> None:
        """Publish a serialised DmCommand. The loop's thread."""
        self._publisher.publish(message)

    def wake(self) -> None:
        """End a :meth:`wait`. Any thread."""
        self._guard.trigger()

    def matched(self) -> tuple[int, int]:
        """(publishers of slopes, readers of commands) on the wire. Not the loop's thread."""
        return (
            self._subscription.handle.get_publisher_count(),
            self._publisher.get_subscription_count(),
        )

    def unmatched(self) -> str:
        """Who is on our topics but not matched to us, whose quality of service is then not compatible; empty: nobody.

        Not the loop's thread.
        """
        publishers, readers = self.matched()
        slopes, command = self._subscription.topic_name, self._publisher.topic_name
        strangers = []
        if (known := self._node.count_publishers(slopes)) > publishers:
            strangers.append(f"{known - publishers} publishers of {slopes}")
        if (known := self._node.count_subscribers(command)) > readers:
            strangers.append(f"{known - readers} readers of {command}")
        return " and ".join(strangers) + " do not match: incompatible quality of service" if strangers else ""

    def rivals(self) -> str:
        """Who else publishes commands; empty: nobody. Not the loop's thread."""
        others = self._node.count_publishers(self._publisher.topic_name) - 1
        return f"{others} others publish {self._publisher.topic_name}: another HRTC runs here" if others > 0 else ""

    def destroy(self) -> None:
        """Give the endpoints back; the loop's thread has left by then."""
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)
        self._node.destroy_guard_condition(self._guard)
