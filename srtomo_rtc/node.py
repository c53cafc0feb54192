"""The HRTC as a ROS 2 lifecycle node: configure allocates, loads, locks and warms; activate runs.

Four threads. The loop's thread waits for slopes, runs :class:`~srtomo_rtc.hrtc.Hrtc` and publishes commands. The
executor's thread (main) serves lifecycle, parameters, services, status and events; it swaps and changes settings
itself. Two workers, which never run at the loop's priority, take what may last a minute: one stages reconstructors, one
writes files; only lifecycle transitions wait for them. None of them touches the loop's arrays: they post references and
read counters. The loop's thread does not run in the interpreter (:mod:`srtomo_rtc.hot`).
"""

from __future__ import annotations

from srtomo_rtc import realtime

# before numpy loads
_BLAS = realtime.pin_blas()

import json
import math
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from msgs_schema.msg import HrtcEvent, HrtcState, HrtcStatus
from msgs_schema.msg import Reconstructor as ReconstructorMsg
from msgs_schema.msg import ReconstructorBlock as ReconstructorBlockMsg
from msgs_schema.srv import CloseSensor, PublishReconstructor, SetStaticShape, SwapReconstructor
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, ReconstructorError, load_interaction_matrix
from srtomo_core.ring import RingWriter, ring_path
from srtomo_core.system import InstrumentError, load_system
from srtomo_rtc.crew import MAX_THREADS, SPIN_NS, Crew, candidates, choose
from srtomo_rtc.early_blocks import EarlyBlocks
from srtomo_rtc.events import SCALARS, EventKind, change_fields, event_fields, state_fields
from srtomo_rtc.hot import HotEndpoints, slopes_depth
from srtomo_rtc.hrtc import Hrtc, Snapshot
from srtomo_rtc.latency import LatencyHistogram
from srtomo_rtc.loop import MAX_EPOCHS, LoopState, Program, Settings
from srtomo_rtc.offload import Offload, tilt_of_commands
from srtomo_rtc.swap import MAX_CLOSURES, Manifest, Refused, Swap
from srtomo_rtc.vmm import KERNELS, instructions

_ADOPTION_TIMEOUT = 2.0  # s for the loop to take up what was posted: it does between two frames, or at once if idle
_RESEND_AFTER = 1.0  # s without a new block before missing ones are asked for
_SILENT = 0.1  # s without slopes that are worth a warning
_SILENT_STARS = 1.0  # s without slopes of tip-tilt's own stars, which are slow, that are worth a warning
_GIVE_UP_AFTER = 10.0  # s without a new block before a transfer is refused
_SPEAKS_WITHIN = 1.0  # s in which another HRTC that is active would say so: ten times over
_MESSAGE_HEAD = 192  # bytes of a message in the ring beside its slopes or commands, about
_LEAST_RING = 1 << 20  # bytes


def _read_only(description: str) -> ParameterDescriptor:
    return ParameterDescriptor(description=description, read_only=True)


def _number(description: str, low: float, high: float, read_only: bool = False) -> ParameterDescriptor:
    return ParameterDescriptor(
        description=description,
        read_only=read_only,
        floating_point_range=[FloatingPointRange(from_value=low, to_value=high)],
    )


def _integer(description: str, low: int, high: int, read_only: bool = False) -> ParameterDescriptor:
    return ParameterDescriptor(
        description=description, read_only=read_only, integer_range=[IntegerRange(from_value=low, to_value=high)]
    )


_PARAMETERS: tuple[tuple[str, Any, ParameterDescriptor], ...] = (
    ("system", "", _read_only("instrument: name or path of a .yaml file")),
    ("changes", "{}", _read_only('changes to the instrument as JSON, e.g. {"loop.rate": "1 kHz"}')),
    ("interaction_matrix", "", _read_only("path of the calibrated interaction matrix G_cal (srtomo calibrate)")),
    ("reconstructor", "", _read_only("path of a reconstructor to start with; empty: wait for one on the wire")),
    ("keep", "", _read_only("path where the last committed reconstructor is kept for a restart; empty: nowhere")),
    ("max_behind", 4, _integer("complete frames that may wait before whole frames are skipped", 1, 7, True)),
    (
        "max_epochs",
        1,
        _integer("exposures that a reconstructor may use; n above 1 take n+1 times the memory", 1, MAX_EPOCHS, True),
    ),
    (
        "max_closures",
        MAX_CLOSURES,
        _integer("sets of closed sensors that a reconstructor may have R and Q for, in memory", 0, 255, True),
    ),
    ("frame_path", "compiled", _read_only("how slopes come in and commands go out: compiled, or rclpy")),
    (
        "kernel",
        "auto",
        _read_only(
            "matrix-vector kernel: float32; int16, half the memory traffic; tlr, R in tiles of low rank; "
            "auto: float32, int16 only measured"
        ),
    ),
    ("threads", 0, _integer("that share a product, the loop's included; 0: by measurement", 0, MAX_THREADS, True)),
    ("waiting", "auto", _read_only("how the compiled path waits: blocking, polling, or auto: by the cores there are")),
    ("cores", "", _read_only("cores of the loop's thread, as 2,3; with several threads one each; empty: any")),
    (
        "fifo_priority",
        0,
        _integer("SCHED_FIFO priority of the process, but for what stages; 0: normal scheduling", 0, 99, True),
    ),
    (
        "deadline",
        0.0,
        _number("latency above which a frame is a miss, s; 0: the loop's delay less one exposure", 0.0, 3600.0, True),
    ),
    (
        "ring",
        10.0,
        _number("s of messages, one a sensor, kept in shared memory for the recorder; 0: none", 0.0, 600.0, True),
    ),
    ("polc", True, ParameterDescriptor(description="pseudo-open-loop control; false: classical leaky integrator")),
    ("leak", 0.0, _number("leak of a frame; 0 at configure: the instrument's", 0.0, 0.999)),
    ("relaxation", 0.1, _number("share of the command that an open loop drops each frame", 0.001, 1.0)),
    ("command_limit", 1.0, _number("m of wavefront, on top of the instrument's stroke", 1e-9, 1.0)),
    ("slew_limit", 0.0, _number("m of wavefront, most that a command changes in a frame; 0: no limit", 0.0, 1.0)),
    ("rms_limit", 0.0, _number("m of wavefront, rms of all commands, scaled down to it; 0: no limit", 0.0, 1.0)),
    ("gain_ramp", 0, _integer("frames in which the gain rises once the loop is closed; 0: at once", 0, 1_000_000)),
    ("fault_budget", 50, _integer("consecutive held frames after which the loop opens", 1, 1_000_000)),
    ("watchdog", 10.0, _number("s without slopes after which a closed loop opens, above 0.1; 0: never", 0.0, 3600.0)),
    ("tip_tilt_gain", 0.0, _number("of tip-tilt's own loop; 0 at configure: the instrument's", 0.0, 1.0)),
    ("tip_tilt_leak", 0.0, _number("of a frame of its own; 0 at configure: the instrument's", 0.0, 0.999)),
)


def parameters() -> Iterable[tuple[str, Any, str]]:
    """Name, default and description of each parameter."""
    return ((name, default, descriptor.description) for name, default, descriptor in _PARAMETERS)


class HrtcNode(LifecycleNode):
    """The lifecycle node ``hrtc``. All methods run on the executor's thread unless they say otherwise."""

    def __init__(self, context: rclpy.Context | None = None) -> None:
        super().__init__("hrtc", context=context)
        for name, default, descriptor in _PARAMETERS:
            self.declare_parameter(name, default, descriptor)
        self.add_on_set_parameters_callback(self._set_parameters)
        self._hot_node = Node("hrtc_hot", context=context)
        self._events = self.create_publisher(HrtcEvent, wire.EVENT.name, QoSProfile(**wire.EVENT.qos()))
        self._states = self.create_publisher(HrtcState, wire.STATE.name, QoSProfile(**wire.STATE.qos()))
        self._status = self.create_publisher(HrtcStatus, wire.STATUS.name, QoSProfile(**wire.STATUS.qos()))
        self._diagnostics = self.create_publisher(
            DiagnosticArray, wire.DIAGNOSTICS.name, QoSProfile(**wire.DIAGNOSTICS.qos())
        )
        self.create_service(SetBool, "hrtc/close_loop", self._close_loop)
        self.create_service(Trigger, "hrtc/flat", self._flat)
        self.create_service(SwapReconstructor, "hrtc/commit", self._commit)
        self.create_service(SwapReconstructor, "hrtc/roll_back", self._roll_back)
        self.create_service(SetStaticShape, "hrtc/static_shape", self._static_shape)
        self.create_service(CloseSensor, "hrtc/close_sensor", self._close_sensor)
        # taken from when an activation asks, never by the executor
        self._statuses = self._hot_node.create_subscription(
            HrtcStatus, wire.STATUS.name, lambda _: None, QoSProfile(**wire.STATUS.qos(1))
        )
        self._resend = self.create_client(PublishReconstructor, "srtc/publish")
        self.create_subscription(
            ReconstructorMsg, wire.RECONSTRUCTOR.name, self._on_manifest, QoSProfile(**wire.RECONSTRUCTOR.qos())
        )
        self.create_subscription(
            ReconstructorBlockMsg,
            wire.RECONSTRUCTOR_BLOCK.name,
            self._on_block,
            QoSProfile(**wire.RECONSTRUCTOR_BLOCK.qos()),
            raw=True,
        )
        # timers of the system's clock would stop for as long as it is set back
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.1, self._every_100_ms, clock=steady)
        self.create_timer(1.0, self._every_second, clock=steady)
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="staging")
        self._files = ThreadPoolExecutor(max_workers=1, thread_name_prefix="files")
        self._manifest: Manifest | None = None
        self._early_blocks = EarlyBlocks()
        self._last_block = 0.0
        self._resend_asked = 0.0
        self._kinds: dict[int, tuple[EventKind, str]] = {}
        self._taken_up: tuple[Program | None, int] = (None, 0)  # the newest program that the loop runs, its first frame
        self._refused = 0
        self._opened_by_itself = ""  # why, until an operator closes the loop again
        self._misses_told = 0
        self._realtime: list[realtime.Outcome] = [_BLAS]
        self._cores: list[int] = []
        self._hrtc: Hrtc | None = None
        self._swap: Swap | None = None
        self._hot: HotEndpoints | None = None
        self._crew: Crew | None = None
        self._ring: RingWriter | None = None
        self._thread: threading.Thread | None = None
        self._lifecycle = "unconfigured"
        self.failure: str | None = None
        self.died = False  # the loop's thread ended by an exception

    # -- lifecycle --------------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Allocate, load, lock and warm."""
        return self._transition("inactive", self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the loop's thread."""
        return self._transition("active", self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the loop, publish flat, stop the loop's thread."""
        return self._transition("inactive", self.stop_loop)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give memory and endpoints back."""
        return self._transition("unconfigured", self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop whatever runs."""
        return self._transition("finalized", self.stop_loop)

    def _transition(self, name: str, action: Callable[[], None]) -> TransitionCallbackReturn:
        # rclpy prints nothing of a lifecycle callback that raises
        try:
            action()
        except (InstrumentError, ReconstructorError, Refused, ValueError) as error:
            self.get_logger().error(str(error))
            self.failure = str(error)
            return TransitionCallbackReturn.FAILURE
        except Exception:
            self.get_logger().error(traceback.format_exc())
            self.failure = traceback.format_exc().splitlines()[-1]
            return TransitionCallbackReturn.ERROR
        self._lifecycle = name
        self.failure = None
        self._event(EventKind.LIFECYCLE, name)
        return TransitionCallbackReturn.SUCCESS

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _configure(self) -> None:
        if not self._value("system"):
            raise InstrumentError("parameter system: expected a name or the path of a .yaml file")
        try:
            changes = json.loads(self._value("changes"))
        except json.JSONDecodeError:
            changes = None
        if not isinstance(changes, dict):
            raise InstrumentError(f"parameter changes: expected a JSON object, got {self._value('changes')}")
        system = load_system(self._value("system"), changes)
        layout = Layout(system)
        if not self._value("interaction_matrix"):
            raise ReconstructorError("parameter interaction_matrix: expected a file made by 'srtomo calibrate'")
        G_cal = load_interaction_matrix(self._value("interaction_matrix"), layout.fingerprint)
        values = {name: self._value(name) for name in SCALARS}
        of_instrument = {"leak": system.loop.leak}
        if (own := system.loop.tip_tilt) is not None:
            of_instrument |= {"tip_tilt_gain": own.gain, "tip_tilt_leak": own.leak}
        settings = Settings(
            id=1,
            offset=np.zeros(layout.n_commands, np.float32),
            slope_reference=np.zeros(layout.n_slopes, np.float32),
            **values | {name: value for name, value in of_instrument.items() if not values[name]},
        )
        asked = self._value("kernel")
        if asked not in ("auto", *KERNELS):
            raise ValueError(f"parameter kernel: expected auto or {' or '.join(KERNELS)}, got {asked}")
        kernel = "float32" if asked == "auto" else asked
        try:
            self._cores = [int(word) for word in self._value("cores").split(",") if word]
        except ValueError:
            raise ValueError(f"parameter cores: expected numbers as 2,3, got {self._value('cores')}") from None
        if len(set(self._cores)) < len(self._cores):
            raise ValueError(f"parameter cores: expected each core once, got {self._value('cores')}")
        swap = Swap(
            system, layout, G_cal, settings, self._post, self._value("max_epochs"), kernel, self._value("max_closures")
        )
        loop = system.loop
        deadline = self._value("deadline") or max(loop.delay - 1, 0.1) / loop.rate
        for name, known in (("frame_path", ("compiled", "rclpy")), ("waiting", ("auto", "blocking", "polling"))):
            if self._value(name) not in known:
                raise ValueError(f"parameter {name}: expected {' or '.join(known)}, got {self._value(name)}")
        hot = HotEndpoints(
            self._hot_node,
            slopes_depth(layout),
            wire.COMMAND.depth_at(loop.rate),
            compiled=self._value("frame_path") == "compiled",
            waiting=self._value("waiting"),
        )
        self._hrtc = Hrtc(
            layout,
            loop.delay,
            hot.publish,
            deadline_ns=int(deadline * 1e9),
            max_behind=self._value("max_behind"),
            max_epochs=self._value("max_epochs"),
        )
        self._hot, self._swap, self._layout, self._rate = hot, swap, layout, loop.rate
        self._offload = Offload(tilt_of_commands(layout, G_cal))
        try:
            multiplying = self._start_crew(swap, kernel, others=asked == "auto")
            self._load_first()
        except ValueError:
            self._clean_up()
            raise
        self._realtime = [
            realtime.read_blas(_BLAS),
            hot.outcome,
            multiplying,
            realtime.lock_memory(),
            realtime.huge_pages(swap.matrices()),
            realtime.quiet_interpreter(),
            realtime.fifo_priority(self._value("fifo_priority")),
            *self._pin_helpers(),
            self._set_workers_back(),
        ]
        for outcome in self._realtime:
            self._warn_of(outcome)
        # a manifest and blocks may have come while there was no memory for them
        if self._manifest is not None:
            self._begin(self._manifest)

    def _warn_of(self, outcome: realtime.Outcome) -> None:
        """Any thread."""
        if not outcome.applied:
            self.get_logger().warning(str(outcome))

    def _start_crew(self, swap: Swap, kernel: str, others: bool) -> realtime.Outcome:
        """Have the loop's products shared by as many threads as are asked for, or pay; what was measured."""
        assert self._hrtc is not None and self._hot is not None
        threads, available = self._value("threads"), len(self._cores or os.sched_getaffinity(0))
        if threads > available:
            raise ValueError(f"parameter threads: expected at most {available}, the cores there are, got {threads}")
        # one core is for the system and the middleware, unless cores were set aside
        tried = [threads] if threads else candidates(available if self._cores else available - 1)
        with realtime.kept_on(self._cores):
            choice = choose(swap.scratch(), tried, 1 / self._rate, others)
        self._crew = Crew(choice.threads, max(SPIN_NS, self._hot.poll_ns))
        self._hrtc.loop.use(self._crew)
        how = f"{choice.threads} thread{'s' * (choice.threads > 1)} ({'asked for' if threads else 'auto'})"
        detail = f"{KERNELS[kernel]}, {instructions()}, {how}"
        outcome = realtime.Outcome("kernel", True, f"{detail}; measured: {', '.join(map(str, choice.timings))}")
        self.get_logger().info(str(outcome))
        return outcome

    def _pin_helpers(self) -> list[realtime.Outcome]:
        helpers = self._crew.helpers if self._crew is not None else ()
        return [realtime.pin_helpers(helpers, self._cores)] if helpers else []

    def _set_workers_back(self) -> realtime.Outcome:
        """After SCHED_FIFO: a thread has the priority of the one that started it, or that of all when that was set."""
        outcomes = [pool.submit(realtime.stand_back, self._cores).result() for pool in (self._worker, self._files)]
        return next((outcome for outcome in outcomes if not outcome.applied), outcomes[0])

    def _load_first(self) -> None:
        """Start from the file of parameter ``reconstructor``, or else from the last one committed."""
        keep = self._value("keep")
        if path := self._value("reconstructor"):
            self._load(path)
        elif keep and Path(keep).exists():
            try:
                self._load(keep)
            except (ReconstructorError, Refused) as error:
                # nobody asked for this very one: without it the HRTC waits for the SRTC's
                self.get_logger().warning(f"{keep} is not used: {error}")

    def _load(self, path: str) -> None:
        assert self._swap is not None
        held = self._swap.stage_whole(Reconstructor.load(path))
        self.get_logger().info(f"{Path(path).name}: {held.check}")
        program = self._swap.commit(held.slot.id, held.slot.sha256)
        self._kinds[id(program)] = (EventKind.COMMIT, f"{held.label} from {Path(path).name}")

    def _activate(self) -> None:
        assert self._hrtc is not None
        self._refuse_beside_another()
        self._hrtc.stopping = False
        self._open_ring(self._hrtc)
        self._thread = threading.Thread(target=self._run, name="loop", daemon=True)
        self._thread.start()

    def _refuse_beside_another(self) -> None:
        """A plant would obey whichever of two commands comes first.

        Who publishes commands, the middleware knows, but it misses one that was killed only after many seconds. That
        one says nothing any more.

        Raises:
            Refused: another HRTC of this namespace is active.
        """
        assert self._hot is not None
        if not self._hot.rivals():
            return
        self._next_status()  # whoever's it is, it is of before
        end = time.monotonic() + _SPEAKS_WITHIN
        while time.monotonic() < end:
            said = self._next_status()  # of others alone: this thread would publish our own
            if said is not None and said.state == "active":
                raise Refused(f"another HRTC is active in namespace {self.get_namespace()}: deactivate or end it first")
            time.sleep(0.01)

    def _next_status(self) -> HrtcStatus | None:
        taken = self._statuses.handle.take_message(HrtcStatus, False)
        return None if taken is None else taken[0]

    def _open_ring(self, hrtc: Hrtc) -> None:
        """While the loop runs everything that it takes and publishes goes into a ring, if there can be one.

        Its length holds for one message a sensor; packets have more heads, and fill it sooner, those of a row most.
        """
        name, seconds = "telemetry ring", self._value("ring")
        outcome = realtime.Outcome(name, True, "not asked for")
        if seconds:
            layout, sensors = self._layout, self._layout.sensors
            whole, rows = (
                4 * (layout.n_slopes + layout.n_commands) + _MESSAGE_HEAD * (messages + 1)
                for messages in (len(sensors), sum(len(sensor.mask) for sensor in sensors))
            )
            capacity = max(math.ceil(seconds * self._rate * whole), _LEAST_RING)
            length = f"{seconds:g} s, {capacity / (self._rate * rows):.2g} s in packets of a row"
            path = ring_path(self.context.get_domain_id(), self.get_namespace())
            try:
                self._ring = RingWriter(path, capacity)
                outcome = realtime.Outcome(name, True, f"{length} ({capacity / 2**20:.0f} MiB, {path.name})")
            except OSError as error:
                outcome = realtime.Outcome(name, False, f"{error}; the recorder has to rely on its subscriptions")
        hrtc.record_to(self._ring)
        self._warn_of(outcome)
        self._realtime = [other for other in self._realtime if other.name != name] + [outcome]

    def _close_ring(self) -> None:
        if self._ring is not None:
            assert self._hrtc is not None
            self._hrtc.record_to(None)
            self._ring.close()
            self._ring = None

    def stop_loop(self) -> None:
        """Open the loop, publish flat, end the loop's thread. From every state; twice does no harm."""
        self.end_loop()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self._close_ring()
            self._publish_changes()

    def end_loop(self) -> None:
        """Have the loop's thread end, which publishes flat; without waiting for it. Any thread."""
        hrtc, hot = self._hrtc, self._hot
        if hrtc is not None and hot is not None:
            hrtc.stopping = True
            hot.wake()

    def _clean_up(self) -> None:
        self.stop_loop()
        for pool in (self._worker, self._files):
            pool.submit(lambda: None).result()
        if self._hot is not None:
            self._hot.destroy()
        self._end_crew()
        self._hot = self._hrtc = self._swap = None
        self._kinds.clear()
        self._taken_up = (None, 0)
        self._opened_by_itself, self._misses_told = "", 0

    def _end_crew(self) -> None:
        if self._crew is not None:
            assert self._hrtc is not None
            self._hrtc.loop.use(None)
            self._crew.close()
            self._crew = None

    def close(self) -> None:
        """Stop everything, in an order that never publishes into what is gone."""
        self.stop_loop()
        self._end_crew()
        self._worker.shutdown(wait=True)
        self._files.shutdown(wait=True)
        if self._hot is not None:
            self._hot.destroy()
            self._hot = None
        self._hot_node.destroy_node()
        self.destroy_node()

    # -- the loop's thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Wait, take, answer, until told to stop. The loop's thread."""
        hrtc, hot = self._hrtc, self._hot
        assert hrtc is not None and hot is not None
        try:
            several = self._crew is not None and self._crew.threads > 1
            pinned = realtime.pin_thread(self._cores[:1] if several else self._cores)
            self._warn_of(pinned)
            self._realtime = [outcome for outcome in self._realtime if outcome.name != pinned.name] + [pinned]
            hot.run(hrtc)
        except Exception:
            self.died = True
            self.failure = "the loop's thread died: " + traceback.format_exc()
            self.get_logger().fatal(self.failure)

    def _post(self, program: Program) -> None:
        assert self._hrtc is not None
        self._hrtc.loop.post(program)
        if self._hot is not None:
            self._hot.wake()

    # -- reconstructors on the wire ---------------------------------------------------------------------------------

    def _on_manifest(self, message: Any) -> None:
        manifest = Manifest(
            sha256=bytes(message.sha256),
            fingerprint=bytes(message.fingerprint),
            n_commands=message.n_commands,
            n_slopes=message.n_slopes,
            n_epochs=message.n_epochs,
            n_blocks=message.n_blocks,
            gain=message.gain,
            slope_reference=np.array(message.slope_reference, np.float32),
            command_limit=np.array(message.command_limit, np.float32),
            probe_commands=np.array(message.probe_commands, np.float32),
            probe_slopes=np.array(message.probe_slopes, np.float32),
            label=message.label,
            closed_sensors=tuple(message.closed_sensors),
            low_order_commands=np.array(message.low_order_commands, np.float32),
            low_order_slopes=np.array(message.low_order_slopes, np.float32),
        )
        if message.id != manifest.id:
            self._refuse(manifest, "id is not the first 8 bytes of sha256")
            return
        self._manifest = manifest
        if self._swap is not None:
            self._begin(manifest)

    def _begin(self, manifest: Manifest) -> None:
        swap = self._swap
        assert swap is not None

        def begin() -> None:
            self._last_block = time.monotonic()
            # asked on the worker's thread: the same one may be just being staged
            if swap.holds(manifest.sha256):
                swap.forget()  # a late repetition of what is here already
            else:
                swap.begin(manifest)

        self._watch(self._worker.submit(begin), manifest)
        for block in self._early_blocks.take(manifest.sha256):
            self._take(block)

    def _on_block(self, data: bytes) -> None:
        try:
            block = wire.read_block(data)
        except wire.WireError as error:
            self.get_logger().warning(f"srtc/reconstructor_block: {error}")
            return
        if self._swap is None or self._manifest is None or block.sha256 != self._manifest.sha256:
            self._early_blocks.keep(block, self._manifest.sha256 if self._manifest is not None else None)
            return
        self._take(block)

    def _take(self, block: wire.ReconstructorBlock) -> None:
        swap, manifest = self._swap, self._manifest
        assert swap is not None and manifest is not None

        def take() -> None:
            self._last_block = time.monotonic()  # not when it came: it may have waited for a long stage
            if swap.take(block):
                held = swap.stage()
                self._event(
                    EventKind.STAGED,
                    f"{held.label}: {held.check}",
                    held.slot.sha256,
                )

        self._watch(self._worker.submit(take), manifest)

    def _watch(self, future: Future[None], manifest: Manifest) -> None:
        """Report what the worker refuses; the callback runs on the worker's thread."""

        def report(done: Future[None]) -> None:
            error = done.exception()
            if isinstance(error, Refused):
                self._refuse(manifest, str(error))
            elif error is not None:
                self.get_logger().error(f"staging failed: {error!r}")

        future.add_done_callback(report)

    def _refuse(self, manifest: Manifest, reason: str) -> None:
        self._refused += 1
        self.get_logger().warning(f"reconstructor {manifest.id:016x} refused: {reason}")
        self._event(EventKind.REFUSED, reason, manifest.sha256)

    def _ask_again(self) -> None:
        swap, manifest = self._swap, self._manifest
        missing = swap.missing if swap is not None else None
        if swap is None or manifest is None or missing is None or missing[0] != manifest.id:
            return
        now = time.monotonic()
        identity, blocks = missing
        if now - self._last_block > _GIVE_UP_AFTER:

            def give_up() -> None:
                if swap.missing is not None:  # nothing has come in the meantime
                    swap.forget()
                    raise Refused(f"{len(blocks)} of {manifest.n_blocks} blocks never came")

            self._manifest = None
            self._watch(self._worker.submit(give_up), manifest)
        elif now - max(self._last_block, self._resend_asked) > _RESEND_AFTER and self._resend.service_is_ready():
            self._resend_asked = now
            self._resend.call_async(PublishReconstructor.Request(id=identity, blocks=blocks))

    # -- services ---------------------------------------------------------------------------------------------------

    def _close_loop(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        hrtc = self._hrtc
        if hrtc is None or self._thread is None:
            response.message = "the HRTC is not active"
        elif request.data and (self._swap is None or self._swap.active is None):
            response.message = "no reconstructor is active: commit one first"
        else:
            wanted = LoopState.CLOSED if request.data else LoopState.OPEN
            response.success, response.message = self._request(hrtc, wanted)
        return response

    def _flat(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        hrtc = self._hrtc
        if hrtc is None or self._thread is None:
            response.message = "the HRTC is not active"
        else:
            response.success, response.message = self._request(hrtc, LoopState.FLAT)
        return response

    def _request(self, hrtc: Hrtc, state: LoopState) -> tuple[bool, str]:
        """Have the loop closed, opened or flat: whether it is, and what it is."""
        loop = hrtc.loop
        self._publish_changes()
        if state is LoopState.CLOSED:
            self._opened_by_itself = ""
        loop.request_state(state)
        assert self._hot is not None
        self._hot.wake()
        success = self._wait_for(lambda: loop.loop_state is state)
        self._publish_changes()
        message = loop.loop_state.name.lower()
        if not success:
            reason = "the loop has not taken the request up"
            if self._opened_by_itself:
                reason = f"it opened again by itself ({self._opened_by_itself})"
            message += f": {reason} in {_ADOPTION_TIMEOUT:g} s"
        return success, message

    def _commit(
        self, request: SwapReconstructor.Request, response: SwapReconstructor.Response
    ) -> SwapReconstructor.Response:
        return self._swap_service(request, response, EventKind.COMMIT)

    def _roll_back(
        self, request: SwapReconstructor.Request, response: SwapReconstructor.Response
    ) -> SwapReconstructor.Response:
        return self._swap_service(request, response, EventKind.ROLLBACK)

    def _swap_service(self, request: Any, response: Any, kind: EventKind) -> Any:
        swap = self._swap
        if swap is None:
            response.message = "the HRTC is not configured"
            return response
        action = swap.commit if kind is EventKind.COMMIT else swap.roll_back
        try:
            program = action(request.id, bytes(request.sha256))
        except Refused as error:
            self._event(EventKind.REFUSED, str(error), bytes(request.sha256))
            response.message = str(error)
            return response
        assert swap.active is not None
        self._kinds[id(program)] = (kind, swap.active.label)
        response.success, response.first_frame, response.message = self._adopted(program, swap.active.label)
        self._keep()
        return response

    def _static_shape(
        self, request: SetStaticShape.Request, response: SetStaticShape.Response
    ) -> SetStaticShape.Response:
        swap = self._swap
        if swap is None:
            response.message = "the HRTC is not configured"
            return response
        pair = {}
        for name, values, count in (
            ("offset", request.offset, self._layout.n_commands),
            ("slope_reference", request.slope_reference, self._layout.n_slopes),
        ):
            array = np.array(values, np.float32) if len(values) else np.zeros(count, np.float32)
            if array.shape != (count,) or not np.isfinite(array).all():
                response.message = f"{name}: expected {count} finite values, got {len(values)}"
                return response
            pair[name] = array
        program = swap.change_settings(**pair)
        response.settings = swap.settings.id
        if program is None:
            response.success, response.message = True, "taken up with the first reconstructor"
            self._event(EventKind.SETTINGS, "static shape")
        else:
            self._kinds[id(program)] = (EventKind.SETTINGS, "static shape")
            response.success, response.first_frame, response.message = self._adopted(program, "static shape")
        return response

    def _close_sensor(self, request: CloseSensor.Request, response: CloseSensor.Response) -> CloseSensor.Response:
        swap = self._swap
        if swap is None:
            response.message = "the HRTC is not configured"
            return response
        names = [sensor.name for sensor in self._layout.sensors]
        response.closed_sensors = swap.settings.closed_sensors
        if not request.sensors or not set(request.sensors) <= set(names):
            response.message = f"sensors: expected some of {', '.join(names)}, got {', '.join(request.sensors)}"
            return response
        those = sum(1 << names.index(name) for name in set(request.sensors))
        closed = swap.settings.closed_sensors | those if request.closed else swap.settings.closed_sensors & ~those
        program = swap.change_settings(closed_sensors=closed)
        response.closed_sensors = closed
        text = f"sensors closed: {', '.join(self._closed_names()) or 'none'}"
        if program is None:
            response.success, response.message = True, f"{text}; taken up with the first reconstructor"
            self._event(EventKind.SETTINGS, text)
        else:
            text += f"; commands are made by {program.acts}"
            self._kinds[id(program)] = (EventKind.SETTINGS, text)
            response.success, response.first_frame, response.message = self._adopted(program, text)
        return response

    def _closed_names(self) -> list[str]:
        assert self._swap is not None
        closed = self._swap.settings.closed_sensors
        return [sensor.name for w, sensor in enumerate(self._layout.sensors) if closed >> w & 1]

    def _adopted(self, program: Program, what: str) -> tuple[bool, int, str]:
        """Wait until the loop runs ``program``: (success, first frame, message)."""
        hrtc = self._hrtc
        assert hrtc is not None
        if self._thread is None:
            return True, hrtc.loop.frame, f"{what}: in force when the HRTC is activated"

        def taken_up() -> bool:
            self._publish_changes()
            return self._taken_up[0] is program

        if not self._wait_for(taken_up):
            return False, 0, f"{what}: posted, but the loop has not taken it up in {_ADOPTION_TIMEOUT:g} s"
        return True, self._taken_up[1], what

    @staticmethod
    def _wait_for(condition: Callable[[], bool]) -> bool:
        end = time.monotonic() + _ADOPTION_TIMEOUT
        while time.monotonic() < end:
            if condition():
                return True
            time.sleep(0.0005)
        return condition()

    def _keep(self) -> None:
        path = self._value("keep")
        if path:
            assert self._swap is not None

            def report(done: Future[None]) -> None:
                if (error := done.exception()) is not None:
                    self.get_logger().error(f"{path}: the committed reconstructor was not kept ({error})")

            self._files.submit(self._swap.save_active, path).add_done_callback(report)

    # -- parameters -------------------------------------------------------------------------------------------------

    def _set_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        swap = self._swap
        changes = {p.name: p.value for p in parameters if p.name in SCALARS}
        if swap is not None and changes:
            program = swap.change_settings(**changes)
            text = ", ".join(f"{name} = {value}" for name, value in changes.items())
            if program is None:
                self._event(EventKind.SETTINGS, text)
            else:
                self._kinds[id(program)] = (EventKind.SETTINGS, text)
        return SetParametersResult(successful=True)

    # -- what is published ------------------------------------------------------------------------------------------

    def _event(self, kind: EventKind, text: str, sha256: bytes | None = None) -> None:
        """Tell of something that the loop did not have to take up; ``sha256`` of the reconstructor in question, if one
        is. From the executor's or the worker's thread."""
        hrtc, swap = self._hrtc, self._swap
        now: dict[str, Any] = {}
        if hrtc is not None:
            loop = hrtc.loop
            now = {
                "session": hrtc.session,
                "frame": loop.frame,
                "loop_state": loop.loop_state,
                "delay": loop.delay,
                "program": loop.program,
            }
        fields = event_fields(kind, text, **now, settings=swap.settings if swap is not None else None)
        if sha256 is not None:
            fields |= {"reconstructor": int.from_bytes(sha256[:8], "big"), "sha256": list(sha256)}
        self._publish_event(fields)

    def _publish_event(self, fields: dict[str, Any]) -> None:
        message = HrtcEvent(**fields)
        message.header.stamp = self.get_clock().now().to_msg()
        self._events.publish(message)

    def _publish_changes(self) -> None:
        hrtc = self._hrtc
        while hrtc is not None and not hrtc.changes.empty():
            change = hrtc.changes.get()
            if change.what == "PROGRAM":
                kind, text = self._kinds.pop(id(change.program), (EventKind.SETTINGS, ""))
                self._taken_up = (change.program, change.frame)
            else:
                kind, text = EventKind[change.what], change.reason
                if change.by_itself:
                    self._opened_by_itself = text
            self._publish_event(change_fields(change, kind, text, hrtc.loop.delay))

    def _publish_snapshot(self, snapshot: Snapshot) -> None:
        message = HrtcState(**state_fields(snapshot))
        message.header.stamp.sec, message.header.stamp.nanosec = snapshot.stamp_sec, snapshot.stamp_nanosec
        self._states.publish(message)

    def _every_100_ms(self) -> None:
        self._publish_changes()
        self._ask_again()
        message = HrtcStatus(state=self._lifecycle, reconstructors_refused=self._refused)
        message.header.stamp = self.get_clock().now().to_msg()
        message.realtime = "; ".join(str(outcome) for outcome in self._realtime)
        hrtc, swap, hot = self._hrtc, self._swap, self._hot
        if hrtc is not None and swap is not None and hot is not None:
            while not hrtc.snapshots.empty():
                self._publish_snapshot(hrtc.snapshots.get())
            loop = hrtc.loop
            message.slope_publishers, message.command_readers = hot.matched()
            message.session = hrtc.session
            message.frame = max(loop.answered, 0)
            message.loop_state = int(loop.loop_state)
            message.loop_opened_by_faults = loop.opened_by_faults
            message.loop_opened_by_silence = loop.opened_by_silence
            message.closed_sensors = swap.settings.closed_sensors
            for name in ("active", "staged", "previous"):
                held = getattr(swap, name)
                setattr(message, "reconstructor" if name == "active" else name, held.slot.id if held else 0)
            if swap.active is not None:
                message.stability = swap.active.check.stability
                message.gain = swap.active.slot.gain
            for name, value in vars(hrtc.counters).items():
                setattr(message, name, value)
            message.deadline = hrtc.latency.deadline_ns * 1e-9
            for before, latency in (("", hrtc.latency), ("frame_", hrtc.frame_latency)):
                setattr(message, f"{before}deadline_misses", latency.misses)
                for name, value in latency.summary().items():
                    setattr(message, f"{before}latency_{name}", value)
            message.offload_tip, message.offload_tilt = self._offload.look(loop, hrtc.session)
            message.tip_tilt_frame = loop.tip_tilt_frame
            for name, value in loop.tip_tilt_counts.items():
                setattr(message, f"tip_tilt_{name}", value)
            message.tip_tilt_silence = self._tip_tilt_silence(hrtc)
            message.silence = (time.monotonic_ns() - hrtc.last_slopes_ns) * 1e-9 if hrtc.session else math.inf
        self._status.publish(message)
        self._last_status = message

    def _every_second(self) -> None:
        if self._hrtc is not None:
            self._hrtc.want_snapshot()
        status = DiagnosticStatus(name="hrtc", hardware_id=self.get_namespace())
        status.level, status.message = self._health()
        refused = [outcome.name for outcome in self._realtime if not outcome.applied]
        if refused and status.level == DiagnosticStatus.OK:
            status.level = DiagnosticStatus.WARN
            status.message += f"; refused by the system: {', '.join(refused)}"
        status.values = [KeyValue(key="lifecycle", value=self._lifecycle)] + [
            KeyValue(key=outcome.name, value=str(outcome)) for outcome in self._realtime
        ]
        if self._hrtc is not None:
            status.values += [KeyValue(key=key, value=value) for key, value in self._told(self._hrtc)]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    @staticmethod
    def _tip_tilt_silence(hrtc: Hrtc) -> float:
        last = hrtc.last_tip_tilt_ns
        return (time.monotonic_ns() - last) * 1e-9 if last else math.inf

    def _health(self) -> tuple[bytes, str]:
        hrtc = self._hrtc
        if self.failure is not None:
            return DiagnosticStatus.ERROR, self.failure
        if hrtc is None or self._thread is None:
            return DiagnosticStatus.OK, self._lifecycle
        silence = (time.monotonic_ns() - hrtc.last_slopes_ns) * 1e-9
        silent = f"no slopes for {silence:.1f} s" if silence > _SILENT and hrtc.session else ""
        state = hrtc.loop.loop_state.name.lower()
        if self._opened_by_itself:
            now = f"{state}, {silent}" if silent else state
            return DiagnosticStatus.ERROR, f"{now}; the loop opened by itself: {self._opened_by_itself}"
        if self._hot is not None and (trouble := self._hot.rivals() or self._hot.unmatched()):
            return DiagnosticStatus.WARN, trouble
        if not hrtc.session:
            return DiagnosticStatus.OK, "waiting for slopes"
        if silent:
            return DiagnosticStatus.WARN, silent
        if closed := self._closed_names():
            return DiagnosticStatus.WARN, f"{state}; sensors closed: {', '.join(closed)}"
        starless = self._tip_tilt_silence(hrtc)
        if self._layout.tip_tilt_sensors and starless > _SILENT_STARS:
            return DiagnosticStatus.WARN, f"{state}; no slopes of tip-tilt's own stars for {starless:.1f} s: it is held"
        misses, self._misses_told = hrtc.latency.misses - self._misses_told, hrtc.latency.misses
        if misses:
            return DiagnosticStatus.WARN, f"{state}, {misses} deadline misses in a second"
        if lost := hrtc.counters.changes_lost:
            return DiagnosticStatus.WARN, f"{state}; {lost} events were lost: a replay will not be exact"
        return DiagnosticStatus.OK, state

    @staticmethod
    def _told(hrtc: Hrtc) -> Iterable[tuple[str, str]]:
        """What happened since the HRTC was configured, for the diagnostics."""

        def line(latency: LatencyHistogram) -> str:
            parts = [f"{name} {value * 1e6:.0f} us" for name, value in latency.summary().items()]
            return ", ".join(parts) + f"; {latency.misses} above {latency.deadline_ns * 1e-3:.0f} us"

        yield "last slopes received to command published", line(hrtc.latency)
        yield "first slopes received to command published", line(hrtc.frame_latency)
        loop = hrtc.loop
        yield "loop opened by itself", f"{loop.opened_by_faults} by faults, {loop.opened_by_silence} by silence"
        yield "events lost", str(hrtc.counters.changes_lost)


def _on_signals(react: Callable[[], None]) -> None:
    """Call ``react`` at once, on a thread of its own, at SIGINT or SIGTERM.

    The main thread would do it only after whatever callback it is in, or has been waiting for.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)  # the pipe tells

    def wait() -> None:
        while os.read(reader, 1):
            react()

    threading.Thread(target=wait, name="signals", daemon=True).start()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM. ``arguments``: ROS arguments (``--ros-args -p system:=mini ...``)."""
    # rclpy's own handlers shut the context first, after which flat could not be published any more
    rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    stop = threading.Event()
    node = HrtcNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def on_signal() -> None:
        stop.set()
        node.end_loop()
        executor.wake()

    _on_signals(on_signal)
    try:
        while not stop.is_set() and not node.died:
            try:
                executor.spin_once(timeout_sec=0.1)
            except Exception:
                # no callback may end the loop; one of rclpy fails when the state does not have the transition asked for
                node.get_logger().error(f"a call failed:\n{traceback.format_exc()}")
    finally:
        executor.remove_node(node)
        node.close()
        executor.shutdown()
        rclpy.shutdown()
    return 1 if node.died else 0


if __name__ == "__main__":
    raise SystemExit(main())
