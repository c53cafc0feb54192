"""The matrix-vector kernels of the loop, which stand in ``native/kernel.c``, and the memory that they read.

A product is a sum of columns in a fixed order, sub-aperture by sub-aperture (x, then y), each element rounded after
every multiplication and every addition. No order depends on a vector width or on the packets that slopes come in, and
no multiply-add is fused, so a kernel gives the same bits on every machine: replays and golden bags rely on that.
A matrix is held in tiles of rows, whose sums stay in registers while the columns go by.
:func:`multiply_int16` reads half the memory: 16-bit integers with one float32 scale a row.

Any thread may call any of these, each with output of its own.
"""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from srtomo_rtc import native
from srtomo_rtc.native import lib
from srtomo_rtc.realtime import HUGE_PAGE

Floats = NDArray[np.float32]
Int16s = NDArray[np.int16]

_TILE_BYTES = 128
_ROWS = 64  # of the larger tile

KERNELS = {
    "float32": "subapertures-float32-1thread",
    "int16": "subapertures-int16-rowscale-1thread",
    "tlr": "zones-int16-lowrank",
}
"""Name and arithmetic, by parameter ``kernel``; in HrtcEvent and in every bag. The bits belong to the name, which for
low rank goes on with a digest of the factors."""

_INT16_MAX = 32767


def instructions() -> str:
    """The instruction set that the kernels run with here; their bits do not depend on it."""
    return str(lib.srt_instructions().decode())


def rows_of(n: int) -> int:
    """Length of a vector that products of ``n`` rows go to: whole tiles of either kind."""
    return -(-n // _ROWS) * _ROWS


def tiles_shape(n_rows: int, n_columns: int, dtype: DTypeLike) -> tuple[int, int, int]:
    """(n_tiles, n_columns, rows of a tile): 32 rows of float32, 64 of int16."""
    tile = _TILE_BYTES // np.dtype(dtype).itemsize
    return -(-n_rows // tile), n_columns, tile


def huge_zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """An array of zeros on huge pages, where the system grants them: fewer page walks in a product."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size < HUGE_PAGE:
        return np.zeros(shape, dtype)
    # From one boundary to another: the system makes a page huge only if all of it is the array's. Private: shared
    # memory, mmap's default, follows another setting of the system's, which is "never" unless somebody changes it.
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    memory = mmap.mmap(-1, -(-size // HUGE_PAGE) * HUGE_PAGE + HUGE_PAGE, flags=flags)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        memory.madvise(mmap.MADV_HUGEPAGE)
    start = -np.frombuffer(memory, np.uint8).ctypes.data % HUGE_PAGE
    return np.frombuffer(memory, dtype, int(np.prod(shape)), start).reshape(shape)


def tiled(matrix: NDArray[Any], out: NDArray[Any] | None = None) -> NDArray[Any]:
    """A matrix (n_rows, n_columns) as C-contiguous tiles (:func:`tiles_shape`) of the same type.

    ``tiles[t, j, i]`` is ``matrix[t n + i, j]`` with n rows a tile; rows that the last tile has too many are zero. A
    product then reads memory once, from end to end, which prefetchers follow better than several columns side by side.
    """
    tiles = np.zeros(tiles_shape(len(matrix), matrix.shape[1], matrix.dtype), matrix.dtype) if out is None else out
    for t, tile in enumerate(tiles):
        rows = matrix[t * tiles.shape[2] : (t + 1) * tiles.shape[2]]
        tile[:, : len(rows)] = rows.T
    return tiles


def untiled(tiles: NDArray[Any], n_rows: int) -> NDArray[Any]:
    """The matrix (n_rows, n_columns) that :func:`tiled` made tiles of; a copy."""
    return tiles.transpose(0, 2, 1).reshape(-1, tiles.shape[1])[:n_rows].copy()


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


def accumulate(tiles: NDArray[Any], vector: Floats, sums: Floats, first: int = 0, last: int | None = None) -> None:
    """Add the products of columns ``first`` to ``last`` to ``sums``. Any thread; releases the interpreter.

    Args:
        tiles: of the matrix, float32 or int16, as :func:`tiled` makes them.
        vector: (n_columns,) C-contiguous.
        sums: C-contiguous, of at least as many rows as the tiles have.
    """
    lib.srt_crew_multiply(None, product_of(tiles, vector, sums, first, last))


def product_of(
    tiles: NDArray[Any], vector: Floats, sums: Floats, first: int = 0, last: int | None = None
) -> native.Product:
    """:func:`accumulate`'s arguments for the library; they must stay while it is used."""
    n_tiles, n_columns, _ = tiles.shape
    last = n_columns if last is None else last
    where = tiles.ctypes.data, vector.ctypes.data, sums.ctypes.data
    return native.Product(where[0], n_tiles, n_columns, first, last, *where[1:], tiles.dtype == np.int16)


def multiply(tiles: Floats, vector: Floats, out: Floats) -> None:
    """``out = matrix @ vector``. Any thread; releases the interpreter.

    Args:
        tiles: as :func:`tiled` makes them.
        vector: (n_columns,) C-contiguous.
        out: (:func:`rows_of` n_rows,) C-contiguous, overwritten.
    """
    out[:] = 0
    accumulate(tiles, vector, out)


def multiply_int16(tiles: Int16s, scales: Floats, vector: Floats, out: Floats) -> None:
    """``out = scales * (integers @ vector)``, in float32. Any thread; releases the interpreter.

    Args:
        tiles: of the integers of :func:`quantise`, as :func:`tiled` makes them.
        scales: (n_rows,).
        vector: (n_columns,) C-contiguous.
        out: (:func:`rows_of` n_rows,) C-contiguous, overwritten.
    """
    out[:] = 0
    accumulate(tiles, vector, out)
    out[: len(scales)] *= scales
