"""The frame path over ROS: without the interpreter, without allocation, and with the bytes of the path in Python."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import save_interaction_matrix
from srtomo_core.system import load_system
from srtomo_core.wire import SlopeFrameWriter

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from msgs_schema.msg import DmCommand, SlopeFrame  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402

from srtomo_ops.operator import Operator  # noqa: E402

HERE = Path(__file__).parent
LAYOUT = Layout(load_system("mini"))
SESSION = 5


class Sensor:
    """Publishes slopes of ``mini`` and takes the commands."""

    def __init__(self, namespace: str = "") -> None:
        self.node = Node("sensor", namespace=namespace)
        self._slopes = self.node.create_publisher(
            SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(wire.SLOPES.depth_at(2000)))
        )
        self._commands = self.node.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos()), raw=True
        )
        self._writer = SlopeFrameWriter(
            "all", SESSION, LAYOUT.fingerprint, 0, len(LAYOUT.sensors), LAYOUT.n_slopes // 2
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
def sensor(namespace: str = ""):
    rclpy.init()
    made = Sensor(namespace)
    try:
        yield made
    finally:
        made.node.destroy_node()
        rclpy.shutdown()


def longest_wait(start_process, path: str, seconds: float) -> tuple[float, int]:
    """Of a frame while the HRTC's interpreter is held, s; and how many frames were answered meanwhile."""
    with sensor() as own:
        hrtc = start_process(HERE / "held_interpreter.py", path, str(seconds))
        hrtc.wait_for("ready")
        own.wait_matched()
        times = []
        while "held from" not in hrtc.output:
            sent = time.monotonic_ns()
            own.send(len(times))
            own.answer(len(times))
            times.append((sent, time.monotonic_ns()))
            time.sleep(0.002)
        assert hrtc.wait() == 0, hrtc.output
    words = next(line for line in hrtc.output.splitlines() if line.startswith("held")).split()
    first, last = int(words[2]), int(words[4])
    waits = [(b - a) * 1e-9 for a, b in times if b > first and a < last]
    return max(waits), len(waits)


def test_frames_pass_while_the_interpreter_is_held(start_process):
    """Another thread sits in a C call without giving the lock up, and collects: every frame is answered meanwhile."""
    wait, frames = longest_wait(start_process, "compiled", 3.0)
    assert wait < 1.0
    assert frames > 100


@pytest.mark.slow
def test_the_path_in_python_waits_for_the_interpreter(start_process):
    """What the other is for; and that its test would fail without it."""
    wait, _ = longest_wait(start_process, "rclpy", 1.5)
    assert wait > 1.0


@contextmanager
def hrtc(start_process, folder: Path, *parameters: str):
    """An active node, with a sensor on its topics."""
    if not (folder / "g.npz").exists():
        zeros = np.zeros((LAYOUT.n_slopes, LAYOUT.n_commands))
        save_interaction_matrix(folder / "g.npz", zeros, LAYOUT.fingerprint, {})
    words = ["-p", "system:=mini", "-p", f"interaction_matrix:={folder / 'g.npz'}"]
    for parameter in parameters:
        words += ["-p", parameter]
    process = start_process("-m", "srtomo_rtc.node", "--ros-args", *words)
    with sensor() as own:
        operator = Operator()
        operator.transition("configure")
        operator.transition("activate")
        own.wait_matched()
        yield process, own, operator
        operator.destroy_node()


@pytest.mark.slow
def test_both_paths_give_the_same_bytes(start_process, tmp_path):
    """But for the latency, which is of the clock."""
    answers = []
    for path in ("compiled", "rclpy"):
        with hrtc(start_process, tmp_path, f"frame_path:={path}") as (process, own, operator):
            found = []
            for frame in range(20):
                own.send(frame, np.nan if frame == 7 else frame * 1e-8)
                command = bytearray(own.answer(frame))
                command[-4 * LAYOUT.n_commands - 8 : -4 * LAYOUT.n_commands - 4] = bytes(4)
                found.append(bytes(command))
            answers.append(found)
            operator.spin(0.3)
            assert f"frame path {path}, " in operator.hrtc.realtime
            assert process.terminate() == 0, process.output
    assert answers[0] == answers[1]


def test_flat_comes_at_once_after_sigterm(start_process, mini, tmp_path):
    """Not when the executor looks next, and not lost with its publisher."""
    save_interaction_matrix(tmp_path / "g.npz", mini.G, LAYOUT.fingerprint, {})
    mini.a.save(tmp_path / "r.npz")
    with hrtc(start_process, tmp_path, f"reconstructor:={tmp_path / 'r.npz'}") as (process, own, operator):
        operator.close_loop(True)
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


@pytest.mark.parametrize("frames", [1000, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.timeout(900)])])
def test_frames_allocate_nothing(start_process, tmp_path, monkeypatch, frames):
    """Whatever their number, the frame path's own code asks for no memory."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler here")
    counter, told = tmp_path / "count.so", tmp_path / "allocations"
    source = HERE / "count_allocations.c"
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", counter, source, "-ldl"], check=True)
    monkeypatch.setenv("LD_PRELOAD", str(counter))
    monkeypatch.setenv("ALLOCATIONS", str(told))
    with hrtc(start_process, tmp_path) as (process, own, _):
        for frame in range(frames):
            own.send(frame)
            own.answer(frame)
        assert process.terminate() == 0, process.output
    ours, middleware, takes = map(int, told.read_text().split())
    assert takes >= frames and middleware > 0
    print(f"{frames} frames: {ours} allocations by srtomo, {middleware / frames:.1f} a frame by the middleware")
    assert ours == 0
