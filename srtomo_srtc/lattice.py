"""Covariance of the wavefront at one sensor's nodes with another sensor's slopes, from one table for all layers.

Towards stars at the same range every layer's separation is ``xi_l b + h_l (alpha_i - alpha_j)``, with b the baseline in
the pupil: the sum over the layers is a function of b alone, tabulated once for each pair of sensors. Points that are
seen from another range take a table for each layer.

A sensor's nodes are part of a square lattice. From one point to all of them the baselines differ by whole steps of
that lattice: in a table whose grid divides the step, every node is as far beyond its grid point as the others, and one
set of weights serves them all. Where the points lie on the lattice themselves (a sensor that is only shifted against
the other), the grid is placed there, and a look-up is exact. Otherwise it interpolates by cubics in x and y on a
quarter of the step: nodes that follow each other in a row are then 12 vectors, weighted and summed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.atmosphere import CovarianceTable
from srtomo_srtc.geometry import Lattice

Array = NDArray[np.float64]
Matrix = NDArray[np.floating]
Indices = NDArray[np.integer]

_DIVISIONS = 4  # of the lattice's step, where a table is interpolated
_COLUMNS = 8  # of which a row's length is a multiple: loops that leave no rest are quicker
_POINTS = 48  # whose nodes are held at a time: as much as a cache holds
_ON_LATTICE = 1e-7  # steps of the lattice: closer is on it


@dataclass(frozen=True)
class PairTable:
    """Covariance summed over the layers, on a grid of baselines in steps of a sensor's lattice along its own axes.

    Attributes:
        lattice: the sensor's.
        centres: (n_points, 2) row and column, not whole, of the points in the lattice.
        first: baseline (y, x) of the grid's first point.
        values: (divisions, divisions, n_rows, n_columns) m^2; ``values[a, b, r, c]`` belongs to the baseline
            ``first + (r, c) + (a, b) / divisions``. Without divisions the points are on the grid.
    """

    lattice: Lattice
    centres: Array
    first: Array
    values: Array

    @classmethod
    def build(
        cls,
        lattice: Lattice,
        centres: Array,
        cones: Array,
        offsets: Array,
        fractions: Array,
        table: CovarianceTable,
        dtype: type[np.floating] = np.float64,
    ) -> PairTable:
        """Tabulate.

        Args:
            cones: (n_layers,) xi, the same for points and sensor.
            offsets: (n_layers, 2) x and y by which the sensor's footprint is displaced from that of the points, m.
            fractions: (n_layers,) of the layers.
            table: of the covariance.
            dtype: of the values.
        """
        divisions, margin = (1, 1) if is_on_lattice(centres) else (_DIVISIONS, 3)
        nodes = np.stack([lattice.row, lattice.column], axis=1)
        first = np.floor(nodes.min(axis=0) - centres.max(axis=0)) - margin
        last = np.ceil(nodes.max(axis=0) - centres.min(axis=0)) + margin
        n_rows, n_columns = (last - first).astype(int) + 1
        if divisions == 1:
            first += -centres[0] % 1
        values = np.zeros((divisions, divisions, n_rows, n_columns + _COLUMNS), dtype)
        _tabulate(
            cones, offsets, fractions, lattice.step, lattice.rotation, table.values, 1 / table.step, first, values
        )
        return cls(lattice, centres, first, values)


class Correlator:
    """Covariance of the wavefront at points, summed over one or several tables, with a sensor's slopes.

    The points of all tables are the same ones, on other layers.
    """

    def __init__(self, tables: Sequence[PairTable], gradient: sparse.csr_array) -> None:
        """Set up.

        Args:
            tables: for one sensor.
            gradient: (n_slopes, n_nodes) of the sensor, 1/m.
        """
        self._tables = [((-t.centres - t.first) * len(t.values), t.values) for t in tables]
        self._rows, where = tables[0].lattice.rows(_COLUMNS)
        self._gradient = gradient.indptr, where[gradient.indices], gradient.data.astype(tables[0].values.dtype)

    def __call__(self, points: slice) -> Matrix:
        """Of some of the points: (n_points, n_slopes) rad m."""
        every = range(*points.indices(len(self._tables[0][0])))
        out = np.empty((len(every), len(self._gradient[0]) - 1), self._gradient[2].dtype)
        nodes = np.empty((min(_POINTS, len(every)), self._rows[:, 2].sum()), out.dtype)
        for start in range(0, len(every), _POINTS):
            some = every[start : start + _POINTS]
            own = nodes[: len(some)]
            own[:] = 0
            for place, values in self._tables:
                _add_nodes(place[some.start : some.stop], values, self._rows, own)
            _slopes(own, *self._gradient, out[start : start + _POINTS])
        return out


def is_on_lattice(centres: Array) -> bool:
    """Whether points (n_points, 2), in steps of a lattice, are whole steps apart."""
    apart = centres - centres[0]
    return bool(np.abs(apart - np.rint(apart)).max() < _ON_LATTICE)


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _tabulate(
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
    divisions, _, n_rows, n_columns = out.shape
    cosine, sine, last = np.cos(rotation) * step, np.sin(rotation) * step, len(table) - 2
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
                        i = np.int64(t)
                        if i > last:
                            i = np.int64(last)
                        row[c] += fractions[l] * (table[i] + (t - i) * (table[i + 1] - table[i]))


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _add_nodes(place: Array, table: Matrix, rows: Indices, out: Matrix) -> None:
    flat, n_columns = table.reshape(-1), table.shape[3]
    starts, weights = _taps(place, table)
    at = 0
    # row by row for all points: near points look into the same part of the table, while it is in the cache
    for k in range(len(rows)):
        beyond, n = rows[k, 0] * n_columns + rows[k, 1], rows[k, 2]
        for p in range(len(place)):
            nodes, first, w = out[p, at : at + n], starts[p], weights[p]
            if len(w) == 1:
                nodes += flat[first[0] + beyond : first[0] + beyond + n]
                continue
            for i in range(0, 12, 6):
                f0, f1, f2 = first[i] + beyond, first[i + 1] + beyond, first[i + 2] + beyond
                f3, f4, f5 = first[i + 3] + beyond, first[i + 4] + beyond, first[i + 5] + beyond
                t0, t1, t2 = flat[f0 : f0 + n], flat[f1 : f1 + n], flat[f2 : f2 + n]
                t3, t4, t5 = flat[f3 : f3 + n], flat[f4 : f4 + n], flat[f5 : f5 + n]
                w0, w1, w2, w3, w4, w5 = w[i], w[i + 1], w[i + 2], w[i + 3], w[i + 4], w[i + 5]
                for c in range(n):
                    nodes[c] += w0 * t0[c] + w1 * t1[c] + w2 * t2[c] + w3 * t3[c] + w4 * t4[c] + w5 * t5[c]
        at += n


@numba.njit(cache=True, nogil=True)
def _taps(place: Array, table: Matrix) -> tuple[Indices, Matrix]:
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
        _cubic(place[p, 0] - fy, wy, ly)
        _cubic(place[p, 1] - fx, wx, lx)
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
def _slopes(nodes: Matrix, indptr: Indices, indices: Indices, data: Matrix, out: Matrix) -> None:
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
def _cubic(t: float, cubic: Array, linear: Array) -> None:
    """Lagrange's, for values at -1, 0, 1 and 2, and linear interpolation from the middle two."""
    cubic[0] = -t * (t - 1) * (t - 2) / 6
    cubic[1] = (t + 1) * (t - 1) * (t - 2) / 2
    cubic[2] = -(t + 1) * t * (t - 2) / 2
    cubic[3] = (t + 1) * t * (t - 1) / 6
    linear[1], linear[2] = 1 - t, t
