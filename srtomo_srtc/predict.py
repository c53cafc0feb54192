"""What a reconstructor leaves: its residual from covariances alone, and how far its loop is from instability.

With the mirrors' true interaction matrix in Q, pseudo-open-loop control is a filter of open-loop slopes: the mirror's
shape is ``sum_j g (1-g)^j R s[k-d-j]``. Frozen flow turns every age of a slope into a place, so that the residual

    tr Sigma_phi - 2 tr(N R Sigma_s_phi) + tr(N R Sigma_ss R^T N^T) + g / (2-g) tr(N R Sigma_nn R^T N^T)

needs no more than Sigma_s_phi averaged over the ages that the filter mixes, and Sigma_ss over their differences, the
exposure's own length included. Both averages are Gauss quadratures for those very weights. With several exposures,
R s is ``sum_j R_j s[k-j]``: exposure j is j frames older, and the noise of i and j is correlated by ``(1-g)^|i-j|``.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve, lu_factor, lu_solve
from scipy.sparse.linalg import ArpackError, LinearOperator, aslinearoperator, eigs

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import Atmosphere, Direction, Layer, LoopSettings, System
from srtomo_srtc.atmosphere import METRES_PER_RADIAN, Profile
from srtomo_srtc.covariance import (
    Sightline,
    Turbulence,
    slope_covariance,
    slope_wavefront_covariance,
    wavefront_covariance,
)
from srtomo_srtc.estimator import estimator
from srtomo_srtc.fitting import KAPPA
from srtomo_srtc.geometry import PupilGrid, footprints, pupil_grid
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix, mirror_wavefronts
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.wind import carried, sensors_carried, winds

Array = NDArray[np.float64]

_POINTS_PER_PITCH = 2
_AGES, _DIFFERENCES = 3, 5  # nodes of the quadratures
_NEGLIGIBLE = 1e-10  # weight of a slope that the loop has forgotten
_HIDDEN = 0.01319
"""Wavefront variance in units of (pitch / r0)^(5/3) rad^2 that a grid of two points a pitch mistakes for shapes below
the mirror's cut-off: the Kolmogorov power 0.0229 f^(-11/3) of the aliases of that square."""
_SEEN = 1e-9  # of the largest eigenvalue: mirror shapes below are not in the pupil


class Rule(NamedTuple):
    """A quadrature: nodes (n,) and weights (n,) that sum to 1."""

    nodes: Array
    weights: Array


def gauss_rule(points: Array, weights: Array, n: int) -> Rule:
    """Gauss quadrature of n nodes for a discrete measure: exact for polynomials up to degree 2n - 1 (Lanczos).

    Args:
        points, weights: (n_points,) of the measure; the weights are positive.
    """
    n = min(n, len(points))
    before, vector = np.zeros(len(points)), np.sqrt(weights / weights.sum())
    diagonal, beside = np.empty(n), np.zeros(n)
    for k in range(n):
        diagonal[k] = vector @ (points * vector)
        after = points * vector - diagonal[k] * vector - (beside[k - 1] if k else 0.0) * before
        beside[k] = np.linalg.norm(after)
        before, vector = vector, after / beside[k] if beside[k] > 0 else after
    values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(beside[: n - 1], 1) + np.diag(beside[: n - 1], -1))
    return Rule(values, vectors[0] ** 2)


def slope_ages(loop: LoopSettings, n: int = _AGES) -> Rule:
    """Ages of the slopes in what is on the mirror at mid-exposure, seconds: ``(d + j + exposure) / rate``."""
    whole = math.floor(loop.delay)
    share = loop.delay - whole
    past, weight = _filter(loop.gain)
    age = np.concatenate([whole + past, whole + 1 + past])
    weights = np.concatenate([(1 - share) * weight, share * weight])
    moment, length = np.polynomial.legendre.leggauss(4)
    used = weights > 0
    points = np.add.outer(age[used], moment / 2).ravel()
    rule = gauss_rule(points, np.outer(weights[used], length).ravel(), n)
    return Rule(rule.nodes / loop.rate, rule.weights)


def age_differences(loop: LoopSettings, n: int = _DIFFERENCES) -> tuple[float, Rule]:
    """Differences of age between the slopes that the filter mixes, seconds.

    Returns:
        The weight of no difference; nodes above 0 with weights, each for itself and for its opposite.
    """
    past, _ = _filter(loop.gain)
    difference = np.concatenate([-past[:0:-1], past])
    weights = (1 - loop.gain) ** np.abs(difference)
    moment, length = np.polynomial.legendre.leggauss(4)
    within = np.subtract.outer(moment, moment).ravel() / 2
    points = np.add.outer(difference, within).ravel()
    rule = gauss_rule(points, np.outer(weights, np.outer(length, length).ravel()).ravel(), n | 1)
    middle = len(rule.nodes) // 2
    above = slice(middle + 1, None)
    return float(rule.weights[middle]), Rule(rule.nodes[above] / loop.rate, rule.weights[above])


def _filter(gain: float) -> tuple[Array, Array]:
    """Frames back, and the weight that the loop gives them."""
    n = 1 if gain == 1 else math.ceil(math.log(_NEGLIGIBLE) / math.log1p(-gain))
    past = np.arange(max(n, 1), dtype=np.float64)
    return past, gain * (1 - gain) ** past


@dataclass(frozen=True)
class Budget:
    """Residual variances towards one science direction, m^2; piston removed, and tip-tilt too except where it says so.

    Attributes:
        weight: of the direction in the fit; all sum to 1.
        fitting: what the mirrors could not make if this direction were known and alone.
        tomography: what a static sky without noise adds: that the cone, the field and the sensors leave unknown, and
            what a correction shared between directions cannot give each.
        noise: of the sensors, as the loop passes it on, with the stars' jitter.
        lag: what the sky's motion adds; below 0 where a predictive reconstructor does better than a still sky.
        tip_tilt: of tip and tilt alone, all causes.
    """

    direction: Direction
    weight: float
    fitting: float
    tomography: float
    noise: float
    lag: float
    tip_tilt: float

    @property
    def total(self) -> float:
        """Without tip-tilt."""
        return self.fitting + self.tomography + self.noise + self.lag

    @property
    def wfe(self) -> float:
        """Root of the total, m rms."""
        return math.sqrt(max(self.total, 0.0))


def mean_wfe(budgets: list[Budget]) -> float:
    """Rms over the science directions with their weights, m."""
    return math.sqrt(max(sum(b.weight * b.total for b in budgets), 0.0))


class _Quadratic(NamedTuple):
    """``power - 2 tr(R cross^T) + tr(gram R S R^T)``: residual variance in a space of wavefronts."""

    power: float
    still: Array  # (n_commands, n_slopes)
    moving: list[Array]  # of each exposure
    gram: Array  # (n_commands, n_commands)


class _View(NamedTuple):
    direction: Direction
    weight: float
    fitting: float
    high_order: _Quadratic
    tip_tilt: _Quadratic


class Prediction:
    """Covariances of an instrument under its sky; any reconstructor's residual is then a few products."""

    def __init__(
        self,
        system: System,
        layout: Layout | None = None,
        *,
        lag: bool = True,
        epochs: int = 1,
        progress: Callable[[str, float], None] = lambda stage, done: None,
    ) -> None:
        """Compute the covariances.

        Args:
            system: the true sky, stars, noise and loop.
            layout: where sensors and mirrors truly are; as in ``system`` when not given.
            lag: False supposes a sky that stands still.
            epochs: consecutive exposures that a reconstructor may use.
            progress: called with the name of each stage and the share of the work done before it, 0 to 1.

        Raises:
            MemoryError: one line, before any work, if there is not enough.
        """
        self.system = system
        self.layout = Layout(system) if layout is None else layout
        profile = Profile.of(system)
        sensors = sightlines(system, self.layout, profile)
        velocity = winds(system)
        ages = slope_ages(system.loop) if lag else Rule(np.zeros(1), np.ones(1))
        weight_of_none, differences = age_differences(system.loop) if lag else (1.0, Rule(np.empty(0), np.empty(0)))
        pitch = min(mirror.pitch for mirror in self.layout.mirrors)
        grid = pupil_grid(system.telescope, pitch / _POINTS_PER_PITCH)
        targets = system.science.targets
        n_slopes, n_commands, n_points = self.layout.n_slopes, self.layout.n_commands, len(grid.x)
        require(
            8.0
            * (
                (3 + epochs) * n_slopes**2
                + (2 + epochs) * n_points * (n_points + n_slopes)
                + 2 * (1 + epochs) * len(targets) * n_commands * n_slopes
            ),
            f"prediction for {system.name}",
        )
        points = [footprints(grid.x, grid.y, t.position, math.inf, profile.heights) for t in targets]
        frames = np.arange(epochs) / system.loop.rate
        longest = float(frames[-1] + np.max(np.concatenate([ages.nodes, differences.nodes])))
        turbulence = Turbulence.covering(
            profile, [*points, *(s.nodes for s in sensors), *(carried(s.nodes, velocity, longest) for s in sensors)]
        )

        progress("slope covariance", 0.0)
        self._still = slope_covariance(turbulence, sensors)
        # E[s(t) s(t - l)^T] of filtered slopes, l in frames; a still sky has the same for all
        self._moving = [self._still] * epochs
        if lag:
            self._moving = []
            for frame, apart in enumerate(frames):
                progress("slope covariance", 0.5 * (0.1 + frame) / epochs)
                self._moving.append(
                    weight_of_none * (self._after(turbulence, sensors, apart) if frame else self._still)
                )
                for time, weight in zip(*differences, strict=True):
                    later = self._after(turbulence, sensors, apart + time)
                    before = self._after(turbulence, sensors, apart - time) if frame else later.T
                    self._moving[frame] += weight * (later + before)
        self._noise = noise_covariance(system, self.layout, system.loop.gain)
        self._jitter = jitter(system, self.layout)

        hidden = _HIDDEN * METRES_PER_RADIAN**2 * (pitch / profile.r0) ** (5 / 3)
        total = sum(target.weight for target in targets)
        self._views: list[_View] = []
        for n, (target, seen) in enumerate(zip(targets, points, strict=True)):
            progress("wavefront covariance", 0.5 + 0.5 * n / len(targets))
            phase = wavefront_covariance(turbulence, seen, seen)
            still = slope_wavefront_covariance(turbulence, sensors, seen).T
            moving = [still] * epochs
            if lag:
                moving = [np.zeros_like(still) for _ in frames]
                for of_exposure, older in zip(moving, frames, strict=True):
                    for time, weight in zip(*ages, strict=True):
                        then = sensors_carried(sensors, velocity, older + time)
                        of_exposure += weight * slope_wavefront_covariance(turbulence, then, seen).T
            shapes = mirror_wavefronts(self.layout, grid.x, grid.y, target.position)
            high_order, tip_tilt, unmade = _over_pupil(grid, phase, still, moving, shapes)
            self._views.append(_View(target.position, target.weight / total, unmade + hidden, high_order, tip_tilt))
        progress("done", 1.0)

    def _after(self, turbulence: Turbulence, sensors: list[Sightline], time: float) -> Array:
        """Covariance (n_slopes, n_slopes) of slopes with those a ``time`` (s) before."""
        return _lagged(turbulence, sensors, sensors_carried(sensors, winds(self.system), time))

    def best(self) -> Array:
        """R (n_commands, n_slopes) that leaves least of a still sky, tip-tilt included: what :func:`implicit` builds.

        Blind modes are left alone; of mirror shapes that the pupil does not show, as little as need be.
        """
        blind = blind_modes(self.system, self.layout)
        S = self._still + self._noise.toarray()
        gram = np.zeros((self.layout.n_commands, self.layout.n_commands))
        right = np.zeros((self.layout.n_commands, self.layout.n_slopes))
        for view in self._views:
            for part in (view.high_order, view.tip_tilt):
                gram += view.weight * part.gram
                right += view.weight * part.still
        gram[np.diag_indices_from(gram)] += KAPPA * gram.trace() / len(gram)
        return cho_solve(cho_factor(gram), estimator(S, right.T, blind).T)

    def budgets(self, R: ArrayLike, mismatch: Array | None = None) -> list[Budget]:
        """The residual of a reconstructor, towards each science direction.

        Args:
            R: (n_commands, n_slopes), or (n_epochs, n_commands, n_slopes) with the newest exposure first, m/rad.
            mismatch: (n_commands, n_commands) ``Q - R G`` where Q was not made with the true G, or of each exposure.
                The loop then settles where ``m = R s + mismatch m``; the sky is taken as slow against that, and noise
                as passed on by the mean filter.

        Raises:
            ValueError: R has another shape than the instrument's, or more exposures than the prediction was made for.
        """
        expected = (self.layout.n_commands, self.layout.n_slopes)
        R = np.asarray(R, dtype=np.float64)
        if R.shape[-2:] != expected or R.ndim not in (2, 3):
            raise ValueError(f"R: expected shape {expected}, got {R.shape}")
        parts = [R] if R.ndim == 2 else list(R)
        if len(parts) > len(self._moving):
            raise ValueError(f"R: uses {len(parts)} exposures, the prediction is for {len(self._moving)}")
        if mismatch is not None:
            own_part = mismatch.sum(axis=0) if mismatch.ndim == 3 else mismatch
            factor = lu_factor(np.eye(len(own_part)) - own_part)
            parts = [lu_solve(factor, part) for part in parts]
        total = np.sum(parts, axis=0)
        still = total @ self._still @ total.T
        moving, noise = np.zeros_like(still), np.zeros_like(still)
        for i, one in enumerate(parts):
            for j, other in enumerate(parts[: i + 1]):
                sky = other @ self._moving[i - j] @ one.T
                filtered = (1 - self.system.loop.gain) ** (i - j)
                own = filtered * ((other @ self._noise) @ one.T + (other @ self._jitter) @ (one @ self._jitter).T)
                moving += sky if i == j else sky + sky.T
                noise += own if i == j else own + own.T

        def variances(q: _Quadratic) -> tuple[float, float, float]:
            explained = sum(float(np.vdot(part, cross)) for part, cross in zip(parts, q.moving))
            return (
                q.power - 2 * float(np.vdot(total, q.still)) + float(np.vdot(q.gram, still)),
                q.power - 2 * explained + float(np.vdot(q.gram, moving)),
                float(np.vdot(q.gram, noise)),
            )

        out = []
        for view in self._views:
            a, b, c = variances(view.high_order)
            d = variances(view.tip_tilt)
            out.append(Budget(view.direction, view.weight, view.fitting, a - view.fitting, c, b - a, d[1] + d[2]))
        return out


def _lagged(turbulence: Turbulence, now: list[Sightline], then: list[Sightline]) -> Array:
    """Covariance (n_slopes, n_slopes) between slopes of two sets of sightlines."""
    rows = []
    for a in now:
        rows.append([b.gradient @ (a.gradient @ wavefront_covariance(turbulence, a.nodes, b.nodes)).T for b in then])
    return np.block([[block.T for block in row] for row in rows])


def jitter(system: System, layout: Layout) -> Array:
    """(n_slopes, 2 n_stars) what the stars' jitter adds to the slopes of a frame, times the filter's ``g / (2-g)``."""
    out = np.zeros((layout.n_slopes, 2 * len(system.guide_stars)))
    gain = system.loop.gain
    for w, (sensor, place) in enumerate(zip(system.sensors, layout.sensors, strict=True)):
        star = system.guide_stars.index(system.star_of(sensor))
        size = math.sqrt(gain / (2 - gain)) * system.guide_stars[star].jitter
        c, s = math.cos(place.rotation), math.sin(place.rotation)
        tilts = size * np.array([[c, s], [-s, c]])
        out[layout.slopes_of(w), 2 * star : 2 * star + 2] = np.repeat(tilts, place.n_valid, axis=0)
    return out


def _over_pupil(
    grid: PupilGrid, phase: Array, still: Array, moving: list[Array], shapes: Array
) -> tuple[_Quadratic, _Quadratic, float]:
    """High orders, tip-tilt, and the high orders that no command makes, from covariances at the pupil's points.

    Args:
        phase: (n_points, n_points) Sigma_phi.
        still, moving: (n_points, n_slopes) Sigma_phi_s, and that of each exposure.
        shapes: (n_points, n_commands) N.
    """
    root = np.sqrt(grid.weight)[:, None]
    low = grid.low_orders
    tilts = low[:, 1:]
    phase = root * phase * root.T
    shapes = root * shapes
    seen = tilts.T @ shapes
    to_tilts = (root * tilts @ seen).T
    tip_tilt = _Quadratic(
        float(np.trace(tilts.T @ phase @ tilts)),
        to_tilts @ still,
        [to_tilts @ cross for cross in moving],
        seen.T @ seen,
    )
    phase -= low @ (low.T @ phase)
    phase -= (phase @ low) @ low.T
    shapes -= low @ (low.T @ shapes)
    to_commands = (root * shapes).T
    high_order = _Quadratic(
        float(np.trace(phase)), to_commands @ still, [to_commands @ cross for cross in moving], shapes.T @ shapes
    )
    return high_order, tip_tilt, _unmade(phase, shapes)


def _unmade(phase: Array, shapes: Array) -> float:
    """Variance that no combination of ``shapes`` makes."""
    values, vectors = np.linalg.eigh(shapes.T @ shapes)
    made = shapes @ vectors[:, values > _SEEN * values[-1]]
    made /= np.linalg.norm(made, axis=0)
    return float(np.trace(phase) - np.vdot(made, phase @ made))


# --- stability ------------------------------------------------------------------------------------------------------


def moved_mirrors(
    layout: Layout, shift: tuple[float, float] = (0.0, 0.0), rotation: float = 0.0, names: tuple[str, ...] = ()
) -> Layout:
    """The layout with its mirrors turned about the pupil's centre, then shifted, as seen by everything else.

    Args:
        shift: m, at the mirrors' conjugates.
        rotation: rad, counter-clockwise.
        names: of the mirrors that move; all when empty.
    """
    c, s = math.cos(rotation), math.sin(rotation)
    turn = np.array([[c, s], [-s, c]])  # of row vectors
    moved = copy.copy(layout)
    moved.mirrors = tuple(
        replace(m, actuators=m.actuators @ turn + np.array(shift), rotation=m.rotation + rotation)
        if not names or m.name in names
        else m
        for m in layout.mirrors
    )
    return moved


def mismatch(reconstructor: Reconstructor, G: Array) -> Array:
    """``Q - R G`` of each exposure: what pseudo-open-loop control gets wrong of the mirror's own part.

    Args:
        G: (n_slopes, n_commands) the true interaction matrix, rad/m.

    Returns:
        (n_epochs, n_commands, n_commands).
    """
    return np.stack([Q.astype(np.float64) - R.astype(np.float64) @ G for R, Q in zip(reconstructor.R, reconstructor.Q)])


class Stability(NamedTuple):
    """Of a loop whose mirrors are not where its reconstructor takes them to be.

    Attributes:
        radius: spectral radius of ``E(z) = sum_j (Q_j - R_j G) z^-j``, the largest for any z on the unit circle; below
            1 the loop is stable at every delay and gain. Of one exposure simply that of ``Q - R G``.
        growth: factor by which the loop's slowest mode changes in a frame at the delay and gain given; above 1 it
            diverges.
    """

    radius: float
    growth: float


def stability(error: Array, gain: float, delay: float) -> Stability:
    """Stability of ``u[k] = (1-g) u[k-1] + g sum_j E_j u~[k-j]`` for ``E_j = Q_j - R_j G``.

    Every eigenvalue of a single E makes a loop of its own; the poles are the roots z of
    ``1 = (1-g) / z + g lambda ((1-f) z^-n + f z^-(n+1))`` with n + f the delay in frames. Of several, the poles are the
    eigenvalues of the loop's transition matrix, and E(z) is looked at so closely that a polynomial of its degree is at
    most 8 % larger in between.

    Args:
        error: (n_epochs, n_commands, n_commands) E_j, or one of them.
    """
    if error.ndim == 3 and len(error) > 1:
        return Stability(_radius_on_circle(error), _slowest(error, gain, delay))
    error = error.reshape(error.shape[-2:])
    values = np.linalg.eigvals(error)
    whole = math.floor(delay)
    share = delay - whole
    poles = np.zeros((len(values), whole + 1, whole + 1), complex)  # companion matrices
    poles[:, np.arange(1, whole + 1), np.arange(whole)] = 1
    poles[:, 0, 0] = 1 - gain
    poles[:, 0, whole - 1] += gain * (1 - share) * values
    poles[:, 0, whole] += gain * share * values
    return Stability(float(np.abs(values).max()), float(np.abs(np.linalg.eigvals(poles)).max()))


_ANGLES = 4  # a half circle and an exposure after the first


def _radius_on_circle(error: Array) -> float:
    powers = np.arange(len(error))
    angles = np.linspace(0, math.pi, _ANGLES * (len(error) - 1) + 1)
    return max(_largest(aslinearoperator(np.tensordot(np.exp(-1j * angle * powers), error, 1))) for angle in angles)


def _slowest(error: Array, gain: float, delay: float) -> float:
    """Of the transition from (u[k-1], u[k-2], ...) to (u[k], u[k-1], ...)."""
    n_epochs, n_commands, _ = error.shape
    whole = math.floor(delay)
    share = delay - whole
    frames = whole + n_epochs

    def step(before: Array) -> Array:
        u = before.reshape(frames, n_commands)
        shown = (1 - share) * u[whole - 1 : frames - 1] + share * u[whole:]
        now = (1 - gain) * u[0] + gain * np.einsum("jab,jb->a", error, shown, optimize=True)
        return np.concatenate([now, before.ravel()[:-n_commands]])

    size = frames * n_commands
    return _largest(LinearOperator((size, size), matvec=step, dtype=np.float64))


def _largest(operator: LinearOperator) -> float:
    """Largest absolute eigenvalue (Arnoldi; dense where that does not converge)."""
    size = operator.shape[0]
    start = np.random.default_rng(0).standard_normal(size).astype(operator.dtype)
    try:
        return float(np.abs(eigs(operator, k=4, v0=start, return_eigenvectors=False, tol=1e-6)).max())
    except ArpackError:
        return float(np.abs(np.linalg.eigvals(operator @ np.eye(size))).max())


def misplaced(
    system: System,
    reconstructor: Reconstructor,
    *,
    layout: Layout | None = None,
    shift: tuple[float, float] = (0.0, 0.0),
    rotation: float = 0.0,
    gain_error: float = 1.0,
) -> Stability:
    """Stability with all mirrors shifted (m), turned (rad) and ``gain_error`` times as strong as the layout says."""
    true = moved_mirrors(Layout(system) if layout is None else layout, shift, rotation)
    G = gain_error * interaction_matrix(system, true)
    return stability(mismatch(reconstructor, G), reconstructor.gain, system.loop.delay)


def limit(value: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Where ``value`` first passes 1 between ``low`` (below 1) and ``high``, by bisection; ``high`` if it does not.

    Args:
        tolerance: of the result.
    """
    if value(high) < 1:
        return high
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (middle, high) if value(middle) < 1 else (low, middle)
    return (low + high) / 2


# --- age ------------------------------------------------------------------------------------------------------------


def drifted(start: System, end: System, share: float) -> System:
    """The sky a ``share`` (0 to 1) of the way from one system's to another's.

    Each layer goes from its place to that of the same number: height, strength (r0^(-5/3) times the fraction) and wind
    vector in equal steps; the outer scale too.

    Raises:
        ValueError: the skies have different numbers of layers.
    """
    a, b = start.atmosphere, end.atmosphere
    if len(a.layers) != len(b.layers):
        raise ValueError(f"atmosphere.layers: expected {len(a.layers)} at both ends of the drift, got {len(b.layers)}")

    def between(p: float, q: float) -> float:
        return (1 - share) * p + share * q

    strength_a, strength_b = a.r0 ** (-5 / 3), b.r0 ** (-5 / 3)
    strengths = [between(strength_a * p, strength_b * q) for p, q in zip(a.fractions, b.fractions, strict=True)]
    layers = []
    for p, q, strength in zip(a.layers, b.layers, strengths, strict=True):
        x, y = (
            between(p.wind_speed * turn(p.wind_direction), q.wind_speed * turn(q.wind_direction))
            for turn in (math.cos, math.sin)
        )
        layers.append(
            Layer(
                altitude=between(p.altitude, q.altitude),
                fraction=strength / sum(strengths),
                wind_speed=math.hypot(x, y),
                wind_direction=math.atan2(y, x),
            )
        )
    outer_scale = between(a.outer_scale, b.outer_scale)
    sky = Atmosphere(r0=sum(strengths) ** (-3 / 5), outer_scale=outer_scale, layers=tuple(layers))
    return start.with_changes({"atmosphere": sky.model_dump()})
