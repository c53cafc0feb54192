import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_core.units import ARCSEC
from srtomo_srtc.noise import slope_variance


@pytest.mark.parametrize("electrons", [186.0, 10.0])
def test_variance_of_the_paper_s_sensor(electrons: float) -> None:
    system = load_system("gnao_ltao", {"loop.rate": 1000.0, "sensors.*.photons": electrons / 0.16 * 1000})
    sensor, layout = system.sensors[0], Layout(system).sensors[0]
    variance = slope_variance(sensor, layout, system.loop.rate) / ARCSEC**2
    lit = np.tile(layout.illumination, 2) == 1
    # (1.5/2.355)^2 = 0.4057; 0.25 e^2 times the sum of x^2 over 6x6 pixels of 0.8", 67.2
    assert variance[lit] == pytest.approx(0.4057 * 2 / electrons + 16.8 / electrons**2, rel=1e-4)


def test_less_light_is_more_noise() -> None:
    system = load_system("mini")
    sensor, layout = system.sensors[0], Layout(system).sensors[0]
    variance = slope_variance(sensor, layout, system.loop.rate)
    assert variance.shape == (layout.n_slopes,)
    assert np.array_equal(np.argsort(variance[: layout.n_valid]), np.argsort(-layout.illumination))
