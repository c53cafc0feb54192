from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout, transmission
from srtomo_core.system import System
from srtomo_core.units import ARCSEC
from srtomo_sim.shack_hartmann import atmospheric_slopes, cut, lit_fractions, noise_correlation, noise_sigma
from srtomo_sim.turbulence import Screens


def plane_wave(screens: Screens, layer: int, waves: tuple[int, int]) -> np.ndarray:
    """Replace the sky by ``cos(k . x)`` metres of wavefront in one layer; returns k (rad/m)."""
    n = screens.grid.size
    for spectrum in screens._spectra:
        spectrum[:] = 0
    # of a cubic spline, so that it passes through the wave's values on the grid
    response = np.prod([(2 + np.cos(2 * np.pi * w / n)) / 3 for w in waves])
    screens._spectra[layer][waves[1] % n, waves[0]] = n * n / 2 / response
    if waves[0] == 0:
        screens._spectra[layer][-waves[1] % n, 0] = n * n / 2 / response
    return 2 * np.pi * np.array(waves) / (n * screens.grid.step)


@pytest.mark.parametrize("waves", [(9, 4), (2, -7), (0, 5)])
@pytest.mark.parametrize("layer", [0, 2])
def test_slopes_of_a_plane_wave(mini: System, layer: int, waves: tuple[int, int]) -> None:
    """Shift, rotation, cone, star, wind, exposure, part illumination: against sums over fine points and moments.

    Nothing of the simulator is in the expected value but the layout's own coordinates.
    """
    system = mini.with_changes({"loop.rate": 50.0, "sensors.*.illumination_threshold": 0.2})
    layout, screens = Layout(system), Screens(system, 1)
    k = plane_wave(screens, layer, waves)
    frame = 3
    slopes = atmospheric_slopes(system, layout, screens, frame + 1)[frame]
    wind, height = system.atmosphere.layers[layer], system.los_heights[layer]
    velocity = wind.wind_speed * np.array([math.cos(wind.wind_direction), math.sin(wind.wind_direction)])
    seconds = (frame + (np.arange(10) + 0.5) / 10) / system.loop.rate
    for i, sensor in enumerate(layout.sensors):
        star = system.star_of(system.sensors[i])
        cone = 1 - height / system.los_range(star)
        x, y = sensor.points(30 if sensor.n_valid > 1 else 240)
        lit = transmission(system.telescope, x, y)
        gradient = np.zeros((2, *x.shape))
        for t in seconds:
            at = [
                cone * p + height * a - v * t for p, a, v in zip((x, y), (star.position.x, star.position.y), velocity)
            ]
            gradient -= cone * k[:, None, None, None] * np.sin(k[0] * at[0] + k[1] * at[1]) / len(seconds)
        mean = (gradient * lit).sum(axis=(2, 3)) / lit.sum(axis=(1, 2))
        c, s = math.cos(sensor.rotation), math.sin(sensor.rotation)
        expected = np.concatenate([c * mean[0] + s * mean[1], c * mean[1] - s * mean[0]])
        scale = np.linalg.norm(k) if sensor.n_valid > 1 else abs(mean).max()
        assert slopes[layout.slopes_of(i)] == pytest.approx(expected, abs=6e-3 * scale)


def test_exposures_are_means_of_shorter_ones(mini: System) -> None:
    layout = Layout(mini)
    slow = mini.with_changes({"loop.rate": 40.0})
    fast = mini.with_changes({"loop.rate": 640.0})
    long = atmospheric_slopes(slow, layout, Screens(slow, 4), 3)
    short = atmospheric_slopes(fast, layout, Screens(fast, 4), 48)
    mean = short.reshape(3, 16, -1).mean(axis=1)
    assert np.std(long - mean) < 0.005 * long.std()
    # the exposure does take something away
    assert abs(long - short[8::16]).max() > 0.05 * long.std()


def test_a_whole_subaperture_is_the_sum_of_its_cells(mini: System) -> None:
    layout, in_cells = Layout(mini), Layout(mini)
    in_cells.sensors = tuple(replace(s, illumination=np.minimum(s.illumination, 0.999)) for s in layout.sensors)
    whole, cells = cut(layout.sensors[0], mini.telescope)
    assert whole.side == layout.sensors[0].size
    assert cells.side <= 0.05
    assert len(whole.subaperture) + len(cells.subaperture) == layout.sensors[0].n_valid
    assert len(cut(in_cells.sensors[0], mini.telescope)) == 1
    screens = Screens(mini, 1)
    slopes, same = (atmospheric_slopes(mini, one, screens, 2) for one in (layout, in_cells))
    assert np.std(same - slopes) < 0.01 * slopes.std()


def test_lit_fractions_average_to_the_illumination(mini: System) -> None:
    for sensor in Layout(mini).sensors:
        light = lit_fractions(sensor, mini.telescope, 8)
        assert light.shape == (sensor.n_valid, 8, 8)
        assert light.mean(axis=(1, 2)) == pytest.approx(sensor.illumination, abs=5e-3)


def test_noise(mini: System) -> None:
    """100 electrons in 1.5 arcsec FWHM, excess noise sqrt 2; 0.5 e on each of 36 pixels of 0.8 arcsec."""
    changes = {"sensors.0.photons": 100 * mini.loop.rate / 0.5**2, "sensors.0.excess_noise": math.sqrt(2)}
    system = mini.with_changes(changes)
    layout = Layout(system)
    sigma = noise_sigma(system, layout)
    assert sigma.shape == (layout.n_slopes,)
    pixels = [(column - 2.5) * 0.8 for column in range(6) for _ in range(6)]
    variance = (1.5 / 2.354820045) ** 2 * 2 / 100 + 0.25 * sum(p * p for p in pixels) / 100**2
    full = np.flatnonzero(layout.sensors[0].illumination == 1)[0]
    assert sigma[full] == pytest.approx(math.sqrt(variance) * ARCSEC, rel=1e-9)
    assert sigma[full + layout.sensors[0].n_valid] == sigma[full]
    part = np.argmin(layout.sensors[0].illumination)
    assert sigma[part] > sigma[full] / math.sqrt(layout.sensors[0].illumination[part]) * 0.999


def test_noise_of_elongated_spots_along_and_across(mini: System) -> None:
    """4 m from the launch: 10 km of sodium at 90 km are 10e3 * 4 / 90e3^2 rad long; nothing changes across."""
    changes: dict[str, object] = {"zenith_angle": 0.0, "sensors.0.rotation": 0.4, "sensors.0.read_noise": 0.0}
    system = mini.with_changes({**changes, "guide_stars.0.launch": (4.0, 1.0), "guide_stars.0.sodium_thickness": 10e3})
    layout = Layout(system)
    place = layout.sensors[0]
    n = place.n_valid
    before = noise_sigma(mini.with_changes(changes), layout)[:n] ** 2
    sigma, rho = noise_sigma(system, layout)[: 2 * n], noise_correlation(system, layout)
    x, y = place.to_pupil(*place.local.T)
    for s in range(0, n, 5):
        xy = rho[0][s] * sigma[s] * sigma[n + s]
        covariance = np.array([[sigma[s] ** 2, xy], [xy, sigma[n + s] ** 2]])
        line = np.array([x[s] - 4.0, y[s] - 1.0]) @ np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
        length = 10e3 * np.hypot(*line) / 90e3**2
        along, across = line / np.hypot(*line), np.array([-line[1], line[0]]) / np.hypot(*line)
        assert across @ covariance @ across == pytest.approx(before[s], rel=1e-9)
        ratio = 1 + (length / (1.5 * ARCSEC)) ** 2
        assert along @ covariance @ along == pytest.approx(before[s] * ratio, rel=1e-9)
        assert along @ covariance @ across == pytest.approx(0, abs=1e-12 * before[s])
    assert not any(one.any() for one in rho[1:])
