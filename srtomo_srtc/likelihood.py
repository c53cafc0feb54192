"""The Gaussian likelihood of a measured covariance, and the parameters at which it is largest.

For zero-mean slopes of covariance ``C = sum_i theta_i B_i`` the log-likelihood of a frame is, with S the measured
second moment, ``-1/2 (log det C + tr(C^-1 S))``. Its score and its Fisher information are

    g_i = 1/2 tr(C^-1 (S - C) C^-1 B_i)          F_ij = 1/2 tr(C^-1 B_i C^-1 B_j)

and a step of Fisher scoring is a least-squares fit of S, whitened by the present C. That weighting decides: without it
the strong smooth modes, of which there are few and which hardly change from frame to frame, are all that counts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import lapack
from scipy.optimize import nnls

Array = NDArray[np.float64]
Single = NDArray[np.float32]

_RIDGE = 1e-7  # of the information, where layers are all but the same
_ROWS = 16  # whose products are summed in float32


def information(inverse: Single, bases: Sequence[Single | sparse.csr_array]) -> Array:
    """(n_parameters, n_parameters) F of one frame.

    Args:
        inverse: (n, n) C^-1.
        bases: (n, n) B_i of each parameter; a sparse one saves a product.
    """
    n = len(inverse)
    products = np.empty((len(bases), n, n), np.float32)
    for basis, product in zip(bases, products):
        product[:] = inverse @ basis
    F = np.zeros((len(bases), len(bases)))
    # not all rows: one sum in float32 would be too long
    for start in range(0, n, _ROWS):
        rows = slice(start, start + _ROWS)
        turned = products[:, :, rows].transpose(0, 2, 1)
        F += products[:, rows].reshape(len(F), -1) @ turned.reshape(len(F), -1).T
    return 0.25 * (F + F.T)


def with_ridge(F: Array) -> Array:
    """``F``, which is changed, so that it can be inverted."""
    F[np.diag_indices_from(F)] *= 1 + _RIDGE
    return F


def score(inverse: Single, difference: Single, bases: Sequence[Single] | Single) -> Array:
    """(n_parameters,) g of one frame.

    Args:
        difference: (n, n) S - C.
    """
    seen = np.asarray(inverse @ difference @ inverse, np.float32)
    return np.array([0.5 * _dot(seen, basis) for basis in bases])


def _dot(a: Single, b: Single) -> float:
    # row by row: one sum in float32 would be too long
    return float(np.einsum("ij,ij->i", a, b).sum(dtype=np.float64))


def inverse_of(C: Array) -> Array:
    """C^-1 of a symmetric positive definite matrix, (n, n).

    Raises:
        np.linalg.LinAlgError: it is not.
    """
    factor, failed = lapack.dpotrf(C, lower=1, clean=0)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
    lower = np.tril(inverse)
    lower += np.tril(lower, -1).T
    return np.asarray(lower)


def non_negative_step(theta: Array, g: Array, F: Array) -> Array:
    """The theta >= 0 that the quadratic model of the likelihood about ``theta`` takes for best, (n_parameters,)."""
    scale = 1 / np.sqrt(np.diag(F))
    root = np.linalg.cholesky(F * np.outer(scale, scale)).T
    aim = root @ (theta / scale) + np.linalg.solve(root.T, g * scale)
    return np.asarray(nnls(root, aim)[0] * scale)
