"""Influence functions from a file: bicubic splines through their samples, and the splines' own gradients."""

from __future__ import annotations

import math
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import spline_filter

from srtomo_core.influence import InfluenceFunctions
from srtomo_core.layout import MirrorLayout

Array = NDArray[np.float64]

_RIM = 4  # samples of nothing around each window: splines come down to it smoothly
_POINTS = 4096  # whose values are held densely at a time


class Splines:
    """A mirror's functions as coefficients of cubic B-splines.

    Attributes:
        step: of the samples, m.
        coefficients: (n, size, size) indexed [function, y, x].
    """

    def __init__(self, functions: InfluenceFunctions) -> None:
        self.step = functions.step
        padded = np.pad(functions.values, ((0, 0), (_RIM, _RIM), (_RIM, _RIM)))
        self.coefficients = np.stack([spline_filter(one, order=3) for one in padded])

    @staticmethod
    @lru_cache(maxsize=8)
    def of(functions: InfluenceFunctions) -> Splines:
        """The same splines every time: a file is filtered once."""
        return Splines(functions)

    def values(self, mirror: MirrorLayout, x: Array, y: Array) -> Array:
        """(n_points, n_actuators) m of wavefront per m, at points of the conjugate plane (n_points,) m."""
        out = np.zeros((len(x), mirror.n_actuators))
        _values(x, y, mirror.actuators, *self._axes(mirror), self.step, self.coefficients, out)
        return out

    def sparse_values(self, mirror: MirrorLayout, x: Array, y: Array) -> sparse.csr_array:
        """As :meth:`values`, without zeros."""
        pieces = [slice(start, start + _POINTS) for start in range(0, len(x), _POINTS)]
        return sparse.csr_array(
            sparse.vstack([sparse.csr_array(self.values(mirror, x[p], y[p])) for p in pieces], format="csr")
        )

    def mean_gradients(
        self, mirror: MirrorLayout, x: Array, y: Array, weight: Array, rotation: float, out: Array
    ) -> None:
        """Weighted sums over points (n_valid, n_points) of the gradients along axes turned by ``rotation`` (rad).

        Args:
            out: (2 n_valid, n_actuators) all x, then all y; overwritten.
        """
        out[:] = 0
        axes = self._axes(mirror)
        _gradients(x, y, weight, mirror.actuators, *axes, self.step, self.coefficients, out)
        # they are along the mirror's axes so far
        c, s = math.cos(rotation - mirror.rotation), math.sin(rotation - mirror.rotation)
        n = len(x)
        out[:n], out[n:] = c * out[:n] + s * out[n:], c * out[n:] - s * out[:n]

    def _axes(self, mirror: MirrorLayout) -> tuple[float, float]:
        return math.cos(mirror.rotation), math.sin(mirror.rotation)


@numba.njit(cache=True, nogil=True, inline="always")
def _weights(t: float) -> tuple[float, float, float, float]:
    """Of the four coefficients about a point at a share t between the two in the middle."""
    u = 1 - t
    return u**3 / 6, 2 / 3 - t * t * (2 - t) / 2, 2 / 3 - u * u * (2 - u) / 2, t**3 / 6


@numba.njit(cache=True, nogil=True, inline="always")
def _derivatives(t: float) -> tuple[float, float, float, float]:
    u = 1 - t
    return -u * u / 2, t * (3 * t - 4) / 2, u * (4 - 3 * u) / 2, t * t / 2


@numba.njit(cache=True, nogil=True)
def _values(
    x: Array, y: Array, actuators: Array, cosine: float, sine: float, step: float, coefficients: Array, out: Array
) -> None:
    size = coefficients.shape[1]
    for a in range(len(actuators)):
        own = coefficients[a if len(coefficients) > 1 else 0]
        for p in range(len(x)):
            dx, dy = x[p] - actuators[a, 0], y[p] - actuators[a, 1]
            column = (cosine * dx + sine * dy) / step + (size - 1) / 2
            row = (cosine * dy - sine * dx) / step + (size - 1) / 2
            i, j = math.floor(row), math.floor(column)
            if i >= 1 and j >= 1 and i < size - 2 and j < size - 2:
                along_y, along_x = _weights(row - i), _weights(column - j)
                for m in range(4):
                    for n in range(4):
                        out[p, a] += along_y[m] * along_x[n] * own[i + m - 1, j + n - 1]


@numba.njit(cache=True, nogil=True)
def _gradients(
    x: Array,
    y: Array,
    weight: Array,
    actuators: Array,
    cosine: float,
    sine: float,
    step: float,
    coefficients: Array,
    out: Array,
) -> None:
    """Along the mirror's own axes."""
    n_valid, n_points = x.shape
    size = coefficients.shape[1]
    reach = size * step / math.sqrt(2)
    for s in range(n_valid):
        left, right, low, high = x[s].min(), x[s].max(), y[s].min(), y[s].max()
        for a in range(len(actuators)):
            beside = max(left - actuators[a, 0], actuators[a, 0] - right)
            above = max(low - actuators[a, 1], actuators[a, 1] - high)
            if max(beside, above) > reach:
                continue
            own = coefficients[a if len(coefficients) > 1 else 0]
            gx, gy = 0.0, 0.0
            for p in range(n_points):
                dx, dy = x[s, p] - actuators[a, 0], y[s, p] - actuators[a, 1]
                column = (cosine * dx + sine * dy) / step + (size - 1) / 2
                row = (cosine * dy - sine * dx) / step + (size - 1) / 2
                i, j = math.floor(row), math.floor(column)
                if weight[s, p] != 0 and i >= 1 and j >= 1 and i < size - 2 and j < size - 2:
                    along_y, along_x = _weights(row - i), _weights(column - j)
                    change_y, change_x = _derivatives(row - i), _derivatives(column - j)
                    for m in range(4):
                        for n in range(4):
                            sample = weight[s, p] * own[i + m - 1, j + n - 1]
                            gx += along_y[m] * change_x[n] * sample
                            gy += change_y[m] * along_x[n] * sample
            out[s, a] = gx / step
            out[n_valid + s, a] = gy / step
