"""The sky with its winds, from covariances of frozen flow."""

from __future__ import annotations

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.learn_wind import learn_winds
from srtomo_srtc.learned_sky import learned_sky
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.telemetry import HeldOut, Statistics
from srtomo_srtc.wind import sensors_carried, winds

LIMIT = 100


@pytest.fixture(scope="module")
def truth() -> System:
    layers = [
        {"altitude": 0.0, "fraction": 0.55, "wind_speed": 8.0, "wind_direction": 0.5},
        {"altitude": 9000.0, "fraction": 0.45, "wind_speed": 14.0, "wind_direction": -2.0},
    ]
    return load_system("mini", {"loop.rate": 500.0, "atmosphere.layers": layers})


def statistics(system: System, lag: int, n_frames: int) -> Statistics:
    """Moments of slopes as they are on average, frames and pairs 8 ms apart."""
    layout, profile = Layout(system), Profile.of(system)
    n = layout.n_slopes
    now = sightlines(system, layout, profile, 4)
    then = sensors_carried(now, winds(system), lag / system.loop.rate)
    turbulence = Turbulence.covering(profile, [line.nodes for line in (*now, *then)])
    both = slope_covariance(turbulence, [*now, *then])
    blind = blind_modes(system, layout)
    P = np.eye(n) - blind @ blind.T
    single = P @ (both[:n, :n] + noise_covariance(system, layout, 1.0).toarray()) @ P
    lagged = P @ both[:n, n:] @ P
    nothing = HeldOut(*(np.empty((0, n), np.float32),) * 2, *(np.empty(0, int),) * 3)
    duration = (n_frames - 1) * 0.008
    return Statistics(
        single.astype(np.float32), np.zeros(n), n_frames, 0.008, duration, {lag: lagged.astype(np.float32)},
        {lag: n_frames}, nothing, 1, 0, 4 * (n_frames - 1),
    )  # fmt: skip


def test_errors_go_with_the_winds_that_were_learned(truth: System) -> None:
    """A sky that is blown four times as fast shows four times as many independent ones in the same time."""
    window = statistics(truth, 24, 20_000)
    slower = {
        f"atmosphere.layers.{l}.wind_speed": layer.wind_speed / 4 for l, layer in enumerate(truth.atmosphere.layers)
    }
    file = truth.with_changes({"atmosphere.r0": 0.2, **slower})
    supposed, learned = (
        learned_sky(file, window, winds=asked, altitudes=[0.0, 9000.0], limit=LIMIT) for asked in (False, True)
    )
    assert learned.learned.r0 == supposed.learned.r0 == pytest.approx(truth.atmosphere.r0, rel=0.02)
    assert winds(learned.system) == pytest.approx(winds(truth), abs=0.5)
    assert not supposed.winds and winds(supposed.system) == pytest.approx(winds(file))
    for few, many in zip(supposed.learned.groups, learned.learned.groups, strict=True):
        assert many.n_effective / few.n_effective == pytest.approx(4, rel=0.1)
        assert few.sigma / many.sigma == pytest.approx(2, rel=0.05)


def test_a_weak_layer_is_found_behind_strong_ones() -> None:
    """What a coarse grid of velocities leaves of the strong ones suits it better than its own wind at first."""
    mini = load_system("mini")
    sensors = [sensor.model_dump() | {"subapertures": 6, "photons": 2e5} for sensor in mini.sensors[:3]]
    layers = [
        {"altitude": 0.0, "fraction": 0.366, "wind_speed": 14.3, "wind_direction": 0.765},
        {"altitude": 3000.0, "fraction": 0.119, "wind_speed": 9.3, "wind_direction": -1.184},
        {"altitude": 10000.0, "fraction": 0.515, "wind_speed": 18.8, "wind_direction": 0.612},
    ]
    truth = mini.with_changes({"sensors": sensors, "loop.rate": 500.0, "atmosphere.layers": layers})
    still = truth.with_changes({"atmosphere.layers.*.wind_speed": 0.0})
    found = learn_winds(still, statistics(truth, 32, 2000))
    assert np.array([wind.velocity for wind in found]) == pytest.approx(winds(truth), abs=0.5)
