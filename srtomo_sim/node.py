"""The plant as a ROS 2 node: publishes SlopeFrames and obeys DmCommands, at the instrument's rate or in lockstep.

The sky is prepared before the service ``sim/start`` exists. The plant's thread then publishes frame after frame; its
endpoints are on a node that no executor spins. The executor's thread serves ``sim/start``, ``sim/change`` and the
status. A third thread computes the sky anew where a change asks for it; if it cannot keep up, the sky's clock waits.
"""

from __future__ import annotations

import os

# before numpy loads; numba may use every core while the sky is prepared
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import copy
import dataclasses
import gc
import json
import math
import secrets
import signal
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from types import FrameType
from typing import Any

import numba
import numpy as np
import rclpy
from msgs_schema.msg import AtmosphereProfile, DmCommand, SimStatus, TelescopeStatus
from msgs_schema.msg import SlopeFrame as SlopeFrameMsg
from msgs_schema.srv import ChangeSky
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from srtomo_core import wire
from srtomo_core.clock import ArrivalClock
from srtomo_core.layout import Layout
from srtomo_core.system import InstrumentError, System, load_system
from srtomo_sim.course import Change, alters_turbulence, scheduled
from srtomo_sim.mirror import OnMirror
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare, strehl

_LOCKSTEP_TIMEOUT = 10.0  # s to wait for a command
_LEAD = 0.2  # s of the plant's time before a change can begin
_LEAD_ANEW = 2.0  # the same where the sky has to be computed anew: a start, no more
_CHUNK = 256  # frames computed anew at first; every next time twice as many, since each has a fixed cost


_PARAMETERS: tuple[tuple[str, Any, str], ...] = (
    ("system", "", "instrument: name or path of a .yaml file"),
    ("changes", "{}", 'changes to the instrument as JSON, e.g. {"loop.rate": "1 kHz"}'),
    ("seed", 1, "of sky, noise and jitter"),
    ("frames", 1000, "exposures to publish"),
    ("pace", "wall", "wall: at the instrument's rate; lockstep: a frame when its predecessor is answered"),
    ("combined", False, "one message for all sensors instead of one a sensor"),
    ("science_every", 5, "exposures between two looks at the science directions"),
    ("schedule", "[]", 'changes on the way as JSON, e.g. [{"at": 5, "over": 2, "set": {"atmosphere.r0": "10 cm"}}], s'),
    ("result", "", "path of an .npz for the WFE of every science exposure; empty: none"),
)


def parameters() -> Iterable[tuple[str, Any, str]]:
    """Name, default and description of each parameter; all are read-only."""
    return _PARAMETERS


def _value(text: str) -> Any:
    """As in an instrument file: JSON where it can be, otherwise a quantity with its unit."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


class SimNode(Node):
    """The node ``sim``. Methods run on the executor's thread unless they say otherwise."""

    def __init__(self) -> None:
        super().__init__("sim")
        for name, default, description in parameters():
            self.declare_parameter(name, default, ParameterDescriptor(description=description, read_only=True))
        self._hot_node = Node("sim_hot")
        self._statuses = self.create_publisher(SimStatus, wire.SIM_STATUS.name, QoSProfile(**wire.SIM_STATUS.qos()))
        self._truths = self.create_publisher(
            AtmosphereProfile, wire.SIM_PROFILE.name, QoSProfile(**wire.SIM_PROFILE.qos())
        )
        self._telescope = self.create_publisher(
            TelescopeStatus, wire.TELESCOPE.name, QoSProfile(**wire.TELESCOPE.qos())
        )
        self._start = threading.Event()
        self._behind = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="plant", daemon=True)
        self._computer = threading.Thread(target=self._compute, name="sky", daemon=True)
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

        sky = prepare(
            system,
            values["frames"],
            values["seed"],
            science_every=values["science_every"],
            changes=scheduled(json.loads(values["schedule"]), system.loop.rate),
            progress=show,
        )
        self._plant = Plant(system, sky)
        self.session = secrets.randbits(63) | 1
        own = self._layout.tip_tilt_sensors
        self._writers = self._writers_of([w for w in range(len(self._layout.sensors)) if w not in own])
        self._star_writers = self._writers_of(own)
        rate = system.loop.rate
        # one writer for each message of a frame: a reader then orders each sensor by itself
        depth = wire.SLOPES.depth_at(rate * (len(self._writers) + len(self._star_writers)))
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
        self._told: AtmosphereProfile | None = None
        self._warned = False
        # timers of the system's clock would stop for as long as it is set back
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.1, self._report, clock=steady)
        self._report_telescope()
        self.create_timer(1.0, self._report_telescope, clock=steady)
        gc.collect()
        gc.freeze()
        self._thread.start()
        self._computer.start()
        self.create_service(Trigger, "sim/start", self._on_start)
        self.create_service(ChangeSky, "sim/change", self._on_change)

    def _writers_of(self, sensors: Sequence[int]) -> list[tuple[slice, wire.SlopeFrameWriter]]:
        """A writer for each message of a frame of these sensors, with its place in the slope vector."""
        layout, groups = self._layout, list[list[int]]()
        for w in sensors:
            if self._values["combined"] and groups and groups[-1][-1] == w - 1:
                groups[-1].append(w)
            else:
                groups.append([w])
        return [
            (
                slice(int(layout.slope_start[group[0]]), int(layout.slope_start[group[-1] + 1])),
                wire.SlopeFrameWriter(
                    layout.sensors[group[0]].name,
                    self.session,
                    layout.fingerprint,
                    group[0],
                    len(group),
                    sum(layout.sensors[w].n_valid for w in group),
                ),
            )
            for group in groups
        ]

    def _on_start(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = not self._start.is_set()
        response.message = "started" if response.success else "started before"
        self._start.set()
        return response

    def _on_change(self, request: ChangeSky.Request, response: ChangeSky.Response) -> ChangeSky.Response:
        rate = self._system.loop.rate
        try:
            if not request.keys or len(request.keys) != len(request.values):
                raise InstrumentError("expected as many values as keys, and one at least")
            values = {key: _value(text) for key, text in zip(request.keys, request.values, strict=True)}
            change = Change(0, values, round(request.over * rate))
            soonest = _LEAD_ANEW if alters_turbulence(change) else _LEAD
            wait = max(request.after, soonest) if self._start.is_set() else request.after
            change = dataclasses.replace(change, frame=self.frame + 1 + round(wait * rate))
            if self._plant.change(change):
                self._behind.set()
        except (ValueError, OverflowError) as error:
            response.message = str(error)
            return response
        response.success = True
        response.first_frame = change.frame
        response.message = f"{', '.join(f'{key} = {values[key]}' for key in values)} from frame {change.frame} on"
        self.get_logger().info(response.message)
        return response

    # -- the thread that computes the sky anew ----------------------------------------------------------------------

    def _compute(self) -> None:
        """Stay ahead of the plant where a change has touched the sky, in what time the other threads leave."""
        numba.set_num_threads(1)  # of this thread's own
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)
        try:
            while self._behind.wait() and not self._stop.is_set():
                self._behind.clear()
                chunk = _CHUNK
                while self._plant.ready < self._values["frames"] and not self._stop.is_set():
                    self._plant.catch_up(chunk)
                    chunk *= 2
        except Exception as error:
            self.failure = f"the sky could not be computed anew: {error}"
            self.get_logger().fatal(self.failure)
            self._stop.set()

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
        clock = ArrivalClock()
        for k in range(self._values["frames"]):
            self._sleep_until(start + (k + rest) * period)
            self._drain(clock, start, period)
            if not self._has_sky(k):
                return
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
            self._publish(k, slopes, on)
        self._sleep_until(time.monotonic() + 2 * period)
        self._drain(clock, start, period)

    def _lockstep(self) -> None:
        for k in range(self._values["frames"]):
            if not self._has_sky(k):
                return
            slopes = self._plant.measure(k)
            on = self._plant.on_mirror(k)
            self._look(k)
            self._publish(k, slopes, on)
            end = time.monotonic() + _LOCKSTEP_TIMEOUT
            while not self._answered(k):
                if self._stop.is_set():
                    return
                if time.monotonic() > end:
                    raise TimeoutError(f"no command for it came in {_LOCKSTEP_TIMEOUT:g} s")
                time.sleep(0.0001)

    def _has_sky(self, frame: int) -> bool:
        """Wait for a sky that is being computed anew; False if it need not be waited for any more."""
        while self._plant.ready <= frame:
            if self._stop.is_set():
                return False
            time.sleep(0.001)
        return True

    def _answered(self, frame: int) -> bool:
        while True:
            taken = self._commands.handle.take_message(DmCommand, True)
            if taken is None:
                return False
            if self._obey(taken[0], None) == frame:
                return True

    def _drain(self, clock: ArrivalClock, start: float, period: float) -> None:
        """Hand in every command that came, with its time of arrival in frames since ``start`` (monotonic clock, s)."""
        while True:
            taken = self._commands.handle.take_message(DmCommand, True)
            if taken is None:
                return
            self._obey(taken[0], (clock.monotonic(taken[1]["received_timestamp"]) * 1e-9 - start) / period)

    def _obey(self, message: bytes, arrival: float | None) -> int | None:
        """Hand one command in; its frame, or None if it is not one for this plant."""
        try:
            command = wire.read_dm_command(message)
            if command.session != self.session:
                return None
            self._plant.command(command.frame, command.commands, arrival)
        except ValueError as error:
            self.get_logger().warning(f"command dropped: {error}")
            return None
        return command.frame

    def _publish(self, frame: int, slopes: np.ndarray, on: OnMirror) -> None:
        stamp = time.time_ns()
        if (stars := self._plant.tip_tilt(frame)) is not None:
            for place, writer in self._star_writers:
                writer.values[:] = stars[1][place]
                self._publisher.publish(writer.write(stamp, stars[0], wire.MIRROR_UNKNOWN, wire.MIRROR_UNKNOWN, 1.0))
        for place, writer in self._writers:
            writer.values[:] = slopes[place]
            self._publisher.publish(writer.write(stamp, frame, *on))
        self.frame = frame

    def _look(self, frame: int) -> None:
        if frame % self._values["science_every"] == 0:
            error = self._plant.wfe(frame)
            uncorrected = self._plant.sky.uncorrected(frame).tolist()
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
        truth = self._plant.truth(max(frame, 0))
        message.changes = sum(change.frame <= frame for change in self._plant.sky.course.changes)
        message.photons = [sensor.photons for sensor in truth.sensors]
        sizes = [place.size for place in self._layout.sensors]
        message.shift_x = [sensor.shift[0] * size for sensor, size in zip(truth.sensors, sizes, strict=True)]
        message.shift_y = [sensor.shift[1] * size for sensor, size in zip(truth.sensors, sizes, strict=True)]
        message.rotation = [sensor.rotation for sensor in truth.sensors]
        if recent:
            high_order = np.array([error[1][0] for error in recent])
            message.wfe = float(np.sqrt(np.mean(high_order**2)))
            message.wfe_tip_tilt = float(np.sqrt(np.mean([error[2][0] ** 2 for error in recent])))
            message.strehl = float(strehl(high_order, wavelength).mean())
        self._statuses.publish(message)
        several = self._commands.get_publisher_count() > 1
        if several and not self._warned:
            self.get_logger().warning(f"several publishers of {wire.COMMAND.name}: the mirror obeys whichever is first")
        self._warned = several
        self._report_truth(truth, max(frame, 0))

    def _report_truth(self, truth: System, frame: int) -> None:
        """The sky as it is, whenever it is another."""
        atmosphere = truth.atmosphere
        message = AtmosphereProfile(
            source="plant",
            r0=atmosphere.r0,
            outer_scale=atmosphere.outer_scale,
            outer_scale_low=atmosphere.outer_scale,
            outer_scale_high=atmosphere.outer_scale,
            altitude=[layer.altitude for layer in atmosphere.layers],
            fraction=list(atmosphere.fractions),
            wind_speed=[layer.wind_speed for layer in atmosphere.layers],
            wind_direction=[layer.wind_direction for layer in atmosphere.layers],
        )
        if message == self._told:
            return
        self._told = copy.deepcopy(message)
        message.session, message.first_frame = self.session, frame
        message.header.stamp = self.get_clock().now().to_msg()
        self._truths.publish(message)

    def _report_telescope(self) -> None:
        system = self._system
        lasers = [star.altitude for star in system.guide_stars if star.altitude is not None]
        message = TelescopeStatus(
            elevation=math.pi / 2 - system.zenith_angle,
            sodium_height=lasers[0] if lasers else 0.0,
            star=[star.name for star in system.guide_stars],
            star_x=[star.position.x for star in system.guide_stars],
            star_y=[star.position.y for star in system.guide_stars],
            star_shutter=[True] * len(system.guide_stars),
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._telescope.publish(message)

    @property
    def finished(self) -> bool:
        """Whether the plant's thread has ended."""
        return self._start.is_set() and not self._thread.is_alive()

    def close(self) -> None:
        """End the plant's thread and give the endpoints back."""
        self._stop.set()
        self._start.set()
        # the other thread holds nothing that would have to be given back
        self._behind.set()
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
