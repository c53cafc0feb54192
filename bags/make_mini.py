"""Make the golden bag of ``mini``: real nodes, and a scripted sensor that runs the simulated plant in lockstep.

python bags/make_mini.py bags/mini
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

from srtomo_ops.cli import LOCAL

os.environ.update({"OPENBLAS_NUM_THREADS": "1", **LOCAL})

import numpy as np
import rclpy
from domain_coordinator import domain_id
from msgs_schema.msg import DmCommand, SlopeFrame
from msgs_schema.srv import SetStaticShape
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.qos import QoSProfile

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_ops.commands.calibrate import calibrate
from srtomo_ops.operator import Operator
from srtomo_ops.processes import Processes
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare

FRAMES = 150
PACE = 0.025  # s a frame: slow enough for the state, once a second, to be in the bag some times
NOT_A_NUMBER, INCOMPLETE, SWAP, LEAK, SHAPE, OPEN = 30, 45, 60, 90, 110, 135
"""The frames at which something happens; what a call changes holds from about there on."""

# what a replay needs; the others only say how the making went
TOPICS = (wire.SLOPES, wire.COMMAND, wire.EVENT, wire.STATE, wire.RECONSTRUCTOR, wire.RECONSTRUCTOR_BLOCK, wire.PROFILE)


class ScriptedSensor:
    """Publishes what the plant measures, but for two faults, and hands it the commands."""

    def __init__(self) -> None:
        system = load_system("mini")
        self.layout = Layout(system)
        self._plant = Plant(system, prepare(system, FRAMES, seed=1, science_every=FRAMES))
        session = 0x6D696E69
        self._writers = [
            wire.SlopeFrameWriter(sensor.name, session, self.layout.fingerprint, w, 1, sensor.n_valid)
            for w, sensor in enumerate(self.layout.sensors)
        ]
        self._node = Node("scripted_sensor")
        self._slopes = self._node.create_publisher(
            SlopeFrame, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(wire.SLOPES.depth_at(1000)))
        )
        self._commands = self._node.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos()), raw=True
        )

    def exposure(self, frame: int) -> None:
        slopes = self._plant.measure(frame)
        on = self._plant.on_mirror(frame)
        if frame == NOT_A_NUMBER:
            slopes[17] = np.nan
        for w, writer in enumerate(self._writers):
            if frame == INCOMPLETE and w == 2:
                return  # the rest of the frame never comes: it is held once the next one is complete
            writer.values[:] = slopes[self.layout.slopes_of(w)]
            self._slopes.publish(writer.write(time.time_ns(), frame, on.frame, on.before, on.fraction))
        end = time.monotonic() + 10
        while not self._answered(frame):
            if time.monotonic() > end:
                raise TimeoutError(f"no command for frame {frame}")
            time.sleep(0.0005)

    def _answered(self, frame: int) -> bool:
        while (taken := self._commands.handle.take_message(DmCommand, True)) is not None:
            command = wire.read_dm_command(taken[0])
            self._plant.command(command.frame, command.commands)
            if command.frame == frame:
                return True
        return False


def make(bag: Path, folder: Path) -> None:
    rclpy.init()
    operator, sensor = Operator(name="golden"), ScriptedSensor()
    calibrate(load_system("mini"), folder / "interaction_matrix.npz")
    with Processes(folder) as nodes:

        def until(condition) -> None:
            end = time.monotonic() + 60
            while not condition():
                nodes.check()
                if time.monotonic() > end:
                    raise TimeoutError("the nodes did not find each other")
                operator.spin(0.05)

        def commit(label: str) -> None:
            identity, sha256 = operator.publish(label)
            operator.wait_staged(identity)
            operator.commit(identity, sha256)

        nodes.start("hrtc", ["hrtc", "mini", "-p", f"interaction_matrix:={folder / 'interaction_matrix.npz'}"])
        nodes.start("srtc", ["srtc", "mini", "-p", "priors:=[ground,file]", "-p", "closures:=none"])
        topics = [topic.name for topic in TOPICS]
        nodes.start("recorder", ["record", "mini", "-o", str(bag), "--topics", *topics])
        operator.transition("configure")
        operator.transition("activate")
        until(lambda: operator.hrtc is not None and operator.recorder is not None)
        until(lambda: operator.hrtc.slope_publishers == 1 and operator.hrtc.command_readers == 2)
        until(lambda: operator.recorder.slope_publishers == 1 and operator.recorder.command_publishers == 1)
        commit("ground")
        operator.close_loop(True)
        for frame in range(FRAMES):
            if frame == SWAP:
                commit("file")
            elif frame == LEAK:
                leak = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=0.02)
                request = SetParameters.Request(parameters=[Parameter(name="leak", value=leak)])
                operator.call(SetParameters, "hrtc/set_parameters", request)
            elif frame == SHAPE:
                offset = 30e-9 * np.sin(np.arange(sensor.layout.n_commands))
                operator.call(SetStaticShape, "hrtc/static_shape", SetStaticShape.Request(offset=offset.tolist()))
            elif frame == OPEN:
                operator.close_loop(False)
            sensor.exposure(frame)
            time.sleep(PACE)
        time.sleep(0.5)
        for name in ("recorder", "srtc", "hrtc"):
            nodes.stop(name)
        print((folder / "recorder.log").read_text())
    rclpy.shutdown()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    with tempfile.TemporaryDirectory() as scratch, domain_id() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        make(Path(sys.argv[1]).absolute(), Path(scratch))
