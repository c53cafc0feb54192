"""Covariances of an instrument's slopes as a function of r0, outer scale, layer strengths and noise levels."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import CovarianceTable, Profile
from srtomo_srtc.covariance import Turbulence, slope_cross_covariance, slope_tiles
from srtomo_srtc.model import noise_covariance
from srtomo_srtc.sampling import Sampling
from srtomo_srtc.wind import sensors_carried

Array = NDArray[np.float64]
Single = NDArray[np.float32]

POWER = 1.5
"""The outer scale enters as L0^-1.5, in which the slopes' covariance is nearly linear."""

_DIFFERENCE = 1.05  # of outer scales, for the derivative
_REACH = 8.0  # m: tables are made for multiples of it, so that what differs a little shares one


class SkyModel:
    """``C = sum_l c_l B_l(L0) + sum_w n_w N_w`` of a sampling's slopes, blind modes taken out.

    ``c_l = f_l r0^(-5/3)`` is a layer's strength along the line of sight (m^(-5/3), r0 at 500 nm), and N_w a sensor's
    noise as the instrument says it is, of single exposures.

    What straight lines between nodes lack goes with the square of their distance: from covariances with two distances
    follows that with none (Richardson's extrapolation).

    Attributes:
        sampling: which slopes.
        heights: (n_layers,) along the line of sight, m.
        noise: N_w of each sensor that takes part, (n, n).
        whole_noise: the same, sparse, with what is on the blind modes.
        noisy: index of each of these sensors.
    """

    def __init__(self, system: System, layout: Layout, sampling: Sampling, heights: Array) -> None:
        self.heights = np.asarray(heights, np.float64)
        self.sampling = sampling
        # what a profile adds to a sightline is known layer by layer
        profile = Profile(1.0, 1.0, self.heights, np.ones(len(self.heights)))
        self._grids = [
            (weight, sampling.sightlines(system, profile, coarser)) for weight, coarser in ((4 / 3, 1), (-1 / 3, 2))
        ]
        nodes = [line.nodes for _, lines in self._grids for line in lines]
        self._reach = float(np.hypot(*(np.ptp(np.hstack(p), axis=1) for p in zip(*((n.x, n.y) for n in nodes)))).max())
        whole = noise_covariance(system, layout, 1.0)
        self.noisy = tuple(int(w) for w in np.unique(sampling.sensors))
        self.whole_noise: list[sparse.csr_array] = []
        for w in self.noisy:
            own = np.zeros(layout.n_slopes)
            own[layout.slopes_of(w)] = 1
            only = sparse.diags_array(own)
            T = sampling.reduction
            self.whole_noise.append(sparse.csr_array(T @ only @ whole @ only @ T.T).astype(np.float32))
        self.noise = [self.seen(noise.toarray()) for noise in self.whole_noise]

    def __len__(self) -> int:
        return len(self.sampling)

    def layer(self, index: int, outer_scale: float) -> Single:
        """B_l: (n, n) rad^2 for a strength of 1."""
        return self._covariance(np.ones(1), outer_scale, slice(index, index + 1))

    def turbulence(self, strengths: Array, outer_scale: float) -> Single:
        """sum_l c_l B_l, (n, n) rad^2."""
        return self._covariance(strengths, outer_scale, slice(None))

    def by_outer_scale(self, strengths: Array, outer_scale: float, turbulence: Single) -> Single:
        """Derivative of :meth:`turbulence`, which is given, by L0^-POWER: (n, n).

        A difference to one side, which will do for what is nearly linear.
        """
        near = outer_scale / _DIFFERENCE
        difference = self.turbulence(strengths, near) - turbulence
        return np.asarray(difference / np.float32(near**-POWER - outer_scale**-POWER), np.float32)

    def lagged(
        self, strengths: Array, outer_scale: float, velocity: Array, time: float, layers: slice = slice(None)
    ) -> Single:
        """Covariance of the turbulence's slopes with those a ``time`` (s) earlier in frozen flow, (n, n).

        Args:
            strengths: (n_layers,) of each layer that takes part.
            velocity: (n_layers, 2) where each of them goes, m/s.
            layers: that take part.
        """
        # without extrapolation: correlations are asked for, and the missing part hardly shows in these
        now = [line.only(layers) for line in self._grids[0][1]]
        then = sensors_carried(now, velocity, time)
        reach = self._reach + time * float(np.hypot(*velocity.T).max())
        turbulence = Turbulence(np.asarray(strengths, np.float64), _table(outer_scale, reach))
        return self.seen(slope_cross_covariance(turbulence, now, then))

    def unseen(self, gamma: float) -> Single:
        """``gamma (I - P)``, (n, n), on the blind modes, where model and measurement are then the same."""
        blind = self.sampling.blind
        return np.asarray(gamma * blind @ blind.T, np.float32)

    def measured(self, covariance: NDArray[np.floating], mean: NDArray[np.floating] | None = None) -> Single:
        """The second moment of these slopes, (n, n) rad^2, from the covariance (n_slopes, n_slopes) about the mean.

        Args:
            mean: (n_slopes,) rad; zero when not given.
        """
        reduced = self.sampling.reduced(covariance)
        if mean is not None:
            own = self.sampling.reduction @ mean
            reduced += np.outer(own, own)
        return self.seen(reduced)

    def _covariance(self, strengths: Array, outer_scale: float, layers: slice) -> Single:
        out = np.zeros((len(self), len(self)))
        table = _table(outer_scale, self._reach)
        for weight, lines in self._grids:
            turbulence = Turbulence(weight * np.asarray(strengths, np.float64), table)
            out += slope_tiles(turbulence, [line.only(layers) for line in lines], fast=True).dense()
        return self.seen(out)

    def seen(self, matrix: NDArray[np.floating]) -> Single:
        """``P matrix P``, (n, n): without the blind modes."""
        blind, out = self.sampling.blind, np.array(matrix, np.float64)
        left, right = out @ blind, blind.T @ out
        right -= (blind.T @ left) @ blind.T
        # both sides' in one product of thin matrices; in float32 what is left of the blind modes could be negative
        out -= np.hstack([left, blind]) @ np.vstack([blind.T, right])
        return out.astype(np.float32)


def _table(outer_scale: float, reach: float) -> CovarianceTable:
    """For r0 = 1 m, at least up to a separation (m)."""
    return _table_of(outer_scale, _REACH * math.ceil(reach / _REACH))


@lru_cache(maxsize=4)
def _table_of(outer_scale: float, reach: float) -> CovarianceTable:
    return CovarianceTable.build(1.0, outer_scale, reach)
