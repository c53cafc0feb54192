"""Conjugate gradients against a dense solution."""

import numpy as np
import pytest

from srtomo_srtc import conjugate_gradients


@pytest.fixture
def spread() -> np.ndarray:
    """Symmetric, with eigenvalues from 1 to 1e4: twelve large ones."""
    rng = np.random.default_rng(3)
    basis = np.linalg.qr(rng.normal(size=(150, 150)))[0]
    return basis @ np.diag(1 + np.r_[np.geomspace(1e4, 10, 12), np.zeros(138)]) @ basis.T


def test_solves_every_column_to_its_tolerance(spread: np.ndarray) -> None:
    b = np.random.default_rng(4).normal(size=(150, 5)) * [1, 1e-6, 0, 1e6, 1]
    x = conjugate_gradients.solve(lambda v: spread @ v, b, lambda v: v, tolerance=1e-10)
    np.testing.assert_array_less(np.linalg.norm(spread @ x - b, axis=0), 1.01e-10 * np.linalg.norm(b, axis=0) + 1e-300)
    np.testing.assert_array_equal(x[:, 2], 0)


def test_says_when_it_does_not_converge(spread: np.ndarray) -> None:
    with pytest.raises(ArithmeticError, match="2 of 2 columns above 1e-10 after 3 iterations"):
        conjugate_gradients.solve(
            lambda v: spread @ v, np.eye(150)[:, :2], lambda v: v, tolerance=1e-10, max_iterations=3
        )


def test_nystrom_takes_large_eigenvalues_down_to_one(spread: np.ndarray) -> None:
    B = spread - np.eye(150)
    precondition = conjugate_gradients.nystrom(lambda v: B @ v, 150, 20)
    eigenvalues = np.linalg.eigvals(precondition(spread)).real
    np.testing.assert_allclose(eigenvalues, 1, atol=1e-6)
