"""The Kalman filter against its equations, and against the static estimate that it contains."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc import lqg
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance, slope_wavefront_covariance
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.lqg import LayeredModel, Lqg, RiccatiError, kalman_gain, layered_model, riccati
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines

STEP = 0.6


@pytest.fixture(scope="module")
def mini() -> System:
    """With one elongated star, so that noise is no diagonal."""
    return load_system("mini", {"guide_stars.0.launch": (2.5, 0.0), "guide_stars.0.sodium_thickness": 40e3})


@pytest.fixture(scope="module")
def model(mini: System) -> LayeredModel:
    return layered_model(mini, step=STEP)


def _random_model(n: int, m: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(5)
    A = rng.standard_normal((n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    C = rng.standard_normal((m, n))
    V, E = rng.standard_normal((n, n)), rng.standard_normal((m, m))
    return A, C, V @ V.T, E @ E.T + np.eye(m)


def test_riccati_of_a_scalar() -> None:
    a, c, q, r = 0.9, 2.0, 0.3, 0.5
    # eq. 8 with one unknown is a quadratic: c^2 p^2 + (r (1 - a^2) - c^2 q) p - q r = 0
    b = r * (1 - a**2) - c**2 * q
    p = (-b + np.sqrt(b**2 + 4 * c**2 * q * r)) / (2 * c**2)
    found = riccati(*(np.array([[v]]) for v in (a, c, q, r)))
    assert found == pytest.approx(p)


def test_riccati_against_another_solver() -> None:
    A, C, V, E = _random_model(12, 7)
    P = riccati(A, C, V, E)
    np.testing.assert_allclose(P, solve_discrete_are(A.T, C.T, V, E), rtol=1e-8)
    # eq. 8 as printed
    gain = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + E)
    np.testing.assert_allclose(P, A @ P @ A.T + V - gain @ C @ P @ A.T, rtol=1e-9, atol=1e-9 * np.abs(P).max())


def test_what_no_sensor_sees_must_not_grow() -> None:
    with pytest.raises(RiccatiError):
        riccati(np.eye(1) * 1.5, np.zeros((1, 1)), np.eye(1), np.eye(1))


def test_the_model_is_stationary(model: LayeredModel) -> None:
    forward = model.transition @ model.prior @ model.transition.T + model.excitation
    np.testing.assert_allclose(forward, model.prior, atol=1e-12 * np.abs(model.prior).max())
    assert np.linalg.eigvalsh(model.excitation).min() > 0
    assert np.linalg.eigvalsh(model.noise).min() > 0
    assert np.abs(np.linalg.eigvals(model.transition)).max() < 1


def test_without_wind_the_state_stays(mini: System) -> None:
    calm = layered_model(mini.with_changes({"atmosphere.layers.*.wind_speed": 0.0}), step=STEP)
    identity = np.eye(len(calm.prior))
    np.testing.assert_allclose(calm.transition, identity, atol=1e-8)
    np.testing.assert_allclose(calm.delay, identity, atol=1e-7)


def test_a_fraction_of_delay_lies_between(mini: System, model: LayeredModel) -> None:
    sizes = [
        np.linalg.norm(
            layered_model(mini.with_changes({"loop.delay": delay}), step=STEP).delay - np.eye(len(model.prior))
        )
        for delay in (1.0, 1.5, 2.0)
    ]
    assert sizes == sorted(sizes)
    np.testing.assert_allclose(model.delay, model.transition @ model.transition, atol=1e-8)


def _lmmse(system: System) -> np.ndarray:
    """Sigma_xs P [P (Sigma_ss + Sigma_nn) P]^+ P (eq. 10), all layers and slopes at once."""
    layout, profile = Layout(system), Profile.of(system)
    sensors = sightlines(system, layout, profile)
    views = [points for _, points in Fit(system, layout).footprints(profile.heights)]
    grids = lqg._grids([*(s.nodes for s in sensors), *views], STEP)
    everywhere = [Footprints(np.tile(x, (3, 1)), np.tile(y, (3, 1))) for x, y in grids]
    turbulence = Turbulence.covering(profile, [*everywhere, *(s.nodes for s in sensors)])
    S = slope_covariance(turbulence, sensors) + noise_covariance(system, layout, gain=1.0).toarray()
    blind = blind_modes(system, layout)
    P = np.eye(len(S)) - blind @ blind.T
    columns = []
    for l, points in enumerate(everywhere):
        fractions = np.where(np.arange(3) == l, turbulence.fractions, 0.0)
        columns.append(slope_wavefront_covariance(replace(turbulence, fractions=fractions), sensors, points))
    return np.hstack(columns).T @ np.linalg.pinv(P @ S @ P, rcond=1e-11, hermitian=True)


def test_the_static_estimate_is_the_limit_of_the_filtered_state(mini: System, model: LayeredModel) -> None:
    """Section 2.2.3, A towards 0 with the turbulence's variance kept; the predicted state of eq. 6 vanishes instead."""
    static = _lmmse(mini)
    distances = []
    for a in (0.3, 0.1, 0.0):
        A = a * np.eye(len(model.prior))
        error = riccati(A, model.observation, (1 - a**2) * model.prior, model.noise)
        H = kalman_gain(error, model.observation, model.noise)
        distances.append(np.linalg.norm(H - static) / np.linalg.norm(static))
        assert np.linalg.norm(A @ H) <= 1.0001 * a * np.linalg.norm(H)
    assert distances[0] > distances[1] > distances[2]
    assert distances[2] < 1e-6
    np.testing.assert_allclose(error, model.prior, atol=1e-12 * np.abs(model.prior).max())


def test_memory_helps(model: LayeredModel) -> None:
    """Filtered over frames the state is known better than from one frame."""
    C, noise = model.observation, model.noise
    predicted = riccati(model.transition, C, model.excitation, noise)
    after = predicted - kalman_gain(predicted, C, noise) @ C @ predicted
    one_frame = model.prior - kalman_gain(model.prior, C, noise) @ C @ model.prior
    assert np.trace(after) < 0.8 * np.trace(one_frame)
    # eq. 8: predicted is the filtered error a frame later
    later = model.transition @ after @ model.transition.T + model.excitation
    np.testing.assert_allclose(later, predicted, atol=1e-9 * np.abs(predicted).max())


def test_the_filter_follows_what_its_model_makes(mini: System) -> None:
    """Error variance of a long run of the model's own turbulence is the Riccati equation's."""
    controller = Lqg(mini, step=STEP)
    model, rng = controller.model, np.random.default_rng(3)
    kicks, grains = np.linalg.cholesky(model.excitation), np.linalg.cholesky(model.noise)
    state = np.linalg.cholesky(model.prior) @ rng.standard_normal(len(model.prior))
    errors = []
    for k in range(600):
        predicted = controller._predicted
        if k >= 100:
            errors.append(np.mean((state - predicted) ** 2))
        controller.filtered(model.observation @ state + grains @ rng.standard_normal(len(grains)))
        state = model.transition @ state + kicks @ rng.standard_normal(len(state))
    assert np.mean(errors) == pytest.approx(np.trace(controller.error) / len(state), rel=0.1)
