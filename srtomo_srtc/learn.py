"""The sky from telemetry: r0, outer scale, layer strengths and noise levels, by maximum likelihood.

The theoretical covariance of the slopes, ``C(theta) = sum_l c_l B_l(L0) + sum_w n_w N_w``, is matched to the measured
one of pseudo-open-loop slopes, whitened by itself and iterated (:mod:`srtomo_srtc.likelihood`). Strengths and noise
levels are not negative. Frames of a moving sky resemble each other: how many independent ones they are worth follows,
for each parameter, from frozen flow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from srtomo_core.layout import Layout, SensorLayout
from srtomo_core.system import Atmosphere, Layer, Sensor, System
from srtomo_srtc.between import spread_between
from srtomo_srtc.frozen_flow import independent_frames
from srtomo_srtc.likelihood import information, inverse_of, non_negative_step, score, with_ridge
from srtomo_srtc.model import layout_of
from srtomo_srtc.noise import slope_noise
from srtomo_srtc.sampling import Sampling
from srtomo_srtc.sky_model import POWER, SkyModel
from srtomo_srtc.telemetry import Statistics

Array = NDArray[np.float64]

LIMIT = 1300
"""Default number of slopes that the fit works with, at most about: its cost grows with the cube."""

CORRELATED = 0.85
"""Strengths of neighbouring layers (or groups of such) that correlate by less than minus this are told as one."""

TOP = 18e3
"""Highest altitude of the default grid, m above the telescope."""

_LAYERS = 10  # of the default grid, at most
_R0 = 0.01, 2.0  # m along the line of sight: what is outside is no sky
_OUTER_SCALES = 3.0, 300.0  # m
_CONVERGED = 1e-6  # squared step over the squared error from one frame
_NEAR = 1e-2  # likewise: closer, the information is that of the solution
_ITERATIONS = 20
_RELINEARISE = 0.15  # change of log L0 that the derivative is not trusted with
_REBUILD = 0.2  # likewise, single layers: only directions in which to look, once their sum is right
_STRIDE = 1.0  # of log L0 in an iteration, at most
_EVERYWHERE = 0.1  # of the turbulence to start from: a layer without any is slow to gain some
_FEWEST = 50  # frames
_FEW = 400  # slopes to start with


class LearnError(ValueError):
    """No sky can be told from these frames; one line that says why."""


@dataclass(frozen=True)
class Group:
    """Layers that are told as one.

    Attributes:
        layers: indices, neighbours on the grid.
        altitude: of the group: mean of its layers' by strength, m above the telescope.
        fraction: of the integrated Cn2.
        sigma: of ``fraction``; turbulence between two groups counts as shared by them, nearer ones having more.
        n_effective: number of independent frames that its error stands for, but for turbulence in between.
        reason: why its layers are one; empty for a single layer.
    """

    layers: tuple[int, ...]
    altitude: float
    fraction: float
    sigma: float
    n_effective: float
    reason: str


@dataclass(frozen=True)
class NoiseLevel:
    """Of one sensor: the variance of its slopes' noise over what the instrument's file says.

    Attributes:
        sensor: index.
        factor: 1 where the file is right.
        sigma: of ``factor``.
    """

    sensor: int
    factor: float
    sigma: float


@dataclass(frozen=True, eq=False)
class Learned:
    """What telemetry tells of the sky. 1-sigma errors everywhere.

    They suppose all turbulence to be at ``altitudes`` where these were asked for; on the default grid they allow for
    turbulence anywhere in between, as :func:`srtomo_srtc.between.spread_between` has it.

    Attributes:
        r0: Fried parameter at 500 nm and zenith, m.
        r0_sigma: m.
        outer_scale: m.
        outer_scale_range: 1-sigma interval, m; the upper end is infinite where the outer scale is too large to be seen.
        altitudes: (n_layers,) the grid, m above the telescope.
        fractions: (n_layers,) best fit; of layers that are merged only the sum means anything.
        groups: layers that can be told apart, lowest first.
        noise: of each sensor that takes part.
        n_frames: frames used.
        n_effective: independent ones that r0's error stands for, but for turbulence in between.
        iterations: that the fit took.
        measured, fitted: (n, n) covariances of the slopes that the fit worked with, rad^2.
        sampling: which these are.
    """

    r0: float
    r0_sigma: float
    outer_scale: float
    outer_scale_range: tuple[float, float]
    altitudes: Array
    fractions: Array
    groups: tuple[Group, ...]
    noise: tuple[NoiseLevel, ...]
    n_frames: int
    n_effective: float
    iterations: int
    measured: NDArray[np.float32]
    fitted: NDArray[np.float32]
    sampling: Sampling

    def system(self, system: System, velocity: Array | None = None, layout: Layout | None = None) -> System:
        """The instrument with this sky and noise in it. Sensors with a measured noise covariance keep it.

        Args:
            system: whose telemetry was learned from.
            velocity: (n_layers, 2) of the layers, where they go, m/s; by default that of the system's own sky.
            layout: where sensors were taken to be.
        """
        flow = winds_at(system, self.altitudes) if velocity is None else velocity
        layers = [
            Layer(
                altitude=float(altitude),
                fraction=float(fraction),
                wind_speed=math.hypot(*wind),
                wind_direction=math.atan2(wind[1], wind[0]),
            )
            for altitude, fraction, wind in zip(self.altitudes, self.fractions, flow, strict=True)
            if fraction > 0
        ]
        sky = Atmosphere(r0=self.r0, outer_scale=self.outer_scale, layers=tuple(layers))
        changes: dict[str, object] = {"atmosphere": sky.model_dump()}
        layout = layout_of(system, layout)
        for level in self.noise:
            sensor = system.sensors[level.sensor]
            if sensor.noise_covariance is None:
                photons = photons_for(system, sensor, layout.sensors[level.sensor], level.factor)
                changes[f"sensors.{level.sensor}.photons"] = photons
        return system.with_changes(changes)


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the likelihood is largest.

    Attributes:
        strengths: (n_layers,) along the line of sight, m^(-5/3).
        outer_scale: m.
        levels: (n_sensors,) noise variances over nominal ones.
        information: (n_layers + 1 + n_sensors,) squared: Fisher information of a frame about the strengths, L0^-1.5 and
            the levels, in this order.
        bases: (n_parameters, n, n) the covariance's derivative by each of these.
        covariance: (n, n) of the slopes, rad^2.
        iterations: that it took.
    """

    strengths: Array
    outer_scale: float
    levels: Array
    information: Array
    bases: NDArray[np.float32]
    covariance: Array
    iterations: int


def fit(
    model: SkyModel, S: NDArray[np.floating], strengths: Array, outer_scale: float, levels: Array | None = None
) -> Fit:
    """Find the sky under which slopes with the second moment ``S`` are most likely, by Fisher scoring.

    Args:
        S: (n, n) as :meth:`SkyModel.measured` gives it, rad^2.
        strengths: (n_layers,) to start from; their sum is not used.
        outer_scale: to start from, m.
        levels: (n_sensors,) of noise to start from; 1 when not given.

    Raises:
        LearnError: the fit does not converge, or ends where no sky is.
    """
    n_layers = len(strengths)
    start = np.ones(len(model.noise)) if levels is None else levels
    shape = np.asarray(strengths, np.float64) / np.sum(strengths)
    at = here = outer_scale  # that the layers' bases, and the sum's slope, belong to
    bases = np.empty((n_layers + 1 + len(start), *S.shape), np.float32)
    layers, slope, noise = bases[:n_layers], bases[n_layers], bases[n_layers + 1 :]
    _build(layers, model, at)
    noise[:] = model.noise
    per_strength = shape @ layers.trace(axis1=1, axis2=2)
    trace = float(S.trace())
    scale = max(trace - start @ noise.trace(axis1=1, axis2=2), 0.1 * trace) / per_strength
    theta = np.concatenate([scale * shape, [outer_scale**-POWER], start])
    unseen = model.unseen(trace / len(S)).astype(np.float64)
    far = True
    for iteration in range(1, _ITERATIONS + 1):
        c, outer_scale, levels = theta[:n_layers], theta[n_layers] ** (-1 / POWER), theta[n_layers + 1 :]
        moved = not abs(math.log(outer_scale / at)) < _REBUILD
        if moved:
            at = outer_scale
            _build(layers, model, at)
        # what the layers lack of their sum is that of the layers as they are
        if far or moved or not abs(math.log(outer_scale / here)) < _RELINEARISE:
            here = outer_scale
            of_layers = _total(layers, c)
            turbulence = of_layers if math.isclose(here, at) else model.turbulence(c, here)
            lack = turbulence - of_layers
            slope[:] = model.by_outer_scale(c, here, turbulence)
        C: Array = lack + _total(bases, np.concatenate([c, [theta[n_layers] - here**-POWER], levels])) + unseen
        try:
            inverse = inverse_of(C).astype(np.float32)
            if far:
                F = with_ridge(information(model.seen(inverse), [*layers, slope, *model.whole_noise]))
            g = score(inverse, (S + unseen - C).astype(np.float32), bases)
            if not (np.isfinite(F).all() and np.isfinite(g).all() and np.all(np.diag(F) > 0)):
                raise LearnError("no sky fits: the likelihood is not finite")
            best = _within(theta, non_negative_step(theta, g, F), n_layers)
        except (np.linalg.LinAlgError, RuntimeError):
            raise LearnError("no sky fits: the covariance cannot be inverted") from None
        step = best - theta
        size = float(step @ F @ step)
        if size < _CONVERGED:
            _sensible(c, outer_scale)
            return Fit(c, outer_scale, levels, F, bases, C, iteration)
        far, theta = size > _NEAR, best
    raise LearnError(f"no sky fits: not converged after {_ITERATIONS} iterations")


def _sensible(strengths: Array, outer_scale: float) -> None:
    r0 = max(float(strengths.sum()), 1e-30) ** -0.6
    if not _R0[0] < r0 < _R0[1]:
        raise LearnError(f"no sky fits: an r0 of {r0:.3g} m")
    if outer_scale < 1.01 * _OUTER_SCALES[0]:
        raise LearnError(f"no sky fits: an outer scale below {_OUTER_SCALES[0]:g} m")


def _build(out: NDArray[np.float32], model: SkyModel, outer_scale: float) -> None:
    for l, layer in enumerate(out):
        layer[:] = model.layer(l, outer_scale)


def _total(bases: NDArray[np.float32], factors: Array) -> NDArray[np.float32]:
    return np.asarray(np.tensordot(factors.astype(np.float32), bases, 1))


def _within(theta: Array, aim: Array, n_layers: int) -> Array:
    """``aim``, less far from ``theta`` in outer scale than it may be, and with some noise left."""
    out = aim.copy()
    far = math.exp(POWER * _STRIDE)
    low, high = sorted(scale**-POWER for scale in _OUTER_SCALES)
    out[n_layers] = np.clip(aim[n_layers], max(theta[n_layers] / far, low), min(theta[n_layers] * far, high))
    out[n_layers + 1 :] = np.maximum(aim[n_layers + 1 :], 0.1 * theta[n_layers + 1 :])
    return out


@dataclass(frozen=True, eq=False)
class Solution:
    """The sky that fits best, which can be told with the errors that go with one wind or another.

    Attributes:
        system: the instrument.
        layout: where sensors are taken to be.
        statistics: that were fitted.
        altitudes: (n_layers,) m above the telescope.
        anywhere: errors are to allow for turbulence between these.
        limit: number of slopes to work with, at most about.
        model: that was fitted.
        measured: (n, n) covariance of its slopes, rad^2.
        found: the fit.
    """

    system: System
    layout: Layout
    statistics: Statistics
    altitudes: Array
    anywhere: bool
    limit: int
    model: SkyModel
    measured: NDArray[np.float32]
    found: Fit

    def told(self, velocity: Array | None = None) -> Learned:
        """What is learned, with errors.

        Args:
            velocity: as in :func:`learn`.

        Raises:
            ValueError: it has another shape.
        """
        flow = winds_at(self.system, self.altitudes) if velocity is None else np.asarray(velocity, np.float64)
        if flow.shape != (len(self.altitudes), 2):
            raise ValueError(f"velocity: expected shape {(len(self.altitudes), 2)}, got {flow.shape}")
        model, found, altitudes = self.model, self.found, self.altitudes
        one_frame, told, (groups, reasons) = self._one_frame, self._sums, self._groups
        total = float(found.strengths.sum())
        fractions = np.array([found.strengths[list(group)].sum() / total for group in groups])

        n_effective = self._independent(told @ one_frame, flow)
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", told, one_frame, told) / n_effective)
        if self.anywhere and len(altitudes) > 1:
            sigma = np.hypot(sigma, self._between)
        scale, scale_sigma = found.outer_scale**-POWER, float(sigma[1 + len(groups)])
        large, small = scale - scale_sigma, scale + scale_sigma
        altitude = [
            float(np.average(altitudes[list(g)], weights=found.strengths[list(g)] + 1e-9 * total)) for g in groups
        ]
        to_zenith = math.cos(self.system.zenith_angle) ** -0.6
        return Learned(
            r0=total**-0.6 * to_zenith,
            r0_sigma=float(sigma[0]) * total**-0.6 * to_zenith,
            outer_scale=found.outer_scale,
            outer_scale_range=(small ** (-1 / POWER), large ** (-1 / POWER) if large > 0 else math.inf),
            altitudes=altitudes,
            fractions=found.strengths / total,
            groups=tuple(
                Group(
                    group, altitude[i], float(fractions[i]), float(sigma[1 + i]), float(n_effective[1 + i]), reasons[i]
                )
                for i, group in enumerate(groups)
            ),
            noise=tuple(
                NoiseLevel(w, float(level), float(error))
                for w, level, error in zip(model.noisy, found.levels, sigma[2 + len(groups) :])
            ),
            n_frames=self.statistics.n_frames,
            n_effective=float(n_effective[0]),
            iterations=found.iterations,
            measured=self.measured,
            fitted=np.asarray(
                found.covariance - model.unseen(1.0) * (self.measured.trace() / len(self.measured)), np.float32
            ),
            sampling=model.sampling,
        )

    @cached_property
    def _one_frame(self) -> Array:
        """(n_parameters, n_parameters) covariance of the parameters from one frame."""
        return np.asarray(np.linalg.inv(self.found.information), np.float64)

    @cached_property
    def _groups(self) -> tuple[list[tuple[int, ...]], list[str]]:
        """Layers that are told as one, and why."""
        n_layers = len(self.altitudes)
        return _merge(self._one_frame[:n_layers, :n_layers])

    @cached_property
    def _sums(self) -> Array:
        """(n_told, n_parameters) what is told, each as a sum of these: log r0, fractions, outer scale, noise levels."""
        groups, n_layers, n_sensors = self._groups[0], len(self.altitudes), len(self.model.noise)
        strengths = self.found.strengths
        total = float(strengths.sum())
        told = np.zeros((1 + len(groups) + 1 + n_sensors, n_layers + 1 + n_sensors))
        told[0, :n_layers] = -0.6 / total
        for row, group in zip(told[1:], groups):
            row[list(group)] = 1 / total
            row[:n_layers] -= strengths[list(group)].sum() / total**2
        told[1 + len(groups) :, n_layers:] = np.eye(1 + n_sensors)
        return told

    def _independent(self, influences: Array, velocity: Array) -> Array:
        """(n_told,) independent frames, from a coarse model: only ratios matter."""
        coarse = Sampling.of(self.system, self.layout, self.limit, 2)
        return independent_frames(
            SkyModel(self.system, self.layout, coarse, self.model.heights),
            self.found.strengths,
            self.found.outer_scale,
            self.found.covariance,
            self.found.bases,
            influences,
            velocity,
            min(part.place.size for part in self.model.sampling.parts),
            self.statistics.duration / (self.statistics.n_frames - 1),
            self.statistics.n_frames,
        )

    @cached_property
    def _between(self) -> Array:
        """(n_told,) of turbulence between the grid's altitudes; by few slopes, or by as many as have to be.

        With two node cells a sub-aperture the extrapolated covariance would have negative variances, which no noise
        covers where stars are bright.
        """
        try:
            coarse = Sampling.of(self.system, self.layout, min(_FEW, self.limit // 2), 4)
        except ValueError:
            coarse = Sampling.of(self.system, self.layout, self.limit, 4)
        sky = self.found.strengths, self.found.outer_scale, self.found.levels
        return spread_between(self.system, self.layout, coarse, self.model.heights, *sky, self._sums)


def learn(
    system: System,
    statistics: Statistics,
    *,
    layout: Layout | None = None,
    altitudes: Sequence[float] | None = None,
    velocity: Array | None = None,
    limit: int = LIMIT,
) -> Learned:
    """Estimate the sky.

    The second moment about zero is fitted: what a window's mean holds is turbulence for the most part, and taking it
    out would make short windows' turbulence too weak. Static aberrations belong into the slope reference.

    Args:
        system: the instrument; its sky and photons are where the fit starts from, no more.
        statistics: of pseudo-open-loop slopes without blind modes.
        layout: where sensors are taken to be; as in the system when not given.
        altitudes: of the layers to tell the turbulence from, m above the telescope, ascending, where all of it is then
            supposed to be; by default :func:`default_altitudes`, with turbulence in between allowed for in the errors.
        velocity: (n_layers, 2) of these layers, where they go, m/s; by default that of the system's sky. It decides how
            many independent frames there were, and so the errors, not the estimates.
        limit: number of slopes to work with, at most about.

    Raises:
        LearnError: there are too few frames, or none that are finite; the fit does not converge, or ends where no sky
            is. Nothing is learned then.
        ValueError: the statistics or the layout are another instrument's; the altitudes are not ascending; ``limit`` is
            too small.
    """
    return solve(system, statistics, layout=layout, altitudes=altitudes, limit=limit).told(velocity)


def solve(
    system: System,
    statistics: Statistics,
    *,
    layout: Layout | None = None,
    altitudes: Sequence[float] | None = None,
    limit: int = LIMIT,
) -> Solution:
    """As :func:`learn`, where the winds that decide the errors are not known yet."""
    layout = layout_of(system, layout)
    grid = default_altitudes(system, layout) if altitudes is None else np.asarray(altitudes, np.float64)
    if grid.ndim != 1 or not len(grid) or grid[0] < 0 or not np.all(np.diff(grid) > 0):
        raise ValueError("altitudes: expected ascending metres above the telescope")
    _check(statistics, layout)
    sampling = Sampling.of(system, layout, limit)
    model = SkyModel(system, layout, sampling, grid * system.airmass)
    S = model.measured(statistics.covariance, statistics.mean)
    if not np.isfinite(S).all():
        raise LearnError("the covariance is not finite")
    if not S.trace() > 0:
        raise LearnError("the slopes do not move")
    found = fit(model, S, *_start(system, layout, model, statistics, limit))
    return Solution(system, layout, statistics, grid, altitudes is None, limit, model, S, found)


def _start(
    system: System, layout: Layout, model: SkyModel, statistics: Statistics, limit: int
) -> tuple[Array, float, Array | None]:
    """Strengths, outer scale and noise levels to start from: found from fewer slopes, where there are many."""
    start = strengths_at(system, model.heights / system.airmass), system.atmosphere.outer_scale
    few = min(_FEW, limit // 2)
    if len(model) > 2 * few:
        try:
            rough = SkyModel(system, layout, Sampling.of(system, layout, few, 4), model.heights)
            found = fit(rough, rough.measured(statistics.covariance, statistics.mean), *start)
        except ValueError:  # no sky fits, or they are too few
            pass
        else:
            return found.strengths, found.outer_scale, found.levels
    return *start, None


def photons_for(system: System, sensor: Sensor, place: SensorLayout, factor: float) -> float:
    """Photons (e/m^2/s) with which the noise variance of a sensor is ``factor`` times what it is now."""

    def variance(brighter: float) -> float:
        changed = sensor.model_copy(update={"photons": sensor.photons * brighter})
        return float(slope_noise(system, changed, place).variance.sum())

    # between photons alone (1/N) and read-out alone (1/N^2)
    wanted = factor * variance(1.0)
    ends = sorted((1 / factor, factor**-0.5))
    return sensor.photons * brentq(lambda x: variance(x) / wanted - 1, 0.9 * ends[0], 1.1 * ends[1])


def default_altitudes(system: System, layout: Layout) -> Array:
    """Ground, and up to :data:`TOP` in steps of half of what shifts the farthest stars' beams by a sub-aperture.

    Returns:
        (n_layers,) m above the telescope; no more than ten.
    """
    apart, top = 0.0, TOP
    for a in system.guide_stars:
        for b in system.guide_stars:
            apart = max(apart, math.hypot(a.position.x - b.position.x, a.position.y - b.position.y))
        if a.altitude is not None:
            top = min(top, 0.9 * a.altitude)
    if apart == 0:
        return np.zeros(1)
    size = min(place.size for place in layout.sensors)
    step = max(size / apart / system.airmass / 2, top / (_LAYERS - 1))
    return np.arange(0.0, top + 1e-6 * step, step)


def strengths_at(system: System, altitudes: Array) -> Array:
    """The system's profile on a grid, each layer shared by its two neighbours; a little everywhere. Sums to 1."""
    shares = np.zeros(len(altitudes))
    for layer, fraction in zip(system.atmosphere.layers, system.atmosphere.fractions, strict=True):
        shares += fraction * np.array([np.interp(layer.altitude, altitudes, unit) for unit in np.eye(len(altitudes))])
    return (1 - _EVERYWHERE) * shares / shares.sum() + _EVERYWHERE / len(altitudes)


def winds_at(system: System, altitudes: Array) -> Array:
    """(n_layers, 2) m/s, the system's wind at other altitudes, linear in between."""
    layers = sorted(system.atmosphere.layers, key=lambda layer: layer.altitude)
    at = [layer.altitude for layer in layers]
    return np.stack(
        [
            np.interp(altitudes, at, [layer.wind_speed * turn(layer.wind_direction) for layer in layers])
            for turn in (math.cos, math.sin)
        ],
        axis=1,
    )


def _check(statistics: Statistics, layout: Layout) -> None:
    n = layout.n_slopes
    if statistics.covariance.shape != (n, n):
        raise ValueError(f"statistics: expected covariance of shape {(n, n)}, got {statistics.covariance.shape}")
    if statistics.n_frames < _FEWEST:
        raise LearnError(f"{statistics.n_frames} frames are too few: expected at least {_FEWEST}")


def _merge(covariance: Array) -> tuple[list[tuple[int, ...]], list[str]]:
    """Join neighbours, those that correlate most first, until none do by less than -:data:`CORRELATED`.

    Args:
        covariance: (n_layers, n_layers) of the strengths.
    """
    n_layers = len(covariance)
    groups: list[tuple[int, ...]] = [(l,) for l in range(n_layers)]
    worst: dict[tuple[int, ...], float] = {}
    while len(groups) > 1:
        sums = np.array([[l in group for l in range(n_layers)] for group in groups], np.float64)
        together = sums @ covariance @ sums.T
        size = np.sqrt(np.diag(together))
        correlation = [together[i, i + 1] / (size[i] * size[i + 1]) for i in range(len(groups) - 1)]
        i = int(np.argmin(correlation))
        if correlation[i] > -CORRELATED:
            break
        merged = groups[i] + groups[i + 1]
        worst[merged] = min(float(correlation[i]), worst.pop(groups[i], 0.0), worst.pop(groups[i + 1], 0.0))
        groups[i : i + 2] = [merged]
    return groups, [
        f"their strengths correlate by {worst[group]:.2f}, limit -{CORRELATED:g}" if group in worst else ""
        for group in groups
    ]
