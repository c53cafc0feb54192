"""The noise that the SRTC supposes is the one that the simulated sensors have; they share no formula."""

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_core.units import ARCSEC
from srtomo_sim.shack_hartmann import noise_correlation, noise_sigma
from srtomo_srtc.model import noise_covariance


@pytest.mark.parametrize("stop", [None, 8.0, 3.0])
def test_elongated_spots(stop: float | None) -> None:
    """Whole, and cut by a field stop of so many arcsec: there by a closed form, here by light on a grid of points."""
    changes: dict[str, object] = {"guide_stars.0.launch": (2.5, 0.3), "guide_stars.0.sodium_thickness": 60e3}
    if stop is not None:
        changes["sensors.*.field_stop"] = stop * ARCSEC
    system = load_system("mini", changes)
    layout = Layout(system)
    N = noise_covariance(system, layout, 1.0)
    np.testing.assert_allclose(np.sqrt(N.diagonal()), noise_sigma(system, layout), rtol=2e-3)
    for w, correlation in enumerate(noise_correlation(system, layout)):
        own = layout.slopes_of(w)
        n = layout.sensors[w].n_valid
        block = N[own, own].toarray()
        expected = block[:n, n:].diagonal() / np.sqrt(block.diagonal()[:n] * block.diagonal()[n:])
        np.testing.assert_allclose(correlation, expected, atol=1e-3)
