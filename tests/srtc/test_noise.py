import importlib

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_core.units import ARCSEC
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.crossterms import right_hand_side
from srtomo_srtc.fitting import Fit
from srtomo_srtc.model import elongation_prior, noise_prior, sightlines
from srtomo_srtc.noise import slope_noise, slope_variance
from srtomo_srtc.reconstructors import implicit


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


ELONGATED = {f"guide_stars.{i}.launch": place for i, place in enumerate([(2.5, 0.0), (-1.0, 2.2), (0.0, 0.0)])} | {
    f"guide_stars.{i}.sodium_thickness": 10e3 for i in range(3)
}


def test_an_elongated_spot_by_hand() -> None:
    # 10 km of sodium at 90 km, seen 4 m beside the launch: 10e3 * 4 / 90e3^2 rad = 1.02 arcsec
    system = load_system("mini", {**ELONGATED, "zenith_angle": 0.0, "sensors.*.rotation": 0.0})
    sensor, layout = system.sensors[0], Layout(system).sensors[0]
    noise, round_spot = slope_noise(system, sensor, layout), slope_variance(sensor, layout, system.loop.rate)
    x, y = (layout.local + layout.shift).T
    electrons = sensor.photons * layout.size**2 * layout.illumination / system.loop.rate
    length = 10e3 * np.hypot(x - 2.5, y) / 90e3**2 / 2.355
    angle = np.arctan2(y, x - 2.5)
    extra = 2 * length**2 / electrons  # excess noise sqrt 2
    found = noise.variance - round_spot
    np.testing.assert_allclose(
        found, np.concatenate([extra * np.cos(angle) ** 2, extra * np.sin(angle) ** 2]), rtol=1e-4
    )
    np.testing.assert_allclose(noise.covariance, extra * np.cos(angle) * np.sin(angle), rtol=1e-4, atol=1e-20)


def test_a_rotated_sensor_has_its_noise_along_its_own_axes() -> None:
    straight = load_system("mini", {**ELONGATED, "sensors.*.rotation": 0.0, "sensors.*.shift": (0.0, 0.0)})
    turned = straight.with_changes({"sensors.*.rotation": np.pi / 2, "telescope.obscuration_centre": (0.0, 0.0)})
    straight = straight.with_changes({"telescope.obscuration_centre": (0.0, 0.0)})
    a, b = Layout(straight).sensors[0], Layout(turned).sensors[0]
    before, after = slope_noise(straight, straight.sensors[0], a), slope_noise(turned, turned.sensors[0], b)
    # the sub-aperture that now is where another was: its own x is the pupil's y
    where = np.stack(b.to_pupil(*b.local.T), axis=1)
    same = np.hypot(*(where[:, None] - a.local[None]).T).T.argmin(axis=1)
    n = a.n_valid
    np.testing.assert_allclose(after.variance[:n], before.variance[n:][same])
    np.testing.assert_allclose(after.variance[n:], before.variance[:n][same])
    np.testing.assert_allclose(after.covariance, -before.covariance[same], atol=1e-9 * after.variance.max())


def test_the_prior_has_every_block() -> None:
    system = load_system("mini", ELONGATED)
    layout = Layout(system)
    rows, columns, values = elongation_prior(system, layout, 0.5)
    assert len(rows) == sum(p.n_valid for p in layout.sensors[:3])
    assert np.all(rows > columns)
    variance = noise_prior(system, layout, 0.5)
    assert np.all(values**2 < variance[rows] * variance[columns])
    assert not len(elongation_prior(load_system("mini"), layout, 0.5)[0])


def test_the_elongated_prior_leaves_less_error(monkeypatch: pytest.MonkeyPatch) -> None:
    # as thick as makes a 4 m telescope's spots as long as an ELT's
    system = load_system("mini", ELONGATED | {f"guide_stars.{i}.sodium_thickness": 80e3 for i in range(3)})
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    targets = [points for _, points in fit.footprints(profile.heights)]
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *targets])
    S = slope_covariance(turbulence, sensors) + np.diag(noise_prior(system, layout, 0.5))
    rows, columns, values = elongation_prior(system, layout, 0.5)
    S[rows, columns] += values
    S[columns, rows] += values
    B = right_hand_side(fit, turbulence, sensors, profile.heights)

    def error(R: np.ndarray) -> float:
        """Mean square of the wavefront that is left, less what no reconstructor changes; m^2."""
        return float(np.sum((fit.normal @ R) * (R @ S)) - 2 * np.sum(R * B))

    elongated = error(implicit(system)[0].R[0].astype(float))
    with monkeypatch.context() as patch:
        module = importlib.import_module("srtomo_srtc.reconstructors.implicit")  # the function has the same name
        patch.setattr(module, "elongation_prior", lambda *_: (rows[:0], columns[:0], values[:0]))
        diagonal = error(implicit(system)[0].R[0].astype(float))
    assert diagonal - elongated > (10e-9) ** 2
