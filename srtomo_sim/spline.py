"""Periodic cubic B-spline surfaces: evaluation at scattered points that drift from frame to frame.

A surface is ``f(x, y) = sum_ji c_ji b(y - j) b(x - i)`` in units of the grid's step, with b the centred cubic B-spline.
Every frame is computed on its own, so that results do not depend on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[np.float64]

_PAD = 3


def padded(*channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Periodic coefficients, (n, n) each, wrapped around as the evaluators expect: (n + 3, n + 3, n_channels)."""
    n = len(channels[0])
    c = np.empty((n + _PAD, n + _PAD, len(channels)), np.float32)
    for i, channel in enumerate(channels):
        c[1 : n + 1, 1 : n + 1, i] = channel
    c[:, 0] = c[:, n]
    c[:, n + 1 :] = c[:, 1:_PAD]
    c[0] = c[n]
    c[n + 1 :] = c[1:_PAD]
    return c


def square_sum(n: int) -> Array:
    """(n,) sum over all aliases of the squared transform of b, by discrete frequency ``2 pi i / n``.

    It is the discrete transform of b * b, the B-spline of degree 7, at the integers.
    """
    angle = 2 * np.pi * np.arange(n) / n
    return (2416 + 2382 * np.cos(angle) + 240 * np.cos(2 * angle) + 2 * np.cos(3 * angle)) / 5040


@njit(fastmath={"contract"})
def _weights(t):
    """Six times the spline at 1 + t, t, 1 - t and 2 - t, for 0 <= t < 1."""
    s = np.float32(1) - t
    return (
        s * s * s,
        np.float32(4) + t * t * (np.float32(3) * t - np.float32(6)),
        np.float32(4) + s * s * (np.float32(3) * s - np.float32(6)),
        t * t * t,
    )


@njit(fastmath={"contract"})
def _locate(position, n):
    """First coefficient, as an unsigned index of the padded array, and weights; -n <= position < 2n."""
    cell = math.floor(position)
    weights = _weights(np.float32(position - cell))
    if cell < 0:
        cell += n
    elif cell >= n:
        cell -= n
    return np.uint64(cell), weights


@njit(fastmath={"contract"})
def _sum(c, channel, j, i, wy, wx):
    """The surface, from four by four coefficients."""
    total = np.float32(0)
    for a in range(4):
        column = i + np.uint64(a)
        total += wx[a] * (
            wy[0] * c[j, column, channel]
            + wy[1] * c[j + np.uint64(1), column, channel]
            + wy[2] * c[j + np.uint64(2), column, channel]
            + wy[3] * c[j + np.uint64(3), column, channel]
        )
    return total * np.float32(1 / 36)


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def add_values(c, x, y, drift, scale, out):
    """``out[f, p] += scale[f] f(x[p] + drift[f, 0], y[p] + drift[f, 1])``.

    Args:
        c: padded coefficients of one channel.
        x, y: (n_points,) in grid steps, not farther from 0 than the grid's size.
        drift: (n_frames, 2) in grid steps; scale: (n_frames,).
        out: (n_frames, n_points).
    """
    n = c.shape[0] - _PAD
    for f in prange(drift.shape[0]):
        drift_x, drift_y = drift[f, 0] % n, drift[f, 1] % n
        for p in range(len(x)):
            i, wx = _locate(x[p] + drift_x, n)
            j, wy = _locate(y[p] + drift_y, n)
            out[f, p] += scale[f] * _sum(c, 0, j, i, wy, wx)


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def add_weighted_pairs(c, x, y, weight, start, drift, scale, owner, first, second):
    """Weighted sums of a two-channel surface over groups of points, added to two sets of columns.

    ``first[f, owner[g]] += scale[f] sum_p weight[p] f_0(x[p] + drift[f, 0], y[p] + drift[f, 1])`` over the points
    ``start[g] <= p < start[g+1]``; ``second`` likewise with channel 1.

    Args:
        c: padded coefficients of two channels.
        x, y: (n_points,) in grid steps, not farther from 0 than the grid's size; weight: (n_points,).
        start: (n_groups + 1,); owner: (n_groups,) column of each group.
        drift: (n_frames, 2) in grid steps; scale: (n_frames,).
        first, second: (n_frames, n_columns).
    """
    n = c.shape[0] - _PAD
    for f in prange(drift.shape[0]):
        drift_x, drift_y = drift[f, 0] % n, drift[f, 1] % n
        for g in range(len(owner)):
            total_0 = 0.0
            total_1 = 0.0
            for p in range(start[g], start[g + 1]):
                i, wx = _locate(x[p] + drift_x, n)
                j, wy = _locate(y[p] + drift_y, n)
                total_0 += weight[p] * _sum(c, 0, j, i, wy, wx)
                total_1 += weight[p] * _sum(c, 1, j, i, wy, wx)
            first[f, owner[g]] += scale[f] * total_0
            second[f, owner[g]] += scale[f] * total_1
