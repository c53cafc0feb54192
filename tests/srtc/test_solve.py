import numpy as np
import pytest
from scipy import sparse

from srtomo_srtc.solve import SymmetricTiles

RNG = np.random.default_rng(5)


def _matrix(n: int) -> np.ndarray:
    A = RNG.standard_normal((n, 2 * n))
    return A @ A.T / n + 0.1 * np.eye(n)


@pytest.fixture(scope="module")
def S() -> np.ndarray:
    return _matrix(1300)  # three tiles across, unequal


def test_it_is_the_matrix_that_was_written(S: np.ndarray) -> None:
    tiles = SymmetricTiles(len(S))
    for row, column in ((0, 0), (700, 0), (700, 700)):
        last = 700 if column == 0 else 1300
        tiles.write(row, column, S[row : 700 if row == 0 else 1300, column:last])
    np.testing.assert_allclose(tiles.dense(), S, rtol=1e-14)
    assert tiles.trace() == pytest.approx(np.trace(S))
    assert np.array_equal(tiles.dense(), tiles.dense().T)


def test_arithmetic_before_the_factor(S: np.ndarray) -> None:
    tiles = SymmetricTiles.of(S)
    B, U, V = (RNG.standard_normal((len(S), 3)) for _ in range(3))
    np.testing.assert_allclose(tiles.product(B), S @ B, atol=1e-9)
    tiles.add_symmetric(U, V)
    beside = np.ones(len(S) - 700)
    N = sparse.diags_array([np.arange(len(S)) / 100, beside, beside], offsets=[0, 700, -700])
    tiles.add(N.tocsr())
    np.testing.assert_allclose(tiles.dense(), S + U @ V.T + V @ U.T + N.toarray(), atol=1e-11)
    M = np.linalg.qr(B)[0]
    projected = SymmetricTiles.of(S)
    projected.project(M, gamma=2.0)
    P = np.eye(len(S)) - M @ M.T
    np.testing.assert_allclose(projected.dense(), P @ S @ P + 2.0 * M @ M.T, atol=1e-9)


def test_a_part_is_that_of_the_matrix(S: np.ndarray) -> None:
    which = np.concatenate([np.arange(3, 900, 2), np.arange(1100, len(S))])
    np.testing.assert_array_equal(
        SymmetricTiles.of(S).part(which).dense(), SymmetricTiles.of(S).dense()[np.ix_(which, which)]
    )


@pytest.mark.parametrize(("dtype", "error"), [(np.float64, 1e-12), (np.float32, 1e-4)])
@pytest.mark.parametrize("threads", [1, 3])
def test_division(S: np.ndarray, dtype: type, error: float, threads: int) -> None:
    B = RNG.standard_normal((600, len(S)))
    tiles, X = SymmetricTiles.of(S.astype(dtype)), B.astype(dtype)
    shares: list[float] = []
    tiles.factor(threads, shares.append)
    tiles.divide(X, threads, shares.append)
    np.testing.assert_allclose(X @ S, B, atol=error * np.abs(B).max())
    assert shares.count(1.0) == 2
    assert all(0 < share <= 1 for share in shares)


def test_threads_do_not_change_a_bit(S: np.ndarray) -> None:
    results = []
    for threads in (1, 2):
        tiles, X = SymmetricTiles.of(S), np.eye(4, len(S))
        tiles.factor(threads)
        tiles.divide(X, 1)
        results.append(X.tobytes())
    assert results[0] == results[1]


def test_an_indefinite_matrix_is_refused(S: np.ndarray) -> None:
    tiles = SymmetricTiles.of(S)
    tiles.add(sparse.csr_array(np.diag(np.where(np.arange(len(S)) == 900, -100.0, 0.0))))
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite: row 900"):
        tiles.factor()


def test_it_can_be_interrupted(S: np.ndarray) -> None:
    def interrupt(done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        SymmetricTiles.of(S).factor(2, interrupt)
