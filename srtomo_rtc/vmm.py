"""The matrix-vector kernels of the loop.

A product is a sum of columns in slope order, each element rounded after every multiplication and every addition. No
order depends on a vector width and no multiply-add is fused, so a kernel gives the same bits on every machine: replays
and golden bags rely on that. :func:`multiply` holds the matrix by columns, :func:`multiply_tiled` in tiles of rows.
:func:`multiply_int16` reads half the memory: tiles of 16-bit integers with one float32 scale a row.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Int16s = NDArray[np.int16]

KERNEL = "columns-float32-1thread"
"""Name, arithmetic and threads; travels in HrtcEvent and in every bag."""


# fastmath stays off: it would allow fused multiply-adds, whose bits depend on the machine
@numba.njit("void(f4[:,::1], f4[::1], f4[::1])", nogil=True, cache=True, fastmath=False, error_model="numpy")
def multiply(columns: Floats, vector: Floats, out: Floats) -> None:
    """``out = columns.T @ vector``. Any thread; releases the interpreter.

    Args:
        columns: (n_columns, n_rows) C-contiguous: the matrix by columns.
        vector: (n_columns,).
        out: (n_rows,), overwritten.
    """
    n_columns, n_rows = columns.shape
    for i in range(n_rows):
        out[i] = 0.0
    j = 0
    while j + 4 <= n_columns:
        a, b, c, d = vector[j], vector[j + 1], vector[j + 2], vector[j + 3]
        for i in range(n_rows):
            out[i] = (((out[i] + columns[j, i] * a) + columns[j + 1, i] * b) + columns[j + 2, i] * c) + columns[
                j + 3, i
            ] * d
        j += 4
    while j < n_columns:
        a = vector[j]
        for i in range(n_rows):
            out[i] += columns[j, i] * a
        j += 1


TILE = 64
"""Rows of a tile: their sums stay in registers while all columns go by."""

KERNEL_TILED = "tiles-float32-1thread"
KERNEL_INT16 = "tiles-int16-rowscale-1thread"
"""As :data:`KERNEL`, of :func:`multiply_tiled`, which has its bits, and :func:`multiply_int16`."""

_INT16_MAX = 32767


def tiled(matrix: NDArray[Any]) -> NDArray[Any]:
    """A matrix (n_rows, n_columns) as C-contiguous tiles (n_tiles, n_columns, TILE) of the same type.

    ``tiles[t, j, i] = matrix[t TILE + i, j]``; rows that the last tile has too many are zero. A product then reads
    memory once, from end to end, which prefetchers follow better than several columns side by side.
    """
    n_rows, n_columns = matrix.shape
    n_tiles = -(-n_rows // TILE)
    padded = np.zeros((n_tiles * TILE, n_columns), matrix.dtype)
    padded[:n_rows] = matrix
    return np.ascontiguousarray(padded.reshape(n_tiles, TILE, n_columns).transpose(0, 2, 1))


def quantise(matrix: NDArray[np.floating]) -> tuple[Int16s, Floats]:
    """A matrix as 16-bit integers with a scale a row: ``matrix[i, j] ~ scales[i] * integers[i, j]``.

    Each row's largest element becomes 32767. No element is off by more than ``scales[i] * (0.5 + 2**-9)`` (the second
    part is the rounding of the scale), so that a product is off by at most that times the sum of the vector's absolute
    values; with elements independent of the vector, by ``scales[i] * |vector| / sqrt(12)`` rms.

    Args:
        matrix: (n_rows, n_columns), finite.

    Returns:
        integers (n_rows, n_columns), for :func:`tiled`, and scales (n_rows,) in the matrix's units; 1 for a row of
        zeros.

    Raises:
        ValueError: an element is not finite, or a row is so small that its scale is no normal float32.
    """
    largest = np.max(np.abs(matrix), axis=1, initial=0).astype(np.float64)
    if not np.isfinite(largest).all():
        raise ValueError("matrix: expected finite elements")
    scales = np.where(largest > 0, largest / _INT16_MAX, 1.0).astype(np.float32)
    if np.any(scales < np.finfo(np.float32).tiny):
        raise ValueError("matrix: a row is too small for a float32 scale")
    # the scale's own rounding can make the largest element 32767.002, never 32768
    return np.rint(matrix / scales.astype(np.float64)[:, None]).astype(np.int16), scales


@numba.njit(
    ["void(f4[:,::1], f4[::1], f4[::1], i8)", "void(i2[:,::1], f4[::1], f4[::1], i8)"],
    nogil=True,
    cache=True,
    fastmath=False,
    error_model="numpy",
)
def _multiply_tile(tile: NDArray[Any], vector: Floats, out: Floats, n_rows: int) -> None:
    """The first ``n_rows`` rows of one tile (n_columns, TILE)."""
    n_columns = len(vector)
    for i in range(n_rows):
        out[i] = 0.0
    j = 0
    while j + 4 <= n_columns:
        a, b, c, d = vector[j], vector[j + 1], vector[j + 2], vector[j + 3]
        for i in range(n_rows):
            total = out[i]
            total += np.float32(tile[j, i]) * a
            total += np.float32(tile[j + 1, i]) * b
            total += np.float32(tile[j + 2, i]) * c
            total += np.float32(tile[j + 3, i]) * d
            out[i] = total
        j += 4
    while j < n_columns:
        a = vector[j]
        for i in range(n_rows):
            out[i] += np.float32(tile[j, i]) * a
        j += 1


@numba.njit(
    ["void(f4[:,:,::1], f4[::1], f4[::1])", "void(i2[:,:,::1], f4[::1], f4[::1])"],
    nogil=True,
    cache=True,
    fastmath=False,
    error_model="numpy",
)
def multiply_tiled(tiles: NDArray[Any], vector: Floats, out: Floats) -> None:
    """``out = matrix @ vector``, for float32 with the bits of :func:`multiply`. Any thread; releases the interpreter.

    Args:
        tiles: of the matrix, float32 or int16, as :func:`tiled` makes them.
        vector: (n_columns,).
        out: (n_rows,), overwritten.
    """
    n_rows = len(out)
    for t in range(len(tiles)):
        start = t * TILE
        if start + TILE <= n_rows:
            _multiply_tile(tiles[t], vector, out[start : start + TILE], TILE)
        else:
            _multiply_tile(tiles[t], vector, out[start:], n_rows - start)


@numba.njit("void(i2[:,:,::1], f4[::1], f4[::1], f4[::1])", nogil=True, cache=True, fastmath=False, error_model="numpy")
def multiply_int16(tiles: Int16s, scales: Floats, vector: Floats, out: Floats) -> None:
    """``out = scales * (integers @ vector)``, in float32. Any thread; releases the interpreter.

    Args:
        tiles: of the integers of :func:`quantise`, as :func:`tiled` makes them.
        scales: (n_rows,).
        vector: (n_columns,).
        out: (n_rows,), overwritten.
    """
    multiply_tiled(tiles, vector, out)
    for i in range(len(out)):
        out[i] *= scales[i]


@numba.njit("b1(f4[::1])", nogil=True, cache=True, fastmath=False)
def all_finite(vector: Floats) -> bool:
    """Whether no element is NaN or infinite. Any thread; releases the interpreter."""
    for value in vector:
        if not np.isfinite(value):
            return False
    return True
