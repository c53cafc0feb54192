import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_core.units import ARCSEC
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.crossterms import right_hand_side
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import pupil_grid
from srtomo_srtc.mirrors import mirror_wavefronts
from srtomo_srtc.model import noise_covariance, noise_whitening, sightlines
from srtomo_srtc.noise import slope_noise, slope_variance
from srtomo_srtc.predict import Prediction
from srtomo_srtc.reconstructors import METHODS, implicit


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

SMALL = {
    **{f"sensors.{i}.rotation": 0.11 for i in range(3)},
    **{f"sensors.{i}.subapertures": 6 for i in range(3)},
    "guide_stars.2.altitude": 90e3,
    "mirrors.0.actuators": 7,
}
"""Changes to mini that leave its laser sensors only shifted against each other, as :func:`iterative` needs them."""


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
    N = noise_covariance(system, layout, 0.5)
    assert N.nnz == layout.n_slopes + 2 * sum(place.n_valid for place in layout.sensors[:3])
    for w, (sensor, place) in enumerate(zip(system.sensors, layout.sensors, strict=True)):
        own, noise = N[layout.slopes_of(w)][:, layout.slopes_of(w)].toarray(), slope_noise(system, sensor, place)
        n = place.n_valid
        np.testing.assert_array_equal(own, own.T)
        np.testing.assert_allclose(own.diagonal(), noise.variance / 3)
        np.testing.assert_allclose(own[:n, n:].diagonal(), noise.covariance / 3)
    assert noise_covariance(load_system("mini"), layout, 0.5).nnz == layout.n_slopes


STOPPED = ELONGATED | {f"guide_stars.{i}.sodium_thickness": 60e3 for i in range(3)} | {"sensors.0.field_stop": 1.5e-5}


def test_a_stopped_spot_against_photons() -> None:
    """Centres of gravity of photons drawn one by one, calibrated by a spot that is moved on purpose."""
    electrons, frames, read_noise, moved = 600, 4000, 1.5, 7e-7
    system = load_system("mini", {**STOPPED, "sensors.0.excess_noise": 1.0, "sensors.0.read_noise": read_noise})
    sensor, place = system.sensors[0], Layout(system).sensors[0]
    system = system.with_changes({"sensors.0.photons": electrons * system.loop.rate / place.size**2})
    sensor = system.sensors[0]
    whole = system.with_changes({"sensors.0.field_stop": 1.0, "sensors.0.read_noise": 0.0})
    unstopped, stopped = slope_noise(whole, whole.sensors[0], place), slope_noise(system, sensor, place)
    n, half = place.n_valid, sensor.field_stop / 2
    squares = (np.arange(sensor.pixels) - (sensor.pixels - 1) / 2) ** 2 * sensor.pixel_scale**2
    rng = np.random.default_rng(5)

    def centres(factor: np.ndarray, shift: np.ndarray) -> np.ndarray:
        counts = rng.poisson(electrons * light, frames)
        photons = rng.standard_normal((counts.sum(), 2)) @ factor.T + shift
        frame = np.repeat(np.arange(frames), counts)
        inside = (np.abs(photons) <= half).all(axis=1)
        totals = np.bincount(frame[inside], minlength=frames)
        sums = np.stack([np.bincount(frame[inside], photons[inside, a], frames) for a in (0, 1)])
        sums += read_noise * np.sqrt(sensor.pixels * squares.sum()) * rng.standard_normal(sums.shape)
        return sums / totals

    lit = np.flatnonzero(place.illumination == 1)
    for one in (lit[0], lit[len(lit) // 3]):
        light = place.illumination[one]
        off = unstopped.covariance[one]
        spot = electrons * light * np.array([[unstopped.variance[one], off], [off, unstopped.variance[n + one]]])
        factor = np.linalg.cholesky(spot)
        assert np.trace(spot) > 0.3 * half**2  # much of it does not pass
        gain = np.empty((2, 2))
        for axis, direction in enumerate(np.eye(2)):
            state = rng.bit_generator.state
            ahead = centres(factor, moved * direction).mean(axis=1)
            rng.bit_generator.state = state  # the same photons
            gain[:, axis] = (ahead - centres(factor, -moved * direction).mean(axis=1)) / (2 * moved)
        found = np.cov(np.linalg.solve(gain, centres(factor, np.zeros(2))))
        off = stopped.covariance[one]
        expected = np.array([[stopped.variance[one], off], [off, stopped.variance[n + one]]])
        np.testing.assert_allclose(found, expected, atol=0.07 * np.abs(expected).max())
        assert np.trace(expected) > 1.1 * np.trace(spot) / (electrons * light)


def test_a_wide_stop_changes_nothing() -> None:
    system = load_system("mini", ELONGATED)
    place = Layout(system).sensors[0]
    open_field = slope_noise(system, system.sensors[0], place)
    wide = system.with_changes({"sensors.0.field_stop": 20 * ARCSEC})
    behind = slope_noise(wide, wide.sensors[0], place)
    np.testing.assert_allclose(behind.variance, open_field.variance, rtol=1e-6)
    np.testing.assert_allclose(behind.covariance, open_field.covariance, rtol=1e-6, atol=1e-20)


def test_along_a_spot_much_longer_than_its_stop_there_is_no_information() -> None:
    """Only the direction across is left of N^-1, as with what Bechet et al. suppose of truncated spots."""
    system = load_system("mini", {**ELONGATED, "guide_stars.0.sodium_thickness": 3000e3, "sensors.0.field_stop": 1e-5})
    place = Layout(system).sensors[0]
    noise = slope_noise(system, system.sensors[0], place)
    n = place.n_valid
    N = np.moveaxis(np.array([[noise.variance[:n], noise.covariance], [noise.covariance, noise.variance[n:]]]), -1, 0)
    values, vectors = np.linalg.eigh(np.linalg.inv(N))
    line = np.stack(place.to_pupil(*place.local.T), axis=1) - system.guide_stars[0].launch
    c, s = np.cos(place.rotation), np.sin(place.rotation)
    along = np.einsum("ni,ni->n", line @ [[c, -s], [s, c]], vectors[:, :, 1]) / np.hypot(*line.T)
    far = np.hypot(*line.T) > 1
    assert (values[far, 0] < 1e-2 * values[far, 1]).all()
    assert (np.abs(along[far]) < 1e-2).all()


def test_whitening_whitens() -> None:
    system = load_system("mini", ELONGATED)
    layout = Layout(system)
    N, W = noise_covariance(system, layout, 0.5), noise_whitening(system, layout, 0.5)
    np.testing.assert_allclose((W @ N @ W.T).toarray(), np.eye(layout.n_slopes), atol=1e-12)


def with_files(system: System, folder: Path, layout: Layout, N: np.ndarray) -> System:
    """A system whose sensors' noise was measured to be N."""
    for w, sensor in enumerate(system.sensors):
        np.savez(folder / sensor.name, covariance=N[layout.slopes_of(w), layout.slopes_of(w)])
        system = system.with_changes({f"sensors.{w}.noise_covariance": str(folder / f"{sensor.name}.npz")})
    return system


CASES = [(name, {}) for name in METHODS if name not in ("glao", "iterative")] + [
    ("iterative", {"tolerance": 1e-10}),
    ("explicit", {"form": "information"}),
    ("implicit", {"split": True}),
]


@pytest.mark.parametrize(("method", "keywords"), CASES)
def test_every_method_sees_all_of_the_noise(method: str, keywords: dict[str, Any], tmp_path: Path) -> None:
    plain = load_system("mini", SMALL)
    elongated = plain.with_changes({"guide_stars.0.launch": (2.5, 0.0), "guide_stars.0.sodium_thickness": 80e3})
    layout = Layout(plain)
    N = noise_covariance(elongated, layout, 1.0).toarray()
    modelled = METHODS[method](elongated, **keywords)[0].R[0]
    size = np.abs(modelled).max()
    measured = METHODS[method](with_files(plain, tmp_path, layout, N), **keywords)[0].R[0]
    np.testing.assert_allclose(measured, modelled, atol=1e-6 * size)
    without = METHODS[method](with_files(plain, tmp_path, layout, np.diag(N.diagonal())), **keywords)[0].R[0]
    assert np.abs(without - modelled).max() > 1e-3 * size


def test_the_prediction_sees_all_of_the_noise() -> None:
    system = load_system("mini", {**SMALL, "guide_stars.0.launch": (2.5, 0.0), "guide_stars.0.sodium_thickness": 80e3})
    layout = Layout(system)
    prediction = Prediction(system, lag=False)
    R = prediction.best()
    # the laser's jitter is the same in both
    round_spots = Prediction(load_system("mini", SMALL), lag=False)
    added = prediction.budgets(R)[0].noise - round_spots.budgets(R)[0].noise
    extra = noise_covariance(system, layout, 0.5).toarray() - noise_covariance(load_system("mini", SMALL), layout, 0.5)
    grid = pupil_grid(system.telescope, layout.mirrors[0].pitch / 2)
    shapes = mirror_wavefronts(layout, grid.x, grid.y, system.science.targets[0].position)
    low = np.stack([np.ones_like(grid.x), grid.x, grid.y], axis=1) * np.sqrt(grid.weight)[:, None]
    shapes = shapes * np.sqrt(grid.weight)[:, None]
    shapes -= low @ np.linalg.lstsq(low, shapes, rcond=None)[0]
    assert added == pytest.approx(np.trace(shapes @ R @ extra @ R.T @ shapes.T), rel=1e-6)


def test_the_elongated_prior_leaves_less_error(monkeypatch: pytest.MonkeyPatch) -> None:
    # as thick as makes a 4 m telescope's spots as long as an ELT's
    system = load_system("mini", ELONGATED | {f"guide_stars.{i}.sodium_thickness": 80e3 for i in range(3)})
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    targets = [points for _, points in fit.footprints(profile.heights)]
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *targets])
    noise = noise_covariance(system, layout, 0.5)
    S = slope_covariance(turbulence, sensors) + noise.toarray()
    B = right_hand_side(fit, turbulence, sensors, profile.heights)

    def error(R: np.ndarray) -> float:
        """Mean square of the wavefront that is left, less what no reconstructor changes; m^2."""
        return float(np.sum((fit.normal @ R) * (R @ S)) - 2 * np.sum(R * B))

    elongated = error(implicit(system)[0].R[0].astype(float))
    with monkeypatch.context() as patch:
        module = importlib.import_module("srtomo_srtc.reconstructors.implicit")  # the function has the same name
        patch.setattr(module, "noise_covariance", lambda *_: sparse.diags_array(noise.diagonal()).tocsr())
        diagonal = error(implicit(system)[0].R[0].astype(float))
    assert diagonal - elongated > (10e-9) ** 2
