"""The frame path over ROS: without the interpreter, without allocation, and with the bytes of the path in Python."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, save_interaction_matrix
from srtomo_core.system import load_system
from srtomo_core.wire import SlopeFrameWriter

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from msgs_schema.msg import DmCommand, SlopeFrame  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402

from srtomo_ops.bench.latency import Problem  # noqa: E402
from srtomo_ops.bench.soak_drive import Sending  # noqa: E402
from srtomo_ops.operator import Operator  # noqa: E402
from srtomo_rtc.loop import Verdict  # noqa: E402

HERE = Path(__file__).parent
LAYOUT = Layout(load_system("mini"))
SESSION = 5


def slopes_of(frame: int, n: int = LAYOUT.n_slopes) -> np.ndarray:
    """Of some eight frames that follow each other for ever, each with its opposite after it; rad."""
    sign = -1 if frame % 2 else 1
    return sign * 1e-7 * np.random.default_rng(frame // 2 % 4).standard_normal(n)


class Sensor:
    """Publishes slopes of all sensors and takes the commands."""

    def __init__(self, layout: Layout) -> None:
        self.node = Node("sensor")
        self._slopes = self.node.create_publisher(
            SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(wire.SLOPES.depth_at(2000)))
        )
        self._commands = self.node.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos()), raw=True
        )
        self._writer = SlopeFrameWriter(
            "all", SESSION, layout.fingerprint, 0, len(layout.sensors), layout.n_slopes // 2
        )

    def wait_matched(self) -> None:
        end = time.monotonic() + 30
        while not (self._slopes.get_subscription_count() and self._commands.handle.get_publisher_count()):
            assert time.monotonic() < end, "no HRTC"
            time.sleep(0.02)
        time.sleep(0.3)  # and the other side's part of it

    def send(self, frame: int, slopes=1e-7) -> None:
        self._writer.values[:] = slopes
        self._slopes.publish(self._writer.write(frame, frame, wire.MIRROR_UNKNOWN, wire.MIRROR_UNKNOWN, 1.0))

    def answer(self, frame: int, timeout: float = 20.0) -> bytes:
        """The command of a frame, which must be the next one."""
        end = time.monotonic() + timeout
        while (taken := self._commands.handle.take_message(DmCommand, True)) is None:
            assert time.monotonic() < end, f"frame {frame} was not answered"
            time.sleep(0.0001)
        assert wire.read_dm_command(taken[0]).frame == frame
        return taken[0]


@contextmanager
def sensor(layout: Layout = LAYOUT):
    rclpy.init()
    made = Sensor(layout)
    try:
        yield made
    finally:
        made.node.destroy_node()
        rclpy.shutdown()


class Turns(NamedTuple):
    """What held_interpreter.py says of the loop while the interpreter was free, or held."""

    seconds: float
    frames: int
    misses: int


def run_held(start_process, path: str, mini, folder: Path, turns: int) -> tuple[Turns, Turns]:
    """Frames one after the other through a closed loop while the interpreter is free, and while it is held."""
    mini.a.save(folder / "r.npz")
    with sensor() as own:
        hrtc = start_process(HERE / "held_interpreter.py", path, folder / "r.npz", str(turns))
        hrtc.wait_for("ready")
        own.wait_matched()
        frame = 0
        while "done" not in hrtc.output:
            own.send(frame, slopes_of(frame))
            command = wire.read_dm_command(own.answer(frame))
            assert (command.verdict, command.loop_state) == (Verdict.OK, 1) and command.commands.any()
            frame += 1
            time.sleep(0.002)
        assert hrtc.wait() == 0, hrtc.output
    words = {line.split()[0]: line.split()[1:] for line in hrtc.output.splitlines() if line[:4] in ("free", "held")}
    free, held = (Turns(float(a), int(b), int(c)) for a, b, c in (words["free"], words["held"]))
    print(f"{path}: interpreter free {free}, held {held}")
    return free, held


def test_frames_keep_their_deadline_while_the_interpreter_is_held(start_process, mini, tmp_path):
    """Another thread sits in a C call without giving the lock up, and collects: frames go on as they do without that.

    Beside the same loop with its interpreter free, in turns: whatever else the machine does delays both.
    """
    free, held = run_held(start_process, "compiled", mini, tmp_path, 3)
    assert free.frames > 50
    assert held.frames / held.seconds > 0.5 * free.frames / free.seconds
    assert held.misses / held.frames < 2 * free.misses / free.frames + 0.05


@pytest.mark.slow
def test_the_path_in_python_waits_for_the_interpreter(start_process, mini, tmp_path):
    """What the other is for; and that its test would fail without it."""
    free, held = run_held(start_process, "rclpy", mini, tmp_path, 3)
    assert free.frames > 30
    assert held.frames / held.seconds < 0.1 * free.frames / free.seconds


@contextmanager
def hrtc(start_process, folder: Path, problem: Any, *parameters: str):
    """An active node with the reconstructor ``problem.c`` and its loop closed, and a sensor on its topics."""
    layout = problem.layout
    save_interaction_matrix(folder / "g.npz", problem.G, layout.fingerprint, {})
    problem.c.save(folder / "r.npz")
    words = [f"system:={problem.system.name}", f"interaction_matrix:={folder / 'g.npz'}"]
    words += [f"reconstructor:={folder / 'r.npz'}", *parameters]
    process = start_process("-m", "srtomo_rtc.node", "--ros-args", *[w for p in words for w in ("-p", p)])
    with sensor(layout) as own:
        operator = Operator()
        operator.transition("configure")
        operator.transition("activate")
        own.wait_matched()
        operator.close_loop(True)
        yield process, own, operator
        operator.destroy_node()


def eventful_run(own: Sensor, operator: Operator, problem: Any, frames: int, without: int = -1) -> list[bytes]:
    """The commands of a closed loop that swaps to ``problem.b`` and back, and does without a sensor for a while.

    Frame ``without`` has a slope that is not a number, and is held.
    """
    closed = problem.layout.sensors[1].name
    sending = Sending(operator, problem.layout.n_commands)
    steps = {
        frames // 5: lambda: sending.send(problem.b),
        2 * frames // 5: lambda: (operator.wait_staged(problem.b.id), operator.commit(problem.b.id, problem.b.sha256)),
        3 * frames // 5: lambda: operator.commit(problem.c.id, problem.c.sha256, roll_back=True),
        7 * frames // 10: lambda: operator.close_sensors([closed], True),
        9 * frames // 10: lambda: operator.close_sensors([closed], False),
    }
    everything = (1 << len(problem.layout.sensors)) - 1
    answers = []
    for frame in range(frames):
        if frame in steps:
            steps[frame]()
        own.send(frame, np.nan if frame == without else slopes_of(frame, problem.layout.n_slopes))
        answers.append(own.answer(frame))
        command = wire.read_dm_command(answers[-1])
        assert command.loop_state == 1 and command.commands.any()
        if frame != without:
            assert command.verdict == Verdict.OK
            swapped = 2 * frames // 5 <= frame < 3 * frames // 5
            assert command.reconstructor == (problem.b if swapped else problem.c).id
            assert command.sensors == everything & ~(2 * (7 * frames // 10 <= frame < 9 * frames // 10))
    return answers


@pytest.mark.slow
def test_both_paths_give_the_same_bytes(start_process, mini, tmp_path):
    """But for the latency, which is of the clock."""
    answers = []
    for path in ("compiled", "rclpy"):
        with hrtc(start_process, tmp_path, mini, f"frame_path:={path}") as (process, own, operator):
            found = [bytearray(command) for command in eventful_run(own, operator, mini, 60, without=8)]
            for command in found:
                command[-4 * LAYOUT.n_commands - 8 : -4 * LAYOUT.n_commands - 4] = bytes(4)
            answers.append(found)
            operator.spin(0.3)
            assert f"frame path {path}, " in operator.hrtc.realtime
            assert process.terminate() == 0, process.output
    assert answers[0] == answers[1]


def test_flat_comes_at_once_after_sigterm(start_process, mini, tmp_path):
    """Not when the executor looks next, and not lost with its publisher."""
    with hrtc(start_process, tmp_path, mini) as (process, own, _):
        for frame in range(3):
            own.send(frame)
            assert wire.read_dm_command(own.answer(frame)).loop_state == 1
        os.kill(process.pid, signal.SIGTERM)
        begun = time.monotonic()
        flat = wire.read_dm_command(own.answer(3))
        assert (
            time.monotonic() - begun < 0.05
        )  # it takes 1 ms where there is nothing else to do; an executor's look 100
        assert (flat.verdict, flat.loop_state, flat.commands.any()) == (1, 0, False)
        assert process.wait() == 0, process.output


@pytest.fixture(scope="module")
def gnao():
    """As ``mini`` of conftest.py, of ``gnao_ltao_sr``: large enough for products to be shared among threads."""
    problem = Problem.of(load_system("gnao_ltao_sr"))
    normal = problem.G.T @ problem.G
    seen = problem.G.copy()
    seen[problem.layout.slopes_of(1)] = 0

    def least_squares(G: np.ndarray, damping: float) -> np.ndarray:
        return np.linalg.solve(G.T @ G + damping * np.linalg.norm(normal, 2) * np.eye(len(normal)), G.T)

    def reconstructor(label: str, damping: float, **closures: Any) -> Reconstructor:
        return Reconstructor.from_matrices(
            least_squares(problem.G, damping), problem.G, fingerprint=problem.layout.fingerprint, gain=0.5,
            command_limit=problem.layout.stroke, label=label, **closures,
        )  # fmt: skip

    b, c = reconstructor("b", 1e-2), reconstructor("c", 2e-2, closures={0b10: least_squares(seen, 2e-2)})
    return SimpleNamespace(system=problem.system, layout=problem.layout, G=problem.G, b=b, c=c)


@pytest.mark.parametrize(
    ("name", "frames", "threads"),
    [
        ("mini", 1000, 1),
        pytest.param("gnao", 100_000, 2, marks=[pytest.mark.slow, pytest.mark.timeout(1800)]),
    ],
)
def test_frames_allocate_nothing(start_process, request, tmp_path, monkeypatch, name, frames, threads):
    """Whatever their number, and whatever is swapped, the frame path's own code asks for no memory."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler here")
    if threads > len(os.sched_getaffinity(0)):
        pytest.skip(f"{threads} threads need as many cores")
    problem = request.getfixturevalue(name)
    counter, told = tmp_path / "count.so", tmp_path / "allocations"
    source = HERE / "count_allocations.c"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", counter, source, "-ldl"], check=True)
    monkeypatch.setenv("LD_PRELOAD", str(counter))
    monkeypatch.setenv("ALLOCATIONS", str(told))
    with hrtc(start_process, tmp_path, problem, f"threads:={threads}") as (process, own, operator):
        eventful_run(own, operator, problem, frames)
        assert process.terminate() == 0, process.output
    found = {key: int(value) for key, value in map(str.split, told.read_text().splitlines())}
    assert found["libraries"] == 2 and found["on_purpose"] > 1, "the counter is blind"
    assert found["takes"] >= frames and found["middleware"] > 0
    each = found["middleware"] / frames
    print(f"{frames} frames: {found['own']} allocations by srtomo, {each:.1f} a frame by the middleware")
    assert found["own"] == 0
