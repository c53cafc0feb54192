"""Wavefronts on the layers from slopes ``s = H phi + eta``, by both forms of the LMMSE (eq. 13).

H = G T_alpha is sparse (eq. 12). With C whatever is wanted of the layers (the identity, rays towards science targets,
or those and the fit of mirrors to them), the matrix C W_L is::

    covariance    C Sigma H^T P [P (H Sigma H^T + N) P + gamma (I - P)]^-1 P
    information   C (H^T N' H + Sigma^-1)^-1 H^T N'          N' = N^-1 - N^-1 M (M^T N^-1 M)^-1 M^T N^-1

M spans the slopes of modes that a sensor is blind to and P = I - M M^T: N' is the limit of N^-1 when those slopes have
unlimited noise, and the two forms are one matrix.

Eq. 40 finds it column by column, one for every slope. What is inverted is symmetric, so that its rows can be had in the
same way, one for every row of C: there are fewer commands than slopes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import block_diag, cho_factor, cho_solve, cholesky, solve_triangular
from scipy.sparse.linalg import splu

from srtomo_srtc import conjugate_gradients
from srtomo_srtc.conjugate_gradients import Operator
from srtomo_srtc.estimator import estimator

Array = NDArray[np.float64]

COLUMNS = 128
"""Right-hand sides that are solved for at a time."""

_LONG = 10  # times the median of entries in a row of H: such rows would fill the sparse matrix and go apart


def covariance_form(
    wanted: Array, H: sparse.csr_array, covariances: Sequence[Array], noise: sparse.sparray, blind: Array
) -> Array:
    """``C W_L`` by the first line of eq. 13.

    Args:
        wanted: (n, n_nodes) C; the identity gives W_L itself.
        H: (n_slopes, n_nodes) 1/m.
        covariances: Sigma of each layer's nodes, m^2.
        noise: (n_slopes, n_slopes) N, rad^2.
        blind: (n_slopes, n) M, orthonormal.

    Returns:
        (n, n_slopes) m/rad if C has no unit.
    """
    S = noise.toarray()
    cross = np.zeros((len(S), len(wanted)))
    for layer, covariance in zip(_slices(covariances), covariances, strict=True):
        slopes_nodes = H[:, layer] @ covariance
        S += H[:, layer] @ slopes_nodes.T
        cross += slopes_nodes @ wanted[:, layer].T
    return estimator(S, cross, blind).T


def information_form(
    wanted: Array,
    H: sparse.csr_array,
    inverses: Sequence[Any],
    precision: sparse.sparray,
    blind: Array,
    *,
    coarse: Sequence[sparse.csr_array] | None = None,
    tolerance: float = 1e-6,
    progress: Callable[[float], None] | None = None,
) -> Array:
    """``C W_L`` by the second line of eq. 13, row by row (eq. 38 and 40).

    Args:
        wanted: (n, n_nodes) C; the identity gives W_L itself.
        H: (n_slopes, n_nodes) 1/m.
        inverses: Sigma^-1 of each layer's nodes, 1/m^2, all dense or all sparse.
        precision: (n_slopes, n_slopes) N^-1, 1/rad^2.
        blind: (n_slopes, n) M.
        coarse: for each layer (n_nodes, n_coarse), the interpolation from a coarser grid. With it the solution is by
            conjugate gradients, without by a factorisation.
        tolerance: of conjugate gradients, relative residual.
        progress: called with the share of the rows that are done, 0 to 1.

    Returns:
        (n, n_slopes) m/rad if C has no unit.

    Raises:
        ArithmeticError: conjugate gradients do not converge.
    """
    information = _Information(H, inverses, precision, blind)
    if coarse is None:
        solve = information.factorised()
    else:
        solve = partial(
            conjugate_gradients.solve,
            information.product,
            precondition=information.preconditioner(coarse),
            tolerance=tolerance,
        )
    out = np.empty((len(wanted), H.shape[0]))
    for start in range(0, len(wanted), COLUMNS):
        if progress is not None:
            progress(start / len(wanted))
        rows = slice(start, start + COLUMNS)
        out[rows] = information.weighted(H @ solve(np.ascontiguousarray(wanted[rows].T))).T
    return out


class _Information:
    """``A = H^T N' H + Sigma^-1``, as a sparse or block-diagonal part and a few outer products ``K diag(sign) K^T``.

    The outer products are the blind modes, taken away, and rows of H with many entries (a sensor with one lens over
    the whole pupil): either would fill the sparse part.
    """

    def __init__(self, H: sparse.csr_array, inverses: Sequence[Any], precision: sparse.sparray, blind: Array) -> None:
        self._inverses = inverses
        self._layers = _slices(inverses)
        self._precision = precision.tocsr()
        self._NM = self._precision @ blind
        self._seen = cholesky(blind.T @ self._NM, lower=True) if blind.size else np.zeros((0, 0))

        entries = np.diff(H.indptr)
        long = entries > _LONG * np.median(entries)
        # with the rows that they share noise with
        long = abs(self._precision) @ long.astype(np.float64) > 0
        rows, far = np.flatnonzero(~long), np.flatnonzero(long)
        self._H = H[rows]
        self._HtN = (self._H.T @ self._precision[rows][:, rows]).tocsr()
        added = H[far].T @ cholesky(self._precision[far][:, far].toarray(), lower=True) if len(far) else None
        taken = self._whiten((H.T @ self._NM).T).T
        self._K = taken if added is None else np.hstack([added, taken])
        self._sign = np.repeat([1.0, -1.0], [len(far), taken.shape[1]])

    def weighted(self, slopes: Array) -> Array:
        """N' times slopes (n_slopes, n)."""
        seen = self._whiten(self._NM.T @ slopes)
        return self._precision @ slopes - self._NM @ self._whiten(seen, transposed=True)

    def product(self, x: Array) -> Array:
        """A times x (n_nodes, n)."""
        out = self._HtN @ (self._H @ x) + self._K @ (self._sign[:, None] * (self._K.T @ x))
        for layer, inverse in zip(self._layers, self._inverses, strict=True):
            out[layer] += inverse @ x[layer]
        return out

    def factorised(self) -> Operator:
        """The inverse of A, by sparse LU and Woodbury's identity, or by dense Cholesky if the prior is dense."""
        if not sparse.issparse(self._inverses[0]):
            A = block_diag(*self._inverses)
            A += (self._HtN @ self._H).toarray()
            A += (self._K * self._sign) @ self._K.T
            factor = cho_factor(A.T, overwrite_a=True)
            return lambda b: cho_solve(factor, b)
        solve = _sparse_solve(self._HtN @ self._H + sparse.block_diag(self._inverses))
        across = solve(self._K)
        small = np.linalg.inv(np.diag(self._sign) + self._K.T @ across)

        def solve_all(b: Array) -> Array:
            x = solve(b)
            return x - across @ (small @ (self._K.T @ x))

        return solve_all

    def preconditioner(self, coarse: Sequence[sparse.csr_array]) -> Operator:
        """Every layer alone, plus all layers together on coarser grids.

        What light through several layers cannot tell apart are their large scales, and there are few of those.
        """
        layers: list[Operator] = []
        for layer, inverse in zip(self._layers, self._inverses, strict=True):
            A = self._HtN[layer] @ self._H[:, layer] + inverse
            layers.append(_sparse_solve(A) if sparse.issparse(A) else partial(cho_solve, cho_factor(A)))

        Z = sparse.block_diag(coarse, format="csr")
        K = Z.T @ self._K
        together = ((Z.T @ self._HtN) @ (self._H @ Z)).toarray() + (K * self._sign) @ K.T
        together += block_diag(
            *(_dense(z.T @ (inverse @ z)) for z, inverse in zip(coarse, self._inverses, strict=True))
        )
        factor = cho_factor(together)

        def apply(b: Array) -> Array:
            alone = np.concatenate([solve(b[layer]) for solve, layer in zip(layers, self._layers, strict=True)])
            return alone + Z @ cho_solve(factor, Z.T @ b)

        return apply

    def _whiten(self, matrix: Array, transposed: bool = False) -> Array:
        return solve_triangular(self._seen, matrix, lower=True, trans="T" if transposed else "N")


def _sparse_solve(A: sparse.sparray) -> Operator:
    """For a symmetric, positive definite A."""
    factor = splu(A.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return lambda b: factor.solve(np.ascontiguousarray(b))


def _dense(matrix: Any) -> Array:
    return matrix.toarray() if sparse.issparse(matrix) else matrix


def _slices(blocks: Sequence[Any]) -> list[slice]:
    """Where the nodes of each layer are."""
    ends = np.cumsum([block.shape[0] for block in blocks])
    return [slice(end - block.shape[0], end) for end, block in zip(ends, blocks, strict=True)]
