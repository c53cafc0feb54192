"""Covariances of wavefronts and slopes, summed over the layers (eq. 14 and 23), in optical path.

Everything goes layer by layer through node pairs, so that stars at different distances, shifts and rotations need no
case of their own; sparse gradient operators then turn nodes into slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.atmosphere import CovarianceTable, Profile
from srtomo_srtc.geometry import Footprints

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sightline:
    """A sensor towards its star: its nodes on the layers, and how they make slopes.

    Attributes:
        nodes: on the profile's layers.
        gradient: (n_slopes, n_nodes) 1/m.
    """

    nodes: Footprints
    gradient: sparse.csr_array


@dataclass(frozen=True)
class Turbulence:
    """A profile, and its covariance tabulated as far as a set of footprints needs it."""

    fractions: Array
    table: CovarianceTable

    @classmethod
    def covering(cls, profile: Profile, points: Sequence[Footprints]) -> Turbulence:
        """Tabulate up to the largest separation between any two of ``points`` on a layer."""
        x_span, y_span = (
            np.max([values.max(axis=1) for values in axis], axis=0)
            - np.min([values.min(axis=1) for values in axis], axis=0)
            for axis in ([p.x for p in points], [p.y for p in points])
        )
        reach = float(np.hypot(x_span, y_span).max())
        return cls(profile.fractions, CovarianceTable.build(profile.r0, profile.outer_scale, reach))


def wavefront_covariance(turbulence: Turbulence, a: Footprints, b: Footprints) -> Array:
    """Covariance between wavefronts at two sets of points, less the constant C(0) that piston removal takes out.

    Returns:
        (n_a, n_b) m^2.
    """
    out = np.empty((a.x.shape[1], b.x.shape[1]))
    table = turbulence.table
    _sum_layers(a.x, a.y, b.x, b.y, turbulence.fractions, table.values, 1 / table.step, out)
    return out


def slope_covariance(turbulence: Turbulence, sensors: Sequence[Sightline]) -> Array:
    """Covariance of all slopes with each other, Sigma_ss.

    Returns:
        (n_slopes, n_slopes) rad^2, exactly symmetric.
    """
    starts = np.cumsum([0] + [sensor.gradient.shape[0] for sensor in sensors])
    out = np.empty((starts[-1], starts[-1]))
    for i, first in enumerate(sensors):
        for j, second in enumerate(sensors[: i + 1]):
            nodes = wavefront_covariance(turbulence, first.nodes, second.nodes)
            block = second.gradient @ (first.gradient @ nodes).T
            if i == j:
                block = np.triu(block) + np.triu(block, 1).T
            rows, columns = slice(starts[i], starts[i + 1]), slice(starts[j], starts[j + 1])
            out[columns, rows] = block
            out[rows, columns] = block.T
    return out


def slope_wavefront_covariance(turbulence: Turbulence, sensors: Sequence[Sightline], points: Footprints) -> Array:
    """Covariance between all slopes and the wavefront at points, Sigma_s_phi.

    Returns:
        (n_slopes, n_points) rad m.
    """
    return np.concatenate([s.gradient @ wavefront_covariance(turbulence, s.nodes, points) for s in sensors])


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _sum_layers(
    ax: Array, ay: Array, bx: Array, by: Array, fractions: Array, table: Array, per_step: float, out: Array
) -> None:
    n = bx.shape[1]
    index = np.empty(n, np.int32)
    beyond = np.empty(n)
    for p in range(ax.shape[1]):
        row = out[p]
        row[:] = 0.0
        for l in range(len(fractions)):
            x, y, fraction = ax[l, p], ay[l, p], fractions[l]
            # apart from the look-ups this loop vectorises: together they take twice as long
            for q in range(n):
                dx = x - bx[l, q]
                dy = y - by[l, q]
                t = np.sqrt(dx * dx + dy * dy) * per_step
                i = np.int32(t)
                index[q] = i
                beyond[q] = t - i
            for q in range(n):
                value = table[index[q]]
                row[q] += fraction * (value + beyond[q] * (table[index[q] + 1] - value))
