"""A laser closed and opened again in a running loop, with real nodes: what is lost, and what the wavefront error is."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.reconstructor import save_interaction_matrix
from srtomo_core.system import System, load_system
from srtomo_ops.simulate import program_of, run
from srtomo_rtc.loop import Verdict
from srtomo_sim.course import Change
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky, prepare
from srtomo_srtc.reconstructors import implicit

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from msgs_schema.msg import DmCommand, SlopeFrame  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402

from srtomo_ops.operator import Operator  # noqa: E402

SEED, EVERY = 5, 4
CLOSED = 1  # the sensor that is
DARK = "1 e/m2/s"  # a thousandth of an electron in a sub-aperture


class Trial(NamedTuple):
    """What happens when: the HRTC is told, the light goes, it comes back, the HRTC is told; then the last frame."""

    system: str
    closed: int
    dark: int
    light: int
    opened: int
    frames: int


MINI = Trial("mini", 30, 36, 200, 206, 240)
GNAO = Trial("gnao_ltao_sr", 60, 80, 700, 720, 900)


class Sensors:
    """The plant's sensors and mirrors on the wire, a frame when the one before it is answered."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self._layout = layout = plant.sky.layout
        self._writers = [
            wire.SlopeFrameWriter(place.name, 77, layout.fingerprint, w, 1, place.n_valid)
            for w, place in enumerate(layout.sensors)
        ]
        self._node = Node("sensors")
        self._slopes = self._node.create_publisher(
            SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(wire.SLOPES.depth_at(1000)))
        )
        self._commands = self._node.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos()), raw=True
        )

    def exposure(self, frame: int) -> int:
        """Publish a frame, wait for its answer, and obey it; the sensors that are in it."""
        slopes, on = self.plant.measure(frame), self.plant.on_mirror(frame)
        for w, writer in enumerate(self._writers):
            writer.values[:] = slopes[self._layout.slopes_of(w)]
            self._slopes.publish(writer.write(time.time_ns(), frame, on.frame, on.before, on.fraction))
        end = time.monotonic() + 60
        while (taken := self._commands.handle.take_message(DmCommand, True)) is None:
            assert time.monotonic() < end, f"no command for frame {frame}"
            time.sleep(0.0002)
        command = wire.read_dm_command(taken[0])
        assert (command.frame, command.verdict) == (frame, Verdict.OK)
        self.plant.command(frame, command.commands)
        return command.sensors

    def destroy(self) -> None:
        self._node.destroy_node()


def without_the_sensor(system: System) -> System:
    others = tuple(sensor for w, sensor in enumerate(system.sensors) if w != CLOSED)
    return system.model_copy(update={"sensors": others})


def sky_of(trial: Trial, system: System) -> Sky:
    key = f"sensors.{CLOSED}.photons"
    changes = (Change(trial.dark, {key: DARK}), Change(trial.light, {key: system.sensors[CLOSED].photons}))
    return prepare(system, trial.frames, SEED, science_every=EVERY, changes=changes)


@pytest.mark.parametrize("trial", [MINI, pytest.param(GNAO, marks=pytest.mark.slow)], ids=lambda trial: trial.system)
@pytest.mark.timeout(1200)
def test_a_laser_closed_and_opened_again(start_process, tmp_path, trial: Trial) -> None:
    """Every frame has its command, and in between they are as good as those of a system that never had the laser."""
    name = trial.system
    system = load_system(name)
    lgs = system.sensors[CLOSED].name
    plant = Plant(system, sky_of(trial, system))
    files = tmp_path / "g.npz", tmp_path / "r.npz"
    save_interaction_matrix(files[0], plant.sky.interaction, plant.sky.layout.fingerprint, {})
    implicit(system, closures="singles", fast=trial is GNAO)[0].save(files[1])
    start_process(
        *("-m", "srtomo_ops.cli", "hrtc", name),
        *("-p", f"interaction_matrix:={files[0]}", "-p", f"reconstructor:={files[1]}"),
    )
    rclpy.init()
    operator, sensors = Operator(patience=60.0), Sensors(plant)
    errors, used, told = [], [], {}
    try:
        operator.transition("configure")
        operator.transition("activate")
        operator.close_loop(True)
        while operator.hrtc is None or 0 in (operator.hrtc.slope_publishers, operator.hrtc.command_readers):
            operator.spin(0.05)
        for frame in range(trial.frames):
            if frame in (trial.closed, trial.opened):
                told[frame] = operator.close_sensors([lgs], frame == trial.closed)
            used.append(sensors.exposure(frame))
            if frame % EVERY == 0:
                error = plant.wfe(frame)
                errors.append((frame, error.high_order[0], error.tip_tilt[0]))
        operator.spin(0.5)
        status = operator.hrtc
    finally:
        sensors.destroy()
        operator.destroy_node()
        rclpy.shutdown()
    assert told == {
        trial.closed: (trial.closed, f"sensors closed: {lgs}; commands are made by the reconstructor without these"),
        trial.opened: (trial.opened, "sensors closed: none; commands are made by all sensors"),
    }

    # no frame is lost: each has its command, by the law
    counts = {name: getattr(status, name) for name in status.get_fields_and_field_types()}
    wrong = {name: n for name, n in counts.items() if name.startswith(("held", "dropped")) and n}
    assert (counts["commands"], counts["closed_sensors"], wrong) == (trial.frames, 0, {})
    everyone = (1 << len(system.sensors)) - 1
    some = everyone & ~(1 << CLOSED)
    assert used == (
        [everyone] * trial.closed + [some] * (trial.opened - trial.closed) + [everyone] * (trial.frames - trial.opened)
    )

    # in between, the wavefront error of a system that never had that sensor, under the same sky
    smaller = without_the_sensor(system)
    sky = prepare(smaller, trial.light, SEED, science_every=EVERY)
    alone = run(Plant(smaller, sky), {0: program_of(sky.layout, implicit(smaller)[0])})
    frames, high_order, tip_tilt = np.array(errors).T

    def rms(numbers, values) -> float:
        return float(np.sqrt(np.mean(values[(numbers >= trial.dark) & (numbers < trial.light)] ** 2)) * 1e9)

    mine, theirs = rms(frames, high_order), rms(alone.frames, alone.high_order[:, 0])
    tilts = rms(frames, tip_tilt), rms(alone.frames, alone.tip_tilt[:, 0])
    print(f"{name}: {mine:.2f} nm with {lgs} closed, {theirs:.2f} nm designed without it; tip-tilt {tilts} nm")
    assert mine == pytest.approx(theirs, rel=0.03)
    assert tilts[0] == pytest.approx(tilts[1], rel=0.05)
    after = high_order[frames >= trial.opened + 20]
    assert float(np.sqrt(np.mean(after**2))) * 1e9 < 1.1 * mine  # and it is back
