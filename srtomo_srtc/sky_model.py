"""Covariances of an instrument's slopes as a function of r0, outer scale, layer strengths and noise levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, slope_tiles
from srtomo_srtc.model import noise_covariance
from srtomo_srtc.sampling import Sampling
from srtomo_srtc.wind import carried

Array = NDArray[np.float64]
Single = NDArray[np.float32]

_DIFFERENCE = 0.05  # of the logarithm of the outer scale, either way, for the derivative


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
        whole = noise_covariance(system, layout, 1.0)
        self.noisy = tuple(int(w) for w in np.unique(sampling.sensors))
        self.noise: list[Single] = []
        for w in self.noisy:
            own = np.zeros(layout.n_slopes)
            own[layout.slopes_of(w)] = 1
            only = sparse.diags_array(own)
            self.noise.append(self._projected(sampling.reduced(sparse.csr_array(only @ whole @ only))))

    def __len__(self) -> int:
        return len(self.sampling)

    def layer(self, index: int, outer_scale: float) -> Single:
        """B_l: (n, n) rad^2 for a strength of 1."""
        return self._projected(self._covariance(np.ones(1), outer_scale, slice(index, index + 1)))

    def turbulence(self, strengths: Array, outer_scale: float) -> Single:
        """sum_l c_l B_l, (n, n) rad^2."""
        return self._projected(self._covariance(strengths, outer_scale, slice(None)))

    def by_log_outer_scale(self, strengths: Array, outer_scale: float) -> Single:
        """Its derivative to the logarithm of the outer scale, (n, n)."""
        above, below = (self.turbulence(strengths, outer_scale * np.exp(s * _DIFFERENCE)) for s in (1, -1))
        return np.asarray((above - below) / np.float32(2 * _DIFFERENCE))

    def lagged(
        self, strengths: Array, outer_scale: float, velocity: Array, time: float, layers: slice = slice(None)
    ) -> Single:
        """Covariance of the turbulence's slopes with those a ``time`` (s) earlier in frozen flow, (n, n).

        Args:
            strengths: (n_layers,) of each layer that takes part.
            velocity: (n_layers, 2) where each of them goes, m/s.
            layers: that take part.
        """
        n = len(self)
        # without extrapolation: correlations are asked for, and the missing part hardly shows in these
        lines = [line.only(layers) for line in self._grids[0][1]]
        both = [*lines, *(_moved(line, velocity, time) for line in lines)]
        return self._projected(self._slopes(strengths, outer_scale, both)[n:, :n].T)

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
        return self._projected(reduced)

    def _covariance(self, strengths: Array, outer_scale: float, layers: slice) -> Array:
        out = np.zeros((len(self), len(self)))
        for weight, lines in self._grids:
            out += weight * self._slopes(strengths, outer_scale, [line.only(layers) for line in lines])
        return out

    def _slopes(self, strengths: Array, outer_scale: float, lines: Sequence[Sightline]) -> Single:
        profile = Profile(1.0, outer_scale, self.heights, np.asarray(strengths, np.float64))
        turbulence = Turbulence.covering(profile, [line.nodes for line in lines])
        return np.asarray(slope_tiles(turbulence, lines, fast=True).dense(), np.float32)

    def _projected(self, matrix: NDArray[np.floating]) -> Single:
        blind = self.sampling.blind
        out = np.array(matrix, np.float64)
        out -= blind @ (blind.T @ out)
        out -= (out @ blind) @ blind.T
        return out.astype(np.float32)


def _moved(line: Sightline, velocity: Array, time: float) -> Sightline:
    """Through the turbulence that the line saw a ``time`` (s) ago, where it is now."""
    seen = line.seen and replace(line.seen, offsets=line.seen.offsets + time * velocity)
    return Sightline(carried(line.nodes, velocity, time), line.gradient, seen)
