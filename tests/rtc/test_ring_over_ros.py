"""HRTC and recorder as real processes, with the ring between them; slopes come from here."""

from __future__ import annotations

import json
import os
import signal
import time
from contextlib import suppress

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import save_interaction_matrix
from srtomo_core.ring import RingReader, RingWriter, ring_path
from srtomo_core.system import load_system
from srtomo_core.wire import SlopeFrameWriter
from srtomo_rtc.replay import Replay

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from msgs_schema.msg import DmCommand, SlopeFrame  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402

from srtomo_ops.operator import TRANSITIONS, Operator, OperatorError  # noqa: E402

LAYOUT = Layout(load_system("mini"))
SESSION = 77
PATIENCE = 30.0


class Rig:
    """Sensors here, HRTC and recorder as processes. ``sent`` and ``answered`` hold every message of the wire."""

    def __init__(self, start_process, mini, folder, domain: int) -> None:
        self._start, self._folder, self._mini = start_process, folder, mini
        self.ring = ring_path(domain, "/test")
        save_interaction_matrix(folder / "g.npz", mini.G, LAYOUT.fingerprint, {})
        mini.a.save(folder / "r.npz")
        rclpy.init()
        self._node = Node("sensor", namespace="test")
        self._slopes = self._node.create_publisher(
            SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(wire.SLOPES.depth_at(200)))
        )
        self._commands = self._node.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos(2000)), raw=True
        )
        self._writer = SlopeFrameWriter("all", SESSION, LAYOUT.fingerprint, 0, 4, LAYOUT.n_slopes // 2)
        self.operator = Operator("test")
        self.frame = 0
        self.sent: list[bytes] = []
        self.answered: list[bytes] = []

    def close(self) -> None:
        self.operator.destroy_node()
        self._node.destroy_node()
        rclpy.shutdown()

    def wait(self, condition) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, "what was waited for did not come"
            self.operator.spin(0.02)

    def start_hrtc(self, *parameters: str) -> None:
        words = ["-r", "__ns:=/test"]
        for word in (
            "system:=mini",
            f"interaction_matrix:={self._folder / 'g.npz'}",
            f"reconstructor:={self._folder / 'r.npz'}",
            *parameters,
        ):
            words += ["-p", word]
        self.hrtc = self._start("-m", "srtomo_rtc.node", "--ros-args", *words)
        self.operator.spin(0.3)
        self.operator.hrtc = None
        self.wait(lambda: self.operator.hrtc is not None)  # it is there, and not only the one that was killed
        for transition, state in (("configure", "inactive"), ("activate", "active")):
            self._transition(transition, state)
        self.wait(lambda: self._commands.handle.get_publisher_count() == 1 == self._slopes_matched())
        self.operator.spin(0.3)  # and the other side's part of it

    def _transition(self, name: str, state: str) -> None:
        request = ChangeState.Request(transition=Transition(id=TRANSITIONS[name], label=name))
        client = self.operator.create_client(ChangeState, "hrtc/change_state")
        end = time.monotonic() + PATIENCE
        while self.operator.hrtc.state != state:
            assert time.monotonic() < end, self.hrtc.output
            self.operator.spin(0.5)
            with suppress(OperatorError):  # asked of one that was killed
                self.operator.ask(client, request, 2.0)
                self.operator.spin(0.3)
        self.operator.destroy_client(client)

    def _slopes_matched(self) -> int:
        return int(self.operator.hrtc.slope_publishers)

    def start_recorder(self) -> None:
        self.recorder = self._start(
            *("-m", "srtomo_rtc.recorder_node", self._folder / "bag", "--system", "mini", "--namespace", "test"),
            *("--json", self._folder / "report.json"),
        )
        self.recorder.wait_for("recording")
        self.wait(lambda: self.operator.recorder is not None and self._recorder_matched() == (1, 1))

    def _recorder_matched(self) -> tuple[int, int]:
        status = self.operator.recorder
        return status.slope_publishers, status.command_publishers

    def send(self) -> None:
        """The slopes of the next frame."""
        rng = np.random.default_rng(self.frame)
        self._writer.values[:] = 1e-7 * rng.standard_normal(LAYOUT.n_slopes)
        unknown = wire.MIRROR_UNKNOWN
        mirror = (self.frame - 2, self.frame - 3, 1.0) if self.frame > 3 else (unknown, unknown, 1.0)
        self.sent.append(self._writer.write(time.time_ns(), self.frame, *mirror))
        self._slopes.publish(self.sent[-1])
        self.frame += 1

    def listen(self) -> bool:
        """Take a command, if there is one."""
        taken = self._commands.handle.take_message(DmCommand, True)
        if taken is not None:
            self.answered.append(taken[0])
        return taken is not None

    def run(self, frames: int) -> None:
        """Frames, each with its answer."""
        for _ in range(frames):
            self.send()
            end = time.monotonic() + PATIENCE
            while not self.listen():
                assert time.monotonic() < end, f"frame {self.frame - 1} was not answered"
                time.sleep(0.0002)

    def end(self) -> dict:
        """Stop the recorder; its report."""
        assert self.recorder.interrupt() == 0, self.recorder.output
        return json.loads((self._folder / "report.json").read_text())

    def recorded(self, topic: wire.Topic) -> list[bytes]:
        with BagReader(self._folder / "bag") as reader:
            return [message.data for message in reader.messages(reader.topic(topic.name))]

    def replayed(self):
        with BagReader(self._folder / "bag") as reader:
            return Replay(reader, [self._mini.a]).run()


@pytest.fixture
def rig(start_process, mini, tmp_path, ros_domain):
    made = Rig(start_process, mini, tmp_path, ros_domain)
    yield made
    made.close()


@pytest.mark.parametrize("path", ["compiled", pytest.param("rclpy", marks=pytest.mark.slow)])
def test_all_is_recorded_from_the_ring_and_replays(rig, path):
    rig.start_hrtc(f"frame_path:={path}")
    assert f"telemetry ring 10 s, 3.8 s in packets of a row (5 MiB, {rig.ring.name})" in rig.operator.hrtc.realtime
    rig.start_recorder()
    rig.operator.close_loop(True)
    rig.run(500)
    rig.operator.spin(1.2)  # the overlap is over: from here the ring is the only source
    rig.run(500)
    report = rig.end()
    assert (report["frames"], report["lost"], report["overrun"], report["from_ring"]) == (1000, 0, 0, 2000)
    assert rig.recorded(wire.SLOPES) == rig.sent
    assert rig.recorded(wire.COMMAND) == rig.answered
    outcome = rig.replayed()
    assert (outcome.compared, outcome.differing, outcome.held) == (1000, 0, 0), outcome
    assert wire.read_dm_command(rig.answered[-1]).commands.any()
    assert rig.hrtc.terminate() == 0
    assert not rig.ring.exists()


@pytest.mark.slow
def test_a_killed_hrtc_and_another_one(rig):
    """Slopes go on meanwhile. Nothing is lost or recorded twice, and what the killed one left is cleared."""
    rig.start_hrtc()
    rig.start_recorder()
    rig.run(300)
    rig.operator.spin(1.2)
    rig.run(300)
    for _ in range(20):  # the kill falls into frames
        rig.send()
        time.sleep(0.0005)
    rig.hrtc.kill()
    left = RingReader(rig.ring)
    assert not left.writer_lives
    left.close()
    for _ in range(100):
        rig.send()
        time.sleep(0.005)
    while rig.listen():
        pass
    rig.start_hrtc()
    rig.run(300)
    report = rig.end()
    assert rig.hrtc.terminate() == 0
    assert not rig.ring.exists()
    assert rig.recorded(wire.SLOPES) == rig.sent
    assert rig.recorded(wire.COMMAND)[: len(rig.answered)] == rig.answered
    assert report["topics"]["/test/wfs/slopes"] == {"recorded": len(rig.sent), "lost": 0, "duplicates": 0}
    assert report["topics"]["/test/hrtc/command"]["duplicates"] == 0
    # the killed one counts as a second publisher of commands until the middleware misses it: no ring is used meanwhile
    assert report["from_ring"] >= 1200


@pytest.mark.slow
def test_a_recorder_that_sleeps_is_overrun_and_says_so(rig):
    rig.start_hrtc("ring:=0.01")  # as little as there can be: 1 MiB
    rig.start_recorder()
    rig.run(100)
    rig.operator.spin(1.2)
    os.kill(rig.recorder.pid, signal.SIGSTOP)
    rig.run(2000)
    os.kill(rig.recorder.pid, signal.SIGCONT)
    rig.operator.spin(0.5)
    rig.run(100)
    report = rig.end()
    assert report["overrun"] > 1000
    slopes, commands = (report["topics"][f"/test/{topic.name}"] for topic in (wire.SLOPES, wire.COMMAND))
    for topic in (slopes, commands):
        assert topic["lost"] > 0 and topic["recorded"] + topic["lost"] == 2200 and topic["duplicates"] == 0
    assert report["lost"] >= slopes["lost"] + commands["lost"]
    assert "were overwritten there first" in rig.recorder.output


def test_without_a_ring_of_its_own_the_loop_runs_and_is_recorded(rig):
    """Somebody else has it, and puts nothing in."""
    with RingWriter(rig.ring, 1 << 14):
        rig.start_hrtc()
        assert "telemetry ring refused: " in rig.operator.hrtc.realtime
        assert "in use by another process" in rig.operator.hrtc.realtime
        rig.start_recorder()
        rig.run(300)
        report = rig.end()
    assert (report["frames"], report["lost"], report["from_ring"]) == (300, 0, 0)
    assert rig.recorded(wire.COMMAND) == rig.answered


def test_no_ring_is_wanted(rig):
    rig.start_hrtc("ring:=0.0")
    assert "telemetry ring not asked for" in rig.operator.hrtc.realtime
    assert not rig.ring.exists()
