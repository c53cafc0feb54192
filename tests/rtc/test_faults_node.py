"""Faults on the wire: sensors, an SRTC and other publishers that err, against one HRTC that runs through all of it."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, save_interaction_matrix
from srtomo_rtc.loop import Verdict
from srtomo_sim.mirror import interaction_matrix

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from msgs_schema.msg import DmCommand, HrtcEvent, SlopeFrame
from msgs_schema.msg import Reconstructor as ReconstructorMsg
from msgs_schema.msg import ReconstructorBlock as ReconstructorBlockMsg
from rclpy.node import Node
from rclpy.qos import QoSProfile

from srtomo_ops.operator import TRANSITIONS, Operator, OperatorError

BUDGET = 20
PATIENCE = 30.0  # s, on a machine that others use
OTHER = 77  # a session
DROPPED = ("dropped_duplicate", "dropped_late", "dropped_session", "dropped_fingerprint", "dropped_malformed")
HELD = {
    "held_nonfinite": Verdict.HOLD_NONFINITE,
    "held_incomplete": Verdict.HOLD_INCOMPLETE,
    "held_missing": Verdict.HOLD_MISSING,
    "held_behind": Verdict.HOLD_BEHIND,
    "held_history": Verdict.HOLD_HISTORY,
}

# An HRTC whose check of a reconstructor labelled "long" takes until a file is there.
LONG_CHECK = """
import sys, threading, time
from pathlib import Path
from srtomo_rtc import node, swap
whole = swap.check
def check(reconstructor, *arguments):
    if reconstructor.label == "long":
        print(f"staging on thread {threading.get_native_id()}.", flush=True)
        while not Path(sys.argv[1]).exists():
            time.sleep(0.01)
    return whole(reconstructor, *arguments)
swap.check = check
sys.exit(node.main(sys.argv[sys.argv.index("--ros-args") :]))
"""


class Wire:
    """The test's side of an HRTC: its sensors, which see its commands, an SRTC that publishes anything, an operator."""

    def __init__(self, mini, sky, namespace: str) -> None:
        self.mini, self.layout, self._new_sky = mini, mini.layout, sky
        self.operator = Operator(namespace, f"operator_{namespace}")
        self.node = Node("sensors", namespace=namespace)
        self.slopes = self.slopes_publisher()
        qos = QoSProfile(**wire.COMMAND.qos(4096))
        self._commands = self.node.create_subscription(DmCommand, wire.COMMAND.name, lambda _: None, qos, raw=True)
        self._events = self.node.create_subscription(
            HrtcEvent, wire.EVENT.name, lambda _: None, QoSProfile(**wire.EVENT.qos())
        )
        self._diagnostics = self.node.create_subscription(
            DiagnosticArray, wire.DIAGNOSTICS.name, lambda _: None, QoSProfile(**wire.DIAGNOSTICS.qos())
        )
        self._manifests = self.node.create_publisher(
            ReconstructorMsg, wire.RECONSTRUCTOR.name, QoSProfile(**wire.RECONSTRUCTOR.qos())
        )
        self._blocks = self.node.create_publisher(
            ReconstructorBlockMsg, wire.RECONSTRUCTOR_BLOCK.name, QoSProfile(**wire.RECONSTRUCTOR_BLOCK.qos())
        )
        self.events: list[HrtcEvent] = []
        self.sessions = 0
        self.begin_session()

    def slopes_publisher(self) -> Any:
        return self.node.create_publisher(SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(1024)))

    def begin_session(self) -> None:
        """As sensors do that were started again: their count begins at 0, and nothing has moved the mirror."""
        self.sessions += 1
        self.session = 2**63 + self.sessions
        self.sky = self._new_sky(self.layout, self.mini.G, 2.0)
        self.next = 0
        self.commands: list[wire.DmCommand] = []

    # -- sensors ----------------------------------------------------------------------------------------------------

    def messages(
        self, k: int, slopes=None, session: int | None = None, fingerprint: bytes | None = None
    ) -> list[bytes]:
        """One message a sensor of frame ``k``."""
        slopes = self.sky.slopes(k) if slopes is None else slopes
        made = []
        for w, sensor in enumerate(self.layout.sensors):
            writer = wire.SlopeFrameWriter(
                sensor.name, session or self.session, fingerprint or self.layout.fingerprint, w, 1, sensor.n_valid
            )
            writer.values[:] = slopes[self.layout.slopes_of(w)]
            made.append(writer.write(time.time_ns(), k, *self.sky.timing(k)))
        return made

    def send(self, *messages: bytes, by: Any = None) -> None:
        for message in messages:
            (by or self.slopes).publish(message)

    def listen(self) -> None:
        """Take what the HRTC published; its commands move the mirror."""
        while (taken := self._commands.handle.take_message(DmCommand, True)) is not None:
            command = wire.read_dm_command(taken[0])
            assert np.isfinite(command.commands).all(), f"frame {command.frame} is not finite"
            if command.session == self.session:
                self.commands.append(command)
                self.sky.shown[command.frame] = command.commands.astype(float)
        while (taken := self._events.handle.take_message(HrtcEvent, False)) is not None:
            self.events.append(taken[0])

    def answered(self, k: int) -> list[Verdict]:
        """Wait for the command of frame ``k``; the verdicts of the frames since the last call."""
        since = self.next
        self.until(lambda: bool(self.commands) and self.commands[-1].frame >= k, lambda: f"no command of frame {k}")
        frames = [command.frame for command in self.commands[-(k + 1 - since) :]]
        assert frames == list(range(since, k + 1))  # one each, in order, and none after it
        self.next = k + 1
        return [Verdict(command.verdict) for command in self.commands[-len(frames) :]]

    def run(self, n: int) -> list[Verdict]:
        """``n`` frames without a fault, each when the one before is answered."""
        verdicts = []
        for k in range(self.next, self.next + n):
            self.send(*self.messages(k))
            verdicts += self.answered(k)
        return verdicts

    def until(self, condition, failure=lambda: "what was waited for did not come", timeout: float = PATIENCE) -> None:
        end = time.monotonic() + timeout
        self.listen()
        while not condition():
            assert time.monotonic() < end, failure()
            time.sleep(0.0005)
            self.listen()

    # -- what it says -----------------------------------------------------------------------------------------------

    def status(self, wanted=lambda status: True) -> Any:
        """The first status from now on that is as wanted."""
        end = time.monotonic() + PATIENCE
        self.operator.hrtc = None
        while self.operator.hrtc is None or not wanted(self.operator.hrtc):
            assert time.monotonic() < end, f"the last status was {self.operator.hrtc}"
            self.operator.spin(0.02)
        return self.operator.hrtc

    def event(self, kind: int, since: int) -> HrtcEvent:
        """The first event of a kind after the first ``since`` ones."""
        found: list[HrtcEvent] = []

        def there() -> bool:
            found[:] = [event for event in self.events[since:] if event.kind == kind]
            return bool(found)

        self.until(there, lambda: f"no event {kind} among {[(e.kind, e.text) for e in self.events[since:]]}")
        return found[0]

    def diagnosis(self, text: str) -> int:
        """Wait until the HRTC's diagnostics say a text; their level."""
        levels: list[int] = []

        def said() -> bool:
            while (taken := self._diagnostics.handle.take_message(DiagnosticArray, False)) is not None:
                levels.extend(
                    status.level[0]
                    for status in taken[0].status
                    if status.hardware_id == self.node.get_namespace() and text in status.message
                )
            return bool(levels)

        self.until(said, lambda: f"nobody said {text!r}")
        return levels[-1]

    @contextmanager
    def counting(self, opened: int = 0, **wanted: int):
        """Every counter of what is dropped or held grows by what is stated, and else not at all."""
        before = self.status()
        yield

        def grown(status: Any) -> dict[str, int]:
            names = (*DROPPED, *HELD, "loop_opened_by_faults")
            growth = {name: getattr(status, name) - getattr(before, name) for name in names}
            return {name: n for name, n in growth.items() if n}

        expected = wanted | ({"loop_opened_by_faults": opened} if opened else {})
        end = time.monotonic() + PATIENCE
        while grown(status := self.status()) != expected or status.frame != self.next - 1:
            assert time.monotonic() < end, f"{grown(status)} instead of {expected}, frame {status.frame}"

    # -- an SRTC ----------------------------------------------------------------------------------------------------

    def publish(self, manifest: Any, blocks: Sequence[wire.ReconstructorBlock]) -> None:
        """A manifest, which need not be that of the blocks, and blocks."""
        message = ReconstructorMsg(id=manifest.id)
        for name in ("sha256", "fingerprint"):
            setattr(message, name, list(getattr(manifest, name)))
        for name in ("slope_reference", "command_limit", "probe_commands", "probe_slopes"):
            setattr(message, name, getattr(manifest, name).ravel().tolist())
        for name in ("n_commands", "n_slopes", "n_epochs", "n_blocks", "gain", "label"):
            setattr(message, name, getattr(manifest, name))
        self._manifests.publish(message)
        for block in blocks:
            self._blocks.publish(wire.write_block(block))

    def destroy(self) -> None:
        self.node.destroy_node()
        self.operator.destroy_node()


@pytest.fixture(scope="module")
def matrix_file(tmp_path_factory, mini):
    path = tmp_path_factory.mktemp("faults") / "g.npz"
    save_interaction_matrix(path, mini.G, mini.layout.fingerprint, {})
    return path


@pytest.fixture(scope="module")
def start(start_shared_process, matrix_file):
    """Starts an HRTC in a namespace."""

    def start(namespace: str, *parameters: str, first: Sequence[str] = ()):
        words = [f"interaction_matrix:={matrix_file}", "system:=mini", f"fault_budget:={BUDGET}", *parameters]
        return start_shared_process(
            *(*first, "-m", "srtomo_rtc.node", "--ros-args", "-r", f"__ns:=/{namespace}"),
            *[word for parameter in words for word in ("-p", parameter)],
        )

    return start


@pytest.fixture(scope="module")
def ros(start_shared_process):
    rclpy.init()
    yield
    rclpy.shutdown()


@pytest.fixture(scope="module")
def first_matrix(mini, matrix_file):
    path = matrix_file.parent / "a.npz"
    mini.a.save(path)
    return path


@pytest.fixture(scope="module")
def wired(ros, mini, helpers):
    """Makes a Wire to the HRTC of a namespace, which is active from then on."""
    wires: list[Wire] = []

    def wired(namespace: str) -> Wire:
        wires.append(Wire(mini, helpers.Sky, namespace))
        wires[-1].operator.transition("configure")
        wires[-1].operator.transition("activate")
        wires[-1].status(lambda status: status.slope_publishers == 1 and status.command_readers == 1)
        return wires[-1]

    yield wired
    for made in wires:
        made.destroy()


@pytest.fixture(scope="module", params=["compiled", pytest.param("rclpy", marks=pytest.mark.slow)])
def begun(request, start, wired, first_matrix):
    """The HRTC of most tests here, with reconstructor a; open."""
    name = f"faults_{request.param}"
    process = start(name, f"reconstructor:={first_matrix}", f"frame_path:={request.param}")
    return SimpleNamespace(process=process, wire=wired(name), ended=False)


@pytest.fixture
def loop(begun, mini):
    """The HRTC with its loop closed on reconstructor a; unless the test ended it, it can be so afterwards."""
    made = begun.wire
    make_sure_it_is_closed(made)
    yield made
    if not begun.ended:
        make_sure_it_is_closed(made)
    assert {command.reconstructor for command in made.commands} == {mini.a.id}


def make_sure_it_is_closed(loop: Wire) -> None:
    if loop.status().loop_state != HrtcEvent.CLOSED:
        loop.operator.close_loop(True)
    assert loop.run(5)[-1] == Verdict.OK


# -- settings --------------------------------------------------------------------------------------------------------

# What follows runs as a user without privileges does: neither CAP_IPC_LOCK nor CAP_SYS_NICE, nor limits instead.
UNPRIVILEGED = """
import ctypes, os, resource, sys
for capability in (14, 23):
    ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (1 << 20, 1 << 20))
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""


def test_what_the_system_refuses_is_warned_of_and_the_loop_runs(start, wired, first_matrix):
    process = start("unprivileged", f"reconstructor:={first_matrix}", "fifo_priority:=10", first=("-c", UNPRIVILEGED))
    loop = wired("unprivileged")
    for name, reason in (("memory lock", ""), ("SCHED_FIFO", "RLIMIT_RTPRIO")):
        (line,) = [line for line in process.output.splitlines() if f"{name} refused: " in line]
        assert "[WARN]" in line and reason in line
    assert "blas threads 1;" in loop.status().realtime
    assert loop.diagnosis("waiting for slopes; refused by the system: memory lock, SCHED_FIFO") == 1
    make_sure_it_is_closed(loop)
    assert process.terminate() == 0, process.output


# -- slopes ----------------------------------------------------------------------------------------------------------


def test_sensors_that_stall(loop):
    """Silence shows in status and diagnostics; the mirror stays as it is, and the loop goes on with the frames."""
    k = loop.next
    loop.send(*loop.messages(k)[:2])  # in the middle of a frame
    assert loop.status(lambda status: status.silence > 1.5).loop_state == HrtcEvent.CLOSED
    assert loop.diagnosis("no slopes for") == 1
    with loop.counting():
        loop.send(*loop.messages(k)[2:])
        assert loop.answered(k) == [Verdict.OK]
        assert loop.run(2) == [Verdict.OK] * 2
    assert loop.status(lambda status: status.silence < 5).session == loop.session


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_slopes_that_are_not_finite(loop, bad):
    with loop.counting(held_nonfinite=3):
        for place in (0, 100, -1):
            slopes = loop.sky.slopes(loop.next)
            slopes[place] = bad
            loop.send(*loop.messages(loop.next, slopes))
            assert loop.answered(loop.next) == [Verdict.HOLD_NONFINITE]
            assert loop.commands[-1].commands.tobytes() == loop.commands[-2].commands.tobytes()
        assert loop.run(3) == [Verdict.OK] * 3


def test_slopes_that_stay_not_finite_open_the_loop(loop):
    since = len(loop.events)
    with loop.counting(opened=1, held_nonfinite=BUDGET + 1):
        for k in range(loop.next, loop.next + BUDGET + 1):
            loop.send(*loop.messages(k, np.full(loop.layout.n_slopes, np.nan)))
            assert loop.answered(k) == [Verdict.HOLD_NONFINITE]
        assert loop.run(100) == [Verdict.OPEN] * 100
    assert loop.event(HrtcEvent.LOOP, since).text == f"{BUDGET + 1} frames held in a row"
    assert loop.diagnosis("the loop opened by itself") == 2
    held, flat = (np.abs(command.commands).max() for command in (loop.commands[-101], loop.commands[-1]))
    assert flat == pytest.approx(held * 0.9**100, rel=1e-3)
    loop.operator.close_loop(True)
    loop.run(5)
    while loop.diagnosis("no slopes for") != 1:  # it happened, and is over
        pass


def test_sensors_that_fall_silent_for_good(loop):
    """The watchdog opens the loop and leaves the mirror flat; what comes of the frame after that is late."""
    since, k = len(loop.events), loop.next
    before = loop.status().loop_opened_by_silence
    loop.operator.change_parameters({"watchdog": "0.5"})
    assert np.abs(loop.commands[-1].commands).max() > 0
    parts = loop.messages(k)
    loop.send(*parts[:2])
    assert loop.answered(k) == [Verdict.OPEN]
    assert not loop.commands[-1].commands.any() and loop.commands[-1].sensors == 0
    assert re.fullmatch(r"no slopes for 0\.\d s", loop.event(HrtcEvent.LOOP, since).text)
    assert loop.status(lambda status: status.loop_opened_by_silence > before).loop_opened_by_silence == before + 1
    assert loop.diagnosis("the loop opened by itself: no slopes for") == 2
    with loop.counting(dropped_late=2):
        loop.send(*parts[2:])
        assert loop.run(2) == [Verdict.OPEN] * 2
    loop.operator.change_parameters({"watchdog": "10", "polc": "true", "gain_ramp": "0"})
    for name, value in (
        ("watchdog", "-1"),
        ("watchdog", "soon"),
        ("polc", "1"),
        ("watchdogs", "1"),
        ("kernel", "int16"),
    ):
        with pytest.raises(OperatorError, match=name):
            loop.operator.change_parameters({name: value})


def test_a_manual_flat(loop):
    since = len(loop.events)
    assert np.abs(loop.commands[-1].commands).max() > 0
    loop.operator.flatten()
    assert loop.run(2) == [Verdict.OPEN] * 2
    assert [command.loop_state for command in loop.commands[-2:]] == [HrtcEvent.FLAT] * 2
    assert not loop.commands[-2].commands.any()
    assert loop.event(HrtcEvent.LOOP, since).loop_state == HrtcEvent.FLAT
    assert loop.status().loop_state == HrtcEvent.FLAT


def test_duplicates_and_late_frames(loop):
    with loop.counting(dropped_duplicate=5, held_missing=1, dropped_late=4):
        k = loop.next
        parts = loop.messages(k)
        loop.send(parts[0], *parts)
        assert loop.answered(k) == [Verdict.OK]
        loop.send(*parts)
        late = loop.messages(k + 1)
        loop.send(*loop.messages(k + 2))
        assert loop.answered(k + 2) == [Verdict.HOLD_MISSING, Verdict.OK]
        loop.send(*late)
        assert loop.run(2) == [Verdict.OK] * 2


def test_a_sensor_that_dies(loop):
    """Its frames are held one after the other, then the loop opens; when it is back the loop can be closed."""
    since = len(loop.events)
    frames = BUDGET + 3
    with loop.counting(opened=1, held_incomplete=frames):
        first = loop.next
        for k in range(first, first + frames):
            loop.send(*loop.messages(k)[:-1])
            # as fast as they are held: the reader's queue has room for 16 frames
            loop.until(lambda held=k - 2: held < first or loop.commands[-1].frame >= held)
        loop.send(*loop.messages(first + frames))
        verdicts = loop.answered(first + frames)
        assert verdicts == [Verdict.HOLD_INCOMPLETE] * frames + [Verdict.OPEN]
    assert loop.event(HrtcEvent.LOOP, since).loop_state == HrtcEvent.OPEN


def test_a_burst(loop):
    """40 frames at once, more than the reader's queue holds: each is answered once, and if not used it says why."""
    before, first = loop.status(), loop.next
    loop.send(*(message for k in range(first, first + 40) for message in loop.messages(k)))
    # a gap of more than the assembly memory is believed when a second exposure agrees
    loop.send(*loop.messages(first + 40))
    verdicts = loop.answered(first + 40)
    after = loop.status(lambda status: status.frame == first + 40)
    for name, verdict in HELD.items():
        assert getattr(after, name) - getattr(before, name) == verdicts.count(verdict), name
    assert after.dropped_malformed == before.dropped_malformed
    assert Verdict.OK in verdicts or Verdict.OPEN in verdicts


def test_messages_of_the_wrong_size(loop):
    (message, *_) = loop.messages(loop.next)
    n = loop.layout.sensors[0].n_valid
    other = wire.SlopeFrameWriter("x", loop.session, loop.layout.fingerprint, 0, 1, n + 1)
    wrong = [b"\x00", message[:4], message[:-4], message + bytes(8), other.write(0, loop.next, -1, -1, 1.0)]
    with loop.counting(dropped_malformed=len(wrong)):
        loop.send(*wrong)
        assert loop.run(2) == [Verdict.OK] * 2


def test_a_wrong_fingerprint(loop):
    with loop.counting(dropped_fingerprint=4):
        loop.send(*loop.messages(loop.next, np.ones(loop.layout.n_slopes), fingerprint=bytes(32)))
        assert loop.run(2) == [Verdict.OK] * 2


def test_a_second_publisher_of_slopes(loop):
    """Its frames are dropped and counted as long as the first one's come; the status says that there are two."""
    second = loop.slopes_publisher()
    assert loop.status(lambda status: status.slope_publishers == 2)
    with loop.counting(dropped_session=20):
        for k in range(loop.next, loop.next + 5):
            loop.send(*loop.messages(k, np.ones(loop.layout.n_slopes), session=OTHER), by=second)
            assert loop.run(1) == [Verdict.OK]
    loop.node.destroy_publisher(second)
    loop.status(lambda status: status.slope_publishers == 1)


def test_sensors_that_start_again(loop):
    """A new session: dropped while the old one may go on, adopted after a second; the loop is open then."""
    since, old = len(loop.events), loop.session
    before = loop.status().dropped_session
    loop.begin_session()
    loop.send(*loop.messages(0, np.ones(loop.layout.n_slopes)))
    dropped = loop.status(lambda status: status.silence > 1.2).dropped_session - before
    if dropped:  # otherwise the test was a second late itself
        assert dropped == 4
        loop.begin_session()
    assert loop.run(5) == [Verdict.OPEN] * 5
    event = loop.event(HrtcEvent.SESSION, since)
    assert (event.session, event.first_frame, event.loop_state) == (loop.session, 0, HrtcEvent.OPEN)
    with loop.counting(dropped_session=4):
        loop.send(*loop.messages(100, np.ones(loop.layout.n_slopes), session=old))
        loop.run(1)


# -- reconstructors --------------------------------------------------------------------------------------------------


def of_a_moved_mirror(mini, pitches: float) -> Reconstructor:
    """What an SRTC builds that takes the mirror to be elsewhere."""
    layout = Layout(mini.system)
    (mirror,) = layout.mirrors
    moved = mirror.actuators + pitches * mirror.pitch * np.array([0.8, -0.6])
    layout.mirrors = (replace(mirror, actuators=moved),)
    G = interaction_matrix(mini.system, layout)
    R = np.linalg.solve(G.T @ G + 3e-3 * np.linalg.norm(G, 2) ** 2 * np.eye(layout.n_commands), G.T)
    return Reconstructor.from_matrices(
        R, G, fingerprint=mini.layout.fingerprint, gain=0.5, command_limit=mini.layout.stroke, label="moved"
    )


def bad_matrix(name: str, mini, helpers) -> tuple[Any, list[wire.ReconstructorBlock], str]:
    """(manifest, blocks, reason)"""
    b = mini.b
    blocks = helpers.blocks_of(b)
    rows = np.array(blocks[0].rows)
    if name == "wrong shape":
        return helpers.manifest_of(b, n_commands=100), blocks, "got 100 x 286"
    if name == "block of the wrong shape":
        return helpers.manifest_of(b), [blocks[0]._replace(rows=rows[:-1]), *blocks[1:]], "block 0: expected"
    if name == "one flipped bit":
        rows.view(np.uint32)[5, 7] ^= 1
        return helpers.manifest_of(b), [blocks[0]._replace(rows=rows), *blocks[1:]], "checksum"
    R = np.array(b.R)
    R[0, 3, 4] = np.nan
    made, reason = {
        "NaN": (replace(b, R=R), "not finite"),
        "another instrument": (replace(b, fingerprint=bytes(32)), "made for another instrument"),
        "unstable": (of_a_moved_mirror(mini, 0.5), "not stable enough"),
        "wrong sign": (of_a_moved_mirror(mini, 0.0), "wrong sign or scale"),
    }[name]
    if name == "wrong sign":
        made = replace(made, R=-made.R, Q=-made.Q)
    return helpers.manifest_of(made), helpers.blocks_of(made), reason


@pytest.mark.parametrize(
    "name",
    (
        "wrong shape",
        "block of the wrong shape",
        "one flipped bit",
        "NaN",
        "another instrument",
        "unstable",
        "wrong sign",
    ),
)
def test_a_matrix_that_is_refused(loop, mini, helpers, name):
    """With its reason, in an event and a counter; frames go on meanwhile, and nothing can be committed."""
    manifest, blocks, reason = bad_matrix(name, mini, helpers)
    since, before = len(loop.events), loop.status()
    with loop.counting():
        loop.publish(manifest, blocks)
        assert loop.run(20) == [Verdict.OK] * 20
        refused = loop.event(HrtcEvent.REFUSED, since)
    assert reason in refused.text
    assert refused.reconstructor == manifest.id
    after = loop.status(lambda status: status.reconstructors_refused == before.reconstructors_refused + 1)
    assert (after.reconstructor, after.staged) == (mini.a.id, before.staged)
    with pytest.raises(OperatorError, match=r"no reconstructor is staged|is not staged"):
        loop.operator.commit(manifest.id, manifest.sha256)


def test_a_matrix_that_is_sent_twice(loop, mini, helpers):
    """Every block twice, then all of it again: staged once. Of what is active already, nothing happens."""
    since, refused = len(loop.events), loop.status().reconstructors_refused
    other = replace(mini.b, gain=0.45)
    blocks = [block for block in helpers.blocks_of(other) for _ in range(2)]
    loop.publish(helpers.manifest_of(other), blocks)
    loop.status(lambda status: status.staged == other.id)
    for again in (other, mini.a):
        loop.publish(helpers.manifest_of(again), helpers.blocks_of(again))
    loop.publish(helpers.manifest_of(mini.b), helpers.blocks_of(mini.b))
    staged: list[int] = []

    def all_told() -> bool:
        staged[:] = [event.reconstructor for event in loop.events[since:] if event.kind == HrtcEvent.STAGED]
        return mini.b.id in staged

    loop.until(all_told)
    assert staged == [other.id, mini.b.id]
    assert loop.status().reconstructors_refused == refused


@pytest.fixture(scope="module")
def staging(start, wired, first_matrix, mini, helpers, tmp_path_factory):
    """A closed loop beside a check that goes on until ``done`` is there; the HRTC is asked for SCHED_FIFO."""
    done = tmp_path_factory.mktemp("staging") / "done"
    core = min(os.sched_getaffinity(0))
    parameters = f"reconstructor:={first_matrix}", "fifo_priority:=5", f"cores:='{core}'", "threads:=1"
    process = start("staging", *parameters, first=("-c", LONG_CHECK, str(done)))
    made = wired("staging")
    made.operator.close_loop(True)
    made.run(5)
    long = replace(mini.b, label="long")
    made.publish(helpers.manifest_of(long), helpers.blocks_of(long))
    process.wait_for("staging on thread")
    (thread,) = re.findall(r"staging on thread (\d+)\.", process.output)
    yield SimpleNamespace(wire=made, process=process, thread=int(thread), core=core, done=done, long=long)
    done.touch()
    assert process.terminate() == 0, process.output


def test_nobody_waits_for_a_long_check(staging):
    """Services, parameters and status answer, frames go on; in the end it is staged and can be committed."""
    made = staging.wire
    sensor = made.layout.sensors[0].name
    with pytest.raises(OperatorError, match="no reconstructor is staged"):
        made.operator.commit(staging.long.id, staging.long.sha256)
    with pytest.raises(OperatorError, match="no reconstructor is kept as the previous one"):
        made.operator.commit(staging.long.id, staging.long.sha256, roll_back=True)
    first, _ = made.operator.close_sensors([sensor], True)
    assert first == made.next
    assert made.run(3) == [Verdict.HOLD_CLOSED] * 3
    made.operator.close_sensors([sensor], False)
    made.operator.change_parameters({"leak": "0.01"})
    assert made.run(3) == [Verdict.OK] * 3
    made.operator.flatten()
    assert (made.status().loop_state, made.status().staged) == (HrtcEvent.FLAT, 0)
    staging.done.touch()
    made.status(lambda status: status.staged == staging.long.id)
    made.operator.commit(staging.long.id, staging.long.sha256)
    made.run(3)
    assert (made.commands[-1].reconstructor, made.status().previous) == (staging.long.id, made.mini.a.id)


def test_what_stages_does_not_run_at_the_loops_priority(staging):
    realtime = staging.wire.status().realtime
    if "SCHED_FIFO 5" not in realtime:
        pytest.skip("the system refuses SCHED_FIFO (RLIMIT_RTPRIO)")
    assert os.sched_getscheduler(staging.process.pid) == os.SCHED_FIFO
    assert os.sched_getscheduler(staging.thread) == os.SCHED_OTHER
    others = os.sched_getaffinity(0) - {staging.core} or {staging.core}
    assert os.sched_getaffinity(staging.thread) == others
    assert f"staging normal scheduling, cores {','.join(map(str, sorted(others)))}" in realtime


@pytest.mark.slow
def test_a_matrix_that_is_half_sent_is_given_up(loop, mini, helpers):
    since, before = len(loop.events), loop.status()
    half = replace(mini.b, gain=0.4)
    loop.publish(helpers.manifest_of(half), helpers.blocks_of(half)[:2])
    assert loop.run(20) == [Verdict.OK] * 20
    assert loop.event(HrtcEvent.REFUSED, since).text == "2 of 4 blocks never came"
    assert loop.status().staged == before.staged
    loop.publish(helpers.manifest_of(half), helpers.blocks_of(half))
    loop.status(lambda status: status.staged == half.id)


# -- signals ---------------------------------------------------------------------------------------------------------


SHUTDOWN = Transition(id=Transition.TRANSITION_INACTIVE_SHUTDOWN, label="shutdown")
ROADS: dict[str, tuple[str | Transition, ...]] = {
    "unconfigured": (),
    "inactive": ("configure",),
    "active": ("configure", "activate"),
    "stopped": ("configure", "activate", "deactivate"),
    "cleaned up": ("configure", "cleanup"),
    "finalized": ("configure", SHUTDOWN),
}
ENDS = {"SIGINT": "interrupt", "SIGTERM": "terminate"}


def assert_ends(process: Any, signal: str) -> None:
    assert getattr(process, ENDS[signal])() == 0, process.output
    assert "Traceback" not in process.output


def assert_flat_at_the_end(loop: Wire, process: Any, signal: str) -> None:
    """The signal comes in the middle of a frame, and frames go on: one flat command, and no other after it."""
    k = loop.next
    loop.send(*loop.messages(k)[:2])
    assert_ends(process, signal)
    loop.send(*loop.messages(k + 1))
    loop.until(lambda: loop.commands[-1].frame >= k)
    flat = loop.commands[-1]
    assert (flat.frame, flat.verdict, flat.loop_state) == (k, Verdict.OPEN, HrtcEvent.OPEN)
    assert not flat.commands.any()


def test_a_second_hrtc_is_not_activated_beside_one_that_lives(
    start, start_shared_process, wired, matrix_file, first_matrix
):
    """It says why; killed, the first one is in its way no longer, though the middleware still counts it."""
    first = start("pair", f"reconstructor:={first_matrix}")
    loop = wired("pair")
    make_sure_it_is_closed(loop)
    second = start_shared_process(
        *("-m", "srtomo_rtc.node", "--ros-args", "-r", "__ns:=/pair", "-r", "hrtc:__node:=second"),
        *("-p", "system:=mini", "-p", f"interaction_matrix:={matrix_file}"),
    )

    def ask(label: str) -> bool:
        request = ChangeState.Request(transition=Transition(id=TRANSITIONS[label], label=label))
        return bool(loop.operator.call(ChangeState, "second/change_state", request).success)

    assert ask("configure")
    while ask("activate"):  # before discovery has shown it the first one (docs/faults.md)
        assert ask("deactivate")
    second.wait_for("another HRTC is active in namespace /pair: deactivate or end it first")
    assert "Traceback" not in second.output
    loop.status(lambda status: status.state == "inactive")
    assert loop.run(20) == [Verdict.OK] * 20  # one command each
    first.kill()
    assert loop.operator.count_publishers(wire.COMMAND.name) == 2
    assert ask("activate")
    loop.status(lambda status: status.state == "active")
    assert second.terminate() == 0, second.output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("state", "signal"),
    # SIGTERM in the first three: tests/rtc/test_hrtc_node.py
    [(state, "SIGINT") for state in ROADS] + [(state, "SIGTERM") for state in ("stopped", "cleaned up", "finalized")],
)
def test_a_signal_in_every_state(start, ros, state, signal):
    namespace = f"{signal}_{state}".replace(" ", "_").lower()
    process, operator = start(namespace), Operator(namespace)
    for transition in ROADS[state]:
        if isinstance(transition, str):
            operator.transition(transition)
        else:
            request = ChangeState.Request(transition=transition)
            assert operator.call(ChangeState, "hrtc/change_state", request).success
    assert operator.state() == {"stopped": "inactive", "cleaned up": "unconfigured"}.get(state, state)
    assert_ends(process, signal)
    operator.destroy_node()


@pytest.mark.slow
@pytest.mark.parametrize("signal", ENDS)
def test_a_signal_while_it_is_configured(start, ros, signal):
    namespace = f"configuring_{signal}".lower()
    process, operator = start(namespace), Operator(namespace)
    client = operator.create_client(ChangeState, "hrtc/change_state")
    assert client.wait_for_service(PATIENCE)
    client.call_async(ChangeState.Request(transition=Transition(id=1, label="configure")))
    assert_ends(process, signal)
    operator.destroy_node()


@pytest.mark.slow
def test_sigterm_while_it_runs(start, wired, first_matrix):
    process = start("term_running", f"reconstructor:={first_matrix}")
    running = wired("term_running")
    running.operator.close_loop(True)
    assert running.run(20)[-1] == Verdict.OK
    assert_flat_at_the_end(running, process, "SIGTERM")


def test_sigint_while_it_runs(loop, begun):
    """The last test: it ends the HRTC of all the others."""
    begun.ended = True
    assert_flat_at_the_end(loop, begun.process, "SIGINT")
