"""Covariance of the wavefront at one sensor's nodes with another sensor's slopes, from one table for all layers.

Towards stars at the same range every layer's separation is ``xi_l b + h_l (alpha_i - alpha_j)``, with b the baseline in
the pupil: the sum over the layers is a function of b alone, tabulated once for each pair of sensors. Points that are
seen from another range are the business of :mod:`srtomo_srtc.layered`.

A sensor's nodes are part of a square lattice. From one point to all of them the baselines differ by whole steps of
that lattice: in a table whose grid divides the step, every node is as far beyond its grid point as the others, and one
set of weights serves them all. Where the points lie on the lattice themselves (a sensor that is only shifted against
the other), the grid is placed there, and a look-up is exact. Otherwise it interpolates by cubics in x and y on a
quarter of the step: nodes that follow each other in a row are then 12 vectors, weighted and summed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from srtomo_srtc.atmosphere import CovarianceTable
from srtomo_srtc.geometry import Lattice
from srtomo_srtc.gradient import Stencils

Array = NDArray[np.float64]
Matrix = NDArray[np.floating]
Indices = NDArray[np.integer]

_DIVISIONS = 4  # of the lattice's step, where a table is interpolated
_COLUMNS = 8  # of which a row's length is a multiple: loops that leave no rest are quicker
_POINTS = 48  # whose nodes are held at a time, or more while these are few: as much as a cache holds
_HELD = 2**16  # nodes of all these points
_ON_LATTICE = 1e-7  # steps of the lattice: closer is on it


@dataclass(frozen=True, eq=False)
class Baselines:
    """A grid of baselines from points to a sensor's nodes, in steps of the sensor's lattice along its own axes.

    Attributes:
        lattice: the sensor's.
        centres: (n_points, 2) row and column, not whole, of the points in the lattice.
        divisions: of the step. Without, all baselines are on the grid.
        first: baseline (y, x) of the grid's first point.
        shape: number of whole steps down and across.
    """

    lattice: Lattice
    centres: Array
    divisions: int
    first: Array
    shape: tuple[int, int]

    @classmethod
    def between(cls, centres: Array, lattice: Lattice) -> Baselines:
        """As many as all pairs of points and nodes need."""
        divisions, margin = (1, 1) if is_on_lattice(centres) else (_DIVISIONS, 3)
        nodes = np.stack([lattice.row, lattice.column], axis=1)
        first = np.floor(nodes.min(axis=0) - centres.max(axis=0)) - margin
        last = np.ceil(nodes.max(axis=0) - centres.min(axis=0)) + margin
        n_rows, n_columns = (last - first).astype(int) + 1
        if divisions == 1:
            first += -centres[0] % 1
        return cls(lattice, centres, divisions, first, (int(n_rows), int(n_columns)))


@dataclass(frozen=True)
class PairTable:
    """Covariance summed over the layers.

    Attributes:
        baselines: from the points to the sensor's nodes.
        values: (divisions, divisions, n_rows, n_columns) m^2; ``values[a, b, r, c]`` belongs to the baseline
            ``first + (r, c) + (a, b) / divisions``.
    """

    baselines: Baselines
    values: Array

    @classmethod
    def build(
        cls, baselines: Baselines, cones: Array, offsets: Array, fractions: Array, table: CovarianceTable
    ) -> PairTable:
        """Tabulate.

        Args:
            cones: (n_layers,) xi, the same for points and sensor.
            offsets: (n_layers, 2) x and y by which the sensor's footprint is displaced from that of the points, m.
            fractions: (n_layers,) of the layers.
            table: of the covariance.
        """
        lattice, divisions, (n_rows, n_columns) = baselines.lattice, baselines.divisions, baselines.shape
        values = np.zeros((divisions, divisions, n_rows, n_columns + _COLUMNS))
        tabulate(
            cones,
            offsets,
            fractions,
            lattice.step,
            lattice.rotation,
            table.values,
            1 / table.step,
            baselines.first,
            values,
        )
        return cls(baselines, values)


class Correlator:
    """Covariance of the wavefront at points with a sensor's slopes.

    Most slopes share a stencil (:class:`Stencils`). Put on the table, it makes one of the wavefront with such a slope,
    as a function of where the sub-aperture is: a look-up for each, and none for its nodes.
    """

    def __init__(self, table: PairTable, stencils: Stencils) -> None:
        """Set up.

        Args:
            table: of the points and the sensor's nodes.
            stencils: of the sensor.
        """
        self._place = (-table.baselines.centres - table.baselines.first) * len(table.values)
        self._table = table.values
        n_columns = table.values.shape[3]
        self._shared = []
        for s in stencils.shared:
            values = np.zeros_like(table.values)
            _put_stencil(table.values, s.row, s.column, s.weights, values)
            self._shared.append((values, s.place[:, 0] * n_columns + s.place[:, 1], s.slopes))
        self._n_slopes, self._others = stencils.n_slopes, stencils.others
        self._rows, where = stencils.lattice.rows(_COLUMNS)
        self._gradient = stencils.matrix.indptr, where[stencils.matrix.indices], stencils.matrix.data

    def __call__(self, points: slice) -> Array:
        """Of some of the points: (n_points, n_slopes) rad m."""
        place = self._place[points]
        out = np.empty((len(place), self._n_slopes))
        for shared in self._shared:
            _set_slopes(place, *shared, out)
        if len(self._others):
            n_nodes = self._rows[:, 2].sum()
            at_once = max(_POINTS, _HELD // n_nodes)
            for start in range(0, len(place), at_once):
                some = place[start : start + at_once]
                nodes, slopes = np.zeros((len(some), n_nodes)), np.empty((len(some), len(self._others)))
                _add_nodes(some, self._table, self._rows, nodes)
                slopes_of_nodes(nodes, *self._gradient, slopes)
                out[start : start + at_once, self._others] = slopes
        return out


def is_on_lattice(centres: Array) -> bool:
    """Whether points (n_points, 2), in steps of a lattice, are whole steps apart."""
    apart = centres - centres[0]
    return bool(np.abs(apart - np.rint(apart)).max() < _ON_LATTICE)


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def tabulate(
    cones: Array,
    offsets: Array,
    fractions: Array,
    step: float,
    rotation: float,
    table: Array,
    per_step: float,
    first: Array,
    out: Array,
) -> None:
    """Add to ``out`` the covariance, summed over layers, on a grid of baselines: see :class:`PairTable`, whose
    ``values`` it is, and :meth:`PairTable.build`; ``per_step`` is 1 over the step (m) of the covariance's ``table``."""
    divisions, _, n_rows, n_columns = out.shape
    cosine, sine, last = np.cos(rotation) * step, np.sin(rotation) * step, np.float64(len(table) - 2)
    # unsigned: an index that can count from the end costs a test
    index, beyond = np.empty(n_columns, np.uint32), np.empty(n_columns)
    for a in range(divisions):
        for b in range(divisions):
            for r in range(n_rows):
                row, v = out[a, b, r], first[0] + r + a / divisions
                for l in range(len(cones)):
                    for c in range(n_columns):
                        u = first[1] + c + b / divisions
                        dx = cones[l] * (cosine * u - sine * v) + offsets[l, 0]
                        dy = cones[l] * (sine * u + cosine * v) + offsets[l, 1]
                        t = np.sqrt(dx * dx + dy * dy) * per_step
                        # a corner of the grid may lie farther out than any pair of points, and is then not asked for
                        i = np.int32(min(t, last))
                        index[c] = i
                        beyond[c] = t - i
                    # apart from the look-ups the loop above vectorises
                    for c in range(n_columns):
                        value = table[index[c]]
                        row[c] += fractions[l] * (value + beyond[c] * (table[index[c] + np.uint32(1)] - value))


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _put_stencil(table: Matrix, row: Indices, column: Indices, weights: Array, out: Matrix) -> None:
    """Add to ``out`` the sum of the table's entries that a stencil weighs, wherever all of it is on the table."""
    n_rows, n_columns = table.shape[2] - row.max(), np.uint64(table.shape[3] - column.max())
    for a in range(table.shape[0]):
        for b in range(table.shape[1]):
            for r in range(n_rows):
                to = out[a, b, r]
                for k in range(len(row)):
                    come, w = table[a, b, r + row[k], column[k] :], weights[k]
                    for c in range(n_columns):
                        to[c] += w * come[c]


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _set_slopes(place: Array, table: Matrix, beyond: Indices, slopes: Indices, out: Matrix) -> None:
    """Set these slopes' columns of ``out``, from a table of them; ``beyond``: from where baseline 0 is in it."""
    starts, weights = find_taps(place, table)
    flat, total = table.reshape(-1), np.empty(len(slopes), table.dtype)
    for p in range(len(place)):
        into = out[p]
        if starts.shape[1] == 1:
            start = starts[p, 0]
            for s in range(len(slopes)):
                into[slopes[s]] = flat[start + beyond[s]]
        else:
            total[:] = 0
            for t in range(12):
                start, w = starts[p, t], weights[p, t]
                for s in range(len(slopes)):
                    total[s] += w * flat[start + beyond[s]]
            for s in range(len(slopes)):
                into[slopes[s]] = total[s]


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _add_nodes(place: Array, table: Matrix, rows: Indices, out: Matrix) -> None:
    flat, nodes, n_columns = table.reshape(-1), out.reshape(-1), table.shape[3]
    starts, weights = find_taps(place, table)
    at = 0
    # row by row for all points: near points look into the same part of the table, while it is in the cache
    for k in range(len(rows)):
        beyond, n = rows[k, 0] * n_columns + rows[k, 1], rows[k, 2]
        for p in range(len(place)):
            if starts.shape[1] == 12:
                add_taps(flat, starts, beyond, weights, p, nodes, p * out.shape[1] + at, n)
            else:
                to, start = np.uint64(p * out.shape[1] + at), np.uint64(starts[p, 0] + beyond)
                for c in range(np.uint64(n)):
                    nodes[to + c] += flat[start + c]
        at += n


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def add_taps(
    flat: Matrix, starts: Indices, beyond: int, weights: Matrix, point: int, nodes: Matrix, to: int, n: int
) -> None:
    """Add to ``n`` of a point's nodes, from ``to`` on, 12 weighted entries each, ``beyond`` its starts in a table."""
    # unsigned: an index that can count from the end costs a test
    into = np.uint64(to)
    for i in range(0, 12, 6):
        f0, f1 = np.uint64(starts[point, i] + beyond), np.uint64(starts[point, i + 1] + beyond)
        f2, f3 = np.uint64(starts[point, i + 2] + beyond), np.uint64(starts[point, i + 3] + beyond)
        f4, f5 = np.uint64(starts[point, i + 4] + beyond), np.uint64(starts[point, i + 5] + beyond)
        w0, w1, w2 = weights[point, i], weights[point, i + 1], weights[point, i + 2]
        w3, w4, w5 = weights[point, i + 3], weights[point, i + 4], weights[point, i + 5]
        for c in range(np.uint64(n)):
            first = w0 * flat[f0 + c] + w1 * flat[f1 + c] + w2 * flat[f2 + c]
            nodes[into + c] += first + w3 * flat[f3 + c] + w4 * flat[f4 + c] + w5 * flat[f5 + c]


@numba.njit(cache=True, nogil=True)
def find_taps(place: Array, table: Matrix) -> tuple[Indices, Matrix]:
    """Where in the flat table what belongs to baseline 0 of each point is, and how much each entry counts.

    Interpolated by cubics in x between the two rows next to it, and in y between the two columns, less what is in both.
    """
    divisions, n_columns, per_phase = table.shape[1], table.shape[3], table[0, 0].size
    n = 1 if divisions == 1 else 12
    starts, weights = np.empty((len(place), n), np.int64), np.ones((len(place), n), table.dtype)
    wy, wx, ly, lx = np.empty(4), np.empty(4), np.zeros(4), np.zeros(4)
    for p in range(len(place)):
        if n == 1:
            starts[p, 0] = np.int64(np.rint(place[p, 0])) * n_columns + np.int64(np.rint(place[p, 1]))
            continue
        fy, fx = np.int64(np.floor(place[p, 0])), np.int64(np.floor(place[p, 1]))
        ty, tx = place[p, 0] - fy, place[p, 1] - fx
        cubic(ty, wy)
        cubic(tx, wx)
        ly[1], ly[2], lx[1], lx[2] = 1 - ty, ty, 1 - tx, tx
        tap = 0
        for i in range(4):
            for j in range(4):
                if i in (1, 2) or j in (1, 2):
                    y, x = fy + i - 1, fx + j - 1
                    phase = (y % divisions) * divisions + x % divisions
                    starts[p, tap] = phase * per_phase + (y // divisions) * n_columns + x // divisions
                    weights[p, tap] = wy[i] * lx[j] + ly[i] * wx[j] - ly[i] * lx[j]
                    tap += 1
    return starts, weights


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def slopes_of_nodes(nodes: Matrix, indptr: Indices, indices: Indices, data: Matrix, out: Matrix) -> None:
    """Turn wavefronts at nodes (n_points, n_nodes) into slopes (n_points, n_slopes), by the gradient in CSR form."""
    # the gradient is read once for four points
    for p in range(0, len(nodes), 4):
        last = len(nodes) - 1
        p1, p2, p3 = min(p + 1, last), min(p + 2, last), min(p + 3, last)
        n0, n1, n2, n3 = nodes[p], nodes[p1], nodes[p2], nodes[p3]
        for s in range(len(indptr) - 1):
            s0 = s1 = s2 = s3 = data.dtype.type(0)
            for e in range(indptr[s], indptr[s + 1]):
                i, d = indices[e], data[e]
                s0 += d * n0[i]
                s1 += d * n1[i]
                s2 += d * n2[i]
                s3 += d * n3[i]
            out[p, s], out[p1, s], out[p2, s], out[p3, s] = s0, s1, s2, s3


@numba.njit(cache=True, nogil=True)
def cubic(t: float, weights: Array) -> None:
    """Lagrange's, at t, of values at -1, 0, 1 and 2."""
    weights[0] = -t * (t - 1) * (t - 2) / 6
    weights[1] = (t + 1) * (t - 1) * (t - 2) / 2
    weights[2] = -(t + 1) * t * (t - 2) / 2
    weights[3] = (t + 1) * t * (t - 1) / 6
