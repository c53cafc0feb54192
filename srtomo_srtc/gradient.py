"""What a Shack-Hartmann sensor measures: the mean gradient over each sub-aperture's light, from phase nodes.

Phase is bilinear between nodes. Over one cell of the node grid the light-weighted mean of its gradient depends on the
light only through the light's centroid (u, v), 0 to 1 across the cell::

    dphi/dx = [(1-v) (phi_01 - phi_00) + v (phi_11 - phi_10)] / h          phi_[y][x], h: side of the cell

A slope is the mean over the sub-aperture's cells, each weighted by its light. With 2 x 2 fully lit cells that is the
3 x 3 stencil of eq. 28. With partial illumination it goes where eq. 30-31 mean to go, without their slips: those (as
printed twice too large) give a nearly dark quarter of the sub-aperture the weight of a lit one, and divide 0 by 0 for
a dark one. Whatever the light, a unit x-ramp gives exactly 1 in x and 0 in y, and piston gives 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import SensorLayout
from srtomo_core.system import Telescope
from srtomo_srtc.geometry import Lattice, cell_light

Array = NDArray[np.float64]

LARGEST_SUBAPERTURE = 0.5
"""A larger sub-aperture (a one-lens tip-tilt sensor's) is divided until its parts are no larger than this, m."""

OVERSAMPLING = 2
"""Default number of node cells across a sub-aperture, or across such a part of one."""

_FINE = 16  # points across a node cell when its light is averaged
_ALIKE = 1e-12  # of the largest weight: less apart is rounding
_FEW_ALIKE = 8  # slopes: what is found for all at once pays for more


@dataclass(frozen=True, eq=False)
class Stencil:
    """What fully lit sub-apertures have in common: the same weights, each somewhere else on the lattice.

    Attributes:
        row, column: (n_weights,) from where the stencil lies, not negative.
        weights: (n_weights,) 1/m.
        slopes: (n_alike,) which slopes have it.
        place: (n_alike, 2) row and column of the lattice where it lies for each.
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    weights: Array
    slopes: NDArray[np.int64]
    place: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Stencils:
    """A gradient operator taken apart: slopes that share a stencil, and those with one of their own.

    Attributes:
        n_slopes: in all.
        shared: at most one stencil for x and one for y.
        others: (n_others,) slopes that have none of these.
        matrix: (n_others, n_nodes) 1/m, the operator's rows of ``others``, on the nodes of ``lattice``.
        lattice: the nodes that these need.
    """

    n_slopes: int
    shared: tuple[Stencil, ...]
    others: NDArray[np.int64]
    matrix: sparse.csr_array
    lattice: Lattice

    @classmethod
    def of(cls, matrix: sparse.csr_array, lattice: Lattice) -> Stencils:
        """Take the operator of all slopes (n_slopes, n_nodes), all x then all y, apart."""
        n = matrix.shape[0]
        found = (_most_common(matrix, lattice, rows) for rows in np.split(np.arange(n), 2))
        shared = tuple(stencil for stencil in found if len(stencil.slopes) > _FEW_ALIKE)
        others = np.setdiff1d(np.arange(n), np.concatenate([np.zeros(0, int), *(s.slopes for s in shared)]))
        rest = matrix[others]
        used = np.unique(rest.indices)
        nodes = replace(lattice, row=lattice.row[used], column=lattice.column[used])
        return cls(n, shared, others, rest[:, used], nodes)


def _most_common(matrix: sparse.csr_array, lattice: Lattice, slopes: NDArray[np.int64]) -> Stencil:
    """The stencil that most of these slopes have."""
    length = np.diff(matrix.indptr)[slopes]
    usual = np.bincount(length).argmax()
    slopes = slopes[length == usual]
    entries = matrix.indptr[slopes][:, None] + np.arange(usual)
    nodes, weights = matrix.indices[entries], matrix.data[entries]
    row, column = lattice.row[nodes], lattice.column[nodes]
    place = np.stack([row.min(axis=1), column.min(axis=1)], axis=1)
    row, column = row - place[:, :1], column - place[:, 1:]
    least = _ALIKE * np.abs(weights).max()
    looks = np.hstack([row, column, np.rint(weights / (1e3 * least)).astype(np.int64)])
    _, first, count = np.unique(looks, axis=0, return_index=True, return_counts=True)
    typical = first[count.argmax()]
    same = (row == row[typical]).all(axis=1) & (column == column[typical]).all(axis=1)
    same &= (np.abs(weights - weights[typical]) < least).all(axis=1)
    return Stencil(row[typical], column[typical], weights[typical], slopes[same], place[same])


@dataclass(frozen=True)
class GradientOperator:
    """Slopes as a sparse product with the wavefront at nodes.

    Attributes:
        x, y: (n_nodes,) nodes in pupil coordinates, m.
        matrix: (n_slopes, n_nodes) 1/m: metres of wavefront to radians of tilt, all x then all y, along the sensor's
            own axes.
        lattice: the same nodes by row and column.
    """

    x: Array
    y: Array
    matrix: sparse.csr_array
    lattice: Lattice

    @cached_property
    def stencils(self) -> Stencils:
        """The same, with what most slopes have in common known once."""
        return Stencils.of(self.matrix, self.lattice)


def gradient_operator(
    telescope: Telescope, sensor: SensorLayout, oversampling: int = OVERSAMPLING, *, cells: int | None = None
) -> GradientOperator:
    """The operator of one sensor, where ``sensor`` says that it is.

    Args:
        oversampling: 1 has nodes at a sub-aperture's corners only, 2 is the 3 x 3 stencil of eq. 28, 4 has 5 x 5 nodes.
        cells: of nodes across a sub-aperture, however large, in place of what ``oversampling`` makes.

    Raises:
        ValueError: a sub-aperture is dark, so its slope means nothing.
    """
    if cells is None:
        cells = oversampling * max(1, math.ceil(sensor.size / LARGEST_SUBAPERTURE - 1e-9))
    light, u, v = cell_light(telescope, sensor, cells, _FINE)
    total = light.sum(axis=(1, 2), keepdims=True)
    if not total.all():
        raise ValueError(f"sensor {sensor.name}: sub-aperture {int(np.argmin(total))} is dark in this layout")
    share = light / total * (cells / sensor.size)

    n_grid = len(sensor.mask) * cells + 1
    row, column = (index[:, None, None] * cells for index in np.nonzero(sensor.mask))
    step = np.arange(cells)
    corner = (row + step[:, None]) * n_grid + column + step  # (n_valid, cells, cells): each cell's node 00
    slope = np.broadcast_to(np.arange(sensor.n_valid)[:, None, None], corner.shape)

    node_00, node_01, node_10, node_11 = corner, corner + 1, corner + n_grid, corner + n_grid + 1
    entries = [
        (slope, node_00, -share * (1 - v)),
        (slope, node_01, share * (1 - v)),
        (slope, node_10, -share * v),
        (slope, node_11, share * v),
        (slope + sensor.n_valid, node_00, -share * (1 - u)),
        (slope + sensor.n_valid, node_10, share * (1 - u)),
        (slope + sensor.n_valid, node_01, -share * u),
        (slope + sensor.n_valid, node_11, share * u),
    ]
    rows, columns, values = (np.concatenate([entry[k].ravel() for entry in entries]) for k in range(3))
    matrix = sparse.coo_array((values, (rows, columns)), shape=(sensor.n_slopes, n_grid**2)).tocsr()
    # between two equally lit cells a node's weights cancel but for rounding
    matrix.data[np.abs(matrix.data) < 1e-12 * np.abs(matrix.data).max()] = 0
    matrix.eliminate_zeros()
    used = np.unique(matrix.indices)
    corner_at = -sensor.size * len(sensor.mask) / 2
    lattice = Lattice(
        sensor.size / cells, (corner_at, corner_at), sensor.rotation, sensor.shift, used // n_grid, used % n_grid
    )
    return GradientOperator(*lattice.points(), matrix[:, used], lattice)
