"""The wind of each layer, from pseudo-open-loop slopes at a time lag.

Frozen flow says what slopes have in common with slopes a lag t earlier: ``<s[k] s[k-lag]^T> = sum_l c_l B_l(v_l t)``,
with B_l(d) the covariance of layer l with itself displaced by d. The velocities that fit the measured matrices best
are found in least squares, whitened by the slopes' own covariance: from the peak of the correlation with B_l(v t) over
a grid of velocities, strongest layer first, each found one taken off; then all together by Gauss-Newton over all lags.
What a coarse grid leaves of strong layers can hide a weak one: whichever of them would take most off what is left by
then, were it elsewhere, goes there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.likelihood import inverse_of
from srtomo_srtc.model import layout_of
from srtomo_srtc.sampling import Sampling
from srtomo_srtc.sky_model import SkyModel
from srtomo_srtc.telemetry import Statistics

Array = NDArray[np.float64]

LIMIT = 360
"""Default number of slopes that the fit works with, at most about."""

UNSEEN = 3.0
"""Error of a velocity's component, m/s, beyond which a layer's wind is said not to be seen."""

_SPEEDS = np.arange(0.0, 31.0, 5.0)  # m/s, of the grid
_DIRECTIONS = 12  # an even number
_STEP = 0.3  # m/s, of the central differences
_ITERATIONS = 20
_AGAIN = 3  # times that a layer is looked for elsewhere, at most
_DAMPED = 1e-3  # of the best seen component's information: a layer that is hardly seen stays where it is
_CLOSE = 0.02  # m/s: a step this small is the last
_CURVED = 0.2  # m/s: farther, derivatives are made anew
_NEAR = 0.05  # m/s: likewise, before the last step
_STRIDE = 4.0  # m/s: of an iteration, at most
_FASTEST = 60.0  # m/s
_OF_GROUP = 0.1  # of the strength of layers that are told as one: without it the rest stands for all
_LAGS = 100  # in counted frames, about, over which frames that resemble each other are summed
_RATIO = 1.3  # of those that are looked at
_FORGOTTEN = 1e-3  # of that sum: what comes after it is left out


@dataclass(frozen=True)
class LayerWind:
    """One layer's wind.

    Attributes:
        altitude: m above the telescope.
        fraction: of the integrated Cn2.
        velocity: x, y, where the layer goes, m/s.
        covariance: (2, 2) of it, m^2/s^2.
        reason: why it is not to be trusted; empty when it is.
    """

    altitude: float
    fraction: float
    velocity: tuple[float, float]
    covariance: Array
    reason: str

    @property
    def speed(self) -> float:
        """m/s."""
        return math.hypot(*self.velocity)

    @property
    def direction(self) -> float:
        """Where the layer goes, counter-clockwise from +x, rad."""
        return math.atan2(self.velocity[1], self.velocity[0])

    @property
    def sigma(self) -> float:
        """Larger 1-sigma error of the velocity's components, m/s."""
        return math.sqrt(float(np.diag(self.covariance).max()))


def learn_winds(
    system: System, statistics: Statistics, layout: Layout | None = None, *, limit: int = LIMIT
) -> tuple[LayerWind, ...]:
    """The wind of each turbulent layer of a sky that is known but for its winds.

    Layers that the sensors cannot separate are separated by their winds, if these differ. Errors suppose the layers'
    strengths: what these lack of the truth, as those of such layers do, is in no error.

    Args:
        system: with the sky's r0, outer scale and layers as learned; its winds are not used.
        statistics: with lagged moments; lags in which turbulence moves by half a sub-aperture to two are best.
        limit: slopes to work with.

    Returns:
        One a turbulent layer, in the system's order.

    Raises:
        ValueError: there are no lagged moments, or no sensor with more than one sub-aperture.
    """
    layout = layout_of(system, layout)
    if not statistics.lagged:
        raise ValueError("wind: expected statistics with lagged moments")
    profile = Profile.of(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, limit, cells=2), profile.heights)
    per_frame = 1 / system.loop.rate
    measured = {lag * per_frame: model.measured(matrix).astype(np.float64) for lag, matrix in statistics.lagged.items()}
    pairs = min(statistics.lagged_frames.values())
    flow = _Flow(model, profile, measured)
    found, slopes = flow.find()
    covariance = flow.covariance(found, slopes, pairs, statistics.interval)
    layers = [
        (layer.altitude, fraction)
        for layer, fraction in zip(system.atmosphere.layers, system.atmosphere.fractions, strict=True)
        if fraction > 0
    ]
    return tuple(
        _wind(*layer, found[l], covariance[2 * l : 2 * l + 2, 2 * l : 2 * l + 2]) for l, layer in enumerate(layers)
    )


def wind_of_all(layers: Sequence[LayerWind]) -> LayerWind:
    """Of several layers together: their mean by strength, with the largest error that it can have.

    Not to be trusted if one with a tenth of their strength, or more, is not.
    """
    fractions = np.array([layer.fraction for layer in layers])
    share = fractions / fractions.sum()
    altitude, *velocity = share @ np.array([(layer.altitude, *layer.velocity) for layer in layers])
    sigma = share @ np.array([np.sqrt(np.diag(layer.covariance)) for layer in layers])
    reason = next((layer.reason for layer, part in zip(layers, share) if layer.reason and part > _OF_GROUP), "")
    return LayerWind(altitude, float(fractions.sum()), (velocity[0], velocity[1]), np.diag(sigma**2), reason)


def with_winds(system: System, found: Sequence[LayerWind]) -> System:
    """The system with the winds that were found; layers whose wind is not seen keep theirs.

    Args:
        found: one a turbulent layer, as :func:`learn_winds` has them for this system.
    """
    turbulent = [l for l, fraction in enumerate(system.atmosphere.fractions) if fraction > 0]
    changes = {}
    for l, wind in zip(turbulent, found, strict=True):
        if not wind.reason:
            changes[f"atmosphere.layers.{l}.wind_speed"] = wind.speed
            changes[f"atmosphere.layers.{l}.wind_direction"] = wind.direction
    return system.with_changes(changes)


def _wind(altitude: float, fraction: float, velocity: Array, covariance: Array) -> LayerWind:
    sigma = math.sqrt(float(np.diag(covariance).max()))
    reason = ""
    if not sigma < UNSEEN:
        reason = f"too little of it is seen: {100 * fraction:.1f} % of the turbulence, error {sigma:.1f} m/s"
    elif math.hypot(*velocity) >= _FASTEST:
        reason = f"no wind below {_FASTEST:g} m/s fits"
    return LayerWind(altitude, fraction, (float(velocity[0]), float(velocity[1])), covariance, reason)


@dataclass(frozen=True, eq=False)
class _Slope:
    """How a lagged covariance changes with the winds.

    Attributes:
        derivatives: (n, n) by each component of each velocity, layer by layer.
        whitened: the same, whitened.
    """

    derivatives: list[Array]
    whitened: list[Array]

    @property
    def information(self) -> Array:
        """(2 n_layers, 2 n_layers) products of both."""
        return np.array([[np.vdot(W, D) for D in self.derivatives] for W in self.whitened])


class _Flow:
    """Lagged covariances of a sky, and what was measured of them.

    Args:
        measured: time (s) to (n, n) <s[k] s[k-lag]^T>, rad^2.
    """

    def __init__(self, model: SkyModel, profile: Profile, measured: Mapping[float, Array]) -> None:
        self._model = model
        self._outer_scale = profile.outer_scale
        self._strengths = profile.fractions * profile.r0 ** (-5 / 3)
        self._measured = dict(sorted(measured.items()))
        self._time = list(self._measured)[len(self._measured) // 2]  # the lag that is searched
        # of each layer, once it was searched: v, B_l(v t), and its square
        self._grid: dict[int, list[tuple[Array, NDArray[np.float32], float]]] = {}
        C = model.turbulence(self._strengths, self._outer_scale).astype(np.float64) + sum(model.noise)
        C += model.unseen(C.trace() / len(C))
        self._C = C
        self._inverse = np.asarray(inverse_of(C), np.float64)

    def _layer(self, l: int, velocity: Array, time: float) -> Array:
        """c_l B_l(v t), (n, n) rad^2."""
        alone = slice(l, l + 1)
        seen = self._model.lagged(self._strengths[alone], self._outer_scale, velocity[None], time, alone)
        return seen.astype(np.float64)

    def _whitened(self, matrix: Array) -> Array:
        """A matrix A with A = C^-1: its sum over entries with another is their product in whitened slopes."""
        return np.asarray(self._inverse @ matrix @ self._inverse)

    def find(self) -> tuple[Array, dict[float, _Slope]]:
        """The velocities that fit best, as :meth:`refine` has them."""
        found, slopes = self.refine(self.search())
        for _ in range(_AGAIN):
            elsewhere = self._elsewhere(found)
            if elsewhere is None:
                break
            other = self.refine(elsewhere)
            if not self._misfit(other[0]) < self._misfit(found):
                break
            found, slopes = other
        return found, slopes

    def search(self) -> Array:
        """(n_layers, 2) the best velocities of a grid, m/s, layer after layer."""
        left = self._whitened(self._measured[self._time])
        found = np.zeros((len(self._strengths), 2))
        for l in np.argsort(-self._strengths):
            _, found[l], taken = self._best(int(l), left)
            left -= self._whitened(taken)
        return found

    def _best(self, l: int, left: Array) -> tuple[float, Array, Array]:
        """The velocity of the grid with which a layer takes most off the squares of what is left (whitened).

        Returns:
            How much, the velocity, and B_l(v t) there.
        """
        if l not in self._grid:
            # the other half are their opposites: B_l(-d) = B_l(d)^T
            turns = 2 * np.pi * np.arange(_DIRECTIONS // 2) / _DIRECTIONS
            grid = [np.zeros(2), *(v * np.array([np.cos(a), np.sin(a)]) for v in _SPEEDS[1:] for a in turns)]
            self._grid[l] = []
            for velocity in grid:
                B = self._layer(l, velocity, self._time)
                # kept in single precision, in which they are made: there are many
                self._grid[l].append((velocity, B.astype(np.float32), float(np.vdot(self._whitened(B), B))))
        best, found, taken = -np.inf, np.zeros(2), left
        for velocity, single, square in self._grid[l]:
            B = single.astype(np.float64)
            for there, correlation in ((velocity, B), (-velocity, B.T)):
                gain = 2 * float(np.vdot(left, correlation)) - square
                if gain > best:
                    best, found, taken = gain, there, correlation
        return best, found, taken

    def _elsewhere(self, velocities: Array) -> Array | None:
        """The velocities with the layer moved that another place on the grid suits most better than its own.

        None, if each is next to its best place.
        """
        left = self._left(velocities, self._time)
        most, found = 0.0, None
        for l, velocity in enumerate(velocities):
            own = self._layer(l, velocity, self._time)
            alone = self._whitened(left + own)
            gain, there, _ = self._best(l, alone)
            more = gain - (2 * float(np.vdot(alone, own)) - float(np.vdot(self._whitened(own), own)))
            if more > most and np.hypot(*(there - velocity)) > _SPEEDS[1]:
                most, found = more, velocities.copy()
                found[l] = there
        return found

    def _left(self, velocities: Array, time: float) -> Array:
        """What layers with these velocities leave of a measured covariance."""
        return self._measured[time] - self._model.lagged(self._strengths, self._outer_scale, velocities, time)

    def _misfit(self, velocities: Array) -> float:
        """Whitened squares of that, of all lags."""
        left = [self._left(velocities, time) for time in self._measured]
        return sum(float(np.vdot(self._whitened(matrix), matrix)) for matrix in left)

    def refine(self, velocities: Array) -> tuple[Array, dict[float, _Slope]]:
        """The velocities that fit all lags best, from those given.

        Returns:
            (n_layers, 2) m/s, and what each lag is like about there.
        """
        velocities, at = velocities.copy(), np.full(velocities.shape, np.inf)
        blank = [self._C] * velocities.size  # every layer has moved at first
        slopes = {time: _Slope(blank.copy(), blank.copy()) for time in self._measured}
        seen = np.ones(velocities.shape)  # of each component, relative to the best: what is hardly seen decides nothing
        stride, last, curved = np.full(len(velocities), _STRIDE), np.zeros(velocities.shape), _CURVED
        for _ in range(_ITERATIONS):
            moved = np.flatnonzero((seen * np.abs(velocities - at)).max(axis=1) > curved)
            if len(moved):
                at[moved] = velocities[moved]
                for time, slope in slopes.items():
                    for l in moved:
                        both = self._derivatives(int(l), velocities[l], time)
                        slope.derivatives[2 * l : 2 * l + 2] = both
                        slope.whitened[2 * l : 2 * l + 2] = [self._whitened(D) for D in both]
                information = np.sum([slope.information for slope in slopes.values()], axis=0)
                diagonal = np.diag(information)
                seen = np.sqrt(diagonal / diagonal.max()).reshape(-1, 2)
                ridge = np.diag(diagonal + diagonal.max()) * _DAMPED
            score = np.zeros(velocities.size)
            for time in self._measured:
                left = self._left(velocities, time)
                score += [np.vdot(W, left) for W in slopes[time].whitened]
            step: Array = np.linalg.solve(information + ridge, score).reshape(-1, 2)
            length = np.hypot(*step.T)
            # a layer that goes to and fro has gone too far each time
            back = np.sum(step * last, axis=1) < 0
            shorter = np.maximum(np.minimum(stride, length) / 2, _CURVED)
            stride = np.where(back, shorter, np.minimum(1.5 * stride, _STRIDE))
            step *= np.minimum(1, stride / np.maximum(length, 1e-9))[:, None]
            last = step
            velocities += step
            speed = np.hypot(*velocities.T)[:, None]
            velocities *= np.minimum(1, _FASTEST / np.maximum(speed, 1e-9))
            if (seen * np.abs(step)).max() < _CLOSE:
                if curved < _CURVED:
                    break
                curved = _NEAR  # small, but by derivatives of a little elsewhere: once more with new ones
            else:
                curved = _CURVED
        return velocities, slopes

    def _derivatives(self, l: int, velocity: Array, time: float) -> list[Array]:
        """Of the lagged covariance by each component of a layer's velocity."""
        out = []
        for axis in np.eye(2):
            ahead, behind = (self._layer(l, velocity + s * _STEP * axis, time) for s in (1, -1))
            out.append((ahead - behind) / (2 * _STEP))
        return out

    def covariance(self, velocities: Array, slopes: Mapping[float, _Slope], pairs: int, interval: float) -> Array:
        """(2 n_layers, 2 n_layers) of the velocities, m^2/s^2.

        Of the lag that tells most, as if there were no other: lags largely repeat each other. With Q_p the whitened
        derivative, a score is the mean over k of ``s[k]^T Q_p s[k-lag]``; how much a frame's repeats that of frames
        after it follows from frozen flow too.

        Args:
            slopes: what each lag is like about there.
            pairs: of exposures in the measured moments.
            interval: s between counted frames.
        """
        best = max(slopes.values(), key=lambda slope: float(slope.information.trace()))
        frames, parts = [0], [self._repeated(best.whitened, self._C)]
        spread = parts[0].copy()
        while frames[-1] < _LAGS and np.diag(abs(parts[-1])).max() > _FORGOTTEN * np.diag(spread).min():
            frames.append(max(frames[-1] + 1, round(_RATIO * frames[-1])))
            C = self._model.lagged(self._strengths, self._outer_scale, velocities, frames[-1] * interval)
            parts.append(self._repeated(best.whitened, C.astype(np.float64)))
            # linear in between
            first, last = frames[-2:]
            share = np.arange(1, last - first + 1) / (last - first)
            part = (1 - share).sum() * parts[-2] + share.sum() * parts[-1]
            spread += part + part.T
        # scaled first: only what goes together is left out, not what is hardly seen
        scale = 1 / np.sqrt(np.diag(best.information))
        inverse = np.linalg.pinv(best.information * np.outer(scale, scale), rcond=1e-9, hermitian=True)
        inverse *= np.outer(scale, scale)
        return np.asarray(inverse @ spread @ inverse / pairs)

    @staticmethod
    def _repeated(whitened: Sequence[Array], later: Array) -> Array:
        """tr(Q_p^T C Q_q C^T) for C the covariance of slopes with earlier ones."""
        moved = [later @ Q @ later.T for Q in whitened]
        return np.array([[np.vdot(Q, M) for M in moved] for Q in whitened])
