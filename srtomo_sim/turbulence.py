"""Frozen-flow turbulence: periodic von Karman screens whose covariance is exact at every lag of their grid.

The covariance on the torus is the closed form at the shortest way round; its discrete Fourier transform is the power
spectrum (circulant embedding), so that low frequencies need no sub-harmonics. A screen is a cubic spline surface: the
spectrum of its coefficients is divided by that of the spline, so that the surface, averaged over where it lies within a
grid step, has the closed form's covariance at all grid lags. A moving screen loses no power to interpolation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.fft
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray
from scipy.special import gamma, kv

from srtomo_core.system import Direction, System
from srtomo_sim.course import Course, travel
from srtomo_sim.spline import Array, padded, square_sum

METRES_PER_RADIAN = 500e-9 / (2 * math.pi)
"""Phase at 500 nm, at which r0 is defined, to metres of wavefront."""

_STEP = 0.05
_MAX_SIZE = 4096


def covariance(rho: ArrayLike, r0: float, outer_scale: float) -> Array:
    """Von Karman phase covariance at separations ``rho`` (m), rad^2 at the wavelength of r0; any shape."""
    x = 2 * np.pi * np.asarray(rho, float) / outer_scale
    scale = (outer_scale / r0) ** (5 / 3) * gamma(11 / 6) / (2 ** (5 / 6) * np.pi ** (8 / 3))
    scale *= (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    at_zero = 2 ** (-1 / 6) * gamma(5 / 6)
    safe = np.maximum(x, 1e-12)
    return scale * np.where(x > 1e-12, safe ** (5 / 6) * kv(5 / 6, safe), at_zero)


@dataclass(frozen=True)
class Grid:
    """A periodic square grid: ``size`` points of ``step`` metres on each side."""

    size: int
    step: float


def grid_for(system: System) -> Grid:
    """Grid of an instrument's screens.

    The same for instruments of one diameter and outer scale, which then see the same sky. Steps of 5 cm, finer for
    telescopes below 4 m; the side at least four outer scales and twice what the telescope sees of the highest layer.

    Raises:
        ValueError: an outer scale so large that the screens would not fit.
    """
    diameter, outer_scale = system.telescope.diameter, system.atmosphere.outer_scale
    directions = [s.position for s in system.guide_stars] + [t.position for t in system.science.targets]
    field = max(math.hypot(d.x, d.y) for d in directions)
    side = max(4 * outer_scale, 2 * (diameter + 2 * max(system.los_heights) * field))
    step = min(_STEP, max(diameter / 80, side / _MAX_SIZE))
    size = int(scipy.fft.next_fast_len(math.ceil(side / step / 2), real=True)) * 2
    if size > 2 * _MAX_SIZE:
        raise ValueError(f"turbulence: screens of {side:.0f} m are too large to simulate (outer scale, field)")
    return Grid(size, step)


@lru_cache(maxsize=1)
def _amplitude(grid: Grid, r0: float, outer_scale: float) -> Array:
    """(size, size/2 + 1) root of the spline coefficients' power, m, for all the turbulence in one layer."""
    n = grid.size
    lag = np.minimum(np.arange(n), n - np.arange(n))
    # a quarter of the torus holds every lag, and half of that every distance
    j, i = np.tril_indices(n // 2 + 1)
    quarter = np.empty((n // 2 + 1, n // 2 + 1))
    quarter[j, i] = quarter[i, j] = covariance(np.hypot(i, j) * grid.step, r0, outer_scale)
    power = scipy.fft.rfft2(quarter[np.ix_(lag, lag)], workers=-1).real
    spline = square_sum(n)
    # beyond four outer scales what the embedding leaves negative is rounding
    amplitude = np.sqrt(np.maximum(power, 0) / (spline[:, None] * spline[: n // 2 + 1]))
    amplitude *= METRES_PER_RADIAN
    amplitude.setflags(write=False)
    return amplitude


class Screens:
    """The layers of one sky, moving.

    Depends on seed, grid and atmosphere alone, so that instruments of one diameter, outer scale and frame rate see the
    same sky. Holds 4 bytes a grid point and layer, and as much again once :attr:`phases` are asked for.

    Attributes:
        heights: (n_layers,) along the line of sight, m.
        travel: (n_layers, 2) how far each layer moves in exposure 0, m.
        course: how strength and wind change. The screens have the strength of its ``kept_at``.
    """

    def __init__(self, system: System, seed: int, course: Course | None = None) -> None:
        self.grid = grid_for(system)
        self.heights = np.array(system.los_heights)
        self.travel = travel(system)
        self.course = course or Course(system)
        amplitude = _amplitude(self.grid, system.los_r0, system.atmosphere.outer_scale)
        self._spectra = []
        for l, fraction in enumerate(self.course.kept_at):
            noise = np.random.default_rng([seed, l]).standard_normal((self.grid.size, self.grid.size))
            spectrum = scipy.fft.rfft2(noise, workers=-1, overwrite_x=True)
            spectrum *= amplitude
            spectrum *= math.sqrt(fraction)
            self._spectra.append(spectrum.astype(np.complex64))

    def __len__(self) -> int:
        return len(self._spectra)

    def drift(self, layer: int, frames: NDArray[np.integer], direction: Direction) -> Array:
        """Where a star's beam crosses a layer's screen at the middle of exposures: (n_frames, 2), grid steps.

        Exposure k lasts from k to k+1 frame times. The sky at x is the screen at x - v t: the layer goes with the wind.
        """
        offset = self.heights[layer] * np.array([direction.x, direction.y])
        return (offset - self.course.gone(layer, frames)) / self.grid.step

    @cached_property
    def phases(self) -> tuple[NDArray[np.float32], ...]:
        """Each layer's wavefront, m: padded spline coefficients, one channel."""
        return tuple(padded(_real(spectrum)) for spectrum in self._spectra)

    def gradient(self, layer: int, side: float, rotation: float, travel: Array | None = None) -> NDArray[np.float32]:
        """The gradient of a layer's wavefront, averaged exactly over a square and over an exposure.

        Args:
            side: of the square at the layer, m.
            rotation: of the square, and of the axes along which the gradient is taken, rad.
            travel: (2,) how far the layer moves in the exposure, m; by default as in exposure 0.

        Returns:
            Padded spline coefficients of two channels, along x and y of the turned axes: m of wavefront per m.
        """
        spectrum = self._spectra[layer]
        n = self.grid.size
        k = 2 * np.pi * scipy.fft.fftfreq(n, self.grid.step)
        c, s = math.cos(rotation), math.sin(rotation)
        # each row: along x of the square, along y, along the wind; a phase is the sum of one part for kx, one for ky
        along = self.travel[layer] if travel is None else travel
        over_x = np.outer([c * side, -s * side, along[0]], k[: n // 2 + 1]) / 2
        over_y = np.outer([s * side, c * side, along[1]], k) / 2
        along_x, along_y = np.empty_like(spectrum), np.empty_like(spectrum)
        _filter_gradient(spectrum, over_x, over_y, 2 / side, along_x, along_y)
        return padded(_real(along_x), _real(along_y))


def _real(spectrum: NDArray[np.complex64]) -> NDArray[np.float32]:
    n = len(spectrum)
    return scipy.fft.irfft2(spectrum, s=(n, n), workers=-1)


@njit(parallel=True, nogil=True, cache=True)
def _filter_gradient(spectrum, over_x, over_y, scale, along_x, along_y):
    """Multiply by ``i k sinc sinc sinc``; the sincs' arguments are sums over_x[:, i] + over_y[:, j], and k is ``scale``
    times the first two."""
    n = spectrum.shape[0]
    half = n // 2
    sin_x, cos_x, sin_y, cos_y = np.sin(over_x), np.cos(over_x), np.sin(over_y), np.cos(over_y)
    for j in prange(n):
        for i in range(half + 1):
            mean = 1.0
            for a in range(3):
                u = over_x[a, i] + over_y[a, j]
                if abs(u) < 1e-4:
                    mean *= 1 - u * u / 6
                else:
                    mean *= (sin_x[a, i] * cos_y[a, j] + cos_x[a, i] * sin_y[a, j]) / u
            # at the Nyquist frequency the sign of a slope is not defined
            value = 1j * (scale * mean) * spectrum[j, i] if i != half and j != half else 0j
            along_x[j, i] = (over_x[0, i] + over_y[0, j]) * value
            along_y[j, i] = (over_x[1, i] + over_y[1, j]) * value
