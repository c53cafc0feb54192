"""The sensors of a soak, and the operator who swaps reconstructors meanwhile, in a process of their own.

It computes nothing: a frame is sent as soon as no more than :data:`IN_FLIGHT` wait for their command. At every so many
frames the reconstructor is changed: rolled back to the previous one, and now and then to one that was sent meanwhile.
Bad reconstructors are sent in between.
"""

from __future__ import annotations

import argparse
import itertools
import json
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from msgs_schema.msg import DmCommand, SlopeFrame
from msgs_schema.msg import Reconstructor as ReconstructorMsg
from msgs_schema.msg import ReconstructorBlock as ReconstructorBlockMsg
from msgs_schema.srv import SwapReconstructor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, block_table
from srtomo_core.system import load_system
from srtomo_ops.bench.soak_plan import Fault, Matrices, Plan, Sensors
from srtomo_ops.operator import Operator

IN_FLIGHT = 3
"""Frames without an answer: more than a held frame needs to be noticed, less than what the HRTC would skip."""

SWAPS_A_TRANSFER = 4
"""Swaps from one transfer of a reconstructor to the next."""

_PATIENCE = 60.0  # s, for anything that has to come
_SHORT = 50e-6  # s between looks for commands
_SPIN_EVERY = 32  # frames between looks at services and status
_REFUSED = ("wrong shape", "another instrument", "one bit", "not finite", "wrong sign")
_LEFT = "half sent"  # given up when the next transfer begins
BAD = (*_REFUSED, _LEFT)
"""What is wrong with the bad reconstructors, one after the other."""


class Sending:
    """Publishes reconstructors as an SRTC does, good and bad."""

    def __init__(self, operator: Operator, n_commands: int) -> None:
        self._operator = operator
        two = 2 * len(block_table(n_commands, 1))
        self._manifests = operator.create_publisher(
            ReconstructorMsg, wire.RECONSTRUCTOR.name, QoSProfile(**wire.RECONSTRUCTOR.qos())
        )
        self._blocks = operator.create_publisher(
            ReconstructorBlockMsg, wire.RECONSTRUCTOR_BLOCK.name, QoSProfile(**wire.RECONSTRUCTOR_BLOCK.qos(two))
        )

    def send(self, one: Reconstructor, fault: str = "") -> None:
        """Publish it; ``fault`` is one of :data:`BAD`."""
        fingerprint = bytes(32) if fault == "another instrument" else one.fingerprint
        n_slopes = one.n_slopes + (fault == "wrong shape")
        message = ReconstructorMsg(
            id=one.id,
            sha256=np.frombuffer(one.sha256, np.uint8),
            fingerprint=np.frombuffer(fingerprint, np.uint8),
            n_commands=one.n_commands,
            n_slopes=n_slopes,
            n_epochs=one.n_epochs,
            n_blocks=len(block_table(one.n_commands, one.n_epochs)),
            gain=one.gain,
            label=one.label,
        )
        for name in ("slope_reference", "command_limit", "probe_commands", "probe_slopes"):
            setattr(message, name, getattr(one, name).astype(np.float32).ravel())
        message.header.stamp = self._operator.get_clock().now().to_msg()
        self._manifests.publish(message)
        if fault in ("another instrument", "wrong shape"):
            return
        for block in one.blocks():
            rows = block.rows
            if block.index == 0 and fault in ("one bit", "not finite"):
                rows = rows.copy()
                rows[0, 0] = np.nan if fault == "not finite" else np.nextafter(rows[0, 0], np.float32(1))
            if fault != _LEFT or block.index % 2:
                fields = (block.index, block.epoch, block.matrix, block.first_row, rows)
                self._blocks.publish(wire.write_block(wire.ReconstructorBlock(one.id, one.sha256, *fields)))


class Swapping:
    """Changes the reconstructor while frames go on, a step at a time.

    Attributes:
        told: first frame and id of every swap, as the HRTC told.
        transfers, refused: reconstructors sent to be used, and to be refused.
    """

    def __init__(self, operator: Operator, good: list[Reconstructor], bad: Reconstructor) -> None:
        self._operator, self._bad = operator, bad
        self._turns = itertools.cycle(good)
        self._sending = Sending(operator, bad.n_commands)
        self._clients = {
            name: operator.create_client(SwapReconstructor, f"hrtc/{name}") for name in ("commit", "roll_back")
        }
        self._active, self._previous = good[0], good[0]
        self._coming = good[0]
        self._sent = False  # what comes is on its way, or there
        self._under_way: tuple[Future, Reconstructor] | None = None
        self._number = 0
        self._next_bad = 0
        self.told: list[tuple[int, int]] = []
        self.transfers = self.refused = 0
        self._transfer()

    def _status(self, name: str) -> int:
        return 0 if self._operator.hrtc is None else int(getattr(self._operator.hrtc, name))

    @property
    def staged(self) -> bool:
        """Whether what was sent to be used waits for its commit."""
        return self._sent and self._status("staged") == self._coming.id

    @property
    def all_refused(self) -> bool:
        """Whether what was sent to be refused was."""
        return self._status("reconstructors_refused") >= self.refused

    @property
    def all_come(self) -> bool:
        """Whether what was sent to be used is there."""
        return not self._sent or self.staged

    def _transfer(self) -> None:
        # the HRTC takes what it has for a repetition, and would not stage it; what comes may be under way to be used
        has = {self._active.id, self._previous.id, self._coming.id}
        self._coming = next(one for one in self._turns if one.id not in has)
        self._sending.send(self._coming)
        self._sent_at = time.monotonic()
        self._sent = True
        self.transfers += 1

    def begin(self) -> None:
        """Ask for the next swap; the one before must be done.

        Raises:
            ValueError: a reconstructor that was sent long ago has not come.
        """
        assert self._under_way is None
        if not self.all_come and time.monotonic() > self._sent_at + _PATIENCE:
            raise ValueError(f"reconstructor {self._coming.id:016x}: sent, but not staged within {_PATIENCE:g} s")
        if self.staged:
            self._call("commit", self._coming)
            self._sent = False
        elif self.told:
            self._call("roll_back", self._previous)
        self._number += 1
        turn = self._number % SWAPS_A_TRANSFER
        # never two at a time: what is under way would be given up for the next
        if turn == SWAPS_A_TRANSFER // 2 and not self._sent and self.all_refused:
            self._send_bad()
        elif turn == 0 and not self._sent and self.all_refused:
            self._transfer()

    def _send_bad(self) -> None:
        fault = BAD[self._next_bad % len(BAD)]
        self._next_bad += 1
        # on top of what is wrong with it anyway: one that was used, or will be, would be taken for a repetition
        self._sending.send(self._bad, fault)
        self.refused += fault in _REFUSED

    def _call(self, service: str, one: Reconstructor) -> None:
        request = SwapReconstructor.Request(id=one.id, sha256=list(one.sha256))
        self._under_way = self._clients[service].call_async(request), one

    def done(self) -> bool:
        """Whether no swap is under way any more.

        Raises:
            ValueError: it was refused.
        """
        if self._under_way is None:
            return True
        if not self._under_way[0].done():
            return False
        (future, one), self._under_way = self._under_way, None
        said = future.result()
        if not said.success:
            raise ValueError(f"a swap was refused: {said.message}")
        self.told.append((int(said.first_frame), one.id))
        self._previous, self._active = self._active, one
        return True


class Driver:
    """Sends a plan's frames and takes the commands."""

    def __init__(self, plan: Plan, rate: float) -> None:
        self._plan = plan
        self._sensors = Sensors(plan)
        self.operator = Operator(name="soak")
        self._hot = rclpy.create_node("soak_sensors")
        depth = wire.SLOPES.depth_at(rate * len(plan.layout.sensors))
        self._slopes = self._hot.create_publisher(SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(depth)))
        self._commands = self._hot.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos()), raw=True
        )
        self.answered = -1

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Spin until something is so.

        Raises:
            ValueError: not in time.
        """
        end = time.monotonic() + _PATIENCE
        while not condition():
            if time.monotonic() > end:
                raise ValueError(f"{what}: not within {_PATIENCE:g} s")
            self.operator.spin(0.005)

    def wait_matched(self) -> None:
        """Until HRTC and recorder are there, each with both topics, and say so themselves."""

        def matched() -> bool:
            hrtc, recorder = self.operator.hrtc, self.operator.recorder
            return (
                hrtc is not None and recorder is not None
                and hrtc.slope_publishers > 0 and hrtc.command_readers >= 2
                and recorder.slope_publishers > 0 and recorder.command_publishers > 0
                and self._slopes.get_subscription_count() >= 2
            )  # fmt: skip

        self.wait_for(matched, "HRTC and recorder matched with the sensors")

    def _wait_answered(self, frame: int) -> None:
        """Until the command for a frame has come.

        Raises:
            ValueError: one comes out of order, twice, or not at all.
        """
        end = 0.0
        while self.answered < frame:
            taken = self._commands.handle.take_message(DmCommand, True)
            if taken is not None:
                got = wire.read_dm_command(taken[0]).frame
                self.answered += 1
                if got != self.answered:
                    raise ValueError(f"a command for frame {got} where frame {self.answered} was due")
                end = 0.0
            else:
                now = time.monotonic()
                end = end or now + _PATIENCE
                if now > end:
                    raise ValueError(f"no command for frame {self.answered + 1} within {_PATIENCE:g} s")
                time.sleep(_SHORT)

    def run(self, swapping: Swapping, swap_every: int) -> None:
        """Send every frame.

        Raises:
            ValueError: something did not come, or was refused.
        """
        plan, publish, messages = self._plan, self._slopes.publish, self._sensors.messages
        late: list[bytes] = []
        with self._slopes.handle, self._commands.handle:
            for frame in range(plan.frames):
                if frame % swap_every == 0 and frame:
                    self.wait_for(swapping.done, "the swap before")
                    swapping.begin()
                if frame % _SPIN_EVERY == 0:
                    self.operator.poll()
                    swapping.done()
                self._wait_answered(frame - IN_FLIGHT)
                fault = plan.faults[frame]
                made = messages(frame, time.time_ns())
                if fault in (Fault.LATE, Fault.OVERTAKEN):
                    late = made
                    continue
                for message in made:
                    publish(message)
                if late:
                    if plan.faults[frame - 1] == Fault.LATE:
                        self._wait_answered(frame)
                    for message in late:
                        publish(message)
                    late = []
            self._wait_answered(plan.frames - 1)
        self.wait_for(swapping.done, "the last swap")
        self.wait_for(lambda: swapping.all_come, "the last reconstructor staged")
        self.wait_for(lambda: swapping.all_refused, "bad reconstructors refused")

    def status_after(self, frame: int) -> dict[str, Any]:
        """The HRTC's numbers once it says that it has answered a frame; a status made meanwhile is not counted."""
        operator = self.operator
        for _ in range(2):
            operator.hrtc = None
            self.wait_for(lambda: operator.hrtc is not None and operator.hrtc.frame >= frame, "the last status")
        assert operator.hrtc is not None
        names = operator.hrtc.get_fields_and_field_types()
        return {name: getattr(operator.hrtc, name) for name in names if name != "header"}

    def destroy(self) -> None:
        """Leave the network."""
        self._hot.destroy_node()
        self.operator.destroy_node()


def main(words: Sequence[str] | None = None) -> int:
    """Send everything, write what was told to a file, and wait to be ended."""
    parser = argparse.ArgumentParser(prog="soak_drive")
    parser.add_argument("folder", type=Path)
    parser.add_argument("system")
    parser.add_argument("changes", type=json.loads)
    for name in ("frames", "seed", "swap_every"):
        parser.add_argument(name, type=int)
    options = parser.parse_args(words)
    system = load_system(options.system, options.changes)
    plan = Plan.of(Layout(system), options.frames, options.seed)
    good, bad = Matrices.load(options.folder)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs ignore
    try:
        driver = Driver(plan, system.loop.rate)
        operator = driver.operator
        operator.transition("configure")
        operator.transition("activate")
        operator.close_loop(True)
        driver.wait_matched()
        swapping = Swapping(operator, good, bad)
        driver.wait_for(lambda: swapping.staged, "a reconstructor staged")
        (options.folder / "begun").touch()
        start = time.monotonic()
        driver.run(swapping, options.swap_every)
        seconds = time.monotonic() - start
        told = {
            "seconds": seconds,
            "swaps": swapping.told,
            "transfers": swapping.transfers,
            "refused": swapping.refused,
            "status": driver.status_after(plan.frames - 1),
        }
        partial = options.folder / "told.partial"
        partial.write_text(json.dumps(told))
        partial.replace(options.folder / "told.json")
        while True:  # what it published is to be kept for those who come late
            time.sleep(1.0)
    except KeyboardInterrupt:
        return 0
    except ValueError as error:
        print(error, flush=True)
        return 1
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    raise SystemExit(main())
