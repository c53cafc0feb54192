"""Covariance of the wavefront at points on the layers with one sensor's slopes, layers summed from tables of their own.

From one point of a layer to all nodes of a sensor the baselines differ by whole steps of the sensor's lattice. The
covariance is smooth but for its cusp at no separation, and is split there, as Ewald split his sums: within a core of
some steps the smooth part goes on as a polynomial.

- The smooth part takes tables of the lattice's step alone, so small that all layers' stay in a cache, and cubics: a row
  of nodes is four rows of a table weighted and summed, and then the same with itself moved by a column. Neighbouring
  points need not all be looked up: their footprints move together from layer to layer, so that once the layers are
  summed, polynomials between a few of them give the others.
- What it lacks near a point is in finer tables, no wider than the core.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.atmosphere import CovarianceTable
from srtomo_srtc.geometry import Footprints, SeenLattice
from srtomo_srtc.lattice import cubic, find_taps, slopes_of_nodes, tabulate

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.integer]

WIDEST = 14.0
"""Steps of a sensor's lattice across which neighbouring points may lie."""

_CORE = 16.0  # steps of the lattice in the pupil
_DIVISIONS = 4  # of the step, within the core
_REACH = 0.5  # steps from a point within the core to the farthest one that its interpolation takes
_FEW = 8  # points a side, between which others are interpolated
_COLUMNS = 16  # of which a row's length is a multiple: loops that leave no rest are quicker
_POINTS = 48  # whose nodes are held at a time: as much as a cache holds


@dataclass(frozen=True)
class Neighbours:
    """Points near each other, seen towards one star, and a few between which anything smooth can be interpolated.

    Attributes:
        points: on the profile's layers.
        few: on the same layers: footprints move and shrink, but where a point is between these stays the same.
        weights: (n_points, n_few) of the interpolation.
    """

    points: Footprints
    few: Footprints
    weights: Floats

    @classmethod
    def of(cls, points: Footprints) -> Neighbours:
        """Chebyshev's nodes in the rectangle of the points, and Lagrange's polynomials; all of few points."""
        if points.x.shape[1] <= _FEW**2:
            return cls(points, points, np.eye(points.x.shape[1], dtype=np.float32))
        nodes = (1 - np.cos(np.pi * (2 * np.arange(_FEW) + 1) / (2 * _FEW))) / 2
        few, weights = [], []
        for values in (points.x, points.y):
            low, wide = values.min(axis=1), np.ptp(values, axis=1)
            few.append(low[:, None] + wide[:, None] * nodes)
            at = (values[0] - low[0]) / (wide[0] or 1.0)
            factors = (at[:, None, None] - nodes) / (nodes[:, None] - nodes + np.eye(_FEW))
            factors[:, np.arange(_FEW), np.arange(_FEW)] = 1
            weights.append(factors.prod(axis=2))
        x, y = few
        both = (weights[1][:, :, None] * weights[0][:, None, :]).reshape(len(weights[0]), -1)
        return cls(points, Footprints(np.tile(x, _FEW), np.repeat(y, _FEW, axis=1)), both.astype(np.float32))


class LayeredCorrelator:
    """Covariance of the wavefront at points, summed over the layers, with a sensor's slopes.

    float32, and wrong by less than 1e-5 of the norm in sums over the points. For one thread.
    """

    def __init__(
        self,
        seen: SeenLattice,
        gradient: sparse.csr_array,
        groups: Sequence[Neighbours],
        fractions: Array,
        table: CovarianceTable,
    ) -> None:
        """Tabulate.

        Args:
            seen: the sensor's lattice.
            gradient: (n_slopes, n_nodes) of the sensor, 1/m.
            groups: all those that will be asked for.
            fractions: (n_layers,) of the layers.
            table: of the covariance.
        """
        self._seen = seen
        self._rows, where = seen.lattice.rows(_COLUMNS)
        self._gradient = gradient.indptr, where[gradient.indices], gradient.data.astype(np.float32)
        smooth, rest = table.split(_CORE * seen.lattice.step)
        centres = np.concatenate([seen.centres(group.few) for group in groups], axis=1)
        self._first, self._smooth = _smooth_tables(seen, centres, fractions, smooth)
        self._radii = _CORE / seen.cones + _REACH
        self._cores = _core_tables(seen, self._radii, fractions, rest)
        # held: fresh memory for every group costs as much as some of the work
        at_once, n_slopes = max(_POINTS, _FEW**2), gradient.shape[0]
        self._nodes = np.empty((at_once, self._rows[:, 2].sum()), np.float32)
        self._slopes = np.empty((at_once, n_slopes), np.float32)
        self._out = np.empty((max(len(group.weights) for group in groups), n_slopes), np.float32)

    def __call__(self, group: Neighbours) -> Floats:
        """Of one of the groups: (n_points, n_slopes) rad m, good until the next call."""
        n_few = group.weights.shape[1]
        nodes, slopes = self._nodes[:n_few], self._slopes[:n_few]
        _set_smooth(-self._seen.centres(group.few) - self._first, self._smooth, self._rows, nodes)
        slopes_of_nodes(nodes, *self._gradient, slopes)
        out = np.matmul(group.weights, slopes, out=self._out[: len(group.weights)])

        centres = self._seen.centres(group.points)
        for start in range(0, len(out), _POINTS):
            own = out[start : start + _POINTS]
            nodes, slopes = self._nodes[: len(own)], self._slopes[: len(own)]
            nodes[:] = 0
            for at, core, radius in zip(centres[:, start : start + _POINTS], self._cores, self._radii, strict=True):
                _add_core(at, core, radius, self._rows, nodes)
            slopes_of_nodes(nodes, *self._gradient, slopes)
            own += slopes
        return out


def _smooth_tables(seen: SeenLattice, centres: Array, fractions: Array, table: CovarianceTable) -> tuple[Array, Floats]:
    """First baseline (row, column), and (n_layers, n_rows, n_columns) tables from it on; an even number of layers."""
    lattice = seen.lattice
    nodes = np.stack([lattice.row, lattice.column], axis=1)
    first = np.floor(nodes.min(axis=0) - centres.max(axis=(0, 1))) - 2
    last = np.ceil(nodes.max(axis=0) - centres.min(axis=(0, 1))) + 2
    n_rows, n_columns = (last - first).astype(int) + 1
    n_layers = len(fractions)
    values = np.zeros((n_layers + n_layers % 2, n_rows, n_columns + 2 * _COLUMNS), np.float32)
    for l in range(n_layers):
        _tabulate_layer(seen, l, fractions, table, first, values[l, None, None])
    return first, values


def _core_tables(seen: SeenLattice, radii: Array, fractions: Array, table: CovarianceTable) -> list[Floats]:
    """(divisions, divisions, n_rows, n_columns) of each layer; baseline 0 is in the middle of the columns."""
    tables = []
    for l, radius in enumerate(radii):
        half = math.ceil(radius) + 2
        values = np.zeros((_DIVISIONS, _DIVISIONS, 2 * half + 2, 2 * half + 1), np.float32)
        _tabulate_layer(seen, l, fractions, table, np.array([-half, -half], np.float64), values)
        tables.append(values)
    return tables


def _tabulate_layer(
    seen: SeenLattice, l: int, fractions: Array, table: CovarianceTable, first: Array, out: Floats
) -> None:
    one, lattice = slice(l, l + 1), seen.lattice
    here = np.zeros((1, 2))
    tabulate(
        seen.cones[one], here, fractions[one], lattice.step, lattice.rotation, table.values, 1 / table.step, first, out
    )


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _set_smooth(place: Array, tables: Floats, rows: Indices, out: Floats) -> None:
    """Args: place (n_layers, n_points, 2) of baseline 0 in the tables."""
    n_points, n_tables, n_columns = place.shape[1], tables.shape[0], tables.shape[2]
    starts, wy, wx = _cubics(place, tables)
    flat, nodes = tables.reshape(-1), out.reshape(-1)
    # unsigned: an index that can count from the end costs a test
    one, two, three, down = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(n_columns)
    longest = np.uint64(rows[:, 2].max() + _COLUMNS)
    mixed = np.empty(2 * longest, np.float32)
    at = 0
    # row by row for all points: near points look into the same part of the tables, while it is in the cache
    for k in range(len(rows)):
        beyond, n = rows[k, 0] * n_columns + rows[k, 1], np.uint64(rows[k, 2])
        for p in range(n_points):
            to = np.uint64(p * out.shape[1] + at)
            for c in range(n):
                nodes[to + c] = 0
            for l in range(0, n_tables, 2):
                for m in range(2):
                    w0, w1, w2, w3 = wy[p, l + m, 0], wy[p, l + m, 1], wy[p, l + m, 2], wy[p, l + m, 3]
                    r0, into = np.uint64(starts[p, l + m] + beyond), np.uint64(m) * longest
                    r1, r2, r3 = r0 + down, r0 + down + down, r0 + down + down + down
                    for c in range(n + np.uint64(_COLUMNS)):
                        mixed[into + c] = w0 * flat[r0 + c] + w1 * flat[r1 + c] + w2 * flat[r2 + c] + w3 * flat[r3 + c]
                a0, a1, a2, a3 = wx[p, l, 0], wx[p, l, 1], wx[p, l, 2], wx[p, l, 3]
                b0, b1, b2, b3 = wx[p, l + 1, 0], wx[p, l + 1, 1], wx[p, l + 1, 2], wx[p, l + 1, 3]
                for c in range(n):
                    d = longest + c
                    a = a0 * mixed[c] + a1 * mixed[c + one] + a2 * mixed[c + two] + a3 * mixed[c + three]
                    b = b0 * mixed[d] + b1 * mixed[d + one] + b2 * mixed[d + two] + b3 * mixed[d + three]
                    nodes[to + c] += a + b
        at += rows[k, 2]


@numba.njit(cache=True, nogil=True)
def _cubics(place: Array, tables: Floats) -> tuple[Indices, Floats, Floats]:
    """Of each point and layer: where in the flat tables the first of 4 x 4 entries is, and weights in y and in x."""
    n_layers, n_points, _ = place.shape
    n_tables, n_rows, n_columns = tables.shape
    starts = np.zeros((n_points, n_tables), np.int64)
    wy, wx = np.zeros((n_points, n_tables, 4), np.float32), np.zeros((n_points, n_tables, 4), np.float32)
    weights = np.empty(4)
    for p in range(n_points):
        for l in range(n_layers):
            y, x = np.int64(np.floor(place[l, p, 0])), np.int64(np.floor(place[l, p, 1]))
            starts[p, l] = (l * n_rows + y - 1) * n_columns + x - 1
            cubic(place[l, p, 0] - y, weights)
            wy[p, l] = weights
            cubic(place[l, p, 1] - x, weights)
            wx[p, l] = weights
        # a table without a layer is empty, and only has to be there
        starts[p, n_layers:] = starts[p, 0]
    return starts, wy, wx


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _add_core(centres: Array, table: Floats, radius: float, rows: Indices, out: Floats) -> None:
    """Args: centres (n_points, 2) row and column in the lattice."""
    n_columns = table.shape[3]
    middle = n_columns // 2
    starts, w = find_taps((middle - centres) * _DIVISIONS, table)
    across = np.int64(2 * radius) + 2
    flat, nodes, n = table.reshape(-1), out.reshape(-1), np.uint64(across * n_columns)
    patch = np.empty(n, np.float32)
    for p in range(len(centres)):
        top, left = np.int64(np.ceil(centres[p, 0] - radius)), np.int64(np.ceil(centres[p, 1] - radius))
        beyond = top * n_columns + left
        # a patch as wide as the table: every tap is as far on from node to node, even where rows end
        for i in range(0, 12, 6):
            f0, f1 = np.uint64(starts[p, i] + beyond), np.uint64(starts[p, i + 1] + beyond)
            f2, f3 = np.uint64(starts[p, i + 2] + beyond), np.uint64(starts[p, i + 3] + beyond)
            f4, f5 = np.uint64(starts[p, i + 4] + beyond), np.uint64(starts[p, i + 5] + beyond)
            w0, w1, w2, w3, w4, w5 = w[p, i], w[p, i + 1], w[p, i + 2], w[p, i + 3], w[p, i + 4], w[p, i + 5]
            if i == 0:
                for c in range(n):
                    a = w0 * flat[f0 + c] + w1 * flat[f1 + c] + w2 * flat[f2 + c]
                    patch[c] = a + w3 * flat[f3 + c] + w4 * flat[f4 + c] + w5 * flat[f5 + c]
            else:
                for c in range(n):
                    a = w0 * flat[f0 + c] + w1 * flat[f1 + c] + w2 * flat[f2 + c]
                    patch[c] += a + w3 * flat[f3 + c] + w4 * flat[f4 + c] + w5 * flat[f5 + c]
        at = p * out.shape[1]
        for k in range(len(rows)):
            r = rows[k, 0] - top
            if 0 <= r < across:
                begin, end = max(left, rows[k, 1]), min(left + across, rows[k, 1] + rows[k, 2])
                to, come = np.uint64(at + begin - rows[k, 1]), np.uint64(r * n_columns + begin - left)
                for c in range(np.uint64(max(end - begin, 0))):
                    nodes[to + c] += patch[come + c]
            at += rows[k, 2]
