"""Where each sensor truly sits: its shift, rotation and magnification with respect to the mirrors.

All of it is in the interaction matrix G(place), of which a measurement shows some products: ``G(place) m = -y`` for
pokes m; or, from a closed loop, what slopes y and the shapes m~ on the mirrors have in common. A misplaced sensor
leaves

    x[k] = y[k] + G m~[k] = s[k] + noise[k] - (G(place) - G) m~[k]

in its pseudo-open-loop slopes, and its place is where x no longer goes with m~. Plain regression fails: m~ follows the
turbulence late, and ``-v tau . grad phi`` looks like a shift by v tau. So x is differenced over time, and compared with
an **instrument** z that goes with m~ but not with the turbulence:

- with a dither, a known pattern whose sign changes: the dither alone. Nothing else in the loop goes with it;
- without one, the third difference of m~ in time. The noise of past exposures goes round in the loop, tens of
  nanometres of it, and does not repeat: it is a dither by itself, of which every value is known. Turbulence is smooth
  in time, and of its commands little is left. What is left is a bias, 0.003 sub-aperture at 10 m/s, 500 Hz and 0.4 m.
  Each further difference leaves a third of it or less, but of the noise's share less too: from what the second one
  finds follows how large it may be, and that is part of the stated errors.

Only differences show: all sensors and mirrors moved together leave G as it is, but for the light at the pupil's edge. A
place is therefore with respect to the mirrors, all of them together, taken to be where the layout has them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout, SensorLayout, transmission
from srtomo_core.system import Direction, System
from srtomo_srtc.geometry import pupil_grid
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix, mirror_wavefronts
from srtomo_srtc.model import layout_of

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

MIN_STRETCHES = 8
"""Stretches of telemetry, at least: the spread between them is the uncertainty."""

TOLERANCE = 0.1
"""Displacement, in sub-apertures rms, that a reconstructor bears: it costs some 2.5 nm on 100."""

_FINE = 32  # points across a sub-aperture when its light is averaged
_MIN_SUBAPERTURES = 8  # of a sensor that can be placed
_ORDER = 3  # of the difference in time that is the instrument without a dither
_LEFT = 1 / 3  # at most, of what moves a place from one order to the next: the bias after it
_PARAMETERS = 5  # shift x, y, rotation, magnification, gain
_STEPS = (0.02, 0.02, 0.004, 0.004)  # of the central differences: sub-apertures, rad, relative
_ITERATIONS = 8
_RENEWED = 3  # iterations that make derivatives and weights anew: after these a place is known to some thousandths
_CLOSE = 1e-3  # sub-apertures: a step this small is the last
_SINGULAR = 1e-10  # reciprocal condition of the normal equations, diagonal scaled to 1
_REGULAR = 1e-3  # of the mean variance, added to a measured covariance before it is inverted
_CYCLES = 0.55  # of a dither's pattern, a sub-aperture: where slopes change most with a shift
_FINEST = 0.45  # cycles an actuator pitch that a mirror can make


class RegisterError(ValueError):
    """Places cannot be told from this; one line that says why."""


@dataclass(frozen=True, eq=False)
class Place:
    """One sensor's place, as differences from where the layout has it.

    Attributes:
        sensor: index.
        name: of the sensor.
        shift: x, y, m in the pupil.
        rotation: rad, counter-clockwise.
        magnification: relative size of its lenslets in the pupil, less 1.
        gain: of its slopes over the model's for the same commands; nothing to do with place, but fitted along.
        covariance: (5, 5) of shift x, y, rotation, magnification and gain.
        displacement: rms over its sub-apertures of how far they are from where the layout has them, in sub-apertures.
        displacement_sigma: of it.
    """

    sensor: int
    name: str
    shift: tuple[float, float]
    rotation: float
    magnification: float
    gain: float
    covariance: Array
    displacement: float
    displacement_sigma: float

    @property
    def sigma(self) -> Array:
        """(5,) 1-sigma errors of shift x, y (m), rotation (rad), magnification and gain."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def is_out_of(self, tolerance: float) -> bool:
        """Whether the sensor is surely displaced by more than a tolerance, in sub-apertures rms."""
        return self.displacement - 3 * self.displacement_sigma > tolerance


@dataclass(frozen=True)
class Registration:
    """Places of the sensors that have sub-apertures enough to be placed, in the system's order."""

    places: tuple[Place, ...]

    def layout(self, system: System, layout: Layout) -> Layout:
        """``layout``, with respect to which the places are, with its sensors where they were found."""
        moves = np.zeros((len(layout.sensors), 4))
        for place in self.places:
            moves[place.sensor] = *place.shift, place.rotation, place.magnification
        return moved_sensors(system, layout, moves)

    def notes(self, tolerance: float = TOLERANCE) -> list[str]:
        """One line for each sensor that is surely out of tolerance (sub-apertures rms)."""
        return [
            f"sensor {place.name} is {place.displacement:.2f} sub-aperture rms from its place "
            f"(tolerance {tolerance:g}): shift {place.shift[0] * 1e3:+.0f} {place.shift[1] * 1e3:+.0f} mm, "
            f"rotation {math.degrees(place.rotation):+.2f} deg, magnification {100 * place.magnification:+.2f} %"
            for place in self.places
            if place.is_out_of(tolerance)
        ]


def moved_sensors(system: System, layout: Layout, moves: Array) -> Layout:
    """The layout with its sensors moved: the same sub-apertures in other places, and in other light.

    It keeps its fingerprint, so that what is built for it is for this instrument.

    Args:
        moves: (n_sensors, 4) shift x, y (m), rotation (rad) and magnification less 1, each added to the sensor's own.
    """

    def moved(sensor: SensorLayout, move: Array) -> SensorLayout:
        x, y, rotation, magnification = (float(value) for value in move)
        there = replace(
            sensor,
            size=sensor.size * (1 + magnification),
            local=sensor.local * (1 + magnification),
            shift=(sensor.shift[0] + x, sensor.shift[1] + y),
            rotation=sensor.rotation + rotation,
        )
        light = transmission(system.telescope, *there.points(_FINE)).mean(axis=(1, 2))
        return replace(there, illumination=light) if move.any() else sensor

    out = copy.copy(layout)
    out.fingerprint = layout.fingerprint  # of the same slopes and commands
    out.sensors = tuple(moved(sensor, move) for sensor, move in zip(layout.sensors, moves, strict=True))
    return out


def dither_pattern(system: System, layout: Layout, rms: float) -> Array:
    """A mirror shape that shows where sensors are: an egg crate of about half a cycle a sub-aperture.

    It goes onto the mirrors through the loop's offset, with the slope reference ``-G o`` that belongs to it, so that
    the loop leaves it alone, and changes sign again and again. The finer it is, the more slopes change with a shift;
    beyond a cycle in two sub-apertures these average it out. On the lowest mirror.

    Args:
        rms: of the wavefront over the pupil, piston removed, m.

    Returns:
        (n_commands,) m.
    """
    lowest = min(range(len(layout.mirrors)), key=lambda m: layout.mirrors[m].altitude)
    mirror = layout.mirrors[lowest]
    finest = min(sensor.size for sensor in layout.sensors if sensor.n_valid >= _MIN_SUBAPERTURES)
    k = 2 * math.pi * min(_CYCLES / finest, _FINEST / mirror.pitch)
    # neither even nor odd about the centre
    x, y = mirror.actuators.T
    pattern = np.zeros(layout.n_commands)
    pattern[layout.commands_of(lowest)] = np.cos(k * x + 0.7) * np.cos(k * y + 0.3)
    grid = pupil_grid(system.telescope, mirror.pitch / 4)
    wavefront = mirror_wavefronts(layout, grid.x, grid.y, Direction()) @ pattern
    wavefront -= grid.weight @ wavefront
    return pattern * (rms / math.sqrt(grid.weight @ wavefront**2))


class Stretches:
    """What stretches of telemetry say of places, in a size that does not grow with their length.

    Differenced over time: x pseudo-open-loop slopes, m~ on the mirrors, z the instrument. Of each stretch the sums of
    ``x z^T`` and ``m~ z^T``; of all together second moments of x and m~, for the weights.

    Attributes:
        system, layout: where sensors and mirrors are taken to be.
        n_frames: in all stretches, less those that differences cost.
        slopes_with: of each stretch, (n_slopes, n_commands) sum of x z^T, rad m.
        mirror_with: of each stretch, (n_commands, n_commands) sum of m~ z^T, m^2.
        lower: without a dither the same sums over all stretches, with a z of one order less.
    """

    def __init__(self, system: System, layout: Layout | None = None, *, half_period: int | None = None) -> None:
        """None yet.

        Args:
            layout: where sensors and mirrors are taken to be; as in the system when not given.
            half_period: of the dither that instruments will be given, in frames: how long each sign lasts, at most.
                None: there is no dither.

        Raises:
            MemoryError: one line, before any work, if there is not enough for :data:`MIN_STRETCHES`.
        """
        self.system, self.layout = system, layout_of(system, layout)
        n, m = self.layout.n_slopes, self.layout.n_commands
        squares = sum(sensor.n_slopes**2 for sensor in self.layout.sensors)
        require(8.0 * squares + (16.0 + 4.0 * MIN_STRETCHES) * (n + m) * m, f"registration of {system.name}")
        self.n_frames = 0
        self.slopes_with: list[Floats] = []
        self.mirror_with: list[Floats] = []
        self._G = interaction_matrix(system, self.layout).astype(np.float32)
        self._half_period = half_period
        # slopes must not hold noise that is in z: with less delay than two frames, that of the exposure before is
        self._lag = half_period or (1 if system.loop.delay >= 2 else 0)
        self._slopes = [np.zeros((sensor.n_slopes, sensor.n_slopes)) for sensor in self.layout.sensors]
        self._cross, self._mirror = np.zeros((n, m)), np.zeros((m, m))
        self.lower = None if half_period is not None else (np.zeros((n, m)), np.zeros((m, m)))

    def __len__(self) -> int:
        return len(self.slopes_with)

    def add(self, slopes: Floats, mirror: Floats, dither: Floats | None = None) -> None:
        """Take exposures that follow each other without a gap; one to a few seconds are best.

        Args:
            slopes: (n_frames, n_slopes) as measured, rad.
            mirror: (n_frames, n_commands) what was on the mirrors meanwhile, m.
            dither: (n_frames, n_commands) the dither's share of it, m; given if and only if there is one.

        Raises:
            ValueError: a dither where there is none, or the reverse; or too few frames to difference.
        """
        if (dither is None) != (self._half_period is None):
            raise ValueError("dither: expected together with half_period")
        lost = max(self._lag, _ORDER)
        n = len(slopes) - lost
        if n < 1:
            raise ValueError(f"slopes: expected more than {lost} successive frames, got {len(slopes)}")
        m = self._differenced(mirror, lost)
        x = self._differenced(slopes, lost) + m @ self._G.T
        if dither is not None:
            z = self._differenced(dither, lost)
        else:
            z = np.diff(mirror, _ORDER - 1, axis=0)[-n - 1 :]
            assert self.lower is not None
            for total, rows in zip(self.lower, (x, m), strict=True):
                total += rows.T @ z[1:]
            z = np.diff(z, axis=0)
        self.n_frames += n
        self.slopes_with.append(x.T @ z)
        self.mirror_with.append(m.T @ z)
        for w, squares in enumerate(self._slopes):
            own = x[:, self.layout.slopes_of(w)]
            squares += own.T @ own
        self._cross += x.T @ m
        self._mirror += m.T @ m

    def _differenced(self, rows: Floats, lost: int) -> Floats:
        if not self._lag:
            return rows[lost:]
        return rows[lost:] - rows[lost - self._lag : len(rows) - self._lag]

    def residual_covariance(self, w: int, change: Array) -> Array:
        """(n_slopes_w, n_slopes_w) second moment of ``x + change m~`` of a sensor, rad^2.

        Args:
            change: (n_slopes_w, n_commands) of its interaction matrix, rad/m.
        """
        crossed = self._cross[self.layout.slopes_of(w)] @ change.T
        return np.asarray((self._slopes[w] + crossed + crossed.T + change @ self._mirror @ change.T) / self.n_frames)


def from_telemetry(stretches: Stretches) -> Registration:
    """Places from a closed loop.

    Errors come from the spread between stretches and, without a dither, from the bias that may remain.

    Args:
        stretches: at least :data:`MIN_STRETCHES`; some 15 s in all, the longer the better.

    Raises:
        RegisterError: too few stretches, no sensor to place, or an instrument that shows too little: an open loop.
    """
    if len(stretches) < MIN_STRETCHES:
        raise RegisterError(
            f"registration: expected at least {MIN_STRETCHES} stretches of closed loop, got {len(stretches)}"
        )

    def weight(w: int, change: Array) -> Array:
        C = stretches.residual_covariance(w, change)
        C[np.diag_indices_from(C)] += _REGULAR * C.trace() / len(C)
        return np.asarray(np.linalg.inv(C))

    sums = stretches.slopes_with, stretches.mirror_with
    return _fit(stretches.system, stretches.layout, *sums, weight, stretches.lower)


def from_interaction_matrix(
    system: System, measured: NDArray[np.floating], layout: Layout | None = None
) -> Registration:
    """Places from a measured interaction matrix.

    Errors come from what the best fit leaves, taken as independent from entry to entry.

    Args:
        measured: (n_slopes, n_commands) rad/m.

    Raises:
        RegisterError: a matrix of another instrument or not finite, or no sensor to place.
    """
    layout = layout_of(system, layout)
    if measured.shape != (layout.n_slopes, layout.n_commands) or not np.isfinite(measured).all():
        raise RegisterError(
            f"interaction matrix: expected finite values of shape {(layout.n_slopes, layout.n_commands)}"
        )
    model = interaction_matrix(system, layout)
    # a slope vector a poke: x = y + G m with y = -measured m
    return _fit(system, layout, [model - measured], [np.eye(layout.n_commands)])


def _fit(
    system: System,
    layout: Layout,
    slopes_with: Sequence[NDArray[np.floating]],
    mirror_with: Sequence[NDArray[np.floating]],
    weight: Callable[[int, Array], Array] | None = None,
    lower: tuple[Array, Array] | None = None,
) -> Registration:
    """Solve ``sum <z^T D_p^T W (x + (G(place) - G) m~)> = 0`` for every sensor's place p, by Gauss-Newton.

    W belongs to what is left at the place: made at the layout's, the displacement itself would count as noise, just in
    the slopes that show it, and 7 % of a place be missed.

    Args:
        slopes_with, mirror_with: sums over each stretch of x z^T and m~ z^T.
        weight: makes W of a sensor by index and by how much its G has changed, a step behind; None: the same for all
            slopes, and errors from what is left.
        lower: as :attr:`Stretches.lower`.
    """
    n_sensors = len(layout.sensors)
    placed = [w for w, sensor in enumerate(layout.sensors) if sensor.n_valid >= _MIN_SUBAPERTURES]
    if not placed:
        raise RegisterError(f"{system.name}: expected a sensor with {_MIN_SUBAPERTURES} sub-apertures or more")
    start = interaction_matrix(system, layout)
    total_slopes, total_mirror = (np.add.reduce(sums, dtype=np.float64) for sums in (slopes_with, mirror_with))
    sizes = np.array([sensor.size for sensor in layout.sensors])
    moves, gains = np.zeros((n_sensors, 4)), np.ones(n_sensors)
    columns: list[list[Array]] = [[] for _ in range(n_sensors)]
    weighted: list[list[Array]] = [[] for _ in range(n_sensors)]
    inverse = [np.empty(0)] * n_sensors
    for iteration in range(_ITERATIONS):
        G = interaction_matrix(system, moved_sensors(system, layout, moves))
        anew = iteration < _RENEWED
        if anew:
            derivatives = _derivatives(system, layout, moves)
        largest = 0.0
        for w in placed:
            own = layout.slopes_of(w)
            change = gains[w] * G[own] - start[own]
            if anew:
                columns[w] = [*(gains[w] * D[own] for D in derivatives), G[own]]
                if weight is None:
                    weighted[w] = columns[w]
                else:
                    W = weight(w, change)
                    weighted[w] = [W @ D for D in columns[w]]
                inverse[w] = _inverse(columns[w], weighted[w], total_mirror)
            step = -inverse[w] @ _scores(weighted[w], total_slopes[own] + change @ total_mirror)
            moves[w] += step[:4]
            gains[w] += step[4]
            radius = sizes[w] * len(layout.sensors[w].mask) / 2
            largest = max(largest, float(np.abs(step[:4] * (1, 1, radius, radius)).max()) / sizes[w])
        if largest < _CLOSE:
            break
    else:
        raise RegisterError(
            f"registration: not converged after {_ITERATIONS} iterations; is the loop closed and stable?"
        )
    G = interaction_matrix(system, moved_sensors(system, layout, moves))
    found = []
    for w in placed:
        own = layout.slopes_of(w)
        change = gains[w] * G[own] - start[own]
        if weight is None:
            left = total_slopes[own] + change @ total_mirror
            covariance = float(np.vdot(left, left)) / (left.size - _PARAMETERS) * inverse[w]
        else:
            scores = np.array(
                [_scores(weighted[w], x[own] + change @ m) for x, m in zip(slopes_with, mirror_with, strict=True)]
            )
            # they sum to zero at the solution
            spread = scores.T @ scores * (len(scores) / (len(scores) - 1))
            covariance = inverse[w] @ spread @ inverse[w].T
        if lower is not None:
            with_slopes, with_mirror = lower[0][own], lower[1]
            scores = _scores(weighted[w], with_slopes + change @ with_mirror)
            bias = _LEFT * _inverse(columns[w], weighted[w], with_mirror) @ scores
            covariance += np.outer(bias, bias)
        found.append(_place(layout, w, moves[w], gains[w], covariance))
    return Registration(tuple(found))


def _scores(weighted: Sequence[Array], left: Array) -> Array:
    """(5,) what is left, seen through each weighted derivative: the trace of a product is a sum over entries."""
    return np.array([np.vdot(p, left) for p in weighted])


def _inverse(columns: Sequence[Array], weighted: Sequence[Array], mirror_with: Array) -> Array:
    """(5, 5) steps from scores.

    Raises:
        RegisterError: some combination of parameters does not show.
    """
    A = np.array([_scores(weighted, D @ mirror_with) for D in columns]).T
    scale = np.sqrt(np.abs(np.diag(A)))
    if not scale.all() or not np.linalg.cond(A / np.outer(scale, scale)) < 1 / _SINGULAR:
        raise RegisterError("registration: nothing on the mirrors shows where sensors are")
    return np.asarray(np.linalg.inv(A))


def _derivatives(system: System, layout: Layout, moves: Array) -> list[Array]:
    """Of G, with the sensors moved, by shift x, y, rotation and magnification of every sensor."""
    sizes = np.array([sensor.size for sensor in layout.sensors])
    out = []
    for parameter, relative in enumerate(_STEPS):
        step = np.zeros_like(moves)
        step[:, parameter] = relative * sizes if parameter < 2 else relative
        ahead, behind = (interaction_matrix(system, moved_sensors(system, layout, moves + s * step)) for s in (1, -1))
        ahead -= behind
        for w, size in enumerate(step[:, parameter]):
            ahead[layout.slopes_of(w)] /= 2 * size
        out.append(ahead)
    return out


def _place(layout: Layout, w: int, move: Array, gain: float, covariance: Array) -> Place:
    sensor = layout.sensors[w]
    # the mean square displacement is a quadratic form of the move
    centre = sensor.local.mean(axis=0)
    lever = float(np.mean(np.sum(sensor.local**2, axis=1)))
    c, s = math.cos(sensor.rotation), math.sin(sensor.rotation)
    by_turn = np.array([-s * centre[0] - c * centre[1], c * centre[0] - s * centre[1]])
    by_growth = np.array([c * centre[0] - s * centre[1], s * centre[0] + c * centre[1]])
    form = np.diag([1.0, 1.0, lever, lever])
    form[:2, 2], form[:2, 3] = by_turn, by_growth
    form[2:, :2] = form[:2, 2:].T
    displacement = math.sqrt(float(move @ form @ move))
    slope = form @ move / max(displacement, 1e-12)
    return Place(
        w,
        sensor.name,
        (float(move[0]), float(move[1])),
        float(move[2]),
        float(move[3]),
        float(gain),
        covariance,
        displacement / sensor.size,
        math.sqrt(float(slope @ covariance[:4, :4] @ slope)) / sensor.size,
    )
