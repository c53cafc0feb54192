"""The predictive reconstructor against the static one, and against the wind; from one exposure and from several."""

import math

import numpy as np
import pytest
from scipy.linalg import block_diag

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import METRES_PER_RADIAN, covariance
from srtomo_srtc.fitting import KAPPA
from srtomo_srtc.geometry import pupil_grid
from srtomo_srtc.gradient import gradient_operator
from srtomo_srtc.mirrors import mirror_wavefronts
from srtomo_srtc.model import blind_modes, noise_covariance
from srtomo_srtc.predict import Prediction, mean_wfe
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.reconstructors.predictive import predictive
from srtomo_srtc.wind import effective_lag, winds, with_trusted_winds


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def _turned(system: System, angle: float) -> System:
    return system.with_changes(
        {
            f"atmosphere.layers.{l}.wind_direction": layer.wind_direction + angle
            for l, layer in enumerate(system.atmosphere.layers)
        }
    )


def test_winds_go_where_they_blow(mini: System) -> None:
    np.testing.assert_allclose(winds(mini)[1], [12 * np.cos(np.radians(100)), 12 * np.sin(np.radians(100))])
    dark = mini.with_changes({"atmosphere.layers.0.fraction": 0.0, "atmosphere.layers.1.fraction": 0.85})
    np.testing.assert_allclose(winds(dark), winds(mini)[1:])


def test_lag_is_delay_and_filter(mini: System) -> None:
    assert effective_lag(mini.loop) == pytest.approx((2 + 1) / 200)
    assert effective_lag(mini.with_changes({"loop.gain": 1.0}).loop) == pytest.approx(2 / 200)


def test_without_wind_or_delay_it_is_the_static_one(mini: System) -> None:
    static = implicit(mini)[0]
    assert np.array_equal(predictive(mini, lag=0.0)[0].R, static.R)
    calm = mini.with_changes({"atmosphere.layers.*.wind_speed": 0.0})
    np.testing.assert_allclose(predictive(calm)[0].R, static.R, atol=1e-6 * np.abs(static.R).max())


def test_a_uniform_wind_shifts_the_estimate(mini: System) -> None:
    """All layers gone by d: what is estimated at x is what the static reconstructor estimates at x - d."""
    wind = {"atmosphere.layers.*.wind_speed": 10.0, "atmosphere.layers.*.wind_direction": 0.0}
    step = 0.4  # one actuator along x
    later = predictive(mini.with_changes(wind), lag=step / 10)[0].R[0].astype(float)
    now = implicit(mini)[0].R[0].astype(float)
    # a smooth wavefront that every sensor sees alike: x^2 - y^2 as slopes
    layout = Layout(mini)
    slopes = []
    for place in layout.sensors[:3]:
        x, y = place.to_pupil(*place.local.T)
        c, s = np.cos(place.rotation), np.sin(place.rotation)
        gx, gy = 2 * x, -2 * y
        slopes += [c * gx + s * gy, c * gy - s * gx]
    slopes = np.concatenate([*slopes, np.zeros(2)]) * 1e-7
    ax, ay = layout.mirrors[0].actuators.T
    inner = np.hypot(ax, ay) < 1.3
    for R, moved in ((now, 0.0), (later, step)):
        got = (R @ slopes)[inner]
        wanted = 1e-7 * ((ax - moved) ** 2 - ay**2)[inner]
        basis = np.stack([np.ones(inner.sum()), ax[inner], ay[inner]], axis=1)
        # commands of a smooth shape are the shape over the sum of influence functions; piston and tip-tilt are free
        got, wanted = (v - basis @ np.linalg.lstsq(basis, v, rcond=None)[0] for v in (got, wanted))
        assert got @ wanted / np.sqrt((got @ got) * (wanted @ wanted)) > 0.98


def test_prediction_gains_and_a_reversed_wind_costs(mini: System) -> None:
    prediction = Prediction(mini)
    static, right, wrong = (
        [b.wfe for b in prediction.budgets(R.R[0])]
        for R in (implicit(mini)[0], predictive(mini)[0], predictive(_turned(mini, np.pi))[0])
    )
    for a, b, c in zip(static, right, wrong):
        assert b < a - 15e-9
        assert c > a + 15e-9


def test_provenance_says_what_it_is(mini: System) -> None:
    provenance = predictive(mini)[0].provenance
    assert provenance["method"] == "predictive"
    assert provenance["lag_s"] == effective_lag(mini.loop)


# --- several exposures ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [0.3, 1.0])
@pytest.mark.parametrize("split", [False, True])
def test_without_wind_several_exposures_only_average_noise(mini: System, gain: float, split: bool) -> None:
    """R_j = w_j R for w = C^-1 1 / (1^T C^-1 1), C_ij = (1-g)^|i-j|, and R the static one for so much less noise."""
    calm = mini.with_changes({"atmosphere.layers.*.wind_speed": 0.0})
    n = 3
    C = (1 - gain) ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    whole = float(np.linalg.solve(C, np.ones(n)).sum())
    less = gain / (2 - gain) / whole
    found, _ = predictive(calm, epochs=n, noise_gain=gain, split=split)
    static = implicit(calm, noise_gain=2 * less / (1 + less), split=split)[0].R[0]
    for R, weight in zip(found.R, np.linalg.solve(C, np.ones(n)) / whole):
        np.testing.assert_allclose(R, weight * static, atol=2e-5 * np.abs(static).max())
    alone = implicit(calm, noise_gain=gain, split=split)[0].R[0]
    np.testing.assert_allclose(found.fallback_R, alone, atol=1e-6 * np.abs(alone).max())


def _by_hand(system: System, lag: float, epochs: int) -> np.ndarray:
    """(epochs, n_commands, n_slopes) from phases at each node of each exposure on each layer, and a pseudo-inverse."""
    layout = Layout(system)
    rho = np.linspace(0, 60, 60001)
    C = METRES_PER_RADIAN**2 * covariance(rho, system.los_r0, system.atmosphere.outer_scale)

    def seen(x: np.ndarray, y: np.ndarray, direction, distance: float, age: float) -> list[np.ndarray]:
        """Places on each layer where the turbulence of an exposure that long ago now is, as complex numbers."""
        out = []
        for layer, height in zip(system.atmosphere.layers, system.los_heights):
            here = (1 - height / distance) * (x + 1j * y) + height * (direction.x + 1j * direction.y)
            out.append(here + age * layer.wind_speed * np.exp(1j * layer.wind_direction))
        return out

    def correlated(a: list[np.ndarray], b: list[np.ndarray]) -> np.ndarray:
        return sum(
            fraction * np.interp(np.abs(np.subtract.outer(p, q)), rho, C)
            for fraction, p, q in zip(system.atmosphere.fractions, a, b)
        )

    nodes, gradients = [], []
    for epoch in range(epochs):
        for sensor, place in zip(system.sensors, layout.sensors):
            operator, star = gradient_operator(system.telescope, place), system.star_of(sensor)
            age = lag + epoch / system.loop.rate
            nodes.append(seen(operator.x, operator.y, star.position, system.los_range(star), age))
            gradients.append(operator.matrix.toarray())
    everywhere = [np.concatenate(places) for places in zip(*nodes)]
    gradient = block_diag(*gradients)
    P = np.eye(layout.n_slopes) - (M := blind_modes(system, layout)) @ M.T
    P = np.kron(np.eye(epochs), P)
    g = system.loop.gain
    filtered = (1 - g) ** np.abs(np.subtract.outer(np.arange(epochs), np.arange(epochs)))
    noise = np.kron(filtered, noise_covariance(system, layout, g).toarray())
    S = P @ (gradient @ correlated(everywhere, everywhere) @ gradient.T + noise) @ P

    grid = pupil_grid(system.telescope, layout.mirrors[0].pitch / 2)
    normal, right = np.zeros((layout.n_commands,) * 2), np.zeros((layout.n_commands, len(S)))
    for target in system.science.targets:
        N = mirror_wavefronts(layout, grid.x, grid.y, target.position)
        N = N - grid.weight @ N
        weighted = target.weight / 1.5 * (N.T * grid.weight)
        normal += weighted @ N
        right += (
            weighted @ correlated(seen(grid.x, grid.y, target.position, math.inf, 0.0), everywhere) @ gradient.T @ P
        )
    normal += KAPPA * np.trace(normal) / len(normal) * np.eye(len(normal))
    R = np.linalg.solve(normal, right @ np.linalg.pinv(S, rcond=1e-12, hermitian=True))
    return R.reshape(layout.n_commands, epochs, layout.n_slopes).transpose(1, 0, 2)


def test_two_exposures_by_hand(mini: System) -> None:
    lag = 0.012
    found, _ = predictive(mini, epochs=2, lag=lag)
    expected = _by_hand(mini, lag, 2)
    assert np.linalg.norm(found.R - expected) < 1e-4 * np.linalg.norm(expected)


def test_fast_and_on_threads_is_as_good(mini: System) -> None:
    prediction = Prediction(mini, epochs=2)
    for epochs in (1, 2):
        one, other = (predictive(mini, epochs=epochs, fast=fast, threads=1 + fast)[0] for fast in (False, True))
        assert mean_wfe(prediction.budgets(other.R)) == pytest.approx(mean_wfe(prediction.budgets(one.R)), abs=0.1e-9)


def test_each_exposure_more_gains(mini: System) -> None:
    prediction = Prediction(mini, epochs=3)
    wfe = [1e9 * mean_wfe(prediction.budgets(predictive(mini, epochs=n)[0].R)) for n in (1, 2, 3)]
    assert wfe[0] - 1 > wfe[1] > wfe[2] + 0.3
    # against the wind, it costs
    wrong = predictive(_turned(mini, np.pi), epochs=3)[0]
    assert 1e9 * mean_wfe(prediction.budgets(wrong.R)) > wfe[0] + 25


def test_provenance_of_several(mini: System) -> None:
    provenance = predictive(mini, epochs=2, wind_uncertainty=[1, 2, 3], label="two")[0].provenance
    assert (provenance["method"], provenance["epochs"], provenance["wind_uncertainty"]) == ("predictive", 2, [1, 2, 3])
    assert predictive(mini, wind_uncertainty=2)[0].provenance["wind_uncertainty"] == 2
    with pytest.raises(ValueError, match="epochs: expected at least 1, got 0"):
        predictive(mini, epochs=0)


def test_progress_rises_to_one(mini: System) -> None:
    told: list[tuple[str, float]] = []
    predictive(mini, epochs=2, progress=lambda name, done: told.append((name, done)))
    shares = [done for _, done in told]
    assert np.all(np.diff(shares) > -1e-9) and shares[0] == 0 and told[-1] == ("done", 1.0)


# --- a wind that is not well known ----------------------------------------------------------------------------------


def test_a_wind_is_trusted_as_far_as_it_is_known(mini: System) -> None:
    """max(0, 1 - 3 sigma^2 / v^2) of 6, 12 and 18 m/s."""
    calmed = with_trusted_winds(mini, 6.0)
    np.testing.assert_allclose([layer.wind_speed for layer in calmed.atmosphere.layers], [0, 3, 12])
    each = with_trusted_winds(mini, [0, 6, 100])
    np.testing.assert_allclose([layer.wind_speed for layer in each.atmosphere.layers], [6, 3, 0])
    np.testing.assert_allclose(winds(each)[:2] / winds(mini)[:2], [[1, 1], [0.25, 0.25]])
    assert with_trusted_winds(mini, 0.0) is mini
    for bad in (-1.0, [1.0, 2.0]):
        with pytest.raises(ValueError, match="wind_uncertainty: expected one or 3 speeds"):
            with_trusted_winds(mini, bad)


def test_an_unknown_wind_is_no_wind(mini: System) -> None:
    static = implicit(mini)[0].R
    np.testing.assert_allclose(predictive(mini, wind_uncertainty=10.5)[0].R, static, atol=1e-6 * np.abs(static).max())


@pytest.mark.parametrize("uncertainty", [4.0, 10.0])
def test_winds_measured_badly_cost_no_more_than_none(mini: System, uncertainty: float) -> None:
    """Winds drawn with that error: on average about as good as the better of trusting them and of ignoring them."""
    prediction = Prediction(mini)

    def variance(R: np.ndarray) -> float:
        return 1e18 * mean_wfe(prediction.budgets(R)) ** 2

    rng = np.random.default_rng(0)
    trusting, gated = [], []
    for _ in range(8):
        measured = winds(mini) + uncertainty * rng.standard_normal((3, 2))
        changes = {}
        for l, (x, y) in enumerate(measured):
            changes[f"atmosphere.layers.{l}.wind_speed"] = math.hypot(x, y)
            changes[f"atmosphere.layers.{l}.wind_direction"] = math.atan2(y, x)
        believed = mini.with_changes(changes)
        trusting.append(variance(predictive(believed)[0].R))
        gated.append(variance(predictive(believed, wind_uncertainty=uncertainty)[0].R))
    static = variance(implicit(mini)[0].R)
    assert np.mean(gated) < min(static, np.mean(trusting)) * 1.02
