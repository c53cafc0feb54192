"""Statistics of a layer's nodes, exact and sparse."""

import numpy as np
import pytest

from srtomo_srtc.atmosphere import METRES_PER_RADIAN, Profile, covariance
from srtomo_srtc.layer_prior import exact_covariance, exact_inverse, laplacian, sparse_inverse
from srtomo_srtc.raytrace import LayerGrid

PROFILE = Profile(0.15, 25.0, np.array([0.0, 5000.0]), np.array([0.7, 0.3]))


@pytest.fixture(scope="module")
def grid() -> LayerGrid:
    """An ellipse off the centre."""
    x, y = np.meshgrid(0.25 * np.arange(-14, 14), 0.25 * np.arange(-10, 14))
    inside = (x / 3.2) ** 2 + ((y - 0.4) / 2.6) ** 2 < 1
    return LayerGrid.under(x[inside] + 0.01, y[inside], 0.25)


def test_exact_covariance_is_that_of_the_distances(grid: LayerGrid) -> None:
    x, y = grid.points
    rho = np.hypot(x[:, None] - x, y[:, None] - y)
    expected = 0.3 * METRES_PER_RADIAN**2 * covariance(rho, PROFILE.r0, PROFILE.outer_scale)
    S = exact_covariance(grid, PROFILE, 1)
    np.testing.assert_allclose(S, expected, rtol=1e-12)
    np.testing.assert_allclose(exact_inverse(grid, PROFILE, 1) @ S, np.eye(len(S)), atol=1e-9)


def test_laplacian_is_the_stencil_of_eq_37_with_folded_edges() -> None:
    x, y = np.meshgrid(np.arange(3.0), np.arange(4.0))
    L = laplacian(LayerGrid.under(x.ravel(), y.ravel(), 1.0)).toarray().reshape(4, 3, 4, 3)
    inside = [[0, 0.25, 0], [0.25, -1, 0.25], [0, 0.25, 0], [0, 0, 0]]
    left_edge = [[0.25, 0, 0], [-1, 0.5, 0], [0.25, 0, 0], [0, 0, 0]]
    corner = [[-1, 0.5, 0], [0.5, 0, 0], [0, 0, 0], [0, 0, 0]]
    np.testing.assert_array_equal(L[1, 1], inside)
    np.testing.assert_array_equal(L[1, 0], left_edge)
    np.testing.assert_array_equal(L[0, 0], corner)
    np.testing.assert_array_equal(L.sum(axis=(2, 3)), 0)
    row = LayerGrid.under(np.arange(3.0), np.zeros(3), 1.0)
    np.testing.assert_array_equal(laplacian(row).toarray(), [[-0.5, 0.5, 0], [0.25, -0.5, 0.25], [0, 0.5, -0.5]])


def _without_hold(grid: LayerGrid, inverse: np.ndarray) -> np.ndarray:
    """The inverse without what holds the first node; piston then costs nothing."""
    inverse = inverse.copy()
    inverse[0, 0] -= inverse.sum()
    return inverse


def test_scale_makes_every_row_of_the_laplacian_white_in_the_layer_s_turbulence(grid: LayerGrid) -> None:
    L, S = laplacian(grid).toarray(), exact_covariance(grid, PROFILE, 0)
    variance = np.diag(L @ S @ L.T)
    inverse = sparse_inverse(grid, PROFILE, 0).toarray()
    assert inverse.sum() == pytest.approx(1 / variance[0], rel=1e-6)
    inverse = _without_hold(grid, inverse)
    np.testing.assert_allclose(inverse, L.T @ np.diag(1 / variance) @ L, rtol=1e-6, atol=1e-6 * inverse.max())
    # as the exact inverse does
    assert np.trace(inverse @ S) == pytest.approx(grid.n_nodes, rel=1e-6)


@pytest.mark.parametrize(("step", "r0", "fraction"), [(0.25, 0.15, 0.7), (0.1, 0.3, 0.3)])
def test_scale_in_closed_form(step: float, r0: float, fraction: float) -> None:
    x, y = np.meshgrid(step * np.arange(11), step * np.arange(9))
    grid = LayerGrid.under(x.ravel(), y.ravel(), step)
    nearly_kolmogorov = Profile(r0, 1e5, np.array([0.0]), np.array([fraction]))
    inverse = sparse_inverse(grid, nearly_kolmogorov, 0).toarray()
    # 1/v times the sum of squares of the stencil, far from the edges
    v = 1.0856 * (step / r0) ** (5 / 3) * fraction * METRES_PER_RADIAN**2
    middle = grid.numbers[4, 5]
    assert inverse[middle, middle] == pytest.approx((1 + 4 / 16) / v, rel=2e-3)


def test_sparse_inverse_stands_for_the_exact_one_between_outer_scale_and_step(grid: LayerGrid) -> None:
    exact, inverse = exact_inverse(grid, PROFILE, 0), _without_hold(grid, sparse_inverse(grid, PROFILE, 0).toarray())
    x, y = grid.points
    for k in (0.5, 0.7, 1.0, 1.4, 1.8):
        shape = np.cos(2 * np.pi * k * (0.8 * x + 0.6 * y) + 0.3)
        assert shape @ inverse @ shape == pytest.approx(shape @ exact @ shape, rel=0.2)


def test_every_part_of_a_grid_has_its_piston_held() -> None:
    x, y = np.meshgrid(np.arange(4.0), np.arange(4.0))
    apart = LayerGrid.under(np.r_[x.ravel(), x.ravel() + 9], np.r_[y.ravel(), y.ravel() + 9], 1.0)
    assert apart.n_nodes == 32
    assert np.linalg.eigvalsh(sparse_inverse(apart, PROFILE, 0).toarray())[0] > 0
