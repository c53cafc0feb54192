"""Preconditioned conjugate gradients for many right-hand sides at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular, svd

Array = NDArray[np.float64]
Operator = Callable[[Array], Array]

MAX_ITERATIONS = 2000


def solve(
    product: Operator,
    right: Array,
    precondition: Operator,
    *,
    tolerance: float,
    max_iterations: int = MAX_ITERATIONS,
) -> Array:
    """Solve ``A x = b`` for every column b; each has its own step lengths, the products are shared.

    Args:
        product: A times a matrix (n, m); A symmetric, positive definite where the columns of ``right`` lie.
        right: (n, m).
        precondition: an approximate, symmetric and positive inverse of A times a matrix (n, m).
        tolerance: on the norm of each column's residual, relative to that of the column.
        max_iterations: before giving up.

    Returns:
        (n, m).

    Raises:
        ArithmeticError: a residual is above the tolerance after ``max_iterations``.
    """
    x = np.zeros_like(right)
    goal = tolerance * np.linalg.norm(right, axis=0)
    going = np.flatnonzero(goal)
    residual = right[:, going]
    z = precondition(residual)
    direction = z.copy()
    rho = _dots(residual, z)
    for _ in range(max_iterations):
        if not len(going):
            return x
        image = product(direction)
        step = rho / _dots(direction, image)
        x[:, going] += step * direction
        residual -= step * image
        left = np.linalg.norm(residual, axis=0) > goal[going]
        if not left.all():
            going, residual, direction, rho = going[left], residual[:, left], direction[:, left], rho[left]
        z = precondition(residual)
        previous, rho = rho, _dots(residual, z)
        direction = z + (rho / previous) * direction
    if len(going):
        raise ArithmeticError(
            f"conjugate gradients: {len(going)} of {right.shape[1]} columns above {tolerance:g} "
            f"after {max_iterations} iterations"
        )
    return x


def _dots(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->j", a, b)


def nystrom(product: Operator, n: int, rank: int) -> Operator:
    """A preconditioner for ``I + B`` when few eigenvalues of B are much above 1.

    Randomised Nystrom approximation ``B = U diag(l) U^T`` (Frangella, Tropp and Udell 2023), with its smallest l in
    place of the eigenvalues that it leaves out. The same every time.

    Args:
        product: B times a matrix (n, m); B symmetric and positive semi-definite.
        n: rows of B.
        rank: of the approximation.
    """
    start = np.linalg.qr(product(np.random.default_rng(0).standard_normal((n, rank))))[0]
    image = product(start)
    # lifts B off zero by the rounding of the product: the approximation needs a positive matrix
    lift = np.finfo(np.float64).eps * np.linalg.norm(image)
    image += lift * start
    root = solve_triangular(cholesky(start.T @ image), image.T, trans="T").T
    U, singular, _ = svd(root, full_matrices=False, overwrite_a=True)
    values = np.maximum(singular**2 - lift, 0)
    excess = ((values[-1] + 1) / (values + 1) - 1)[:, None]
    return lambda b: b + U @ (excess * (U.T @ b))
