"""The matrix-vector kernels of the loop.

One kernel so far. Matrices are stored by columns, and a product is a sum of columns in slope order, four at a time,
each element rounded after every multiplication and every addition. No order depends on a vector width and no
multiply-add is fused, so it gives the same bits on every machine: replays and golden bags rely on that.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

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


@numba.njit("b1(f4[::1])", nogil=True, cache=True, fastmath=False)
def all_finite(vector: Floats) -> bool:
    """Whether no element is NaN or infinite. Any thread; releases the interpreter."""
    for value in vector:
        if not np.isfinite(value):
            return False
    return True
