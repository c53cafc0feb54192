"""What low rank is stated to cost, against the SRTC's model of all slopes: outer scale, cone, and star with star."""

from __future__ import annotations

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_rtc.compression import SlopeStatistics, error_to_noise
from srtomo_rtc.lowrank import factorise
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.model import sightlines
from srtomo_srtc.reconstructors import implicit


def test_it_is_what_the_model_s_slopes_leave_or_a_little_more() -> None:
    system = load_system("mini", {"sensors.*.subapertures": 12, "mirrors.*.actuators": 13})
    layout, profile = Layout(system), Profile.of(system)
    R = implicit(system, layout=layout)[0].R[0].astype(float)
    sensors = sightlines(system, layout, profile)
    statistics = SlopeStatistics(system, layout)
    photons = np.concatenate([np.tile(statistics.photons(w), 2) for w in range(len(sensors))])
    S = slope_covariance(Turbulence.covering(profile, [sensor.nodes for sensor in sensors]), sensors) + np.diag(photons)
    for tolerance in (0.1, 0.3):
        applied = factorise(system, layout, R, tolerance).applied()
        wrong = applied - R
        found = np.sqrt(np.sum((wrong @ S) * wrong) / np.sum(R**2 @ photons))
        stated = error_to_noise(system, layout, R, applied)
        assert stated == pytest.approx(tolerance, rel=0.1)
        assert 0.6 * stated < found < stated
