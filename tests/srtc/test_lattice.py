"""Tables against the layers one by one, which the direct sums of test_covariance hold."""

from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, slope_covariance
from srtomo_srtc.model import sightlines

SAME_RANGE = {"guide_stars.2.altitude": 90e3}
SHIFTED = {**SAME_RANGE, "sensors.*.rotation": 0.0}
TURNED_TOGETHER = {**SAME_RANGE, "sensors.*.rotation": 0.3}
UNEQUAL_SIZES = {**SHIFTED, "sensors.1.subapertures": 10}


def _sensors(changes: dict[str, object], oversampling: int = 2) -> tuple[Turbulence, list[Sightline]]:
    system: System = load_system("mini", changes)
    profile = Profile.of(system)
    sensors = sightlines(system, Layout(system), profile, oversampling)
    return Turbulence.covering(profile, [s.nodes for s in sensors]), sensors


def _layer_by_layer(sensors: list[Sightline]) -> list[Sightline]:
    return [replace(sensor, seen=None) for sensor in sensors]


@pytest.mark.parametrize("oversampling", [1, 2, 4])
@pytest.mark.parametrize("changes", [SHIFTED, TURNED_TOGETHER], ids=["shifted", "turned together"])
def test_shifted_sensors_exactly(changes: dict[str, object], oversampling: int) -> None:
    turbulence, sensors = _sensors(changes, oversampling)
    exact = slope_covariance(turbulence, _layer_by_layer(sensors))
    np.testing.assert_allclose(slope_covariance(turbulence, sensors), exact, atol=1e-12 * exact.max())
    # float32 alone
    fast = slope_covariance(turbulence, sensors, fast=True)
    assert np.linalg.norm(fast - exact) < 1e-7 * np.linalg.norm(exact)


@pytest.mark.parametrize("changes", [SAME_RANGE, UNEQUAL_SIZES], ids=["rotated", "unequal sizes"])
def test_others_by_interpolation_and_only_when_asked(changes: dict[str, object]) -> None:
    turbulence, sensors = _sensors(changes)
    exact = slope_covariance(turbulence, _layer_by_layer(sensors))
    np.testing.assert_allclose(slope_covariance(turbulence, sensors), exact, atol=1e-12 * exact.max())
    fast = slope_covariance(turbulence, sensors, fast=True)
    assert 1e-7 < np.linalg.norm(fast - exact) / np.linalg.norm(exact) < 1e-4
    assert np.abs(fast - exact).max() < 5e-4 * exact.max()


def test_threads_do_not_change_a_bit() -> None:
    turbulence, sensors = _sensors(SAME_RANGE)
    one, three = (slope_covariance(turbulence, sensors, fast=True, threads=n) for n in (1, 3))
    assert one.tobytes() == three.tobytes()
