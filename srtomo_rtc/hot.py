"""The hot endpoints: raw slopes in, raw commands out, on a node that no executor spins.

An executor would take most of their messages itself. Waiting is behind :class:`HotEndpoints.wait` alone, so that
another way of waiting (polling, or out of the interpreter) changes nothing else.
"""

from __future__ import annotations

from types import TracebackType

from msgs_schema.msg import DmCommand, SlopeFrame
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

from srtomo_core import wire


class HotEndpoints:
    """Slopes' subscription and commands' publisher. Entered by the loop's thread, which holds both handles meanwhile:
    destroying one under it would be a segmentation fault.

    Args:
        node: plain node, not in any executor.
        command_depth: depth of the command's writer, messages.
    """

    def __init__(self, node: Node, command_depth: int) -> None:
        self._subscription = node.create_subscription(
            SlopeFrame, wire.SLOPES.name, lambda _: None, QoSProfile(**wire.SLOPES.qos()), raw=True
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

    def wait(self, timeout_ns: int) -> None:
        """Block until slopes came, :meth:`wake` was called, or the time is over. The loop's thread."""
        self._wait_set.clear_entities()
        self._wait_set.add_subscription(self._subscription.handle)
        self._wait_set.add_guard_condition(self._guard.handle)
        self._wait_set.wait(timeout_ns)

    def take(self) -> bytes | None:
        """The next serialised SlopeFrame, or None. The loop's thread."""
        taken = self._subscription.handle.take_message(SlopeFrame, True)
        return None if taken is None else taken[0]

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

    def destroy(self) -> None:
        """Give the endpoints back; the loop's thread has left by then."""
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)
        self._node.destroy_guard_condition(self._guard)
