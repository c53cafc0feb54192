"""Commands to wavefronts: the least-squares fit of the mirrors over pupil and science directions (eq. 15-19)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from srtomo_core.layout import Layout
from srtomo_core.system import Direction, System
from srtomo_srtc.geometry import Footprints, footprints, pupil_grid
from srtomo_srtc.mirrors import sparse_wavefronts
from srtomo_srtc.solve import SymmetricTiles

Array = NDArray[np.float64]

KAPPA = 1e-4
"""Default regularisation of the fit, relative to the mean square of an influence function over the pupil."""

_POINTS_PER_PITCH = 2  # finer changes the residual by less than 0.05 nm


@dataclass(frozen=True)
class View:
    """One science direction of the fit.

    Attributes:
        direction: rad.
        weight: of the direction; all sum to 1.
        light: (n_points,) W, the pupil's weights; they sum to 1.
        modes: (n_points, n_commands) N, the mirrors' wavefronts.
    """

    direction: Direction
    weight: float
    light: Array
    modes: sparse.csr_array

    @property
    def pistons(self) -> Array:
        """(n_commands,) mean of each mode over the pupil."""
        return np.asarray(self.light @ self.modes)

    @property
    def projection(self) -> Array:
        """(n_commands, n_points) ``w N^T W``, piston taken out: what turns a wavefront into its share of the normal
        equations' right-hand side. Dense, and made anew each time."""
        return np.asarray((self.modes.toarray() - self.pistons).T * (self.weight * self.light))


class Fit:
    """``F = (sum_i w_i N_i^T W N_i + kappa I)^-1 sum_i w_i N_i^T W``, piston removed (eq. 15-16, with N^T N).

    Attributes:
        grid: pupil points and their weights W.
        views: the science directions of any weight.
        normal: (n_commands, n_commands) with kappa in it.
        ridge: what kappa adds to its diagonal.
    """

    def __init__(self, system: System, layout: Layout, kappa: float = KAPPA) -> None:
        """Set the fit up.

        Args:
            kappa: relative to the mean square of an influence function over the pupil.
        """
        spacing = min(mirror.pitch for mirror in layout.mirrors) / _POINTS_PER_PITCH
        self.grid = pupil_grid(system.telescope, spacing)
        total = sum(target.weight for target in system.science.targets)
        self.views: list[View] = []
        self.normal = np.zeros((layout.n_commands, layout.n_commands))
        for target in system.science.targets:
            if target.weight == 0:
                continue
            modes = sparse_wavefronts(layout, self.grid.x, self.grid.y, target.position)
            view = View(target.position, target.weight / total, self.grid.weight, modes)
            _add_products(modes.indptr, modes.indices, modes.data, view.weight * view.light, self.normal)
            self.views.append(view)
        self.normal += np.tril(self.normal, -1).T
        pistons = np.stack([view.pistons for view in self.views])
        self.normal -= (pistons.T * [view.weight for view in self.views]) @ pistons
        self.ridge = kappa * float(self.normal.trace()) / len(self.normal)
        self.normal[np.diag_indices_from(self.normal)] += self.ridge
        self._factor = cho_factor(self.normal)

    def footprints(self, heights: Array) -> Iterator[tuple[View, Footprints]]:
        """Each direction with its pupil points on layers at ``heights`` (n_layers,), m along the line of sight."""
        for view in self.views:
            yield view, footprints(self.grid.x, self.grid.y, view.direction, math.inf, heights)

    def solve(self, right: Array, threads: int = 1) -> Array:
        """Commands (n_commands, n) from the right-hand side (n_commands, n) of the normal equations.

        In the precision of ``right``, float64 or float32; in the latter on so many threads.
        """
        if right.dtype == np.float64:
            return cho_solve(self._factor, right)
        normal = SymmetricTiles.of(self.normal.astype(right.dtype))
        normal.factor(threads)
        commands = np.ascontiguousarray(right.T)
        normal.divide(commands, threads)
        return commands.T


@numba.njit(cache=True, nogil=True)
def _add_products(
    indptr: NDArray[np.integer], indices: NDArray[np.integer], data: Array, weight: Array, out: Array
) -> None:
    """``out += N^T diag(weight) N``, lower half; the indices of each row of N ascend."""
    for p in range(len(weight)):
        for a in range(indptr[p], indptr[p + 1]):
            value, row = weight[p] * data[a], out[indices[a]]
            for b in range(indptr[p], a + 1):
                row[indices[b]] += value * data[b]
