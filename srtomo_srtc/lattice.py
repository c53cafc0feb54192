"""Covariance of the wavefront at one sensor's nodes with another sensor's slopes, from one table for all layers.

Towards stars at the same range every layer's separation is ``xi_l b + h_l (alpha_i - alpha_j)``, with b the baseline in
the pupil: the sum over the layers is a function of b alone, tabulated once for each pair of sensors.

A sensor's nodes are part of a square lattice. From one point to all of them the baselines differ by whole steps of
that lattice: in a table whose grid divides the step, every node is as far beyond its grid point as the others, and one
set of weights serves them all. Where the points lie on the lattice themselves (a sensor that is only shifted against
the other), the grid is placed there, and a look-up is exact. Otherwise it interpolates by cubics in x and y on a
quarter of the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.atmosphere import CovarianceTable
from srtomo_srtc.geometry import Lattice

Array = NDArray[np.float64]
Indices = NDArray[np.integer]

_DIVISIONS = 4  # of the lattice's step, where a table is interpolated
_COLUMNS = 16  # that are done at a time
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
        cls, lattice: Lattice, centres: Array, cones: Array, offsets: Array, fractions: Array, table: CovarianceTable
    ) -> PairTable:
        """Tabulate.

        Args:
            cones: (n_layers,) xi, the same for points and sensor.
            offsets: (n_layers, 2) x and y by which the sensor's footprint is displaced from that of the points, m.
            fractions: (n_layers,) of the layers.
            table: of the covariance.
        """
        divisions, margin = (1, 1) if is_on_lattice(centres) else (_DIVISIONS, 3)
        nodes = np.stack([lattice.row, lattice.column], axis=1)
        first = np.floor(nodes.min(axis=0) - centres.max(axis=0)) - margin
        last = np.ceil(nodes.max(axis=0) - centres.min(axis=0)) + margin
        n_rows, n_columns = (last - first).astype(int) + 1
        if divisions == 1:
            first += -centres[0] % 1
        values = np.zeros((divisions, divisions, n_rows, n_columns + _COLUMNS))
        _tabulate(
            cones, offsets, fractions, lattice.step, lattice.rotation, table.values, 1 / table.step, first, values
        )
        return cls(lattice, centres, first, values)

    def slopes(self, gradient: sparse.csr_array, points: slice) -> Array:
        """Covariance of the wavefront at some of the points with the sensor's slopes.

        Args:
            gradient: (n_slopes, n_nodes) of the sensor, 1/m.

        Returns:
            (n_points, n_slopes) rad m.
        """
        place = (-self.centres[points] - self.first) * len(self.values)
        rows, where = self.lattice.rows(_COLUMNS)
        out = np.empty((len(place), gradient.shape[0]))
        _correlate(place, self.values, rows, gradient.indptr, where[gradient.indices], gradient.data, out)
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


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _correlate(
    place: Array, table: Array, rows: Indices, indptr: Indices, indices: Indices, data: Array, out: Array
) -> None:
    divisions, n_columns = table.shape[1], table.shape[3]
    flat, per_phase = table.reshape(-1), table[0, 0].size
    nodes = np.empty(rows[:, 2].sum())
    weights = np.empty((2, 4))
    start = np.empty(4, np.int64)
    for p in range(len(place)):
        nodes[:] = 0.0
        if divisions == 1:
            base = np.int64(np.rint(place[p, 0])) * n_columns + np.int64(np.rint(place[p, 1]))
            at = 0
            for k in range(len(rows)):
                _add(nodes, at, rows[k, 2], flat, base + rows[k, 0] * n_columns + rows[k, 1])
                at += rows[k, 2]
        else:
            fy, fx = np.int64(np.floor(place[p, 0])), np.int64(np.floor(place[p, 1]))
            _cubic(place[p, 0] - fy, weights[0])
            _cubic(place[p, 1] - fx, weights[1])
            for i in range(4):
                y = fy + i - 1
                for j in range(4):
                    x = fx + j - 1
                    phase = (y % divisions) * divisions + x % divisions
                    start[j] = phase * per_phase + (y // divisions) * n_columns + x // divisions
                product = weights[0, i] * weights[1]
                at = 0
                for k in range(len(rows)):
                    _add_4(nodes, at, rows[k, 2], flat, start, rows[k, 0] * n_columns + rows[k, 1], product)
                    at += rows[k, 2]
        for s in range(len(indptr) - 1):
            total = 0.0
            for e in range(indptr[s], indptr[s + 1]):
                total += data[e] * nodes[indices[e]]
            out[p, s] = total


@numba.njit(cache=True, nogil=True)
def _cubic(t: float, weights: Array) -> None:
    """Lagrange's, for values at -1, 0, 1 and 2."""
    weights[0] = -t * (t - 1) * (t - 2) / 6
    weights[1] = (t + 1) * (t - 1) * (t - 2) / 2
    weights[2] = -(t + 1) * t * (t - 2) / 2
    weights[3] = (t + 1) * t * (t - 1) / 6


# Unsigned indices cannot count from the end, and a known number of columns leaves no rest: so these loops vectorise.


@numba.njit(cache=True, nogil=True)
def _add(out: Array, first: int, n: int, table: Array, start: int) -> None:
    f, s = np.uintp(first), np.uintp(start)
    for block in range(np.uintp(n) // np.uintp(_COLUMNS)):
        for k in range(_COLUMNS):
            q = block * np.uintp(_COLUMNS) + np.uintp(k)
            out[f + q] += table[s + q]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _add_4(out: Array, first: int, n: int, table: Array, start: Indices, beyond: int, weights: Array) -> None:
    f, w0, w1, w2, w3 = np.uintp(first), weights[0], weights[1], weights[2], weights[3]
    s0, s1 = np.uintp(start[0] + beyond), np.uintp(start[1] + beyond)
    s2, s3 = np.uintp(start[2] + beyond), np.uintp(start[3] + beyond)
    for block in range(np.uintp(n) // np.uintp(_COLUMNS)):
        for k in range(_COLUMNS):
            q = block * np.uintp(_COLUMNS) + np.uintp(k)
            out[f + q] += w0 * table[s0 + q] + w1 * table[s1 + q] + w2 * table[s2 + q] + w3 * table[s3 + q]
