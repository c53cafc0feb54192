"""Propagation from layer grids to pupil points: sparse, bilinear (T of eq. 12, section 3.2.1).

A sensor's shift and rotation, its star's direction and the cone of a laser are all in the points where its rays meet
the layers (:func:`srtomo_srtc.geometry.footprints`): at most four non-zero entries a ray and layer, whatever the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.geometry import Footprints

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_ON_LINE = 1e-9  # of a step: a ray this close to a grid line goes through it


@dataclass(frozen=True)
class LayerGrid:
    """Nodes of a square grid on one layer.

    Attributes:
        step: m.
        corner: row and column of ``mask[0, 0]`` in the endless grid that has a node at (0, 0).
        mask: (n_rows, n_columns) bool, ``[y, x]``: the nodes that exist, numbered in C order.
    """

    step: float
    corner: tuple[int, int]
    mask: NDArray[np.bool_]

    @classmethod
    def under(cls, x: Array, y: Array, step: float) -> LayerGrid:
        """The nodes around rays that meet the layer at ``x``, ``y`` (n,), m, and those in between.

        Gaps are filled along rows, then along columns: a grid finer than the rays still hangs together.
        """
        row, column, weight = _around(x / step, y / step)
        row, column = row[weight > 0], column[weight > 0]
        corner = int(row.min()), int(column.min())
        mask = np.zeros((int(row.max()) - corner[0] + 1, int(column.max()) - corner[1] + 1), dtype=bool)
        mask[row - corner[0], column - corner[1]] = True
        for axis in (1, 0):
            from_first = np.logical_or.accumulate(mask, axis)
            to_last = np.flip(np.logical_or.accumulate(np.flip(mask, axis), axis), axis)
            mask = from_first & to_last
        return cls(step, corner, mask)

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return int(np.count_nonzero(self.mask))

    @property
    def points(self) -> tuple[Array, Array]:
        """x, y of the nodes, each (n_nodes,), m."""
        row, column = np.nonzero(self.mask)
        return self.step * np.asarray(column + self.corner[1], float), self.step * np.asarray(
            row + self.corner[0], float
        )

    @cached_property
    def numbers(self) -> Indices:
        """(n_rows, n_columns) number of each node, -1 where there is none."""
        numbers = np.full(self.mask.shape, -1)
        numbers[self.mask] = np.arange(self.n_nodes)
        return numbers

    def interpolation(self, x: Array, y: Array) -> sparse.csr_array:
        """Bilinear interpolation at points (n,), m.

        Returns:
            (n, n_nodes), every row with a sum of 1.

        Raises:
            ValueError: a point lies between nodes that do not exist.
        """
        row, column, weight = _around(x / self.step, y / self.step)
        ray = np.broadcast_to(np.arange(len(x))[:, None], weight.shape)
        used = weight > 0
        row, column, ray, weight = row[used] - self.corner[0], column[used] - self.corner[1], ray[used], weight[used]
        inside = (row >= 0) & (row < self.mask.shape[0]) & (column >= 0) & (column < self.mask.shape[1])
        if not inside.all() or not self.mask[row, column].all():
            raise ValueError("layer grid: a ray passes where there are no nodes")
        return sparse.coo_array((weight, (ray, self.numbers[row, column])), shape=(len(x), self.n_nodes)).tocsr()

    def refinement(self, factor: int) -> sparse.csr_array:
        """Bilinear interpolation from a grid of ``factor`` times the step to this one.

        Returns:
            (n_nodes, n_nodes of the coarser grid).
        """
        return LayerGrid.under(*self.points, self.step * factor).interpolation(*self.points)


def layer_grids(rays: Sequence[Footprints], steps: Sequence[float]) -> list[LayerGrid]:
    """A grid for every layer, under all of ``rays``.

    Args:
        rays: of every sensor and science direction, on the same layers.
        steps: of each layer's grid, m.
    """
    return [
        LayerGrid.under(np.concatenate([r.x[l] for r in rays]), np.concatenate([r.y[l] for r in rays]), step)
        for l, step in enumerate(steps)
    ]


def propagation(grids: Sequence[LayerGrid], rays: Footprints) -> sparse.csr_array:
    """Wavefront along rays from the wavefronts at all layers' nodes (eq. 3), T.

    Returns:
        (n_points, n_nodes), nodes layer by layer.
    """
    return sparse.hstack([grid.interpolation(rays.x[l], rays.y[l]) for l, grid in enumerate(grids)], format="csr")


def _around(x: Array, y: Array) -> tuple[Indices, Indices, Array]:
    """Row, column and bilinear weight of the four nodes around each point (n,), in steps; each (n, 4)."""
    (column, u), (row, v) = _split(x), _split(y)
    return (
        np.stack([row, row, row + 1, row + 1], axis=1),
        np.stack([column, column + 1, column, column + 1], axis=1),
        np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1),
    )


def _split(t: Array) -> tuple[Indices, Array]:
    """Whole and fraction."""
    nearest = np.rint(t)
    t = np.where(np.abs(t - nearest) < _ON_LINE, nearest, t)
    whole = np.floor(t)
    return whole.astype(np.intp), t - whole
