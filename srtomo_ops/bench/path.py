"""Latency of the whole path: slopes published here, taken by another process, its command received here.

The HRTC and an echo run at the same time, each in its namespace, and are driven in turns; what is not being driven
sleeps. The echo is an HRTC without a reconstructor: it reads slopes and writes commands, and multiplies nothing. Times
are the middleware's, on the system's clock, which all processes of a host share.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from msgs_schema.msg import DmCommand, SlopeFrame
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from scipy import stats

from srtomo_core import wire
from srtomo_core.reconstructor import save_interaction_matrix
from srtomo_ops.bench.latency import ARRIVALS, HELD, Problem, Sensors, Summary, refuse_if_held, wait_until
from srtomo_ops.operator import Operator
from srtomo_ops.processes import Processes
from srtomo_rtc import realtime

WARM_UP = 20
"""First frames of each turn that are checked and not counted (or a fifth of the turn, if that is less)."""

_TIMEOUT = 30.0  # s, for processes to find each other
_GRACE = 10.0  # s, for the last commands to come: what the middleware drops it sends again up to 3 s later
_NODE = "srtomo_ops.bench.path_node"

Times = NDArray[np.int64]


class Turn(NamedTuple):
    """One turn of one node. Times in ns of the system's clock, one a frame.

    Attributes:
        sent: just before the last message of the frame was published.
        received: when the node's middleware received that message; 0 where the node's queue lost some of the frame.
        answered: when the node published the command.
        returned: when the middleware received it here.
        taken: s, DmCommand.latency: the loop's own, last slopes received to command ready.
        held: the node was behind, and multiplied nothing; left out of all that follows.
    """

    sent: Times
    received: Times
    answered: Times
    returned: Times
    taken: NDArray[np.float64]
    held: NDArray[np.bool_]

    @property
    def path(self) -> Times:
        """Last slopes published to command received, both here; ns, without the warm-up."""
        return (self.returned - self.sent)[self._counted]

    @property
    def inside(self) -> Times:
        """Last slopes received by the node's middleware to command published; ns, without warm-up and lost slopes."""
        return (self.answered - self.received)[self._counted & (self.received > 0)]

    @property
    def loop(self) -> NDArray[np.float64]:
        """Last slopes received to command ready; ns, without the warm-up."""
        return self.taken[self._counted] * 1e9

    @property
    def _counted(self) -> NDArray[np.bool_]:
        return ~self.held & (np.arange(len(self.sent)) >= min(WARM_UP, len(self.sent) // 5))


class Difference(NamedTuple):
    """A quantile of the HRTC's path less the echo's, s: mean over pairs of turns, half-width of its 95 % interval."""

    mean: float
    half_width: float

    @classmethod
    def of(cls, hrtc: list[Turn], echo: list[Turn], quantile: float) -> Difference:
        """Of turns that belong together, pair by pair; at least two."""
        pairs = [np.quantile(a.path, quantile) - np.quantile(b.path, quantile) for a, b in zip(hrtc, echo, strict=True)]
        error = np.std(pairs, ddof=1) / np.sqrt(len(pairs))
        return cls(float(np.mean(pairs)) * 1e-9, float(stats.t.ppf(0.975, len(pairs) - 1) * error) * 1e-9)


class PathLatency(NamedTuple):
    """One way of arrival. Keys of the summaries: ``hrtc`` and ``echo``; what they time is said at :class:`Turn`."""

    path: dict[str, Summary]
    inside: dict[str, Summary]
    loop: Summary
    median: Difference
    p90: Difference


class Paths(NamedTuple):
    """All that was measured, by way of arrival.

    ``error`` and ``held`` are as in :class:`~srtomo_ops.bench.latency.Compute`, ``held`` of both nodes; ``realtime`` is
    what the HRTC says of its settings; ``lost`` counts the frames of each node of which its queue lost slopes.
    """

    arrivals: dict[str, PathLatency]
    error: float
    held: int
    lost: dict[str, int]
    realtime: str


class _End:
    """This process's end of one node's path."""

    def __init__(self, name: str, problem: Problem, patience: Callable[[], None]) -> None:
        self._node = Node("bench", namespace=name)
        self._patience = patience
        self._period = round(1e9 / problem.system.loop.rate)
        depth = wire.SLOPES.depth_at(problem.system.loop.rate * len(problem.sensors("staggered").due_ns))
        self._slopes = self._node.create_publisher(SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(depth)))
        self._commands = self._node.create_subscription(
            DmCommand,
            wire.COMMAND.name,
            lambda _: None,
            QoSProfile(**wire.COMMAND.qos(wire.COMMAND.depth_at(problem.system.loop.rate))),
            raw=True,
        )
        self.frame = 0
        self.messages: list[int] = []  # of each frame so far

    def wait_matched(self) -> None:
        """Until the node is there.

        Raises:
            ValueError: it is not in time.
        """
        end = time.monotonic() + _TIMEOUT
        while not (self._slopes.get_subscription_count() and self._commands.handle.get_publisher_count()):
            self._patience()
            if time.monotonic() > end:
                raise ValueError(f"{self._node.get_namespace()}: no node within {_TIMEOUT:g} s")
            time.sleep(0.02)

    def drive(self, sensors: Sensors, frames: int) -> tuple[list[int], list[tuple[bytes, dict[str, int]]]]:
        """Publish the next frames, paced: when each frame's last message went out, and what came back."""
        sent: list[int] = []
        back: list[tuple[bytes, dict[str, int]]] = []
        start = time.monotonic_ns() + self._period
        for i in range(frames):
            messages = sensors.messages(self.frame)
            last = 0
            for message, after in zip(messages, sensors.due_ns, strict=True):
                # a core that has gone to sleep would be late for the command: that is no latency of the node's
                wait_until(start + i * self._period + after, awake=True)
                last = time.time_ns()
                self._slopes.publish(message)
            sent.append(last)
            self.messages.append(len(messages))
            self.frame += 1
            self._drain(back)
        end = time.monotonic() + _GRACE
        while len(back) < frames and time.monotonic() < end:
            time.sleep(0.001)
            self._drain(back)
        return sent, back

    def _drain(self, back: list[tuple[bytes, dict[str, int]]]) -> None:
        while (taken := self._commands.handle.take_message(DmCommand, True)) is not None:
            back.append(taken)

    def destroy(self) -> None:
        self._node.destroy_node()


def measure_paths(
    problem: Problem,
    name: str,
    changes: Mapping[str, Any],
    pairs: int,
    frames: int,
    folder: Path,
    fifo_priority: int = 0,
) -> Paths:
    """Drive HRTC and echo in turns of ``frames`` frames, ``pairs`` pairs of turns for each way of arrival.

    Args:
        name, changes: how the HRTC is to load the instrument.
        pairs: at least 2.
        folder: for matrices, times and the nodes' logs; exists.
        fifo_priority: SCHED_FIFO priority of both nodes; 0: normal scheduling.

    Raises:
        ValueError: a node ended, refused or did not answer; a frame has not exactly one command, in order; or the
            HRTC's are wrong; too many frames were held.
    """
    save_interaction_matrix(folder / "gcal.npz", problem.G, problem.layout.fingerprint, {"source": "bench"})
    problem.reconstructor.save(folder / "reconstructor.npz")
    # the outer quotes keep YAML from reading the JSON as a mapping
    common = [f"system:={name}", f"changes:='{json.dumps(dict(changes))}'"]
    common += [f"interaction_matrix:={folder / 'gcal.npz'}", f"fifo_priority:={fifo_priority}"]
    # a loop that opened would be another measurement; frames that are held are counted
    own = [f"reconstructor:={folder / 'reconstructor.npz'}", "fault_budget:=1000000"]
    rclpy.init()
    try:
        with Processes(folder) as nodes:
            for node, parameters in (("echo", common), ("hrtc", common + own)):
                nodes.start(node, [str(folder / f"{node}.npy"), *_ros(node, parameters)], _NODE)
            ends = {node: _End(node, problem, nodes.check) for node in ("echo", "hrtc")}
            operators = {node: Operator(node) for node in ends}
            for each in operators.values():
                each.transition("configure")
                each.transition("activate")
            operator = operators["hrtc"]
            operator.close_loop(True)
            for end in ends.values():
                end.wait_matched()
            _listen_at(fifo_priority)
            operator.spin(0.3)  # statuses, and the other side's part of discovery
            settings = operator.hrtc.realtime if operator.hrtc is not None else ""
            reference = problem.reference()
            log = _Log()
            sensors = {arrival: problem.sensors(arrival) for arrival in ARRIVALS}
            for pair in range(pairs):
                for arrival in ARRIVALS:
                    for node in ("echo", "hrtc") if pair % 2 == 0 else ("hrtc", "echo"):
                        nodes.check()
                        first = ends[node].frame
                        sent, back = ends[node].drive(sensors[arrival], frames)
                        commands = [wire.read_dm_command(buffer) for buffer, _ in back]
                        if [command.frame for command in commands] != list(range(first, first + frames)):
                            raise ValueError(f"{node}: {len(commands)} commands for {frames} frames, or out of order")
                        if node == "hrtc":
                            reference.check(commands, frames)
                        log.add(node, arrival, sent, back, commands)
            for node in ends:
                if nodes.stop(node) != 0:
                    raise ValueError(f"{node} failed at the end: {nodes.last_line(node)}")
            for end in ends.values():
                end.destroy()
            for each in operators.values():
                each.destroy_node()
    finally:
        rclpy.shutdown()
    received = {node: _received(folder / f"{node}.npy", end.messages) for node, end in ends.items()}
    lost = {node: int(np.sum(times == 0)) for node, times in received.items()}
    held = log.held()
    for node, end in ends.items():
        refuse_if_held(f"path, {node}", held[node], end.frame)
    return Paths(log.summarise(received), reference.error, sum(held.values()), lost, settings)


def _listen_at(priority: int) -> None:
    """Have the middleware's threads here preempt what the nodes do after a command is out.

    A command is timed when it is received, and the loop's thread goes on with the next frame's part on the core that
    would wake them. This thread, which is awake all the time, stays where it is, or they would wait for it.
    """
    realtime.fifo_priority(priority)
    if priority > 0:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _ros(namespace: str, parameters: list[str]) -> list[str]:
    words = ["--ros-args", "-r", f"__ns:=/{namespace}"]
    for parameter in parameters:
        words += ["-p", parameter]
    return words


def _received(file: Path, messages: list[int]) -> Times:
    """When each frame's last message was received, ns; 0 where one of its ``messages`` is missing."""
    frames, times = np.load(file).T
    last = np.zeros(len(messages), np.int64)
    np.maximum.at(last, frames, times)
    last[np.bincount(frames, minlength=len(messages)) != messages] = 0
    return last


class _Log:
    """What was sent and came back, turn by turn."""

    def __init__(self) -> None:
        self._turns: list[tuple[str, str, Turn]] = []

    def add(
        self, node: str, arrival: str, sent: list[int], back: list[tuple[bytes, dict[str, int]]],
        commands: list[wire.DmCommand],
    ) -> None:  # fmt: skip
        self._turns.append((node, arrival, Turn(
            np.array(sent, np.int64),
            np.zeros(len(sent), np.int64),
            np.array([info["source_timestamp"] for _, info in back], np.int64),
            np.array([info["received_timestamp"] for _, info in back], np.int64),
            np.array([command.latency for command in commands], np.float64),
            np.array([command.verdict in HELD for command in commands]),
        )))  # fmt: skip

    def held(self) -> dict[str, int]:
        """Frames that each node held."""
        found: dict[str, int] = {}
        for node, _, turn in self._turns:
            found[node] = found.get(node, 0) + int(turn.held.sum())
        return found

    def summarise(self, received: dict[str, Times]) -> dict[str, PathLatency]:
        """With the times that the nodes noted, of all their frames."""
        turns: dict[tuple[str, str], list[Turn]] = {}
        begun = dict.fromkeys(received, 0)
        for node, arrival, turn in self._turns:
            start, begun[node] = begun[node], begun[node] + len(turn.sent)
            turns.setdefault((node, arrival), []).append(turn._replace(received=received[node][start : begun[node]]))
        found = {}
        for arrival in ARRIVALS:
            hrtc, echo = turns["hrtc", arrival], turns["echo", arrival]
            both = {"hrtc": hrtc, "echo": echo}
            found[arrival] = PathLatency(
                {node: Summary.of(np.concatenate([turn.path for turn in own])) for node, own in both.items()},
                {node: Summary.of(np.concatenate([turn.inside for turn in own])) for node, own in both.items()},
                Summary.of(np.concatenate([turn.loop for turn in hrtc])),
                Difference.of(hrtc, echo, 0.5),
                Difference.of(hrtc, echo, 0.9),
            )
        return found
