"""The SRTC node beside a loop that is made up: why there is nothing new is said in health and diagnostics."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_core.wire import DmCommandWriter, SlopeFrameWriter

pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from msgs_schema.msg import DmCommand, HrtcStatus, ModelHealth, SlopeFrame
from msgs_schema.msg import Reconstructor as ReconstructorMsg
from msgs_schema.srv import PublishReconstructor, SwapReconstructor
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

import srtomo_srtc.node
from srtomo_srtc.learn import LearnError
from srtomo_srtc.learner import Belief, Judgement, Outcome
from srtomo_srtc.listener import Listener
from srtomo_srtc.node import SrtcNode
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.telemetry import NoWindow

KEPT, FAILED = 0, 3


class Loop:
    """Random slopes, each frame answered flat; and what the SRTC beside it says."""

    def __init__(self, srtc: SrtcNode) -> None:
        self.srtc, self.node = srtc, Node("loop")
        self._layout = layout = Layout(load_system("mini"))
        self._sensors = [
            SlopeFrameWriter(sensor.name, 7, layout.fingerprint, w, 1, sensor.n_valid)
            for w, sensor in enumerate(layout.sensors)
        ]
        self._answers = DmCommandWriter("hrtc", layout.n_commands)
        self._slopes, self._commands, self._status = (
            self.node.create_publisher(kind, topic.name, QoSProfile(**topic.qos(2000)))
            for kind, topic in ((SlopeFrame, wire.SLOPES), (DmCommand, wire.COMMAND), (HrtcStatus, wire.STATUS))
        )
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(srtc)
        self._executor.add_node(self.node)
        self.healths: list[ModelHealth] = []
        self.diagnostics: list[tuple[int, str]] = []
        self._subscribe(ModelHealth, wire.HEALTH, self.healths.append)
        self._subscribe(
            DiagnosticArray,
            wire.DIAGNOSTICS,
            lambda m: self.diagnostics.extend((int.from_bytes(s.level, "little"), s.message) for s in m.status),
        )
        self._frame, self._rng = 0, np.random.default_rng(1)
        # what the HRTC holds, by id; 0: nothing, or the file's running
        self.reconstructor = self.staged = self.previous = 0
        self.swaps: list[tuple[str, int]] = []
        self.refuses_to_roll_back = False
        self._subscribe(ReconstructorMsg, wire.RECONSTRUCTOR, self._stage)
        for service in ("commit", "roll_back"):
            self.node.create_service(SwapReconstructor, f"hrtc/{service}", partial(self._swap, service))

    def _subscribe(self, kind: type, topic: wire.Topic, call: Callable[[Any], None]) -> None:
        self.node.create_subscription(kind, topic.name, call, QoSProfile(**topic.qos()))

    def _stage(self, manifest: ReconstructorMsg) -> None:
        self.staged = manifest.id

    def _swap(
        self, service: str, request: SwapReconstructor.Request, response: SwapReconstructor.Response
    ) -> SwapReconstructor.Response:
        self.swaps.append((service, request.id))
        response.success = not (self.refuses_to_roll_back and service == "roll_back")
        if response.success:
            self.reconstructor, self.previous = request.id, self.reconstructor
        return response

    def run(self, seconds: float, sensors: int | None = 0b1111) -> None:
        """Frames at 200 Hz, answered with some sensors; None: no frames."""
        reconstructor = self.reconstructor or self.srtc._built["file"].reconstructor.id
        self._status.publish(HrtcStatus(reconstructor=reconstructor, staged=self.staged, previous=self.previous))
        for frame in range(self._frame, self._frame + (0 if sensors is None else round(200 * seconds))):
            for writer in self._sensors:
                writer.values[:] = 1e-6 * self._rng.standard_normal(len(writer.values))
                self._slopes.publish(writer.write(frame, frame, -1, -1, 1.0))
            fields = (7, frame, reconstructor, 1, sensors, 0, True, 0, 0.5, -1)
            self._commands.publish(self._answers.write(0, frame, *fields, -1, -1, 1.0, 0.0))
            self._frame = frame + 1
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._executor.spin_once(timeout_sec=0.01)

    def until(self, told: str, sensors: int | None = 0b1111) -> tuple[ModelHealth, int]:
        """Go on until health and diagnostics both tell a reason; the message, and the diagnostics' level."""
        patience = time.monotonic() + 60
        while time.monotonic() < patience:
            self.run(0.2, sensors)
            healths = [message for message in self.healths if told in message.text]
            levels = [level for level, text in self.diagnostics if told in text]
            if healths and levels:
                return healths[-1], levels[-1]
        raise AssertionError(f"no {told!r}: {[m.text for m in self.healths]}, {self.diagnostics[-3:]}")


@pytest.fixture
def loop(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Loop]:
    def fails(*_: object, **__: object) -> None:
        raise LearnError("of no sky at all")

    monkeypatch.setattr(srtomo_srtc.node, "learned_sky", fails)
    parameters = ("system:=mini", "learn:=true", "window:=1.0", "closures:=none")
    rclpy.init(args=["--ros-args", *(word for parameter in parameters for word in ("-p", parameter))])
    srtc = SrtcNode()
    rig = Loop(srtc)
    try:
        srtc.build()
        yield rig
    finally:
        srtc.close()
        rig.node.destroy_node()
        rclpy.shutdown()


def test_a_window_is_given_once() -> None:
    window: Any = SimpleNamespace(session=7, last_frame=10)
    telemetry: Any = SimpleNamespace(
        add_slopes=None, add_command=None, statistics=lambda: window, refusal=lambda what: NoWindow(what, 7, 20)
    )
    node: Any = SimpleNamespace(create_subscription=lambda *_, **__: None)
    listener = Listener(node, telemetry, 200.0, 4)
    assert listener._window() is window
    assert str(listener._window()) == "no new frame to count"
    window.last_frame = 11
    assert listener._window() is window


def test_whatever_becomes_of_a_window_is_said(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit that fails, silence, a sensor that is closed, and the listener's end."""
    health, level = loop.until("no candidate: of no sky at all")
    assert (health.decision, level) == (FAILED, 1)
    assert (health.source, health.n_blocks > 5, len(health.innovation)) == ("file", True, 4)

    health, level = loop.until("nothing came", sensors=None)
    assert (health.decision, health.session, health.source, level) == (FAILED, 7, "file", 1)
    judged = [message.last_frame for message in loop.healths if "telemetry" not in message.text]
    assert len(set(judged)) == len(judged)

    health, level = loop.until("sensor closed", sensors=0b1101)
    assert (health.decision, level) == (FAILED, 1)

    def breaks(message: object) -> None:
        raise MemoryError("no room")

    assert loop.srtc._listener is not None
    monkeypatch.setattr(loop.srtc._listener._telemetry._matcher, "add_slopes", breaks)
    health, level = loop.until("telemetry has ended")
    assert "MemoryError: no room" in health.text
    assert (health.decision, level) == (FAILED, 2)


def test_health_is_live_while_a_fit_goes_on(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what came of the fit is dropped when the loop runs something else by then."""
    begun, over = threading.Event(), threading.Event()
    windows = []

    def fit(window: Any) -> Any:
        windows.append(window)
        begun.set()
        over.wait(60)
        raise LearnError("of no sky at all")

    srtc = loop.srtc
    assert srtc._learner is not None
    monkeypatch.setattr(srtc._learner, "_fit", fit)
    patience = time.monotonic() + 60
    seen = None
    while seen is None or loop.healths[-1].last_frame <= seen:
        assert time.monotonic() < patience, [message.text for message in loop.healths]
        loop.run(0.2)
        if begun.is_set() and seen is None and loop.healths:
            seen = loop.healths[-1].last_frame
    message = loop.healths[-1]
    assert (message.decision, message.source, message.n_blocks > 5, len(message.innovation)) == (KEPT, "file", True, 4)
    assert "the active model" in message.text

    file = srtc._built["file"]
    srtc._auto_commit = True
    for running, dropped in ((file.reconstructor.id, False), (5, True)):
        srtc._status = HrtcStatus(reconstructor=running)
        srtc._order = None
        srtc._act_on(Judgement(windows[0], file, candidate=file).ended(Outcome.PUBLISHED, "better"))
        assert (srtc._order is None) == dropped
    assert srtc._reason == (0, "better; dropped: the loop runs 0000000000000005")
    over.set()


@pytest.mark.parametrize("kept", ["the target", "another", "the target, by a status of before another swap"])
def test_the_loop_goes_back_to_what_the_hrtc_kept_or_not(loop: Loop, kept: str) -> None:
    """What it kept is rolled back to; an older one is published again and committed, and its blocks are to be had."""
    srtc = loop.srtc
    file = srtc._built["file"]
    wrong, target, latest = (
        Belief("learned", system, implicit(system, label="learned", closures="none")[0])
        for system in (file.system.with_changes({"atmosphere.r0": r0}) for r0 in (0.1, 0.2, 0.3))
    )
    assert srtc._learner is not None
    for belief in (target, wrong):
        srtc._learner.know(belief)
    srtc._built["learned"], srtc._auto_commit = latest, True
    loop.reconstructor, identity = wrong.reconstructor.id, target.reconstructor.id
    loop.previous = file.reconstructor.id if kept == "another" else identity
    loop.refuses_to_roll_back = "another swap" in kept
    until = time.monotonic() + 60
    while srtc._status is None or srtc._status.previous != loop.previous:
        assert time.monotonic() < until
        loop.run(0.1, sensors=None)
    recent: Any = SimpleNamespace(session=7, first_frame=0, last_frame=9)
    srtc._act_on(Judgement(recent, wrong, target).ended(Outcome.ROLLED_BACK, "roll back: it is worse"))
    while loop.reconstructor != identity or srtc._order is not None:
        assert time.monotonic() < until, (loop.swaps, srtc._order)
        loop.run(0.1, sensors=None)
    swaps = {"the target": ["roll_back"], "another": ["commit"]}.get(kept, ["roll_back", "commit"])
    assert loop.swaps == [(swap, identity) for swap in swaps]
    assert loop.staged == (identity if "commit" in swaps else 0)
    request = PublishReconstructor.Request(id=identity, blocks=[0])
    assert srtc._publish(request, PublishReconstructor.Response()).success


def test_what_runs_is_known_after_a_restart(loop: Loop, tmp_path: Path) -> None:
    """What another SRTC learned, from the file that the HRTC keeps; and another instrument's is refused."""
    srtc, kept = loop.srtc, tmp_path / "kept.npz"
    learned = load_system("mini").with_changes({"atmosphere.r0": 0.1, "sensors.1.photons": 2e5})
    reconstructor, _ = implicit(learned, label="learned", closures="none")
    reconstructor.save(kept)
    identity = reconstructor.id
    loop.reconstructor = identity
    health, _ = loop.until("no reconstructor whose model is known here")
    assert (health.decision, health.reconstructor) == (FAILED, 0)

    srtc._recall(str(kept))
    assert srtc._built["learned"].system.model_dump() == learned.model_dump()
    assert srtc._learner is not None
    srtc._learner.running(0)
    srtc._learner.running(identity)
    health, _ = loop.until("no candidate: of no sky at all")
    assert (health.source, health.reconstructor, len(health.innovation)) == ("learned", identity, 4)

    del srtc._built["learned"]
    other = load_system("mini", {"sensors.0.subapertures": 10})
    implicit(other, label="learned", closures="none")[0].save(kept)
    srtc._recall(str(kept))
    assert "learned" not in srtc._built


def test_what_does_not_fit_in_memory_is_refused_in_one_line(start_process: Any) -> None:
    code = (
        "import sys; from srtomo_srtc import memory, node; memory.available = lambda: 1e3; "
        "sys.exit(node.main(['--ros-args', '-p', 'system:=mini']))"
    )
    srtc = start_process("-c", code)
    assert srtc.wait(110) == 2, srtc.output
    assert "GiB of memory" in srtc.output and "Traceback" not in srtc.output
