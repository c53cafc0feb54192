"""Processes that die and come back, a second HRTC, forged commands, and a system's clock that is set, in one run."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader, repair
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, save_interaction_matrix
from srtomo_core.system import load_system
from srtomo_rtc.loop import Verdict
from srtomo_rtc.replay import Replay
from srtomo_sim.mirror import interaction_matrix

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from msgs_schema.msg import DmCommand, HrtcEvent, HrtcStatus, RecorderStatus  # noqa: E402
from msgs_schema.srv import PublishReconstructor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from srtomo_ops.operator import Operator, OperatorError  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

RATE = 100  # Hz: slow, so that a machine that others use keeps up
CHANGES = ("--set", f"loop.rate={RATE} Hz", "--set", "atmosphere.outer_scale=8 m")
SYSTEM = load_system("mini")
LAYOUT = Layout(SYSTEM)
BUDGET = 1000  # held frames: a machine that stands still opens no loop here
PATIENCE = 60.0  # s
HOUR = 3600 * 10**9  # ns
FORGED = 13  # reconstructor of commands that are
NO_COMMAND = b"\x00\x01\x00\x00"


class Instrument:
    """Plant, HRTC, SRTC and recorder as processes, each of which may be killed, and what they say."""

    def __init__(self, start_process: Callable[..., Any], folder: Path) -> None:
        self._start, self.folder = start_process, folder
        self.operator, self.node = Operator(), Node("listener")
        qos = QoSProfile(**wire.COMMAND.qos(4096))
        self._commands = self.node.create_subscription(DmCommand, wire.COMMAND.name, lambda _: None, qos, raw=True)
        self._events = self.node.create_subscription(
            HrtcEvent, wire.EVENT.name, lambda _: None, QoSProfile(**wire.EVENT.qos())
        )
        self.commands: list[wire.DmCommand] = []
        self.events: list[HrtcEvent] = []
        self.bags = 0
        self._step = 0
        (folder / "clock").write_bytes(struct.pack("q", 0))
        self.clock = compiled_clock(folder)
        save_interaction_matrix(folder / "g.npz", interaction_matrix(SYSTEM, LAYOUT), LAYOUT.fingerprint, {})

    def start(self, command: str, *words: str | Path) -> Any:
        """``srtomo COMMAND mini``; its system's clock is for :meth:`set_clock` to set."""
        with pytest.MonkeyPatch.context() as patch:
            if self.clock is not None:
                patch.setenv("LD_PRELOAD", str(self.clock))
                patch.setenv("STEPPED_CLOCK", str(self.folder / "clock"))
            return self._start("-m", "srtomo_ops.cli", command, "mini", *words)

    def set_clock(self, step: int) -> None:
        """Set the processes' system clock by so many ns."""
        self._step += step
        with (self.folder / "clock").open("r+b") as file:
            file.write(struct.pack("q", self._step))

    def start_hrtc(self) -> None:
        matrix = f"interaction_matrix:={self.folder / 'g.npz'}"
        keep = f"keep:={self.folder / 'kept.npz'}"
        self.hrtc = self.start("hrtc", *CHANGES, "-p", matrix, "-p", f"fault_budget:={BUDGET}", "-p", keep)

    def start_srtc(self) -> None:
        self.srtc = self.start("srtc", *CHANGES, "-p", 'priors:=["ground","file"]')

    def start_recorder(self) -> None:
        """In another bag each time."""
        self.bags += 1
        self.bag = self.folder / f"bag_{self.bags}"
        self.recorder = self.start("record", *CHANGES, "-o", self.bag, "--json", self.folder / "recorder.json")
        self.recorder.wait_for("recording", PATIENCE)
        self.recorder_status(lambda status: status.bag.endswith(self.bag.name) and status.frames > 0)
        self.until(self._can_be_replayed, lambda: f"{self.bag}: no events or no state")

    def _can_be_replayed(self) -> bool:
        """Slopes and commands come from the ring at once. What a replay starts from comes by the middleware, which to
        a process that takes the place of a killed one may take seconds to find its way."""
        with BagReader(self.bag) as reader:
            return all(reader.counts.get(f"/{topic.name}") for topic in (wire.EVENT, wire.STATE))

    def end_recorder(self) -> dict[str, Any]:
        """Its report. It began in the middle: what it missed before it had found everybody is lost (exit status 1)."""
        assert self.recorder.interrupt() in (0, 1), self.recorder.output
        assert "Traceback" not in self.recorder.output
        report: dict[str, Any] = json.loads((self.folder / "recorder.json").read_text())
        return report

    def start_plant(self) -> None:
        """Prepared, and running once its predecessor, if there was one, does not count as there any more."""
        self.plant = self.start("sim", *CHANGES, "-p", "frames:=20000", "-p", "science_every:=20000")
        self.plant.wait_for("sky 100 %", 120)
        self.insist(Trigger, "sim/start", Trigger.Request(), lambda said: said.success or "before" in said.message)

    def insist(self, kind: Any, service: str, request: Any, wanted: Callable[[Any], bool]) -> Any:
        """Call a service until it says what is wanted: one that was killed is still known for a while."""
        end = time.monotonic() + PATIENCE
        while True:
            with suppress(OperatorError):
                said = self.operator.call(kind, service, request, timeout=2.0)
                if wanted(said):
                    return said
            assert time.monotonic() < end, service

    def publish(self, label: str) -> tuple[int, bytes]:
        said = self.insist(
            PublishReconstructor, "srtc/publish", PublishReconstructor.Request(label=label), lambda said: said.success
        )
        return int(said.id), bytes(said.sha256)

    # -- what comes -------------------------------------------------------------------------------------------------

    def spin(self, seconds: float) -> None:
        self.operator.spin(seconds)
        while (taken := self._commands.handle.take_message(DmCommand, True)) is not None:
            if taken[0] == NO_COMMAND:
                continue
            command = wire.read_dm_command(taken[0])
            if command.reconstructor == FORGED:
                continue
            assert np.isfinite(command.commands).all(), f"frame {command.frame} is not finite"
            self.commands.append(command)
        while (taken := self._events.handle.take_message(HrtcEvent, False)) is not None:
            self.events.append(taken[0])

    def until(self, condition: Callable[[], bool], failure: Callable[[], str] = lambda: "it did not come") -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, failure()
            self.spin(0.02)

    def status(self, wanted: Callable[[HrtcStatus], bool] = lambda status: True) -> HrtcStatus:
        """The HRTC's next status that is as wanted."""
        self.operator.hrtc = None
        self.until(
            lambda: self.operator.hrtc is not None and wanted(self.operator.hrtc), lambda: str(self.operator.hrtc)
        )
        return self.operator.hrtc

    def recorder_status(self, wanted: Callable[[RecorderStatus], bool]) -> RecorderStatus:
        self.operator.recorder = None
        self.until(
            lambda: self.operator.recorder is not None and wanted(self.operator.recorder),
            lambda: str(self.operator.recorder),
        )
        return self.operator.recorder

    def run(self, n: int) -> list[wire.DmCommand]:
        """The next ``n`` commands: of frames in order."""
        self.spin(0.02)
        first = len(self.commands)
        self.until(lambda: len(self.commands) >= first + n)
        commands = self.commands[first : first + n]
        frames = [command.frame for command in commands]
        assert frames == list(range(frames[0], frames[0] + n))
        return commands

    def assert_runs(self, session: int | None = None) -> None:
        """The loop is closed, and makes commands of the slopes again."""
        commands = self.run(100)
        assert all(command.loop_state == HrtcEvent.CLOSED for command in commands)
        assert sum(command.verdict == Verdict.OK for command in commands) > 50  # the machine may stand still
        assert session is None or {command.session for command in commands} == {session}

    def destroy(self) -> None:
        self.node.destroy_node()
        self.operator.destroy_node()


def compiled_clock(folder: Path) -> Path | None:
    """The library that lets us set a process's clock; None without a C compiler."""
    compiler = shutil.which(os.environ.get("CC", "cc"))
    if compiler is None:
        return None
    library = folder / "stepped_clock.so"
    source = Path(__file__).with_name("stepped_clock.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-pthread"], check=True)
    return library


@pytest.fixture(scope="module")
def instrument(start_shared_process, tmp_path_factory):
    """Everything runs, the loop is closed on the reconstructor of the file's profile."""
    rclpy.init()
    made = Instrument(start_shared_process, tmp_path_factory.mktemp("faults"))
    made.start_hrtc()
    made.start_srtc()
    made.operator.transition("configure")
    made.operator.transition("activate")
    made.srtc.wait_for("built file", PATIENCE)
    identity, sha256 = made.publish("file")
    made.status(lambda status: status.staged == identity)
    made.operator.commit(identity, sha256)
    made.operator.close_loop(True)
    made.start_plant()
    made.start_recorder()
    made.assert_runs()
    yield made
    made.destroy()
    rclpy.shutdown()


def replayed(instrument: Instrument, bag: Path) -> Any:
    """The SRTC runs in idle time: a recorder may have to wait for its matrix longer than it lives here."""
    with BagReader(bag) as reader:
        return Replay(reader, [Reconstructor.load(instrument.folder / "kept.npz")]).run()


def test_a_killed_recorder_and_another_one(instrument, tmp_path):
    """The loop does not notice; the cut bag can be mended and replayed, and the next one begins in the middle."""
    before = instrument.status()
    instrument.run(300)  # with a state of the loop to begin at
    instrument.recorder.kill()
    cut = instrument.bag
    instrument.assert_runs(before.session)
    instrument.start_recorder()
    instrument.assert_runs(before.session)
    repair(cut, tmp_path / "mended")
    for bag in (tmp_path / "mended", None):
        if bag is None:
            instrument.run(200)
            instrument.end_recorder()
            bag = instrument.bag
        outcome = replayed(instrument, bag)
        assert outcome.compared > 100 and outcome.differing == 0, outcome
    assert instrument.status().loop_opened_by_faults == before.loop_opened_by_faults
    instrument.start_recorder()


def test_a_killed_srtc_and_another_one(instrument):
    """The reconstructor in use stays; the next SRTC's can be staged and committed."""
    before = instrument.status()
    instrument.srtc.kill()
    instrument.assert_runs(before.session)
    assert instrument.status().reconstructor == before.reconstructor
    instrument.start_srtc()
    instrument.srtc.wait_for("built file", PATIENCE)
    identity, sha256 = instrument.publish("ground")
    instrument.status(lambda status: status.staged == identity)
    first = instrument.operator.commit(identity, sha256)
    instrument.until(lambda: instrument.commands[-1].frame >= first + 50)
    made_by = {c.frame: c.reconstructor for c in instrument.commands if c.session == before.session}
    assert (made_by[first - 1], made_by[first]) == (before.reconstructor, identity)
    instrument.assert_runs(before.session)


def test_a_killed_plant_and_another_one(instrument):
    """Silence is told; the next plant's session is adopted with an open loop, which can be closed."""
    before, known = instrument.status(), len(instrument.events)
    instrument.plant.kill()
    silent = instrument.status(lambda status: status.silence > 2)
    assert (silent.state, silent.session, silent.loop_state) == ("active", before.session, HrtcEvent.CLOSED)
    instrument.start_plant()
    status = instrument.status(lambda status: status.session != before.session)
    instrument.until(lambda: any(e.kind == HrtcEvent.SESSION for e in instrument.events[known:]))
    (adopted,) = [e for e in instrument.events[known:] if e.kind == HrtcEvent.SESSION]
    assert (adopted.session, adopted.loop_state) == (status.session, HrtcEvent.OPEN)
    first = [command for command in instrument.commands if command.session == status.session][:50]
    assert {command.verdict for command in first} <= {Verdict.OPEN, Verdict.HOLD_MISSING, Verdict.HOLD_INCOMPLETE}
    instrument.operator.close_loop(True)
    instrument.assert_runs(status.session)


def test_a_killed_hrtc_and_another_one(instrument):
    """It comes back with the reconstructor that it was committed last, and the loop open."""
    before = instrument.status()
    instrument.hrtc.kill()
    instrument.start_hrtc()
    end = time.monotonic() + PATIENCE
    while instrument.status().state != "active":
        assert time.monotonic() < end
        for transition in ("configure", "activate"):
            with suppress(OperatorError):  # asked of the dead one, or not possible
                instrument.operator.transition(transition)
    status = instrument.status(lambda status: status.session == before.session)
    assert (status.reconstructor, status.loop_state) == (before.reconstructor, HrtcEvent.OPEN)
    assert not instrument.run(20)[-1].commands.any()
    instrument.operator.close_loop(True)
    instrument.assert_runs(before.session)


def test_forged_commands(instrument):
    """Not finite, of the wrong size, of another session, of frames to come: the plant says so and does not obey."""
    status = instrument.status()
    publisher = instrument.node.create_publisher(DmCommand, wire.COMMAND.name, QoSProfile(**wire.COMMAND.qos()))
    instrument.recorder_status(lambda status: status.command_publishers == 2)
    instrument.plant.wait_for("several publishers of hrtc/command")
    frame = instrument.status().frame
    for session, ahead, n, value in (
        (status.session, 0, LAYOUT.n_commands, np.nan),
        (status.session, 0, 3, 0.0),
        (77, 0, LAYOUT.n_commands, 1.0),
        (status.session, 64 * 10**6, LAYOUT.n_commands, 1.0),
    ):
        writer = wire.DmCommandWriter("forged", n)
        writer.values[:] = value
        publisher.publish(writer.write(0, 0, session, frame + ahead, FORGED, 0, 15, 0, 1, 0, 0.5, -1, -1, -1, 1.0, 0.0))
    publisher.publish(NO_COMMAND)
    for reason in ("expected finite values", "expected shape", "exposures up to", "expected little-endian CDR"):
        instrument.plant.wait_for(reason)
    instrument.node.destroy_publisher(publisher)
    instrument.recorder_status(lambda status: status.command_publishers == 1)
    instrument.assert_runs(status.session)


def test_a_second_hrtc(instrument):
    """On one domain and in one namespace: it is not activated, and every frame has one command."""
    session = instrument.status().session
    matrix = f"interaction_matrix:={instrument.folder / 'g.npz'}"
    second = instrument.start("hrtc", *CHANGES, "-p", matrix)
    end = time.monotonic() + PATIENCE
    while "another HRTC is active in namespace /" not in second.output:
        assert time.monotonic() < end
        for transition in ("configure", "activate"):
            with suppress(OperatorError):  # the request goes to both; that of the first cannot
                instrument.operator.transition(transition)
        instrument.spin(0.2)
    instrument.recorder_status(lambda status: status.command_publishers == 2)
    instrument.run(200)
    second.kill()
    instrument.recorder_status(lambda status: status.command_publishers == 1)
    instrument.assert_runs(session)
    report = instrument.end_recorder()
    assert report["topics"]["/hrtc/command"]["duplicates"] == 0
    instrument.start_recorder()


@pytest.mark.parametrize("step", [HOUR, -2 * HOUR], ids=["forward", "back"])
def test_the_system_s_clock_is_set(instrument, step):
    """Stamps jump with it and are carried; latencies, the mirror's timing and the order in the bag do not."""
    if instrument.clock is None:
        pytest.skip("needs a C compiler")
    session = instrument.run(100)[0].session
    instrument.set_clock(step)
    instrument.assert_runs(session)
    instrument.run(200)
    assert all(0 <= command.latency < 600 for command in instrument.commands)
    instrument.end_recorder()
    outcome = replayed(instrument, instrument.bag)
    assert outcome.compared > 300 and outcome.differing == 0, outcome
    frames, stamps, times, mirror = [], {}, [], {}
    with BagReader(instrument.bag) as reader:
        for message in reader.messages(reader.topic(wire.SLOPES.name)):
            slopes = wire.read_slope_frame(message.data)
            frames.append(slopes.frame)
            times.append(message.log_time)
            stamps[slopes.frame] = slopes.stamp_sec, slopes.stamp_nanosec
            mirror[slopes.frame] = slopes.mirror_frame
        for message in reader.messages(reader.topic(wire.COMMAND.name)):
            command = wire.read_dm_command(message.data)
            if command.sensors and command.frame in stamps:
                assert (command.stamp_sec, command.stamp_nanosec) == stamps[command.frame]
    assert frames == sorted(frames)
    assert max(np.diff(times)) < HOUR / 2
    jumps = np.diff([stamps[frame][0] for frame in sorted(stamps)])
    assert jumps[np.abs(jumps).argmax()] == pytest.approx(step / 1e9, abs=600)
    behind = [frame - mirror[frame] for frame in sorted(mirror)[-100:]]
    assert np.median(behind) == SYSTEM.loop.delay
    instrument.start_recorder()


def test_the_status_goes_on_when_the_system_s_clock_is_set_back(instrument):
    if instrument.clock is None:
        pytest.skip("needs a C compiler")
    instrument.set_clock(-HOUR)
    try:
        instrument.status()
    finally:
        instrument.set_clock(HOUR)


@pytest.mark.parametrize("signal", ["interrupt", "terminate"])
@pytest.mark.parametrize(
    ("command", "words", "said", "status"),
    [
        ("sim", ["-p", "frames:=20000"], "sky ", 130),
        ("srtc", ["-p", 'priors:=["ground","file"]'], "built ground", 0),
        ("srtc", ["-p", 'priors:=["file"]'], "built file", 0),
        ("record", ["-o", "bag"], "recording", 0),
    ],
    ids=["sim, preparing", "srtc, building", "srtc, built", "recorder"],
)
def test_a_signal_to_the_others(start_process, command, words, said, status, signal):
    process = start_process("-m", "srtomo_ops.cli", command, "mini", *CHANGES, "--namespace", "signalled", *words)
    process.wait_for(said)
    assert getattr(process, signal)() in (status, 0), process.output
    assert "Traceback" not in process.output
