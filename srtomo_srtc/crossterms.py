"""The right-hand side of the fit: mirrors' wavefronts in all science directions, correlated with all slopes.

    B = sum_i w_i N_i^T W (1 - piston) Sigma_phi_i_s

so that the implicit reconstructor is ``(N^T W N + kappa I)^-1 B S^-1``. Neither Sigma_phi_s of a whole pupil nor, for
many directions, of any of them is ever formed. Directly, each direction's points go through all layers. Or the points
of all directions are first spread, with their weights, over one grid for each layer (the transpose of a cubic
interpolation), and each grid is correlated once, whatever the number of directions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.covariance import Share, Sightline, Turbulence, slope_products
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.parallel import Progress, silent

Array = NDArray[np.float64]

_TILE = 24  # points across; near points share their mirrors' actuators
_GRID_STEP = (
    0.75  # of a layer's grid, in steps of the finest sensor's lattice; 1.5 would cost 4 % of the wavefront error
)


def right_hand_side(
    fit: Fit,
    turbulence: Turbulence,
    sensors: Sequence[Sightline],
    heights: Array,
    *,
    fast: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Array:
    """B, the covariance of the fit's projected wavefront with all slopes.

    Args:
        heights: (n_layers,) of the turbulence, m along the line of sight.
        fast: float32, and through layer grids where these have fewer points: wrong by some 3e-4 of the norm.

    Returns:
        (n_commands, n_slopes) rad m.
    """
    means = fit.grid.weight[:, None]
    shares = _direct(fit, means, heights)
    if fast:
        step = _GRID_STEP * min(s.seen.lattice.step for s in sensors if s.seen is not None)
        grids = _LayerGrids(fit, means, heights, step)
        if not _direct_is_less(shares, grids):
            shares = grids.shares()
    return _without_piston(
        fit, slope_products(turbulence, sensors, shares, fast=fast, threads=threads, progress=progress)
    )[0]


def right_hand_side_and_tilts(
    fit: Fit,
    turbulence: Turbulence,
    sensors: Sequence[Sightline],
    heights: Array,
    *,
    single: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """As :func:`right_hand_side`, with the covariance of tip and tilt in each direction with all slopes.

    Never through layer grids: a residual is of first order in the error of B, of second only in that of R.

    Args:
        single: float32.

    Returns:
        B (n_commands, n_slopes) rad m; (n_views, 2, n_slopes) rad m, of tip and tilt in m rms.
    """
    means = np.column_stack([fit.grid.weight, fit.grid.tilts])
    shares = _direct(fit, means, heights)
    right, low = _without_piston(
        fit, slope_products(turbulence, sensors, shares, fast=single, threads=threads, progress=progress)
    )
    return right, low[:, 1:]


def _without_piston(fit: Fit, products: Array) -> tuple[Array, Array]:
    """B, and the means (n_views, n_means, n_slopes), the first of which is piston, from the sums of :func:`_sums`."""
    n_commands = len(fit.normal)
    low = products[n_commands:].reshape(len(fit.views), -1, products.shape[1])
    for view, (piston, *_) in zip(fit.views, low, strict=True):
        # in two steps: the outer product of an extremely large telescope is as large as B
        for rows in np.array_split(np.arange(n_commands), math.ceil(n_commands / 512)):
            products[rows] -= np.multiply.outer((view.weight * view.pistons[rows]).astype(products.dtype), piston)
    return products[:n_commands], low


def _direct_is_less(direct: list[Share], grids: _LayerGrids) -> bool:
    return sum(share.weights.shape[0] for share in direct) <= grids.n_points


def _sums(fit: Fit, means: Array, index: int) -> sparse.csr_array:
    """(n_points, n_commands + n_views n_means) ``w W N`` of a direction, and the means in its own columns."""
    view = fit.views[index]
    mine = sparse.csr_array((np.ones(1), ([0], [index])), shape=(1, len(fit.views)))
    own = sparse.kron(mine, sparse.csr_array(means), format="csr")
    weighted = sparse.csr_array(view.modes * (view.weight * view.light)[:, None])
    return sparse.csr_array(sparse.hstack([weighted, own], format="csr"))


def _direct(fit: Fit, means: Array, heights: Array) -> list[Share]:
    order = _near_each_other(fit.grid.x, fit.grid.y)
    return [
        Share(slice(None), Footprints(points.x[:, order], points.y[:, order]), _sums(fit, means, i)[order])
        for i, (_, points) in enumerate(fit.footprints(heights))
    ]


def _near_each_other(x: Array, y: Array) -> NDArray[np.intp]:
    """An order in which points of a square grid come tile by tile."""
    side = _TILE * math.sqrt(np.ptp(x) * np.ptp(y) / len(x))
    return np.lexsort([np.arange(len(x)), np.floor(x / side), np.floor(y / side)])


class _LayerGrids:
    """A square grid on each layer, wide enough for all science directions.

    Attributes:
        n_points: on all layers.
    """

    def __init__(self, fit: Fit, means: Array, heights: Array, step: float) -> None:
        self._fit, self._means, self._step = fit, means, step
        self._seen = [points for _, points in fit.footprints(heights)]
        self._grids = [self._grid(l) for l in range(len(heights))]
        # in a circle, as nearly all the light is
        self.n_points = math.pi / 4 * sum(rows * columns for _, _, rows, columns in self._grids)

    def _grid(self, layer: int) -> tuple[float, float, int, int]:
        """x and y of the first point, rows and columns; two more than needed on each side."""
        x, y = (np.concatenate([getattr(points, axis)[layer] for points in self._seen]) for axis in "xy")
        across = [math.ceil(np.ptp(values) / self._step) + 5 for values in (y, x)]
        return float(x.min() - 2 * self._step), float(y.min() - 2 * self._step), across[0], across[1]

    def shares(self) -> list[Share]:
        """What the fit asks of each layer."""
        sums = [_sums(self._fit, self._means, i) for i in range(len(self._seen))]
        return [self._share(l, sums) for l in range(len(self._grids))]

    def _share(self, layer: int, sums: list[sparse.csr_array]) -> Share:
        x, y, rows, columns = self._grids[layer]
        weights = np.zeros((rows * columns, sums[0].shape[1]))
        for points, own in zip(self._seen, sums):
            _spread(
                (points.y[layer] - y) / self._step,
                (points.x[layer] - x) / self._step,
                columns,
                own.indptr,
                own.indices,
                own.data,
                weights,
            )
        row, column = np.divmod(np.flatnonzero(weights.any(axis=1)), columns)
        order = _near_each_other(column.astype(float), row.astype(float))
        row, column = row[order], column[order]
        grid = Footprints(x + self._step * column[None], y + self._step * row[None])
        return Share(slice(layer, layer + 1), grid, sparse.csr_array(weights[row * columns + column]))


@numba.njit(cache=True, nogil=True)
def _spread(
    row: Array,
    column: Array,
    n_columns: int,
    indptr: NDArray[np.integer],
    indices: NDArray[np.integer],
    data: Array,
    out: Array,
) -> None:
    """Transpose of a cubic (Lagrange) interpolation: ``out += H^T sums`` with H from grid points to points."""
    wy, wx = np.empty(4), np.empty(4)
    for p in range(len(row)):
        y, x = np.int64(row[p]), np.int64(column[p])
        for w, t in ((wy, row[p] - y), (wx, column[p] - x)):
            w[0] = -t * (t - 1) * (t - 2) / 6
            w[1] = (t + 1) * (t - 1) * (t - 2) / 2
            w[2] = -(t + 1) * t * (t - 2) / 2
            w[3] = (t + 1) * t * (t - 1) / 6
        for i in range(4):
            for j in range(4):
                weight, target = wy[i] * wx[j], out[(y + i - 1) * n_columns + x + j - 1]
                for e in range(indptr[p], indptr[p + 1]):
                    target[indices[e]] += weight * data[e]
