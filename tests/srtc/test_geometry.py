import numpy as np
import pytest

from srtomo_core.system import Direction, Telescope
from srtomo_srtc.geometry import footprints, pupil_grid


def test_footprints_shrink_towards_a_near_star_and_move_towards_it() -> None:
    star = Direction(x=1e-4, y=-2e-4)
    seen = footprints(np.array([2.0, 0.0]), np.array([1.0, 0.0]), star, 90e3, np.array([0.0, 9e3, 90e3]))
    np.testing.assert_allclose(seen.x, [[2, 0], [2 * 0.9 + 0.9, 0.9], [9, 9]], atol=1e-12)
    np.testing.assert_allclose(seen.y, [[1, 0], [1 * 0.9 - 1.8, -1.8], [-18, -18]], atol=1e-12)


def test_a_natural_star_has_no_cone() -> None:
    seen = footprints(np.array([2.0]), np.array([0.0]), Direction(), np.inf, np.array([1e4]))
    assert seen.x[0, 0] == 2.0


def test_pupil_grid_is_the_pupil() -> None:
    telescope = Telescope(diameter=4.0, obscuration=0.25, obscuration_centre=(0.35, -0.2))
    grid = pupil_grid(telescope, 0.1)
    # uniform disc of radius a has <x^2> = a^2/4; the obscuration (area 1/16, at (c_x, c_y)) is taken out of it
    share = 1 / 16
    assert grid.weight.sum() == pytest.approx(1)
    assert grid.weight @ grid.x == pytest.approx(-share * 0.35 / (1 - share), abs=1e-3)
    assert grid.weight @ grid.y == pytest.approx(share * 0.2 / (1 - share), abs=1e-3)
    expected = (1 - share * (0.25 / 4 + 0.35**2)) / (1 - share)
    assert grid.weight @ grid.x**2 == pytest.approx(expected, rel=2e-3)
