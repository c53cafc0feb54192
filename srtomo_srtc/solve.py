"""Large symmetric systems in tiles: half of the matrix, factored where it lies, on a given number of threads.

LAPACK's own ``spotrf`` does not survive 40000 rows everywhere, and nothing that it does can be interrupted or tells how
far it is. Here each tile is one matrix product.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy import sparse
from scipy.linalg import get_lapack_funcs

from srtomo_srtc.parallel import Progress, run, silent

Matrix = NDArray[np.floating]

_TILES = 24  # across, as long as they are neither so small that products are slow nor so large that threads wait
_SMALLEST, _LARGEST = 512, 4096
_ROWS = 1024  # divided at a time: products of half as many are a tenth slower, more would be long between two reports


class SymmetricTiles:
    """A symmetric matrix S of which the lower half is kept.

    Attributes:
        starts: first row of each row of tiles; the last entry is n.
        tiles: ``tiles[i][j]`` for j <= i; of those on the diagonal only the lower half is read.
    """

    def __init__(self, n: int, dtype: DTypeLike = np.float64) -> None:
        """All zero.

        Args:
            dtype: float32 or float64.
        """
        across = math.ceil(n / min(max(n / _TILES, _SMALLEST), _LARGEST))
        self.starts = [n * i // across for i in range(across + 1)]
        sizes = [b - a for a, b in pairwise(self.starts)]
        self.dtype = np.dtype(dtype)
        # one piece of memory, which goes back to the system as a whole; the heap would keep that of single tiles
        memory = np.zeros(sum(size * end for size, end in zip(sizes, self.starts[1:], strict=True)), self.dtype)
        self.tiles: list[list[Matrix]] = []
        for i, size in enumerate(sizes):
            *row, memory = np.split(memory, [size * end for end in self.starts[1 : i + 2]])
            self.tiles.append([tile.reshape(size, -1) for tile in row])

    @classmethod
    def of(cls, S: Matrix) -> SymmetricTiles:
        """The lower half of a dense matrix, (n, n)."""
        tiles = cls(len(S), S.dtype)
        tiles.write(0, 0, S)
        return tiles

    @staticmethod
    def bytes_needed(n: int, dtype: DTypeLike = np.float64) -> float:
        """Size of the half of an (n, n) matrix, about."""
        return np.dtype(dtype).itemsize * n * (n / 2 + min(max(n / _TILES, _SMALLEST), _LARGEST))

    def __len__(self) -> int:
        return self.starts[-1]

    def write(self, row: int, column: int, values: Matrix) -> None:
        """Set a block that begins at (row, column); what of it lies above the diagonal tiles is left out."""
        for i, (top, bottom) in enumerate(pairwise(self.starts)):
            rows = slice(max(top, row), min(bottom, row + len(values)))
            if rows.start >= rows.stop:
                continue
            for j, (left, right) in enumerate(pairwise(self.starts[: i + 2])):
                columns = slice(max(left, column), min(right, column + values.shape[1]))
                if columns.start < columns.stop:
                    self.tiles[i][j][rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = (
                        values[rows.start - row : rows.stop - row, columns.start - column : columns.stop - column]
                    )

    def part(self, which: NDArray[np.intp]) -> SymmetricTiles:
        """Some rows and the same columns, in ascending order."""
        out = SymmetricTiles(len(which), self.dtype)
        bounds = np.searchsorted(which, self.starts)
        inside = [which[a:b] - start for (a, b), start in zip(pairwise(bounds), self.starts)]
        for i, row in enumerate(self.tiles):
            for j, tile in enumerate(row):
                out.write(bounds[i], bounds[j], tile[np.ix_(inside[i], inside[j])])
        return out

    def dense(self) -> Matrix:
        """(n, n), exactly symmetric."""
        out = np.empty((len(self), len(self)), self.dtype)
        for i, row in enumerate(self.tiles):
            for j, tile in enumerate(row[:-1]):
                out[self._part(i), self._part(j)] = tile
                out[self._part(j), self._part(i)] = tile.T
            lower = np.tril(row[-1])
            out[self._part(i), self._part(i)] = lower + np.tril(lower, -1).T
        return out

    def trace(self) -> float:
        """Sum of the diagonal."""
        return float(sum(row[-1].trace(dtype=np.float64) for row in self.tiles))

    def add(self, matrix: sparse.csr_array) -> None:
        """S += a sparse symmetric matrix (n, n)."""
        for i, row in enumerate(self.tiles):
            strip = matrix[self._part(i)]
            for j, tile in enumerate(row):
                part = strip[:, self._part(j)].tocoo()
                tile[part.row, part.col] += part.data.astype(self.dtype)

    def product(self, B: Matrix) -> NDArray[np.float64]:
        """S B, (n, m), before :meth:`factor`."""
        out = np.zeros(B.shape)
        for i, row in enumerate(self.tiles):
            for j, tile in enumerate(row[:-1]):
                out[self._part(i)] += tile @ B[self._part(j)].astype(self.dtype)
                out[self._part(j)] += tile.T @ B[self._part(i)].astype(self.dtype)
            lower = np.tril(row[-1])
            out[self._part(i)] += (lower + np.tril(lower, -1).T) @ B[self._part(i)].astype(self.dtype)
        return out

    def add_symmetric(self, U: Matrix, V: Matrix) -> None:
        """S += U V^T + V U^T, with U and V (n, m)."""
        left, right = (np.hstack(pair).astype(self.dtype) for pair in ((U, V), (V, U)))
        for i, row in enumerate(self.tiles):
            for j, tile in enumerate(row):
                tile += left[self._part(i)] @ right[self._part(j)].T

    def project(self, means: NDArray[np.float64], gamma: float) -> None:
        """Turn S into ``P S P + gamma (I - P)``, ``P = I - M M^T`` with the orthonormal M = ``means`` (n, m)."""
        product = self.product(means)
        half = product - 0.5 * means @ (means.T @ product + gamma * np.eye(means.shape[1]))
        self.add_symmetric(-means, half)

    def factor(self, threads: int = 1, progress: Progress = silent) -> None:
        """Cholesky: S = L L^T, in place, with the inverse of L in the diagonal tiles.

        Raises:
            np.linalg.LinAlgError: S is not positive definite.
        """
        potrf, trtri = get_lapack_funcs(("potrf", "trtri"), dtype=self.dtype)
        across, n = len(self.tiles), len(self)
        for k, row in enumerate(self.tiles):
            # a C-ordered lower triangle is LAPACK's upper one
            upper, failed = potrf(row[k].T, lower=0, overwrite_a=1, clean=1)
            if failed:
                raise np.linalg.LinAlgError(f"not positive definite: row {self.starts[k] + failed - 1}")
            row[k][:] = trtri(upper, lower=0, overwrite_c=1)[0].T

            below = range(k + 1, across)
            run([partial(self._scale, i, k) for i in below], threads)
            run([partial(self._subtract, i, j, k) for i in below for j in range(k + 1, i + 1)], threads)
            progress(1 - (1 - self.starts[k + 1] / n) ** 3)

    def divide(self, B: Matrix, threads: int = 1, progress: Progress = silent) -> None:
        """Turn B (m, n), C-ordered, into ``B S^-1`` where it lies; after :meth:`factor`."""
        # as many for each thread
        pieces = threads * math.ceil(len(B) / (threads * _ROWS))
        bounds = [len(B) * p // pieces for p in range(pieces + 1)]

        def solve(rows: slice) -> None:
            part = B[rows]
            for i, row in enumerate(self.tiles):
                mine = part[:, self._part(i)]
                for j, tile in enumerate(row[:-1]):
                    mine -= part[:, self._part(j)] @ tile.T
                mine[:] = mine @ row[i].T
            for i in reversed(range(len(self.tiles))):
                mine = part[:, self._part(i)]
                mine[:] = mine @ self.tiles[i][i]
                for j, tile in enumerate(self.tiles[i][:-1]):
                    part[:, self._part(j)] -= mine @ tile

        run([partial(solve, slice(*rows)) for rows in pairwise(bounds)], threads, progress)

    def _scale(self, i: int, k: int) -> None:
        self.tiles[i][k][:] = self.tiles[i][k] @ self.tiles[k][k].T

    def _subtract(self, i: int, j: int, k: int) -> None:
        self.tiles[i][j] -= self.tiles[i][k] @ self.tiles[j][k].T

    def _part(self, i: int) -> slice:
        return slice(self.starts[i], self.starts[i + 1])
