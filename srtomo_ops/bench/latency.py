"""Latency of the frame loop, held against one float32 matrix-vector product (sgemv) on one core.

Sensors send random slopes whose sum comes back to zero, paced at the instrument's rate: a tight loop would measure a
warm cache. They arrive in two ways. **Staggered**: the rows of every sensor in packets, all packets spread evenly over
half a frame. **Burst**: one message with everything. Every command is held against the control law in float64 before
a figure is given. Here the loop runs in this process, without ROS; :mod:`srtomo_ops.bench.path` has it in another.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_core.wire import MIRROR_UNKNOWN, DmCommand, SlopeFrameWriter, read_dm_command
from srtomo_ops.simulate import plain_settings, program_of
from srtomo_rtc.compression import int16_to_noise
from srtomo_rtc.hrtc import Hrtc
from srtomo_rtc.loop import Verdict
from srtomo_rtc.vmm import huge_zeros, multiply, multiply_int16, quantise, rows_of, tiled, tiles_shape
from srtomo_sim.mirror import interaction_matrix

Floats = NDArray[np.float64]

ARRIVALS = ("staggered", "burst")
TARGETS = {"staggered": 0.35, "burst": 1.1, "burst_int16": 0.65}
"""Largest median allowed, in sgemv's: the loop's compute in both ways of arrival, and in a burst with kernel int16."""

PATH_TARGETS = {"staggered": 0.5, "burst": 1.0}
"""What the whole path may take more than an echo's, median and p90, in sgemv's."""

TOLERANCE = 1e-4
"""Of a command, of the largest of its frame: float32 leaves some 1e-6; a wrong slope or state leaves about 1."""

HELD = (Verdict.HOLD_BEHIND, Verdict.HOLD_INCOMPLETE, Verdict.HOLD_MISSING)
"""What a loop that is behind may say of a frame: its command costs no product, and is in no figure."""

MOST_HELD = 0.01
"""Share of held frames above which there are no figures: those left would be of the easier frames."""

_SESSION = 1
_DISTINCT = 8  # slope vectors; their negatives follow, so that commands stay where they are
_SLOPE = 1e-7  # rad rms
_DAMPING = 1e-2  # of the least-squares reconstructor, of the largest eigenvalue of G'G
_BLOCK = 50  # frames of one measurement before it is another's turn
_SPIN_NS = 200_000  # before an appointment; sleeping on would be late


class Packet(NamedTuple):
    """One message of a frame: where its slopes are in the slope vector, and when it goes out, in frames."""

    sensor: int
    n_sensors: int
    first: int
    n_subapertures: int
    slopes: NDArray[np.intp]
    due: float


def burst(layout: Layout) -> list[Packet]:
    """One message with every sensor, at the frame's start."""
    n = layout.n_slopes
    return [Packet(0, len(layout.sensors), 0, n // 2, np.arange(n), 0.0)]


def staggered(layout: Layout, packets: int) -> list[Packet]:
    """Whole rows of each sensor in up to ``packets`` messages, sensors read out side by side, over half a frame."""
    found = []
    for w, sensor in enumerate(layout.sensors):
        before_row = np.concatenate([[0], np.cumsum(sensor.mask.sum(axis=1))])
        cuts = np.linspace(0, len(sensor.mask), min(packets, len(sensor.mask)) + 1).round().astype(int)
        for number, (a, b) in enumerate(zip(before_row[cuts[:-1]], before_row[cuts[1:]], strict=True)):
            if b > a:
                places = layout.slope_start[w] + np.concatenate([np.arange(a, b), sensor.n_valid + np.arange(a, b)])
                found.append(((number + 1) / (len(cuts) - 1), w, Packet(w, 1, int(a), int(b - a), places, 0.0)))
    found.sort(key=lambda entry: entry[:2])
    return [entry[2]._replace(due=0.5 * (i + 1) / len(found)) for i, entry in enumerate(found)]


class Sensors:
    """The sensors of one way of arrival: the serialised messages of any frame.

    Attributes:
        due_ns: of each message, from the frame's start.
    """

    def __init__(self, layout: Layout, rate: float, packets: Sequence[Packet], slopes: NDArray[np.float32]) -> None:
        self.due_ns = [round(packet.due / rate * 1e9) for packet in packets]
        self._slopes = [[np.ascontiguousarray(y[packet.slopes]) for packet in packets] for y in slopes]
        self._writers = [
            SlopeFrameWriter(
                layout.sensors[p.sensor].name,
                _SESSION,
                layout.fingerprint,
                p.sensor,
                p.n_sensors,
                p.n_subapertures,
                p.first,
            )
            for p in packets
        ]

    def messages(self, frame: int) -> list[bytes]:
        """Serialised SlopeFrames, in the order in which they are to be sent."""
        stamp = time.time_ns()
        made = []
        for writer, slopes in zip(self._writers, self._slopes[frame % len(self._slopes)], strict=True):
            writer.values[:] = slopes
            made.append(writer.write(stamp, frame, MIRROR_UNKNOWN, MIRROR_UNKNOWN, 1.0))
        return made


class Reference:
    """The control law in float64, from its equations, for commands that are in time; held frames hold.

    ``u[k] = (1-leak) (1-g) u[k-1] + g (Q u~[k] + R (y[k] - y_ref))``, with
    ``u~[k] = (1-f) u[k-n] + f u[k-n-1]``, n + f the delay.
    """

    def __init__(self, system: System, reconstructor: Reconstructor, slopes: NDArray[np.float32]) -> None:
        deviations = slopes.astype(np.float64) - reconstructor.slope_reference
        self._products = deviations @ reconstructor.R[0].astype(np.float64).T
        self._Q = reconstructor.Q[0].astype(np.float64)
        self._limit = reconstructor.command_limit.astype(np.float64)
        self._gain, self._keep = reconstructor.gain, (1 - system.loop.leak) * (1 - reconstructor.gain)
        self._whole = math.floor(system.loop.delay)
        self._part = system.loop.delay - self._whole
        # newest first; nothing but a flat mirror before the first frame
        self._past = [np.zeros(len(self._limit)) for _ in range(self._whole + 1)]
        self.frame = 0
        self.held = 0
        self.error = 0.0

    def check(self, commands: Iterable[DmCommand], frames: int) -> None:
        """Hold the next ``frames`` commands against the law; ``error``, ``held`` and ``frame`` count on.

        Raises:
            ValueError: one is missing, twice, out of order, not of the closed loop, or wrong.
        """
        end = self.frame + frames
        for command in commands:
            if command.frame != self.frame or command.session != _SESSION:
                raise ValueError(f"a command for frame {command.frame} where frame {self.frame} was due")
            if not command.loop_state:
                raise ValueError(f"frame {self.frame}: the loop is open")
            m = self._next(command)
            error = float(np.max(np.abs(command.commands - m)) / max(np.max(np.abs(m)), 1e-12))
            if not error <= TOLERANCE:
                raise ValueError(f"frame {self.frame}: commands are off by {error:.1e} of the largest")
            self.error = max(self.error, error)
            self.frame += 1
        if self.frame != end:
            raise ValueError(f"{end - self.frame} of {frames} frames have no command")

    def _next(self, command: DmCommand) -> Floats:
        u = self._past[0]
        if command.verdict == Verdict.OK:
            seen = (1 - self._part) * self._past[self._whole - 1] + self._part * self._past[self._whole]
            y = self._products[self.frame % len(self._products)]
            u = np.clip(self._keep * u + self._gain * (self._Q @ seen + y), -self._limit, self._limit)
        elif command.verdict in HELD:
            self.held += 1
        else:
            raise ValueError(f"frame {self.frame} was answered with verdict {Verdict(command.verdict).name}")
        self._past = [u, *self._past[:-1]]
        return u


@dataclass(frozen=True)
class Problem:
    """An instrument with what is needed to drive its loop.

    Attributes:
        G: (n_slopes, n_commands) rad/m, of the simulated instrument.
        slopes: (n, n_slopes) rad; frame k has row k % n.
        packets: messages a sensor when staggered.
    """

    system: System
    layout: Layout
    reconstructor: Reconstructor
    G: Floats
    slopes: NDArray[np.float32]
    packets: int

    @classmethod
    def of(cls, system: System, reconstructor: Reconstructor | None = None, packets: int = 4) -> Problem:
        """Random slopes, and a damped least-squares reconstructor unless one is given: only its size sets the time.

        Raises:
            ValueError: the reconstructor is of another instrument, or predictive; tip-tilt has a loop of its own.
        """
        if system.loop.tip_tilt is not None:
            raise ValueError(f"{system.name}: has tip-tilt in a loop of its own, which is not timed")
        layout = Layout(system)
        G = interaction_matrix(system, layout)
        if reconstructor is None:
            normal = G.T @ G
            R = np.linalg.solve(normal + _DAMPING * np.linalg.norm(normal, 2) * np.eye(len(normal)), G.T)
            reconstructor = Reconstructor.from_matrices(
                R, G, fingerprint=layout.fingerprint, gain=system.loop.gain, command_limit=layout.stroke, label="bench"
            )
        elif reconstructor.fingerprint != layout.fingerprint or reconstructor.n_epochs != 1:
            raise ValueError(f"reconstructor {reconstructor.label!r}: expected a static one of {system.name}")
        some = np.random.default_rng(0).standard_normal((_DISTINCT, layout.n_slopes)).astype(np.float32) * _SLOPE
        return cls(system, layout, reconstructor, G, np.concatenate([some, -some]).astype(np.float32), packets)

    def sensors(self, arrival: str) -> Sensors:
        """The sensors of one of ARRIVALS."""
        packets = burst(self.layout) if arrival == "burst" else staggered(self.layout, self.packets)
        return Sensors(self.layout, self.system.loop.rate, packets, self.slopes)

    def reference(self, kernel: str = "float32") -> Reference:
        """The commands to expect, from frame 0 with the loop closed, of R as the kernel holds it."""
        reconstructor = self.reconstructor
        if kernel == "int16":
            held = reconstructor.R.copy()
            for w in range(len(self.layout.sensors)):
                integers, scales = quantise(held[0, :, self.layout.slopes_of(w)])
                held[0, :, self.layout.slopes_of(w)] = integers * scales[:, None]
            reconstructor = replace(reconstructor, R=held)
        return Reference(self.system, reconstructor, self.slopes)


class Summary(NamedTuple):
    """Quantiles of a latency, s."""

    median: float
    p90: float
    p99: float
    max: float
    samples: int

    @classmethod
    def of(cls, nanoseconds: Sequence[float] | NDArray[np.integer]) -> Summary:
        """Of samples in ns."""
        seconds = np.asarray(nanoseconds, np.float64) * 1e-9
        median, p90, p99, largest = map(float, np.quantile(seconds, [0.5, 0.9, 0.99, 1.0]))
        return cls(median, p90, p99, largest, len(seconds))


@dataclass(frozen=True)
class Compute:
    """Compute alone, in this process.

    Attributes:
        latencies: of ``sgemv`` (one product R y, numpy); ``staggered``, ``burst`` and ``burst_int16`` (last message due
            to command serialised); ``float32`` and ``int16`` (that kernel alone, over the whole of R).
        error: largest error of a command, of the largest of its frame.
        held: frames that the loop held because it was behind; they are left out.
        int16_to_noise: see :func:`srtomo_rtc.compression.int16_to_noise`.
    """

    latencies: dict[str, Summary]
    error: float
    held: int
    int16_to_noise: float

    def ratio(self, name: str) -> float:
        """Median over sgemv's."""
        return self.latencies[name].median / self.latencies["sgemv"].median


def wait_until(due_ns: int, awake: bool = False) -> int:
    """Wait for a time of the monotonic clock, ns; the time it then is, or ``due_ns`` if that was past already.

    ``awake``: without sleeping.
    """
    now = time.monotonic_ns()
    if now >= due_ns:
        return due_ns
    if due_ns - now > _SPIN_NS and not awake:
        time.sleep((due_ns - now - _SPIN_NS) * 1e-9)
    while (now := time.monotonic_ns()) < due_ns:
        pass
    return now


def refuse_if_held(what: str, held: int, frames: int) -> None:
    """Raise ValueError if more than MOST_HELD of the frames were held."""
    if held > MOST_HELD * frames:
        raise ValueError(
            f"{what}: {held} of {frames} frames were held because the loop was behind, more than {MOST_HELD:.0%}: "
            "the figures would be those of the others"
        )


def measure_compute(problem: Problem, frames: int) -> Compute:
    """Latencies without ROS, ``frames`` of each kind, in turns of a few frames.

    Raises:
        ValueError: a command is missing or wrong, or a kernel's product is; too many frames were held.
    """
    period = round(1e9 / problem.system.loop.rate)
    loop, loop_int16 = LoopHere(problem, period), LoopHere(problem, period, "int16")
    measured: dict[str, Callable[[int], list[int]]] = {
        **_kernels(problem, period),
        **{arrival: partial(loop.run, arrival) for arrival in ARRIVALS},
        "burst_int16": partial(loop_int16.run, "burst"),
    }
    samples: dict[str, list[int]] = {name: [] for name in measured}
    left = frames
    while left > 0:
        block = min(left, _BLOCK)
        for name, run in measured.items():
            samples[name] += run(block)
        left -= block
    held = loop.reference.held + loop_int16.reference.held
    refuse_if_held("compute", held, loop.reference.frame + loop_int16.reference.frame)
    latencies = {name: Summary.of(values) for name, values in samples.items()}
    return Compute(
        latencies,
        max(loop.reference.error, loop_int16.reference.error),
        held,
        int16_to_noise(problem.system, problem.layout, problem.reconstructor.R[0]),
    )


class LoopHere:
    """The HRTC's frame gate and loop on this thread."""

    def __init__(self, problem: Problem, period: int, kernel: str = "float32") -> None:
        self._sensors = {arrival: problem.sensors(arrival) for arrival in ARRIVALS}
        self._period = period
        self._ready = 0
        self._commands: list[bytes] = []
        self._hrtc = Hrtc(problem.layout, problem.system.loop.delay, self._publish)
        settings = plain_settings(problem.layout, problem.system.loop.leak)
        program = program_of(problem.layout, problem.reconstructor, settings, kernel)
        program.warm()
        self._hrtc.loop.post(program)
        self._hrtc.loop.request(closed=True)
        self._hrtc.start()
        self.reference = problem.reference(kernel)

    def _publish(self, buffer: bytes) -> None:
        self._ready = time.monotonic_ns()
        self._commands.append(buffer)

    def run(self, arrival: str, frames: int) -> list[int]:
        """Latencies of the next frames but for those held, ns, once they are checked."""
        sensors, hrtc = self._sensors[arrival], self._hrtc
        latencies = []
        first = self.reference.frame
        start = time.monotonic_ns() + self._period
        for frame in range(first, first + frames):
            due = last = start + (frame - first) * self._period
            for message, after in zip(sensors.messages(frame), sensors.due_ns, strict=True):
                last = wait_until(due + after)
                hrtc.offer(message, last)
                hrtc.advance()
            latencies.append(self._ready - last)
            hrtc.idle(self._ready)
        commands = [read_dm_command(buffer) for buffer in self._commands]
        self._commands = []
        self.reference.check(commands, frames)
        return [ns for ns, command in zip(latencies, commands, strict=True) if command.verdict not in HELD]


def _kernels(problem: Problem, period: int) -> dict[str, Callable[[int], list[int]]]:
    """Each measures its product R y a number of times, paced, ns; all are checked against float64 here."""
    R, y = problem.reconstructor.R[0], problem.slopes[0]
    padded = np.empty(rows_of(len(R)), np.float32)
    out = padded[: len(R)]
    tiles = tiled(R, huge_zeros(tiles_shape(len(R), len(y), np.float32), np.float32))
    integers, scales = quantise(R)
    tiles_of_integers = tiled(integers, huge_zeros(tiles_shape(len(R), len(y), np.int16), np.int16))
    products: dict[str, Callable[[], object]] = {
        "sgemv": lambda: np.dot(R, y, out=out),
        "float32": lambda: multiply(tiles, y, padded),
        "int16": lambda: multiply_int16(tiles_of_integers, scales, y, padded),
    }
    size = np.abs(R).astype(np.float64) @ np.abs(y).astype(np.float64)
    rounding = len(y) * 2.0**-24 * size
    bounds = {name: rounding for name in products}
    bounds["int16"] = 1.01 * rounding + scales * (0.5 + 2.0**-9) * np.abs(y).sum(dtype=np.float64)
    exact = R.astype(np.float64) @ y.astype(np.float64)

    def repeated(product: Callable[[], object]) -> Callable[[int], list[int]]:
        def run(times: int) -> list[int]:
            taken = []
            start = time.monotonic_ns() + period
            for i in range(times):
                wait_until(start + i * period)
                begun = time.monotonic_ns()
                product()
                taken.append(time.monotonic_ns() - begun)
            return taken

        return run

    for name, product in products.items():
        product()
        if not np.all(np.abs(out - exact) <= bounds[name]):
            raise ValueError(f"the {name} product is wrong")
    return {name: repeated(product) for name, product in products.items()}
