"""The SRTC as a ROS 2 node: builds reconstructors from its priors, and learns better ones from telemetry.

It computes with one BLAS thread under SCHED_IDLE, so that the loop beside it is not disturbed. Reconstructors are
published on request, by label or id; with ``learn`` also whenever one proves better on telemetry, and with
``auto_commit`` they are committed and rolled back as well. Four threads: the executor's, which carries messages; the
listener, which takes telemetry off the wire; one that fits and builds; one that judges what the loop runs, which does
not wait for a fit.
"""

from __future__ import annotations

import os

# before numpy loads
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"

import json
import signal
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, get_args

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from msgs_schema.msg import AtmosphereProfile, HrtcStatus, ModelHealth
from msgs_schema.msg import Reconstructor as ReconstructorMsg
from msgs_schema.msg import ReconstructorBlock as ReconstructorBlockMsg
from msgs_schema.srv import PublishReconstructor, SwapReconstructor
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from srtomo_core import wire
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, ReconstructorError, block_table, load_interaction_matrix
from srtomo_core.system import InstrumentError, System, load_system
from srtomo_srtc.closures import Closures, sets_of_lasers
from srtomo_srtc.decide import Rules
from srtomo_srtc.learned_sky import lags_of, learned_sky
from srtomo_srtc.learner import Belief, Judgement, Learner, Outcome
from srtomo_srtc.listener import Listener
from srtomo_srtc.model import ground_prior
from srtomo_srtc.order import Order, Step
from srtomo_srtc.provenance import believed_system
from srtomo_srtc.reconstructors import implicit, predictive
from srtomo_srtc.registration import registered_layout, with_places
from srtomo_srtc.report import believed_fields, diagnosis, health_fields, learned_fields, refusal_fields
from srtomo_srtc.telemetry import BLOCKS, COUNTED_RATE, STRETCHES, NoWindow, Recent, Statistics, Telemetry
from srtomo_srtc.wind import effective_lag
from srtomo_srtc.worker import Worker

PRIORS: dict[str, Callable[[System], System]] = {"file": lambda system: system, "ground": ground_prior}
"""What a reconstructor may suppose of the sky: the instrument file's profile, or all turbulence at the ground."""

METHODS: dict[str, Callable[..., tuple[Reconstructor, Any]]] = {"implicit": implicit, "predictive": predictive}

_LEARNED = "learned"
_LAST_READER = Duration(seconds=1)
_STAGING = 30.0  # s that the HRTC may take to stage a reconstructor
_MOST_OF_CLOSURES = 2**30  # bytes that come with each reconstructor; the writer keeps two, and the HRTC three and one

_PARAMETERS: tuple[tuple[str, Any, str], ...] = (
    ("system", "", "instrument: name or path of a .yaml file"),
    ("changes", "{}", 'changes to the instrument as JSON, e.g. {"loop.rate": "1 kHz"}'),
    ("priors", ["file"], f"reconstructors to build at the start, by prior: {', '.join(PRIORS)}"),
    ("method", "implicit", f"of all reconstructors: {', '.join(METHODS)}"),
    ("interaction_matrix", "", "path of the calibrated interaction matrix (srtomo calibrate); empty: the model's own"),
    ("registration", "", "path of where the sensors were found (srtomo register --json); empty: as in the instrument"),
    ("closures", "singles", f"what is built for when lasers are closed: {', '.join(get_args(Closures))}"),
    ("learn", False, "learn the sky from telemetry, and publish reconstructors that are better by it"),
    ("auto_commit", False, "commit what was learned, and roll back what proves worse; false: leave that to operators"),
    ("keep", "", "path of the HRTC's parameter keep: what the loop runs is known from it after a restart of this node"),
    ("window", 16.0, "telemetry that a sky is learned from, s; each window is judged once"),
    ("every", 10.0, "from one swap to the next at least, s"),
    ("floor", 1.0, "wavefront error that a swap has to gain by prediction, nm rms"),
    ("pause", 60.0, "from a roll-back to the next swap, s"),
)
_LEAST = {"window": 0.1, "every": 0.1, "floor": 0.0, "pause": 0.0}


def parameters() -> Iterable[tuple[str, Any, str]]:
    """Name, default and description of each parameter; all are read-only."""
    return _PARAMETERS


class SrtcNode(Node):
    """The node ``srtc``. Its methods run on the executor's thread."""

    def __init__(self) -> None:
        super().__init__("srtc")
        for name, default, description in parameters():
            self.declare_parameter(name, default, ParameterDescriptor(description=description, read_only=True))
        self._manifests = self._publisher(ReconstructorMsg, wire.RECONSTRUCTOR)
        self._blocks: Any = None
        self._profiles = self._publisher(AtmosphereProfile, wire.PROFILE)
        self._healths = self._publisher(ModelHealth, wire.HEALTH)
        self._diagnostics = self._publisher(DiagnosticArray, wire.DIAGNOSTICS)
        self._built: dict[str, Belief] = {}
        self._learner: Learner | None = None
        self._listener: Listener | None = None

    def _publisher(self, kind: type, topic: wire.Topic) -> Any:
        return self.create_publisher(kind, topic.name, QoSProfile(**topic.qos()))

    def build(self) -> None:
        """Build a reconstructor for every prior; from then on they can be asked for, and learning begins.

        Raises:
            InstrumentError: the instrument, or a parameter, is wrong.
        """
        values = {name: self.get_parameter(name).value for name, _, _ in parameters()}
        if not values["system"]:
            raise InstrumentError("parameter system: expected a name or the path of a .yaml file")
        if values["method"] not in METHODS:
            raise InstrumentError(f"parameter method: expected one of {', '.join(METHODS)}, got {values['method']!r}")
        for name, least in _LEAST.items():
            if not values[name] >= least:
                raise InstrumentError(f"parameter {name}: expected at least {least:g}, got {values[name]:g}")
        if values["closures"] not in get_args(Closures):
            raise InstrumentError(
                f"parameter closures: expected one of {', '.join(get_args(Closures))}, got {values['closures']!r}"
            )
        system = load_system(values["system"], json.loads(values["changes"]))
        places = Path(values["registration"]) if values["registration"] else None
        try:
            self._layout, self._places = registered_layout(places, system)
        except ValueError as error:
            raise InstrumentError(f"parameter registration: {error}") from None
        self._method = partial(METHODS[values["method"]], closures=self._that_fit(system, values["closures"]))
        G = None
        for prior in values["priors"]:
            if prior not in PRIORS:
                raise InstrumentError(f"parameter priors: expected some of {', '.join(PRIORS)}, got {prior!r}")
            believed = PRIORS[prior](system)
            reconstructor, G = self._reconstructor(believed, prior)
            self._built[prior] = Belief(prior, believed, reconstructor, self._layout)
            self.get_logger().info(f"built {prior}: {reconstructor.id:016x}")
        if values["learn"]:
            if values["interaction_matrix"]:
                try:
                    G = load_interaction_matrix(values["interaction_matrix"], Layout(system).fingerprint)
                except ReconstructorError as error:
                    raise InstrumentError(f"parameter interaction_matrix: {error}") from None
            if G is None:
                raise InstrumentError("parameter priors: expected at least one to begin learning with")
            self._begin_learning(system, G, values)
            if values["keep"] and Path(values["keep"]).exists():
                self._recall(values["keep"])
        self.create_service(PublishReconstructor, "srtc/publish", self._publish)

    def _reconstructor(self, believed: System, label: str, **keywords: Any) -> tuple[Reconstructor, Any]:
        """By the method, for the places that the sensors are in; with its interaction matrix."""
        reconstructor, G = self._method(believed, self._layout, label=label, **keywords)
        return with_places(reconstructor, self._places), G

    def _that_fit(self, system: System, closures: Closures) -> Closures:
        """The same, or the low order alone where they would take more memory than they may."""
        layout, n = Layout(system), len(sets_of_lasers(system, closures))
        size = 4 * n * layout.n_commands * (layout.n_slopes + layout.n_commands)
        if size <= _MOST_OF_CLOSURES:
            return closures
        self.get_logger().warning(
            f"closures: low_order, since {n} sets of lasers would take {size / 2**30:.1f} GiB with each reconstructor"
        )
        return "low_order"

    # -- publishing -------------------------------------------------------------------------------------------------

    def _publish(
        self, request: PublishReconstructor.Request, response: PublishReconstructor.Response
    ) -> PublishReconstructor.Response:
        found = [
            belief
            for label, belief in self._built.items()
            if request.label == label or (not request.label and request.id == belief.reconstructor.id)
        ]
        if not found:
            wanted = request.label or f"{request.id:016x}"
            response.message = f"no reconstructor {wanted!r} here, only {', '.join(self._built) or 'none yet'}"
            return response
        belief = found[0]
        if request.blocks:
            self._send_blocks(belief.reconstructor, set(request.blocks))
        else:
            if belief.source != _LEARNED:
                self._send_profile(belief.source, belief.reconstructor.id, believed_fields(belief.system))
            self._send(belief.reconstructor)
        response.success = True
        response.message = belief.source
        response.id = belief.reconstructor.id
        response.sha256 = list(belief.reconstructor.sha256)
        return response

    def _send(self, reconstructor: Reconstructor) -> None:
        # the topic keeps one manifest: the next would take the place of one that a busy reader has not got yet
        self._manifests.wait_for_all_acked(_LAST_READER)
        low = reconstructor.low_order
        message = ReconstructorMsg(
            id=reconstructor.id,
            sha256=list(reconstructor.sha256),
            fingerprint=list(reconstructor.fingerprint),
            n_commands=reconstructor.n_commands,
            n_slopes=reconstructor.n_slopes,
            n_epochs=reconstructor.n_epochs,
            n_blocks=len(block_table(reconstructor.n_commands, reconstructor.n_epochs, len(reconstructor.closures))),
            gain=reconstructor.gain,
            slope_reference=reconstructor.slope_reference.tolist(),
            command_limit=reconstructor.command_limit.tolist(),
            probe_commands=reconstructor.probe_commands.ravel().tolist(),
            probe_slopes=reconstructor.probe_slopes.ravel().tolist(),
            closed_sensors=[closure.sensors for closure in reconstructor.closures],
            low_order_commands=[] if low is None else low.commands.ravel().tolist(),
            low_order_slopes=[] if low is None else low.slopes.ravel().tolist(),
            label=reconstructor.label,
            provenance=json.dumps(dict(reconstructor.provenance)),
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._manifests.publish(message)
        self._send_blocks(reconstructor, None)

    def _send_blocks(self, reconstructor: Reconstructor, only: Iterable[int] | None) -> None:
        blocks = list(reconstructor.blocks())
        if self._blocks is None:
            # two reconstructors' are kept for late readers: any more would be memory for nothing
            topic = wire.RECONSTRUCTOR_BLOCK
            self._blocks = self.create_publisher(
                ReconstructorBlockMsg, topic.name, QoSProfile(**topic.qos(2 * len(blocks)))
            )
        for block in blocks:
            if only is None or block.index in only:
                self._blocks.publish(
                    wire.write_block(
                        wire.ReconstructorBlock(
                            reconstructor.id, reconstructor.sha256, block.index, block.epoch, block.matrix,
                            block.first_row, block.rows,
                        )
                    )
                )  # fmt: skip

    def _send_profile(self, source: str, identity: int, fields: dict[str, Any]) -> None:
        message = AtmosphereProfile(reconstructor=identity, source=source, **fields)
        message.header.stamp = self.get_clock().now().to_msg()
        self._profiles.publish(message)

    # -- learning ---------------------------------------------------------------------------------------------------

    def _begin_learning(self, system: System, G: Any, values: dict[str, Any]) -> None:
        layout, predicts = self._layout, values["method"] == "predictive"
        rules = Rules(
            floor=values["floor"] * 1e-9, every=values["every"], watch=2 * values["window"], pause=values["pause"]
        )
        every = max(1, round(system.loop.rate / COUNTED_RATE))
        lags = lags_of(system, every) if predicts else ()
        telemetry = Telemetry(system, G, layout=layout, window=values["window"], every=every, lags=lags)
        frames_ahead = effective_lag(system.loop) * system.loop.rate
        learner = Learner(
            system,
            partial(learned_sky, system, winds=predicts, layout=layout),
            lambda believed: self._reconstructor(believed, _LEARNED, fast=True)[0],
            rules,
            ahead=every * max(1, round(frames_ahead / every)) if predicts else 0,
            layout=layout,
        )
        for belief in self._built.values():
            learner.know(belief)
        self._system = system
        self._auto_commit, self._window = values["auto_commit"], values["window"]
        self._status: HrtcStatus | None = None
        self._order: Order | None = None
        self._judging = self._looking = False
        self._last_asked = self._last_looked = time.monotonic()
        self._last_seen = -1, -1
        self._reason = 0, "waiting for telemetry"
        self._hot_node = Node("srtc_hot")
        self._listener = Listener(self._hot_node, telemetry, system.loop.rate, len(system.sensors))
        self._learner = learner
        self._fits: Worker[Statistics] = Worker("fits", learner.judge)
        self._watch: Worker[Recent] = Worker("watch", learner.watch)
        for thread in (self._listener, self._fits, self._watch):
            thread.start()
            # its name for `top -H`, which Python's threads have not got from themselves
            with suppress(OSError):
                Path(f"/proc/self/task/{thread.native_id}/comm").write_text(thread.name)
        self.create_subscription(HrtcStatus, wire.STATUS.name, self._on_status, QoSProfile(**wire.STATUS.qos()))
        self._commit = self.create_client(SwapReconstructor, "hrtc/commit")
        self._roll_back = self.create_client(SwapReconstructor, "hrtc/roll_back")
        # timers of the system's clock would stop for as long as it is set back
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.1, partial(self._follow, self._listener), clock=steady)
        self.create_timer(0.1, partial(self._look, self._listener), clock=steady)
        self.create_timer(1.0, partial(self._diagnose, self._listener), clock=steady)

    def _recall(self, path: str) -> None:
        """Know what an SRTC before this one learned, by the file in which the HRTC keeps what was committed last."""
        assert self._learner is not None
        try:
            reconstructor = Reconstructor.load(path)
            if reconstructor.fingerprint != self._layout.fingerprint:
                raise ReconstructorError("made for another instrument")
            if reconstructor.provenance.get("registration", {}) != self._places:
                raise ReconstructorError("made for sensors in other places")
            believed = believed_system(reconstructor.provenance, self._system)
        except (ReconstructorError, InstrumentError) as error:
            self.get_logger().warning(f"{path} is not used: {error}")
            return
        if reconstructor.label == _LEARNED:
            self._built[_LEARNED] = Belief(_LEARNED, believed, reconstructor, self._layout)
            self._learner.know(self._built[_LEARNED])

    def _on_status(self, status: HrtcStatus) -> None:
        if self._learner is not None and (self._status is None or status.reconstructor != self._status.reconstructor):
            self._learner.running(status.reconstructor)
        self._status = status
        self._pursue()

    def _look(self, listener: Listener) -> None:
        """Have the latest frames judged each half block, and act on what comes of it."""
        now = time.monotonic()
        if not self._looking and now - self._last_looked >= self._window / (BLOCKS * STRETCHES):
            self._last_looked, self._looking = now, True
            listener.look()
        if not listener.recent.empty():
            recent = listener.recent.get()
            seen, self._last_seen = self._last_seen, (recent.session, recent.last_frame)
            if self._last_seen != seen:
                self._watch.judge(recent)
            else:
                self._looking = False
        if not self._watch.judgements.empty():
            self._looking = False
            judgement = self._watch.judgements.get()
            if judgement is not None:
                self._act_on(judgement)

    def _follow(self, listener: Listener) -> None:
        """Have windows judged, and act on what comes of it."""
        now = time.monotonic()
        if not (self._judging or listener.failure) and now - self._last_asked >= self._window:
            self._last_asked, self._judging = now, True
            listener.ask()
        if not listener.windows.empty():
            window = listener.windows.get()
            if isinstance(window, Statistics):
                self._fits.judge(window)
            else:
                self._judging = False
                self._refused(window)
        if not self._fits.judgements.empty():
            self._judging = False
            judgement = self._fits.judgements.get()
            if judgement is not None:
                self._act_on(judgement)

    def _refused(self, why: NoWindow) -> None:
        """There is no window to judge."""
        active = 0 if self._status is None else self._status.reconstructor
        sources = {belief.reconstructor.id: belief.source for belief in self._built.values()}
        self._send_health(refusal_fields(why, active, sources.get(active, "")))
        self._told(1, str(why))

    def _send_health(self, fields: dict[str, Any]) -> None:
        message = ModelHealth(**fields)
        message.header.stamp = self.get_clock().now().to_msg()
        self._healths.publish(message)

    def _act_on(self, judgement: Judgement) -> None:
        active, status = judgement.active, self._status
        if judgement.outcome in (Outcome.PUBLISHED, Outcome.ROLLED_BACK) and active is not None and status is not None:
            if status.reconstructor != active.reconstructor.id:
                judgement.candidate = None
                judgement.ended(Outcome.KEPT, f"{judgement.reason}; dropped: the loop runs {status.reconstructor:016x}")
        candidate = judgement.candidate
        if judgement.sky is not None and isinstance(judgement.window, Statistics):
            identity = candidate.reconstructor.id if candidate is not None else 0
            self._send_profile(_LEARNED, identity, learned_fields(self._system, judgement.sky, judgement.window))
        self._send_health(health_fields(judgement))
        if isinstance(judgement.window, Statistics) or judgement.outcome is not Outcome.KEPT:
            self._told(*diagnosis(judgement))
        instead, until = active.reconstructor.id if active is not None else 0, time.monotonic() + _STAGING
        if judgement.outcome is Outcome.PUBLISHED and candidate is not None:
            self._built[_LEARNED] = candidate
            self._send(candidate.reconstructor)
            self._give_order(Order(candidate.reconstructor, instead, until, published=True))
        elif judgement.outcome is Outcome.ROLLED_BACK and judgement.previous is not None:
            target = judgement.previous
            # blocks that the HRTC misses are asked for by id
            self._built[target.source] = target
            self._give_order(Order(target.reconstructor, instead, until, back=True))

    def _told(self, level: int, reason: str) -> None:
        """Say it from now on in the diagnostics, and once in the log; ``level``: 0 OK, 1 WARN, 2 ERROR."""
        news = (level, reason) != self._reason
        self._reason = level, reason
        # rclpy wants one line of code for each severity
        if news and level:
            self.get_logger().warning(reason)
        elif news:
            self.get_logger().info(reason)

    def _give_order(self, order: Order) -> None:
        if self._auto_commit:
            if self._order is not None:
                self._told(2, f"could not {self._order.text}: the HRTC does not hold it")
            self._order = order
        else:
            if self._next(order) is Step.PUBLISH:
                self._send(order.reconstructor)
            self.get_logger().info(f"auto_commit is off: to {order.text} is the operator's")

    def _pursue(self) -> None:
        """Swap as soon as the HRTC can."""
        order, status = self._order, self._status
        if order is None or status is None or order.called:
            return
        step = self._next(order)
        if step in (Step.COMMIT, Step.ROLL_BACK):
            order.called = True
            client = self._roll_back if step is Step.ROLL_BACK else self._commit
            request = SwapReconstructor.Request(id=order.reconstructor.id, sha256=list(order.reconstructor.sha256))
            client.call_async(request).add_done_callback(partial(self._swapped, order, step))
        elif step is Step.PUBLISH:
            order.published = True
            self._send(order.reconstructor)
        elif step is not Step.WAIT:
            self._order = None
            if step is Step.DROP:
                self._told(0, f"did not {order.text}: the loop was given {status.reconstructor:016x} meanwhile")
            elif step is Step.FAIL:
                self._told(2, f"could not {order.text}: the HRTC does not hold it")

    def _next(self, order: Order) -> Step:
        """By the HRTC's latest status."""
        status = self._status
        if status is None:
            return Step.WAIT
        return order.step(status.reconstructor, status.staged, status.previous, time.monotonic())

    def _swapped(self, order: Order, step: Step, future: Future) -> None:
        response = future.result()
        if step is Step.ROLL_BACK and not (response is not None and response.success):
            order.refused, order.called = True, False  # the status was of before another swap
            return
        if self._order is order:
            self._order = None
        if response is not None and response.success:
            self.get_logger().info(f"{order.text}: from frame {response.first_frame} on")
        else:
            self._told(2, f"could not {order.text}: {response and response.message}")

    def _diagnose(self, listener: Listener) -> None:
        level, reason = (2, listener.failure) if listener.failure else self._reason
        status = DiagnosticStatus(name="srtc", hardware_id=self.get_namespace(), level=bytes([level]), message=reason)
        status.values = [KeyValue(key=f"frames {name}", value=str(count)) for name, count in listener.counts.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def close(self) -> None:
        """End the threads and give the endpoints back."""
        if self._learner is not None and self._listener is not None:
            self._fits.finish()
            self._watch.finish()
            self._listener.finish()
            self._hot_node.destroy_node()
        self.destroy_node()


def main(arguments: Sequence[str] | None = None) -> int:
    """Build, then serve until SIGINT or SIGTERM. ``arguments``: ROS arguments (``--ros-args -p system:=mini ...``)."""
    rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)
    node = SrtcNode()
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except OSError as error:
        node.get_logger().warning(f"SCHED_IDLE refused: {error}")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        node.build()
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.1)
    except (InstrumentError, ValueError, MemoryError) as error:
        node.get_logger().error(str(error))
        return 2
    finally:
        executor.shutdown()
        node.close()
        rclpy.shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
