"""How well a model foretells slopes that it was not fitted to: each sensor from all others, and all together.

A model (a system with its sky, noise and geometry) makes pseudo-open-loop slopes ``s = P (y + G m~)`` Gaussian with

    S = P (Sigma_ss + Sigma_nn) P + gamma (I - P),        A = S^-1

Sensor w is foretold from the others with the error ``e_w = A_ww^-1 (A s)_w``, whose covariance is ``A_ww^-1``; without
a truth sensor this is how tomography proves itself on the sky. The normalised innovation ``e_w^T A_ww e_w / n_w``, with
n_w the number of modes that the sensor is trusted with, is 1 on average when the model is right. P acts sensor by
sensor, so that in A_ww, too, the blind modes stand apart and only ``gamma`` is in them: slopes without blind modes
never meet it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_tiles
from srtomo_srtc.memory import require
from srtomo_srtc.model import blind_modes, layout_of, noise_covariance, sightlines
from srtomo_srtc.solve import SymmetricTiles
from srtomo_srtc.wind import sensors_carried, winds

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

OVERSAMPLING = 4
"""Node cells across a sub-aperture. With two, the estimators', the innovation of a right model is 4 to 10 % too large,
for want of small scales; with four it is within 1 %."""

FEWEST_BLOCKS = 6
"""Blocks of frames below which a jackknife's error is itself too uncertain to decide on."""


class Estimate(NamedTuple):
    """A mean over frames and its standard error; of one quantity, or arrays of several."""

    mean: Array
    error: Array

    @property
    def significance(self) -> Array:
        """The mean in units of its error; 0 where the mean is 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.mean == 0, 0.0, self.mean / self.error)


def block_mean(values: NDArray[np.floating], block: NDArray[np.integer]) -> Estimate:
    """Mean over frames, with the error that leaving out one block after the other shows (delete-one jackknife).

    Frames of a block may be correlated in any way; those of different blocks are taken to be independent.

    Args:
        values: (n_frames, ...).
        block: (n_frames,) which block each frame is in.

    Raises:
        ValueError: less than two blocks.
    """
    labels, member = np.unique(block, return_inverse=True)
    if len(labels) < 2:
        raise ValueError(f"block: expected at least 2 blocks, got {len(labels)}")
    count = np.bincount(member).astype(np.float64)
    sums = np.zeros((len(labels), *values.shape[1:]))
    np.add.at(sums, member, values.astype(np.float64))
    total, n = sums.sum(axis=0), count.sum()
    others = (total - sums) / (n - count).reshape(-1, *[1] * (values.ndim - 1))
    spread = ((others - others.mean(axis=0)) ** 2).mean(axis=0)
    return Estimate(total / n, np.sqrt((len(labels) - 1) * spread))


@dataclass(frozen=True, eq=False)
class Scores:
    """What a model says of frames, frame by frame.

    Attributes:
        log_score: (n_frames,) logarithm of the model's density in the seen modes; slopes in rad.
        innovation: (n_frames, n_sensors) ``e_w^T A_ww e_w / n_w``.
        residual: (n_frames, n_sensors) mean over a sensor's seen modes of ``e_w^2``, rad^2.
    """

    log_score: Array
    innovation: Array
    residual: Array


class SlopeModel:
    """The Gaussian of one frame of pseudo-open-loop slopes under a system.

    Attributes:
        n_seen: (n_sensors,) modes that each sensor is trusted with.
        explained: (n_sensors,) share of each sensor's variance, noise included, that the others should foretell.
        noise: (n_sensors,) rms over each sensor's slopes of the noise of one frame, rad.
    """

    def __init__(self, system: System, layout: Layout | None = None, *, threads: int = 1) -> None:
        """Compute A and the inverses of its diagonal blocks, in float32.

        Args:
            system: sky, stars and noise; of one frame, whatever the loop's gain.
            layout: where sensors are taken to be; as in the system when not given.
            threads: to compute with, apart from those of the BLAS library.

        Raises:
            ValueError: the layout has other slopes than the system.
            np.linalg.LinAlgError: the covariance is not positive definite: no system that can be.
            MemoryError: one line, before any work, if there is not enough.
        """
        layout = layout_of(system, layout)
        n = layout.n_slopes
        require(4.0 * n**2 + SymmetricTiles.bytes_needed(n, np.float32), f"health of {system.name}")
        profile = Profile.of(system)
        sensors = sightlines(system, layout, profile, OVERSAMPLING)
        turbulence = Turbulence.covering(profile, [sensor.nodes for sensor in sensors])
        S = slope_tiles(turbulence, sensors, fast=True, threads=threads)
        noise = noise_covariance(system, layout, gain=1.0)
        S.add(noise)
        self._blind = blind_modes(system, layout).astype(np.float32)
        gamma = S.trace() / n
        S.project(self._blind.astype(np.float64), gamma)
        total = np.concatenate([np.diag(row[-1]) for row in S.tiles]).astype(np.float64)
        S.factor(threads)
        # the diagonal tiles now hold inverses of the Cholesky factor
        diagonal = np.concatenate([np.diag(row[-1]) for row in S.tiles]).astype(np.float64)
        log_determinant = -2 * float(np.log(diagonal).sum()) - self._blind.shape[1] * math.log(gamma)
        self._A: Floats = np.eye(n, dtype=np.float32)
        S.divide(self._A, threads)
        self._own = [layout.slopes_of(w) for w in range(len(layout.sensors))]
        self._inverses = [np.linalg.inv(self._A[own, own]) for own in self._own]
        blind = np.array([np.count_nonzero(self._blind[own].any(axis=0)) for own in self._own])
        self.n_seen = np.diff(layout.slope_start) - blind
        variance = np.array([total[own].sum() for own in self._own]) - gamma * blind
        unexplained = np.array([np.trace(inverse, dtype=np.float64) for inverse in self._inverses]) - gamma * blind
        self.explained = 1 - unexplained / variance
        self.noise = np.sqrt([noise.diagonal()[own].mean() for own in self._own])
        self._constant = -0.5 * (log_determinant + int(self.n_seen.sum()) * math.log(2 * math.pi))

    def scores(self, slopes: NDArray[np.floating]) -> Scores:
        """Judge frames: one product of A with each, and a smaller one a sensor.

        Args:
            slopes: (n_frames, n_slopes) pseudo-open-loop slopes, rad; what is in blind modes does not count.
        """
        s, product = self._products(slopes)
        errors = self._errors(product)
        innovation, residual = (
            np.stack(
                [
                    np.einsum("fi,fi->f", error, other[:, own], dtype=np.float64) / n
                    for error, own, n in zip(errors, self._own, self.n_seen, strict=True)
                ],
                axis=1,
            )
            for other in (product, np.concatenate(errors, axis=1))
        )
        power = np.einsum("fi,fi->f", s, product, dtype=np.float64)
        return Scores(self._constant - 0.5 * power, innovation, residual)

    def silent(self, measured: NDArray[np.floating], block: NDArray[np.integer]) -> list[int]:
        """Sensors whose slopes as measured vary by less than a tenth of their noise in some block: they are dead.

        Their pseudo-open-loop slopes are then what the loop itself makes of the others'; a fit takes them for those of
        a sensor without noise.

        Args:
            measured: (n_frames, n_slopes) rad.
            block: (n_frames,) as :func:`block_mean` takes it; single frames tell nothing.
        """
        found = set()
        for label in np.unique(block):
            some = measured[block == label]
            if len(some) > 1:
                varying = np.sqrt([some[:, own].var(axis=0, dtype=np.float64).mean() for own in self._own])
                found |= {int(w) for w in np.flatnonzero(varying < 0.1 * self.noise)}
        return sorted(found)

    def foretold(self, slopes: NDArray[np.floating]) -> Floats:
        """Each sensor's slopes as all others foretell them, (n_frames, n_slopes) rad, without blind modes."""
        s, product = self._products(slopes)
        return np.asarray(s - np.concatenate(self._errors(product), axis=1))

    def _products(self, slopes: NDArray[np.floating]) -> tuple[Floats, Floats]:
        """P s and A P s, a frame a row."""
        s = self._seen(np.asarray(slopes, dtype=np.float32))
        return s, s @ self._A

    def _seen(self, rows: Floats) -> Floats:
        """Each row times P."""
        return np.asarray(rows - (rows @ self._blind) @ self._blind.T)

    def _errors(self, product: Floats) -> list[Floats]:
        return [product[:, own] @ inverse for own, inverse in zip(self._own, self._inverses, strict=True)]


class FlowModel(SlopeModel):
    """The same, and what slopes are some time later: the Gaussian that they have in frozen flow, given those now.

        s(t + ahead) given s(t):   mean C A s(t), covariance S - C A C^T,   C = P Sigma_ss(ahead) P

    Winds show nowhere in single frames: models that differ in their winds differ here.
    """

    def __init__(self, system: System, ahead: float, layout: Layout | None = None, *, threads: int = 1) -> None:
        """As :class:`SlopeModel`, with the system's winds.

        Args:
            ahead: s, more than 0.
        """
        layout = layout_of(system, layout)
        super().__init__(system, layout, threads=threads)
        n = layout.n_slopes
        require(4 * SymmetricTiles.bytes_needed(n, np.float32) + 16.0 * n**2, f"flow of {system.name}")
        profile = Profile.of(system)
        sensors = sightlines(system, layout, profile, OVERSAMPLING)
        earlier = sensors_carried(sensors, winds(system), ahead)
        turbulence = Turbulence.covering(profile, [sensor.nodes for sensor in [*sensors, *earlier]])
        both: Floats = slope_tiles(turbulence, [*sensors, *earlier], fast=True, threads=threads).dense()
        C, S = self._seen(self._seen(both[n:, :n]).T), both[:n, :n]
        S += noise_covariance(system, layout, gain=1.0).astype(np.float32)
        self._predictor = self._A @ C.T
        left = S - C @ self._predictor
        gamma = float(left.trace()) / n
        left = self._seen(self._seen(left).T) + np.float32(gamma) * (self._blind @ self._blind.T)
        factor, _ = cho_factor((left + left.T) / 2, lower=True)
        log_determinant = 2 * float(np.log(np.diag(factor).astype(np.float64)).sum())
        log_determinant -= self._blind.shape[1] * math.log(gamma)
        self._ahead_constant = -0.5 * (log_determinant + int(self.n_seen.sum()) * math.log(2 * math.pi))
        self._ahead_inverse: Floats = cho_solve((factor, True), np.eye(n, dtype=np.float32))

    def scores_ahead(self, now: NDArray[np.floating], later: NDArray[np.floating]) -> Scores:
        """Judge frames by those before: the log-score and residuals of ``later``, given ``now``, all sensors together.

        Args:
            now, later: (n_frames, n_slopes) ``ahead`` apart, rad.
        """
        error = self._seen(np.asarray(later, dtype=np.float32))
        error -= self._seen(np.asarray(now, dtype=np.float32)) @ self._predictor
        power = np.einsum("fi,fi->f", error, error @ self._ahead_inverse, dtype=np.float64)
        squares = np.square(error, dtype=np.float64)
        residual = [squares[:, own].sum(axis=1) / n for own, n in zip(self._own, self.n_seen, strict=True)]
        return Scores(self._ahead_constant - 0.5 * power, self.scores(later).innovation, np.stack(residual, axis=1))


@dataclass(frozen=True, eq=False)
class Health:
    """A model against held-out frames, sensor by sensor.

    Attributes:
        n_frames, n_blocks: that were judged.
        innovation: (n_sensors,) 1 where the model is right; above, the sensor is not where or as good as the model
            has it; below, it is too good to be true.
        residual: (n_sensors,) rms of what the other sensors do not foretell of each, rad.
    """

    n_frames: int
    n_blocks: int
    innovation: Estimate
    residual: Estimate

    @classmethod
    def of(cls, scores: Scores, block: NDArray[np.integer]) -> Health:
        """From the scores of frames in blocks, as :func:`block_mean` takes them."""
        square, error = block_mean(scores.residual, block)
        rms = np.sqrt(square)
        return cls(
            len(block),
            len(np.unique(block)),
            block_mean(scores.innovation, block),
            Estimate(rms, error / (2 * rms)),
        )

    def ill(self, tolerance: float) -> list[int]:
        """Sensors whose innovation is beyond ``1 / (1 + tolerance)`` to ``1 + tolerance`` by three errors."""
        mean, error = self.innovation
        well = (mean - 3 * error <= 1 + tolerance) & (mean + 3 * error >= 1 / (1 + tolerance))
        return [int(w) for w in np.flatnonzero(~well)]
