"""The HRTC as a real process, with plant and SRTC as others: one run in lockstep, whose traces many tests look at."""

from __future__ import annotations

import math
import os
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, save_interaction_matrix
from srtomo_core.system import load_system
from srtomo_ops.simulate import program_of, run
from srtomo_rtc.events import PROGRAM_KINDS, EventKind
from srtomo_rtc.loop import Settings, Verdict
from srtomo_rtc.vmm import instructions
from srtomo_sim.mirror import interaction_matrix
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from msgs_schema.msg import DmCommand, HrtcEvent
from msgs_schema.srv import PublishReconstructor, SetStaticShape, SwapReconstructor
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool

from srtomo_ops.operator import Operator, OperatorError

FRAMES, SEED = 1500, 11
CREW = min(2, len(os.sched_getaffinity(0)))  # threads of the loop of one of the HRTCs
SYSTEM = load_system("mini")
LAYOUT = Layout(SYSTEM)

# An SRTC that never gets round to the last blocks of a reconstructor.
HALTING_SRTC = """
import sys
from srtomo_srtc import node
send = node.SrtcNode._send_blocks
def halt(self, reconstructor, only):
    if only is None:
        send(self, reconstructor, {0, 2})
node.SrtcNode._send_blocks = halt
sys.exit(node.main(["--ros-args", "-p", "system:=mini", "-p", 'priors:=["ground"]']))
"""


class Listener:
    """Keeps what the HRTC publishes; messages wait in the readers' queues until they are asked for."""

    def __init__(self, namespace: str = "") -> None:
        self.node = Node("listener", namespace=namespace)
        self._commands = self.node.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos(2 * FRAMES)), raw=True
        )
        self._events = self.node.create_subscription(
            HrtcEvent, wire.EVENT.name, lambda _: None, QoSProfile(**wire.EVENT.qos())
        )
        self.commands: list[wire.DmCommand] = []
        self.events: list[HrtcEvent] = []

    def listen(self) -> None:
        while (taken := self._commands.handle.take_message(DmCommand, True)) is not None:
            self.commands.append(wire.read_dm_command(taken[0]))
        while (taken := self._events.handle.take_message(HrtcEvent, False)) is not None:
            self.events.append(taken[0])

    def wait_for(self, wanted, timeout: float = 20.0) -> Any:
        """The first event that is as wanted."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            self.listen()
            for event in self.events:
                if wanted(event):
                    return event
            time.sleep(0.02)
        raise AssertionError(f"no such event among {[(event.kind, event.text) for event in self.events]}")


def wait_until(operator: Operator, condition, timeout: float = 20.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "what was waited for did not come"
        operator.spin(0.02)


def set_parameters(operator: Operator, **values) -> list[Any]:
    request = SetParameters.Request(
        parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    )
    return operator.call(SetParameters, "hrtc/set_parameters", request).results


def helpers_of(process) -> int:
    """Threads of the process that share the loop's products."""
    tasks = Path(f"/proc/{process.pid}/task")
    return sum((task / "comm").read_text().strip() == "srtomo-helper" for task in tasks.iterdir())


def answers(operator: Operator) -> bool:
    """Whether an SRTC answers: one that was killed is still known for a while, and does not."""
    with suppress(OperatorError):
        operator.call(PublishReconstructor, "srtc/publish", PublishReconstructor.Request(label="?"), timeout=0.5)
        return True
    return False


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("hrtc")
    save_interaction_matrix(path / "g.npz", interaction_matrix(SYSTEM, LAYOUT), LAYOUT.fingerprint, {})
    return path


@pytest.fixture(scope="module")
def start_hrtc(start_shared_process, folder):
    def start(namespace: str = "", *parameters: str, matrix: str = "g.npz"):
        words = ["--ros-args", "-p", "system:=mini", "-p", f"interaction_matrix:={folder / matrix}"]
        words += ["-r", f"__ns:=/{namespace}"] if namespace else []
        for parameter in parameters:
            words += ["-p", parameter]
        return start_shared_process("-m", "srtomo_rtc.node", *words)

    return start


@pytest.fixture(scope="module")
def ros(start_shared_process):
    rclpy.init()
    yield
    rclpy.shutdown()


@pytest.fixture(scope="module")
def others(start_hrtc, folder):
    """HRTCs that are not part of the run, each in its namespace; started together, for starting takes a while."""
    assert not (folder / "later.npz").exists()
    return SimpleNamespace(
        wrong_file=start_hrtc("wrong", matrix="later.npz"),
        fresh=start_hrtc("fresh"),
        cycled=start_hrtc("cycled", f"threads:={CREW}"),
    )


@pytest.fixture(scope="module")
def finished(ros, start_hrtc, start_shared_process, others, folder):
    """A run in lockstep through swaps and changes: all that was answered and said, and the processes, still up."""
    kept = folder / "kept.npz"
    hrtc = start_hrtc("", f"keep:={kept}", "fault_budget:=20")
    halting = start_shared_process("-c", HALTING_SRTC)
    plant = start_shared_process(
        *("-m", "srtomo_sim.node", "--ros-args", "-p", "system:=mini", "-p", "pace:=lockstep"),
        *("-p", f"frames:={FRAMES}", "-p", f"seed:={SEED}", "-p", f"result:={folder / 'result.npz'}"),
    )
    # six processes start at once
    operator, listener = Operator(patience=90.0), Listener()
    reconstructors: dict[bytes, Reconstructor] = {}
    said: dict[str, Any] = {}

    def commit(identity: int, sha256: bytes, **options) -> int:
        first = operator.commit(identity, sha256, **options)
        end = time.monotonic() + 10
        while not kept.exists() or Reconstructor.load(kept).sha256 != sha256:
            assert time.monotonic() < end
            time.sleep(0.01)
        reconstructors[sha256] = Reconstructor.load(kept)
        return first

    said["close unconfigured"] = operator.call(SetBool, "hrtc/close_loop", SetBool.Request(data=True), timeout=30)
    said["commit unconfigured"] = operator.call(SwapReconstructor, "hrtc/commit", SwapReconstructor.Request(id=1))
    operator.transition("configure")
    said["close inactive"] = operator.call(SetBool, "hrtc/close_loop", SetBool.Request(data=True))
    operator.transition("activate")
    said["close without a reconstructor"] = operator.call(SetBool, "hrtc/close_loop", SetBool.Request(data=True))

    # an SRTC dies in mid-transfer
    cut, cut_sha256 = operator.publish("ground")
    halting.kill()
    srtc = start_shared_process(
        *("-m", "srtomo_srtc.node", "--ros-args", "-p", "system:=mini", "-p", 'priors:=["ground", "file"]')
    )
    operator.spin(0.5)
    said["commit what was cut"] = operator.call(
        SwapReconstructor, "hrtc/commit", SwapReconstructor.Request(id=cut, sha256=list(cut_sha256))
    )
    said["staged after the cut"] = operator.hrtc.staged

    srtc.wait_for("built file")
    wait_until(operator, lambda: answers(operator))
    ground = operator.publish("ground")
    operator.wait_staged(ground[0])
    said["commit with another SHA-256"] = operator.call(
        SwapReconstructor, "hrtc/commit", SwapReconstructor.Request(id=ground[0], sha256=[1] * 32)
    )
    said["first frame of ground"] = commit(*ground)
    file = operator.publish("file")
    operator.wait_staged(file[0])
    operator.close_loop(True)
    # what is called while frames run is called (and refused) once before: a first call takes longer
    assert not operator.call(SetStaticShape, "hrtc/static_shape", SetStaticShape.Request(offset=[0.0])).success
    assert not set_parameters(operator, leak=-1.0)[0].successful
    plant.wait_for("sky 100 %")
    wait_until(operator, lambda: operator.hrtc.slope_publishers == 1 and operator.hrtc.command_readers == 2)
    operator.start_sim()
    wait_until(operator, lambda: operator.hrtc.frame > 10)
    said["first frame of file"] = commit(*file)
    offset = np.random.default_rng(1).standard_normal(LAYOUT.n_commands).astype("f4") * np.float32(2e-8)
    reference = (-interaction_matrix(SYSTEM, LAYOUT) @ offset).astype("f4")
    said["static shape"] = operator.call(
        SetStaticShape,
        "hrtc/static_shape",
        SetStaticShape.Request(offset=offset.tolist(), slope_reference=reference.tolist()),
    )
    said["leak"] = set_parameters(operator, leak=0.02)
    said["first frame of ground again"] = commit(*ground, roll_back=True)
    wait_until(operator, lambda: operator.sim is not None and operator.sim.frame == FRAMES - 1)
    wait_until(operator, lambda: operator.hrtc.frame == FRAMES - 1)
    operator.spin(0.2)
    listener.listen()
    status = operator.hrtc
    yield SimpleNamespace(
        operator=operator, listener=listener, commands=list(listener.commands), events=list(listener.events),
        status=status, said=said, reconstructors=reconstructors, hrtc=hrtc, srtc=srtc, plant=plant, ground=ground,
        file=file, others=others, folder=folder,
    )  # fmt: skip
    listener.node.destroy_node()
    operator.destroy_node()


# -- the run ---------------------------------------------------------------------------------------------------------


def test_every_frame_is_answered_once_and_in_order(finished):
    assert [command.frame for command in finished.commands] == list(range(FRAMES))
    assert {command.verdict for command in finished.commands} == {Verdict.OK}
    status = finished.status
    assert (status.commands, status.held_missing + status.held_incomplete + status.held_behind) == (FRAMES, 0)
    assert status.dropped_malformed == status.dropped_session == status.dropped_late == 0
    assert 0 < status.latency_p50 <= status.latency_p99 <= status.latency_max
    assert status.latency_p50 <= status.frame_latency_p50 <= status.frame_latency_max
    assert min(status.latency_std, status.frame_latency_std) > 0
    assert 0 < math.hypot(status.offload_tip, status.offload_tilt) < 1e-5
    assert status.changes_lost == status.fallback == status.loop_opened_by_silence == 0


def test_commands_are_those_of_the_loop_in_lockstep_bit_for_bit(finished):
    """The same plant and control law without ROS, with each change at the frame that its event names."""
    programs = {}
    for event in finished.events:
        if event.kind in PROGRAM_KINDS and event.reconstructor:
            settings = Settings(
                id=event.settings, offset=np.array(event.offset, "f4"), polc=event.polc, leak=event.leak,
                slope_reference=np.array(event.slope_reference, "f4"), relaxation=event.relaxation,
                command_limit=event.command_limit, fault_budget=event.fault_budget,
            )  # fmt: skip
            reconstructor = finished.reconstructors[bytes(event.sha256)]
            programs[event.first_frame] = program_of(LAYOUT, reconstructor, settings)
    assert len(programs) == 5 and min(programs) == 0
    sky = prepare(SYSTEM, FRAMES, SEED, science_every=5)
    plant = Plant(SYSTEM, sky)
    expected = []
    take = plant.command

    def remember(frame, commands):
        expected.append(commands.copy())
        take(frame, commands)

    plant.command = remember
    errors = run(plant, programs)
    differing = [
        command.frame
        for command, alone in zip(finished.commands, expected, strict=True)
        if command.commands.tobytes() != alone.tobytes()
    ]
    assert differing == []
    with np.load(finished.folder / "result.npz") as result:
        assert result["high_order"] == pytest.approx(errors.high_order, rel=1e-6)
        assert result["late_commands"] == 0


def test_each_command_names_its_reconstructor_and_settings(finished):
    """From the first frame that the services told, and the events say."""
    said = finished.said
    swaps = [said["first frame of ground"], said["first frame of file"], said["first frame of ground again"]]
    assert swaps[0] == 0 < swaps[1] < swaps[2] < FRAMES
    made_by = [command.reconstructor for command in finished.commands]
    ground, file = finished.ground[0], finished.file[0]
    assert made_by == ([ground] * swaps[1] + [file] * (swaps[2] - swaps[1]) + [ground] * (FRAMES - swaps[2]))
    told = [
        (event.kind, event.first_frame)
        for event in finished.events
        if event.kind in (EventKind.COMMIT, EventKind.ROLLBACK)
    ]
    assert told == [(EventKind.COMMIT, swaps[0]), (EventKind.COMMIT, swaps[1]), (EventKind.ROLLBACK, swaps[2])]
    shape = said["static shape"]
    assert shape.success and shape.message == "static shape"
    by_settings = [command.settings for command in finished.commands]
    assert by_settings.index(shape.settings) == shape.first_frame
    assert sorted(set(by_settings)) == [1, 2, 3] and by_settings == sorted(by_settings)


def test_a_parameter_change_is_an_event(finished):
    assert [result.successful for result in finished.said["leak"]] == [True]
    (event,) = [e for e in finished.events if e.kind == EventKind.SETTINGS and e.text == "leak = 0.02"]
    assert event.leak == pytest.approx(0.02) and event.settings == 3
    assert finished.commands[event.first_frame].settings == 3
    assert finished.commands[event.first_frame - 1].settings == 2


def test_events_tell_the_whole_story_in_order(finished):
    # a slow machine gives the cut transfer up before the next one begins
    gone = "of 16 blocks never came"
    kinds = [EventKind(e.kind) for e in finished.events if e.kind != EventKind.STAGED and gone not in e.text]
    before = kinds.index(EventKind.SESSION)
    assert kinds[:before] == [
        EventKind.LIFECYCLE,
        EventKind.LIFECYCLE,
        EventKind.REFUSED,  # of what was cut
        EventKind.REFUSED,  # of another SHA-256
        EventKind.COMMIT,
        EventKind.LOOP,
    ]
    assert kinds[before + 1 :] == [EventKind.COMMIT, EventKind.SETTINGS, EventKind.SETTINGS, EventKind.ROLLBACK]
    session = finished.events[[event.kind for event in finished.events].index(EventKind.SESSION)]
    assert (session.first_frame, session.loop_state, session.delay) == (0, HrtcEvent.CLOSED, 2.0)
    assert {command.session for command in finished.commands} == {session.session}


def test_refusals_with_reasons(finished):
    said = finished.said
    for name, reason in (
        ("close unconfigured", "the HRTC is not active"),
        ("commit unconfigured", "the HRTC is not configured"),
        ("close inactive", "the HRTC is not active"),
        ("close without a reconstructor", "no reconstructor is active: commit one first"),
        ("commit what was cut", "no reconstructor is staged"),
    ):
        assert (said[name].success, said[name].message) == (False, reason)
    assert not said["commit with another SHA-256"].success
    assert "has SHA-256" in said["commit with another SHA-256"].message


def test_an_srtc_killed_in_mid_transfer_changes_nothing(finished):
    """Two of sixteen blocks had come; the next SRTC's transfer of the same reconstructor took over."""
    assert finished.said["staged after the cut"] == 0
    staged = [event for event in finished.events if event.kind == EventKind.STAGED]
    assert [event.reconstructor for event in staged] == [finished.ground[0], finished.file[0]]
    assert "stability 0." in staged[0].text and "scale" in staged[0].text
    # all that the SRTC builds came along
    kept = finished.reconstructors[finished.ground[1]]
    assert [closure.sensors for closure in kept.closures] == [0b1, 0b10, 0b100] and kept.low_order is not None


# -- afterwards, on what still runs ----------------------------------------------------------------------------------


def test_services_refuse_what_they_do_not_have(finished):
    operator = finished.operator
    for service, where in (("hrtc/commit", "staged"), ("hrtc/roll_back", "kept as the previous one")):
        with pytest.raises(OperatorError, match=f"no reconstructor is {where}|is not {where}"):
            operator.commit(5, bytes(32), roll_back=service.endswith("back"))
    refused = finished.listener.wait_for(lambda event: event.kind == EventKind.REFUSED and "previous" in event.text)
    assert refused.reconstructor == 0  # of the SHA-256 that was asked for
    for request, reason in (
        (SetStaticShape.Request(offset=[0.0] * 3), "offset: expected 101 finite values, got 3"),
        (SetStaticShape.Request(slope_reference=[float("nan")] * 286), "slope_reference: expected 286 finite values"),
    ):
        response = operator.call(SetStaticShape, "hrtc/static_shape", request)
        assert not response.success and reason in response.message
    response = operator.call(PublishReconstructor, "srtc/publish", PublishReconstructor.Request(label="none such"))
    assert not response.success and "ground, file" in response.message


@pytest.mark.parametrize(
    "name, value, reason",
    [
        ("leak", 1.0, "out of range"),
        ("leak", -0.1, "out of range"),
        ("leak", float("nan"), "out of range"),
        ("relaxation", 0.0, "out of range"),
        ("command_limit", 0.0, "out of range"),
        ("command_limit", float("inf"), "out of range"),
        ("fault_budget", 0, "out of range"),
        ("polc", 1.0, "Wrong parameter type"),
        ("leak", "much", "Wrong parameter type"),
        ("system", "gnao_ltao", "read-only"),
        ("max_behind", 7, "read-only"),
        ("keep", "/elsewhere", "read-only"),
    ],
)
def test_parameters_are_refused_with_a_reason(finished, name, value, reason):
    (result,) = set_parameters(finished.operator, **{name: value})
    assert not result.successful and reason in result.reason
    finished.listener.listen()
    settings = [event.settings for event in finished.listener.events if event.kind == EventKind.SETTINGS]
    assert max(settings) == 3


def test_deactivating_leaves_the_mirror_flat(finished):
    """One more command, after the last frame, with the static shape alone; then a second life."""
    operator, listener = finished.operator, finished.listener
    operator.transition("deactivate")
    end = time.monotonic() + 5
    while len(listener.commands) == FRAMES and time.monotonic() < end:
        listener.listen()
        time.sleep(0.02)
    (flat,) = listener.commands[FRAMES:]
    assert (flat.frame, flat.verdict, flat.loop_state, flat.sensors) == (FRAMES, Verdict.OPEN, 0, 0)
    offset = next(event.offset for event in reversed(finished.events) if event.kind in PROGRAM_KINDS)
    assert flat.commands.tolist() == list(offset)
    loop = listener.wait_for(lambda event: event.kind == EventKind.LOOP and event.loop_state == HrtcEvent.OPEN)
    assert loop.first_frame == FRAMES
    operator.transition("activate")
    operator.close_loop(True)
    assert operator.state() == "active"


def test_sigterm_while_active_and_closed(finished):
    started = time.monotonic()
    assert finished.hrtc.terminate() == 0, finished.hrtc.output
    assert time.monotonic() - started < 5
    assert "Traceback" not in finished.hrtc.output


def test_a_late_hrtc_gets_the_current_reconstructor(finished, start_hrtc):
    """The SRTC published before this one was there; the blocks are latched. Nothing is committed by that."""
    finished.hrtc.terminate()
    late = start_hrtc()
    operator = finished.operator
    end = time.monotonic() + 30
    while "hrtc" not in operator.get_node_names() or operator.hrtc.state == "active":
        assert time.monotonic() < end
        operator.spin(0.05)
    operator.transition("configure")
    wait_until(operator, lambda: operator.hrtc.staged == finished.file[0])
    assert (operator.hrtc.reconstructor, operator.hrtc.previous) == (0, 0)
    assert late.terminate() == 0, late.output


def test_a_kept_reconstructor_is_there_after_a_restart(finished, start_hrtc):
    again = start_hrtc("kept", f"keep:={finished.folder / 'kept.npz'}")
    operator = Operator("kept")
    operator.transition("configure")
    wait_until(operator, lambda: operator.hrtc is not None and operator.hrtc.reconstructor == finished.ground[0])
    operator.destroy_node()
    assert again.terminate() == 0, again.output


# -- others ----------------------------------------------------------------------------------------------------------


def test_a_missing_or_wrong_file_fails_in_one_line_and_the_node_stays_usable(ros, others, folder):
    process, operator = others.wrong_file, Operator("wrong")
    path = folder / "later.npz"
    with pytest.raises(OperatorError, match="configure"):
        operator.transition("configure")
    process.wait_for(f"{path}: No such file or directory")
    path.write_text("not a matrix")
    with pytest.raises(OperatorError, match="configure"):
        operator.transition("configure")
    process.wait_for(f"{path}: not a srtomo file")
    save_interaction_matrix(path, np.zeros((2, 2)), LAYOUT.fingerprint, {})
    with pytest.raises(OperatorError, match="configure"):
        operator.transition("configure")
    process.wait_for("G_cal: expected shape (286, 101), got (2, 2)")
    save_interaction_matrix(path, interaction_matrix(SYSTEM, LAYOUT), bytes(32), {})
    with pytest.raises(OperatorError, match="configure"):
        operator.transition("configure")
    process.wait_for("made for another instrument")
    assert operator.state() == "unconfigured"
    assert sum("[ERROR]" in line for line in process.output.splitlines()) == 4
    assert "Traceback" not in process.output
    save_interaction_matrix(path, interaction_matrix(SYSTEM, LAYOUT), LAYOUT.fingerprint, {})
    operator.transition("configure")
    operator.transition("activate")
    assert operator.state() == "active"
    wait_until(operator, lambda: operator.count_subscribers(wire.SLOPES.name) == 1)  # none was left over
    assert process.terminate() == 0, process.output  # active, open
    operator.destroy_node()


def test_round_and_round_the_lifecycle(ros, others):
    process, operator = others.cycled, Operator("cycled")
    for _ in range(2):
        for transition in ("configure", "activate", "deactivate", "activate", "deactivate", "cleanup"):
            operator.transition(transition)
    assert helpers_of(process) == 0
    # an activation that is not possible now: refused by its label; an id alone makes rclpy raise
    with pytest.raises(OperatorError, match="activate"):
        operator.transition("activate")
    with pytest.raises(OperatorError, match="no answer"):
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
        operator.call(ChangeState, "hrtc/change_state", request, timeout=0.5)
    assert operator.count_subscribers(wire.SLOPES.name) == 0
    operator.transition("configure")
    wait_until(operator, lambda: operator.hrtc is not None and operator.hrtc.state == "inactive")
    realtime = operator.hrtc.realtime
    assert realtime.count("SCHED_FIFO") == 1
    assert f"{instructions()}, {CREW} thread{'s' * (CREW > 1)} (asked for); measured: float32 with" in realtime
    assert "int16 with" in realtime and realtime.count("affinity of the helpers cores") == (CREW > 1)
    assert helpers_of(process) == CREW - 1
    assert process.terminate() == 0, process.output  # inactive
    assert process.output.count("Traceback") == 1
    operator.destroy_node()


def test_sigterm_before_anything_was_configured(ros, others):
    operator = Operator("fresh")
    assert operator.state() == "unconfigured"
    started = time.monotonic()
    assert others.fresh.terminate() == 0, others.fresh.output
    assert time.monotonic() - started < 5
    operator.destroy_node()


def test_the_environment_of_these_tests_is_their_own(ros, start_shared_process):
    assert os.environ["FASTDDS_BUILTIN_TRANSPORTS"] == "SHM"
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
