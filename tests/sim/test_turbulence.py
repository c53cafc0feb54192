from __future__ import annotations

import math

import numpy as np
import pytest

from srtomo_core.system import Direction, System
from srtomo_sim.sky import wavefronts
from srtomo_sim.spline import add_values
from srtomo_sim.turbulence import METRES_PER_RADIAN, Screens, covariance, grid_for


def test_covariance_closed_form() -> None:
    assert covariance(0.0, 0.15, 25.0) == pytest.approx(0.08631432991183458 * (25 / 0.15) ** (5 / 3), rel=1e-12)
    assert covariance([1.0, 10.0], 0.15, 25.0) == pytest.approx([395.253952, 64.46805737], rel=1e-8)
    # Kolmogorov's 5/3 law where the outer scale is far, to the next order in separation over outer scale
    structure = 2 * (covariance(0.0, 0.15, 1e7) - covariance(0.3, 0.15, 1e7))
    expected = 6.88387718229381 * 2 ** (5 / 3) * (1 - 1.485 * (0.3 / 1e7) ** (1 / 3))
    assert structure == pytest.approx(expected, rel=3e-4)


def test_structure_function_of_drifting_screens(mini: System) -> None:
    """At one grid step within 2 %, out to the pupil's diameter within an ensemble's scatter; r0 of the whole sky."""
    lags = np.array([1, 2, 4, 10, 20, 40, 80])
    rng = np.random.default_rng(5)
    ratios = []
    for seed in range(10):
        screens = Screens(mini, seed)
        # anywhere on the torus and within a grid step, in four directions
        x, y = rng.uniform(0, screens.grid.size, (2, 3000))
        nowhere = np.zeros((1, 2))
        measured = []
        for lag in lags:
            values = np.zeros((5, 1, len(x)))
            ends = [(0, 0), (lag, 0), (0, lag), (-lag, 0), (0, -lag)]
            for value, (dx, dy) in zip(values, ends, strict=True):
                for phase in screens.phases:
                    add_values(
                        phase, (x + dx) % screens.grid.size, (y + dy) % screens.grid.size, nowhere, np.ones(1), value
                    )
            measured.append(((values[1:] - values[0]) ** 2).mean())
        at_lags = covariance(lags * screens.grid.step, mini.los_r0, mini.atmosphere.outer_scale)
        expected = 2 * (covariance(0.0, mini.los_r0, mini.atmosphere.outer_scale) - at_lags) * METRES_PER_RADIAN**2
        ratios.append(np.array(measured) / expected)
    mean, error = np.mean(ratios, axis=0), np.std(ratios, axis=0) / math.sqrt(len(ratios) - 1)
    assert mean[0] == pytest.approx(1, abs=0.02)
    assert (abs(mean - 1) < 4 * error + 0.005).all(), (mean, error)
    assert error.max() < 0.1


def test_layers_go_with_the_wind(mini: System) -> None:
    """Alone in the sky, a layer's pattern is found where the wind has carried it, past the torus' end too."""
    changes = {"atmosphere.layers.0.fraction": 0.0, "atmosphere.layers.1.fraction": 1.0}
    system = mini.with_changes(changes | {"atmosphere.layers.2.fraction": 0.0})
    screens = Screens(system, 3)
    wind = system.atmosphere.layers[1]
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-2, 2, (2, 50))
    first = wavefronts(screens, np.array([0]), x, y, Direction())[0]
    for frame in (7, 10_000):
        way = wind.wind_speed * frame / system.loop.rate
        there_x, there_y = x + way * math.cos(wind.wind_direction), y + way * math.sin(wind.wind_direction)
        side = screens.grid.size * screens.grid.step
        later = wavefronts(screens, np.array([frame]), there_x % side, there_y % side, Direction())[0]
        assert later == pytest.approx(first, abs=1e-4 * first.std())
    assert np.corrcoef(wavefronts(screens, np.array([7]), x, y, Direction())[0], first)[0, 1] < 0.999


def test_off_axis_stars_look_at_another_part_of_high_layers(mini: System) -> None:
    screens = Screens(mini, 3)
    star = Direction(x=3e-5, y=-2e-5)
    x, y = np.array([0.3, -1.1]), np.array([0.2, 0.7])
    expected = np.zeros((1, 2))
    for phase, height, layer in zip(screens.phases, mini.los_heights, mini.atmosphere.layers, strict=True):
        half_frame = 0.5 / mini.loop.rate * layer.wind_speed
        at_x = x + star.x * height - half_frame * math.cos(layer.wind_direction)
        at_y = y + star.y * height - half_frame * math.sin(layer.wind_direction)
        add_values(phase, at_x / screens.grid.step, at_y / screens.grid.step, np.zeros((1, 2)), np.ones(1), expected)
    assert wavefronts(screens, np.array([0]), x, y, star) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("rotation", [0.0, 0.4])
def test_gradient_averages_over_square_and_exposure(mini: System, rotation: float) -> None:
    """Against mean differences between opposite edges of the square, at many moments of the exposure.

    A surface of splines is not quite band-limited: 0.6 % of the gradient at steps of 5 cm, 0.2 % at 2.5 cm.
    """
    system = mini.with_changes({"loop.rate": 20.0})
    screens = Screens(system, 2)
    side, layer = 0.5, 2
    gradient = screens.gradient(layer, side, rotation)
    rng = np.random.default_rng(3)
    centres = rng.uniform(0, screens.grid.size, (40, 2)) * screens.grid.step
    moments = (np.arange(32) + 0.5) / 32 - 0.5
    edge = ((np.arange(40) + 0.5) / 40 - 0.5) * side
    c, s = math.cos(rotation), math.sin(rotation)

    def surface(padded: np.ndarray, points: np.ndarray) -> np.ndarray:
        out = np.zeros((1, len(points)))
        steps = points / screens.grid.step % screens.grid.size
        add_values(np.ascontiguousarray(padded), steps[:, 0], steps[:, 1], np.zeros((1, 2)), np.ones(1), out)
        return out[0]

    expected = np.zeros((2, len(centres)))
    for moment in moments:
        for sign in (1, -1):
            for axis, across in enumerate([(sign * side / 2 + 0 * edge, edge), (edge, sign * side / 2 + 0 * edge)]):
                local_x, local_y = across
                points = centres[:, None, :] + np.stack([c * local_x - s * local_y, s * local_x + c * local_y], axis=-1)
                points = points - moment * screens.travel[layer]
                phase = surface(screens.phases[layer], points.reshape(-1, 2)).reshape(len(centres), -1)
                expected[axis] += sign * phase.mean(axis=1) / side / len(moments)
    for axis in range(2):
        found = surface(gradient[:, :, axis : axis + 1], centres)
        assert found == pytest.approx(expected[axis], abs=2e-2 * expected.std())
        assert np.std(found - expected[axis]) < 0.01 * expected.std()


def test_variance_of_the_gradient(mini: System) -> None:
    """Averaged over a square: against the integral of the power spectrum, 0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6)."""
    side = 0.5
    f = (np.arange(4000) + 0.5) * 0.005
    fx, fy = np.meshgrid(f, f[:2000])
    r0, outer_scale = mini.los_r0 * mini.atmosphere.fractions[0] ** (-3 / 5), mini.atmosphere.outer_scale
    power = 0.0228955 * r0 ** (-5 / 3) * (fx**2 + fy**2 + outer_scale**-2) ** (-11 / 6)
    power *= (2 * np.pi * fx * METRES_PER_RADIAN * np.sinc(fx * side) * np.sinc(fy * side)) ** 2
    expected = 4 * power.sum() * 0.005**2
    found = []
    still = mini.with_changes({"atmosphere.layers.*.wind_speed": 0.0})
    for seed in range(12):
        screens = Screens(still, seed)
        found.append(np.mean(screens.gradient(0, side, 0.0)[::3, ::3].astype(float) ** 2))
    assert np.mean(found) == pytest.approx(expected, rel=0.01 + 3 * np.std(found) / np.mean(found) / math.sqrt(11))
    assert np.std(found) < 0.1 * expected


def test_one_seed_is_one_sky(mini: System) -> None:
    finer = mini.with_changes({"sensors.0.subapertures": 12, "mirrors.0.actuators": 9, "loop.delay": 1.0})
    same, other = Screens(finer, 7), Screens(mini, 8)
    for a, b, c in zip(Screens(mini, 7).phases, same.phases, other.phases, strict=True):
        assert np.array_equal(a, b)
        assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 0.5
    # weaker turbulence is the same sky, scaled
    weaker = Screens(mini.with_changes({"atmosphere.r0": 2 * mini.atmosphere.r0}), 7)
    np.testing.assert_allclose(weaker.phases[1], same.phases[1] * 2 ** (-5 / 6), rtol=1e-4, atol=1e-11)


def test_grid(mini: System) -> None:
    grid = grid_for(mini)
    assert grid.size % 2 == 0
    assert grid.step * grid.size >= 4 * mini.atmosphere.outer_scale
    assert grid.step <= 0.05
    with pytest.raises(ValueError, match="too large to simulate"):
        grid_for(mini.with_changes({"atmosphere.outer_scale": 1000.0}))
