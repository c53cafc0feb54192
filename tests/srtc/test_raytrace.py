"""Rays through layer grids."""

import numpy as np
import pytest
from scipy import ndimage

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.gradient import gradient_operator
from srtomo_srtc.model import sightlines
from srtomo_srtc.raytrace import LayerGrid, layer_grids, propagation


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def _surface(layer: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear, another one on every layer: what interpolation has to give back exactly."""
    a, b, c, d = np.random.default_rng(layer).normal(size=4)
    return a + b * x + c * y + d * x * y


def test_shift_rotation_star_and_cone_are_in_the_rays(mini: System) -> None:
    profile, layout = Profile.of(mini), Layout(mini)
    sensors = sightlines(mini, layout, profile)
    grids = layer_grids([s.nodes for s in sensors], [0.25, 0.4, 0.3])
    on_nodes = np.concatenate([_surface(l, *grid.points) for l, grid in enumerate(grids)])
    for sensor, place, sight in zip(mini.sensors, layout.sensors, sensors):
        star = mini.star_of(sensor)
        operator = gradient_operator(mini.telescope, place)
        expected = np.zeros(len(operator.x))
        for l, height in enumerate(profile.heights):
            # the pupil's nodes are shifted and rotated ones: test_gradient holds that
            shrink = 1 - height / mini.los_range(star)
            x, y = shrink * operator.x + height * star.position.x, shrink * operator.y + height * star.position.y
            expected += _surface(l, x, y)
        T = propagation(grids, sight.nodes)
        np.testing.assert_allclose(T @ on_nodes, expected, atol=1e-12 * np.abs(expected).max())
        assert np.diff(T.indptr).max() <= 4 * len(grids)
        assert T.data.min() > 0


def test_a_ray_through_a_node_needs_no_other() -> None:
    x, y = np.meshgrid(0.5 * np.arange(-3, 3), 0.5 * np.arange(2, 5))
    grid = LayerGrid.under(x.ravel(), y.ravel(), 0.5)
    assert grid.mask.shape == (3, 6)
    np.testing.assert_array_equal(grid.interpolation(x.ravel(), y.ravel()).toarray(), np.eye(18))
    np.testing.assert_allclose(np.stack(grid.points), [x.ravel(), y.ravel()])


def test_a_grid_finer_than_the_rays_hangs_together(mini: System) -> None:
    nodes = sightlines(mini, Layout(mini), Profile.of(mini))[0].nodes
    grid = LayerGrid.under(nodes.x[2], nodes.y[2], 0.05)
    assert ndimage.label(grid.mask)[1] == 1
    np.testing.assert_array_equal(ndimage.binary_fill_holes(grid.mask), grid.mask)


def test_rays_beside_the_nodes_are_refused() -> None:
    x, y = np.array([0.1, 1.9, 1.1]), np.array([0.1, 0.2, 1.3])
    grid = LayerGrid.under(x, y, 1.0)
    with pytest.raises(ValueError, match="a ray passes where there are no nodes"):
        propagation([grid], Footprints(np.array([[2.1]]), np.array([[0.1]])))
    with pytest.raises(ValueError, match="a ray passes where there are no nodes"):
        grid.interpolation(np.array([-0.1]), np.array([0.1]))


def test_a_coarser_grid_interpolates_a_finer_one(mini: System) -> None:
    nodes = sightlines(mini, Layout(mini), Profile.of(mini))[1].nodes
    grid = LayerGrid.under(nodes.x[1], nodes.y[1], 0.25)
    coarse = LayerGrid.under(*grid.points, 0.75)
    np.testing.assert_allclose(grid.refinement(3) @ _surface(0, *coarse.points), _surface(0, *grid.points), atol=1e-12)
