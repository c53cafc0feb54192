"""The plant as a ROS 2 node: publishes SlopeFrames and obeys DmCommands, at the instrument's rate or in lockstep.

The sky is prepared before the service ``sim/start`` exists. The plant's thread then publishes frame after frame; its
endpoints are on a node that no executor spins. The executor's thread serves ``sim/start`` and the status.
"""

from __future__ import annotations

import os

# before numpy loads; numba may use every core while the sky is prepared
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import gc
import json
import secrets
import signal
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from types import FrameType
from typing import Any

import numpy as np
import rclpy
from msgs_schema.msg import DmCommand, SimStatus
from msgs_schema.msg import SlopeFrame as SlopeFrameMsg
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.system import InstrumentError, load_system
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare, strehl

_LOCKSTEP_TIMEOUT = 10.0  # s to wait for a command


_PARAMETERS: tuple[tuple[str, Any, str], ...] = (
    ("system", "", "instrument: name or path of a .yaml file"),
    ("changes", "{}", 'changes to the instrument as JSON, e.g. {"loop.rate": "1 kHz"}'),
    ("seed", 1, "of sky, noise and jitter"),
    ("frames", 1000, "exposures to publish"),
    ("pace", "wall", "wall: at the instrument's rate; lockstep: a frame when its predecessor is answered"),
    ("combined", False, "one message for all sensors instead of one a sensor"),
    ("science_every", 5, "exposures between two looks at the science directions"),
    ("result", "", "path of an .npz for the WFE of every science exposure; empty: none"),
)


def parameters() -> Iterable[tuple[str, Any, str]]:
    """Name, default and description of each parameter; all are read-only."""
    return _PARAMETERS


class SimNode(Node):
    """The node ``sim``. Methods run on the executor's thread unless they say otherwise."""

    def __init__(self) -> None:
        super().__init__("sim")
        for name, default, description in parameters():
            self.declare_parameter(name, default, ParameterDescriptor(description=description, read_only=True))
        self._hot_node = Node("sim_hot")
        self._statuses = self.create_publisher(SimStatus, wire.SIM_STATUS.name, QoSProfile(**wire.SIM_STATUS.qos()))
        self._start = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="plant", daemon=True)
        self.failure: str | None = None

    def prepare(self) -> None:
        """Let the sky pass over the instrument, then offer ``sim/start``.

        Raises:
            InstrumentError: the instrument or a parameter is wrong.
        """
        values = {name: self.get_parameter(name).value for name, _, _ in parameters()}
        if not values["system"]:
            raise InstrumentError("parameter system: expected a name or the path of a .yaml file")
        if values["pace"] not in ("wall", "lockstep"):
            raise InstrumentError(f"parameter pace: expected wall or lockstep, got {values['pace']!r}")
        system = load_system(values["system"], json.loads(values["changes"]))
        if values["pace"] == "wall" and system.loop.delay <= 1:
            raise InstrumentError("loop.delay: expected more than 1 frame, or no command can be in time")
        self._values, self._system, self._layout = values, system, Layout(system)
        shown = -1

        def show(done: float) -> None:
            nonlocal shown
            percent = int(100 * done)
            if percent > shown:
                shown = percent
                print(f"sky {percent} %", flush=True)

        sky = prepare(system, values["frames"], values["seed"], science_every=values["science_every"], progress=show)
        self._plant = Plant(system, sky)
        self.session = secrets.randbits(63) | 1
        sensors = self._layout.sensors
        groups = [range(len(sensors))] if values["combined"] else [range(w, w + 1) for w in range(len(sensors))]
        self._writers = [
            wire.SlopeFrameWriter(
                sensors[group[0]].name,
                self.session,
                self._layout.fingerprint,
                group[0],
                len(group),
                sum(sensors[w].n_valid for w in group),
            )
            for group in groups
        ]
        rate = system.loop.rate
        # one writer for each message of a frame: a reader then orders each sensor by itself
        depth = wire.SLOPES.depth_at(rate * len(groups))
        self._publisher = self._hot_node.create_publisher(
            SlopeFrameMsg, wire.SLOPES.name, QoSProfile(**wire.SLOPES.qos(depth))
        )
        self._commands = self._hot_node.create_subscription(
            DmCommand, wire.COMMAND.name, lambda _: None, QoSProfile(**wire.COMMAND.qos()), raw=True
        )
        self.frame = -1
        self._published_at = 0.0
        self._slipped = 0.0
        self._errors: list[tuple[int, list[float], list[float], list[float]]] = []
        self._reported = 0
        self._last_report = (time.monotonic(), -1)
        self.create_timer(0.1, self._report)
        gc.collect()
        gc.freeze()
        self._thread.start()
        self.create_service(Trigger, "sim/start", self._on_start)

    def _on_start(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = not self._start.is_set()
        response.message = "started" if response.success else "started before"
        self._start.set()
        return response

    # -- the plant's thread -----------------------------------------------------------------------------------------

    def _run(self) -> None:
        self._start.wait()
        try:
            with self._publisher.handle, self._commands.handle:
                if self._values["pace"] == "wall":
                    self._wall()
                else:
                    self._lockstep()
            self._save()
        except Exception as error:
            self.failure = f"the plant stopped at frame {self.frame + 1}: {error}"
            self.get_logger().fatal(self.failure)
            self._stop.set()

    def _wall(self) -> None:
        """Exposure k lasts from start + k period to start + (k+1) period; its slopes go out at its end."""
        period = 1 / self._system.loop.rate
        rest = self._system.loop.delay % 1
        start = time.monotonic() + 0.05
        # the middleware stamps what it receives with the system's clock
        offset = time.time() - time.monotonic()
        for k in range(self._values["frames"]):
            self._sleep_until(start + (k + rest) * period)
            self._drain(start + offset, period)
            slopes = self._plant.measure(k)
            on = self._plant.on_mirror(k)
            self._look(k)
            end = start + (k + 1) * period
            self._sleep_until(end)
            behind = time.monotonic() - end
            if behind > period / 2:
                # the clock of the simulated sky waits for a machine that cannot keep up
                start += behind
                self._slipped += behind
            if self._stop.is_set():
                return
            self._publish(k, slopes, on.frame, on.before, on.fraction)
        self._sleep_until(time.monotonic() + 2 * period)
        self._drain(start + offset, period)

    def _lockstep(self) -> None:
        for k in range(self._values["frames"]):
            slopes = self._plant.measure(k)
            on = self._plant.on_mirror(k)
            self._look(k)
            self._publish(k, slopes, on.frame, on.before, on.fraction)
            end = time.monotonic() + _LOCKSTEP_TIMEOUT
            while not self._answered(k):
                if self._stop.is_set():
                    return
                if time.monotonic() > end:
                    raise TimeoutError(f"no command for it came in {_LOCKSTEP_TIMEOUT:g} s")
                time.sleep(0.0001)

    def _answered(self, frame: int) -> bool:
        while True:
            taken = self._commands.handle.take_message(DmCommand, True)
            if taken is None:
                return False
            command = wire.read_dm_command(taken[0])
            if command.session == self.session:
                self._plant.command(command.frame, command.commands)
                if command.frame == frame:
                    return True

    def _drain(self, start: float, period: float) -> None:
        """Hand in every command that came, with its time of arrival in frames since ``start`` (system's clock)."""
        while True:
            taken = self._commands.handle.take_message(DmCommand, True)
            if taken is None:
                return
            try:
                command = wire.read_dm_command(taken[0])
                if command.session == self.session:
                    arrival = (taken[1]["received_timestamp"] * 1e-9 - start) / period
                    self._plant.command(command.frame, command.commands, arrival)
            except ValueError as error:
                self.get_logger().warning(f"command dropped: {error}")

    def _publish(self, frame: int, slopes: np.ndarray, on: int, before: int, fraction: float) -> None:
        stamp = time.time_ns()
        first = 0
        for writer in self._writers:
            writer.values[:] = slopes[first : first + len(writer.values)]
            first += len(writer.values)
            self._publisher.publish(writer.write(stamp, frame, on, before, fraction))
        self.frame = frame

    def _look(self, frame: int) -> None:
        if frame % self._values["science_every"] == 0:
            error = self._plant.wfe(frame)
            index = frame // self._values["science_every"]
            uncorrected = [float(np.sqrt(target.power[index])) for target in self._plant.sky.targets]
            self._errors.append((frame, error.high_order.tolist(), error.tip_tilt.tolist(), uncorrected))

    def _sleep_until(self, moment: float) -> None:
        left = moment - time.monotonic()
        if left > 0:
            time.sleep(left)

    def _save(self) -> None:
        if self._values["result"] and self._errors:
            frames, high_order, tip_tilt, uncorrected = (np.array(column) for column in zip(*self._errors, strict=True))
            np.savez(
                self._values["result"],
                frame=frames,
                high_order=high_order,
                tip_tilt=tip_tilt,
                uncorrected=uncorrected,
                late_commands=self._plant.late_commands,
                slipped=self._slipped,
                frames=self.frame + 1,
            )

    # -- the executor's thread --------------------------------------------------------------------------------------

    def _report(self) -> None:
        now, frame = time.monotonic(), self.frame
        then, last = self._last_report
        self._last_report = now, frame
        message = SimStatus(session=self.session, frame=max(frame, 0), late_commands=self._plant.late_commands)
        message.header.stamp = self.get_clock().now().to_msg()
        message.rate = (frame - last) / (now - then)
        recent = self._errors[self._reported :]
        self._reported += len(recent)
        wavelength = self._system.science.wavelength
        message.wavelength = wavelength
        if recent:
            high_order = np.array([error[1][0] for error in recent])
            message.wfe = float(np.sqrt(np.mean(high_order**2)))
            message.wfe_tip_tilt = float(np.sqrt(np.mean([error[2][0] ** 2 for error in recent])))
            message.strehl = float(strehl(high_order, wavelength).mean())
        self._statuses.publish(message)

    @property
    def finished(self) -> bool:
        """Whether the plant's thread has ended."""
        return self._start.is_set() and not self._thread.is_alive()

    def close(self) -> None:
        """End the plant's thread and give the endpoints back."""
        self._stop.set()
        self._start.set()
        if self._thread.is_alive():
            self._thread.join()
        self._hot_node.destroy_node()
        self.destroy_node()


def main(arguments: Sequence[str] | None = None) -> int:
    """Prepare, then serve until SIGINT or SIGTERM; the last frames stay readable until then.

    ``arguments``: ROS arguments (``--ros-args -p system:=mini ...``).
    """
    rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        if not prepared:
            sys.exit(130)
        stop.set()

    prepared = False
    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)
    node = SimNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        node.prepare()
        prepared = True
        while not stop.is_set() and node.failure is None:
            executor.spin_once(timeout_sec=0.1)
    except (InstrumentError, ValueError) as error:
        node.get_logger().error(str(error))
        return 2
    finally:
        executor.shutdown()
        node.close()
        rclpy.shutdown()
    return 0 if node.failure is None else 1


if __name__ == "__main__":
    raise SystemExit(main())
