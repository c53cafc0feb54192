"""The far end of a measured path, as a process: the HRTC, or an echo on the same path that multiplies nothing.

``python -m srtomo_ops.bench.path_node hrtc FILE --ros-args ...`` or
``python -m srtomo_ops.bench.path_node echo FILE N_COMMANDS N_SLOPES --ros-args ...``. Both take slopes through the
HRTC's own endpoints and note when the middleware received each message: FILE (.npy) has the frame and the time, ns of
the system's clock, of each (n, 2), once the process was told to end.
"""

from __future__ import annotations

import signal
import sys
import threading
from array import array
from collections.abc import Sequence

import numpy as np
import rclpy
from msgs_schema.msg import SlopeFrame as SlopeFrameMsg
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from srtomo_core.wire import COMMAND, DmCommandWriter, SlopeFrame, read_slope_frame
from srtomo_rtc import node, realtime
from srtomo_rtc.hot import HotEndpoints

_received = array("q")


class _Stamped(HotEndpoints):
    """Notes when each message was received."""

    def take(self) -> bytes | None:
        taken = self._subscription.handle.take_message(SlopeFrameMsg, True)
        if taken is None:
            return None
        _received.extend((_frame_of(taken[0]), taken[1]["received_timestamp"]))
        return taken[0]


def _frame_of(message: bytes) -> int:
    """Reading all of it would add to what is measured. After 4 bytes CDR aligns to 8: header, session, frame."""
    end = 16 + message[12]  # the name of the frame of reference, less than 256 bytes
    start = end + (4 - end) % 8 + 8
    return int.from_bytes(message[start : start + 8], "little")


def echo(n_commands: int, n_slopes: int, ros_arguments: Sequence[str]) -> int:
    """Answer each frame with ``n_commands`` zeros, until SIGINT or SIGTERM.

    A frame is answered when its ``n_slopes`` slopes have come, or when some of a later one have.
    """
    rclpy.init(args=list(ros_arguments), signal_handler_options=SignalHandlerOptions.NO)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    own = Node("echo")
    hot = _Stamped(own, COMMAND.depth)
    writer = DmCommandWriter("dm", n_commands)
    realtime.lock_memory()
    realtime.quiet_interpreter()
    due, come = 0, 0

    def answer(slopes: SlopeFrame) -> None:
        hot.publish(
            writer.write(
                slopes.stamp_sec, slopes.stamp_nanosec, slopes.session, due, 0, 0, 0, 0, 0, 0, 0.0, -1, -1, 1.0, 0.0
            )
        )

    with hot:
        while not stop.is_set():
            hot.wait(100_000_000)
            while (message := hot.take()) is not None:
                slopes = read_slope_frame(message)
                while due < slopes.frame:
                    answer(slopes)
                    due, come = due + 1, 0
                come += len(slopes.slopes)
                if come == n_slopes:
                    answer(slopes)
                    due, come = due + 1, 0
    hot.destroy()
    own.destroy_node()
    rclpy.shutdown()
    return 0


def main(words: Sequence[str]) -> int:
    """Run one of the two, and write what was noted."""
    kind, file, *rest = words
    if kind == "echo":
        code = echo(int(rest[0]), int(rest[1]), rest[2:])
    else:
        node.HotEndpoints = _Stamped  # type: ignore[misc]
        code = node.main(rest)
    np.save(file, np.array(_received, np.int64).reshape(-1, 2))
    return code


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
