"""Predicted residuals against closed forms and identities, stability against the loop's own recursion."""

import math

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import LoopSettings, System, load_system
from srtomo_srtc import predict
from srtomo_srtc.atmosphere import METRES_PER_RADIAN
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.predict import Prediction, drifted, mismatch, moved_mirrors, slope_ages, stability
from srtomo_srtc.reconstructors import implicit


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def R(mini: System) -> np.ndarray:
    return implicit(mini)[0].R[0].astype(float)


@pytest.fixture(scope="module")
def prediction(mini: System) -> Prediction:
    return Prediction(mini)


# --- quadratures ----------------------------------------------------------------------------------------------------


def test_gauss_rule_of_a_uniform_measure_is_gauss_legendre() -> None:
    points = (np.arange(20000) + 0.5) / 10000 - 1
    rule = predict.gauss_rule(points, np.ones_like(points), 4)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    np.testing.assert_allclose(rule.nodes, nodes, atol=1e-7)
    np.testing.assert_allclose(rule.weights, weights / 2, atol=1e-7)


@pytest.mark.parametrize(("gain", "delay"), [(0.5, 2.0), (0.3, 1.4), (1.0, 3.0)])
def test_slopes_are_as_old_as_the_loop_makes_them(gain: float, delay: float) -> None:
    loop = LoopSettings(rate=500.0, delay=delay, gain=gain)
    rule = slope_ages(loop)
    share = delay % 1
    # geometric, Bernoulli and uniform distributions are independent: means and variances add
    mean = delay + (1 - gain) / gain
    variance = (1 - gain) / gain**2 + share * (1 - share) + 1 / 12
    assert rule.weights.sum() == pytest.approx(1)
    assert rule.weights @ rule.nodes == pytest.approx(mean / 500)
    assert rule.weights @ (rule.nodes * 500 - mean) ** 2 == pytest.approx(variance)


@pytest.mark.parametrize("gain", [0.2, 0.5, 1.0])
def test_differences_of_age(gain: float) -> None:
    none, rule = predict.age_differences(LoopSettings(rate=500.0, delay=2.0, gain=gain))
    assert none + 2 * rule.weights.sum() == pytest.approx(1)
    # of two independent draws from the filter, and from the exposure
    variance = 2 * ((1 - gain) / gain**2 + 1 / 12)
    assert 2 * rule.weights @ (rule.nodes * 500) ** 2 == pytest.approx(variance)


def test_few_nodes_are_enough(
    mini: System, R: np.ndarray, prediction: Prediction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(predict, "slope_ages", lambda loop: slope_ages(loop, 12))
    many = predict.age_differences
    monkeypatch.setattr(predict, "age_differences", lambda loop: many(loop, 15))
    fine = Prediction(mini).budgets(R)
    for few, more in zip(prediction.budgets(R), fine):
        assert few.wfe == pytest.approx(more.wfe, abs=0.5e-9)


# --- budgets --------------------------------------------------------------------------------------------------------


def test_nothing_corrected_leaves_noll_s_residual(mini: System) -> None:
    plain = mini.with_changes(
        {
            "telescope.obscuration": 0.0,
            "zenith_angle": 0.0,
            "atmosphere.outer_scale": 2000.0,
            "atmosphere.layers": [mini.atmosphere.layers[0].model_dump() | {"fraction": 1.0}],
        }
    )
    nothing = Prediction(plain, lag=False).budgets(np.zeros((Layout(plain).n_commands, Layout(plain).n_slopes)))[0]
    # Noll's Delta_3, with its exact coefficient
    noll = 0.1361 * (4 / 0.16) ** (5 / 3) * METRES_PER_RADIAN**2
    assert nothing.total == pytest.approx(noll, rel=0.01)
    assert nothing.noise == nothing.lag == 0


def test_fitting_is_that_of_a_square_cut_off(mini: System, prediction: Prediction, R: np.ndarray) -> None:
    square = METRES_PER_RADIAN**2 * 0.23126 * (0.4 / mini.los_r0) ** (5 / 3)
    for budget in prediction.budgets(R):
        # Gaussian influence functions do a little better than the square
        assert 0.85 * square < budget.fitting < square


def test_without_wind_there_is_no_lag(mini: System, R: np.ndarray, prediction: Prediction) -> None:
    windless = Prediction(mini.with_changes({"atmosphere.layers.*.wind_speed": 0.0})).budgets(R)
    for calm, windy in zip(windless, prediction.budgets(R)):
        assert calm.lag == pytest.approx(0, abs=1e-4 * calm.total)
        assert (calm.fitting, calm.tomography, calm.noise) == (
            pytest.approx(windy.fitting),
            pytest.approx(windy.tomography),
            pytest.approx(windy.noise),
        )
        assert windy.lag > 0.2 * windy.total


def test_the_reconstructor_of_a_still_sky_is_the_best_for_it(mini: System) -> None:
    on_axis = mini.with_changes({"science.targets": [mini.science.targets[0].model_dump()]})
    still = Prediction(on_axis, lag=False)
    best = implicit(on_axis)[0].R[0].astype(float)
    # piston and tip-tilt are part of what R minimises, too
    least = still.budgets(best)[0]
    rng = np.random.default_rng(1)
    for _ in range(3):
        other = still.budgets(best * (1 + 0.1 * rng.standard_normal(best.shape)))[0]
        assert other.total + other.tip_tilt > least.total + least.tip_tilt
    for factor in (0.97, 1.03):
        other = still.budgets(factor * best)[0]
        assert other.total + other.tip_tilt > least.total + least.tip_tilt


def test_noise_falls_with_photons(mini: System, R: np.ndarray, prediction: Prediction) -> None:
    # without read noise the variance is inversely proportional to the photons
    quiet = mini.with_changes({"sensors.*.read_noise": 0.0})
    few = Prediction(quiet, lag=False).budgets(R)[0]
    many = Prediction(
        quiet.with_changes({f"sensors.{i}.photons": 4 * s.photons for i, s in enumerate(quiet.sensors)}), lag=False
    ).budgets(R)[0]
    assert few.noise == pytest.approx(4 * many.noise, rel=1e-6)
    assert few.tomography == pytest.approx(many.tomography)


def test_jitter_of_a_star_that_is_trusted_counts(mini: System, R: np.ndarray, prediction: Prediction) -> None:
    def tilt(star: int) -> float:
        shaken = mini.with_changes({f"guide_stars.{star}.jitter": 1e-6})
        return Prediction(shaken, lag=False).budgets(R)[0].tip_tilt

    calm = Prediction(mini, lag=False).budgets(R)[0].tip_tilt
    assert tilt(0) == pytest.approx(calm, rel=1e-6)  # a laser's is projected out
    # followed wholly by the mirror, but for the loop's filter: over a pupil of radius a, x is a / 2 rms
    assert tilt(3) - calm == pytest.approx(2 * (1e-6 * 2 / 2) ** 2 / 3, rel=0.15)


def test_a_reconstructor_of_another_shape_is_refused(prediction: Prediction) -> None:
    with pytest.raises(ValueError, match="R: expected shape"):
        prediction.budgets(np.zeros((3, 4)))


# --- stability ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [1.0, 1.4, 2.0, 3.7])
@pytest.mark.parametrize("value", [0.9, -1.9, 0.6 + 0.9j, 1.2])
def test_growth_is_that_of_the_recursion(value: complex, delay: float) -> None:
    rotation = np.array([[value.real, -value.imag], [value.imag, value.real]])
    found = stability(rotation, 0.5, delay)
    whole, share = math.floor(delay), delay % 1
    u = [np.array([1.0, 0.3])] * (whole + 2)
    norms = []
    for _ in range(400):
        on_mirror = (1 - share) * u[-whole] + share * u[-whole - 1]
        u.append(0.5 * u[-1] + 0.5 * rotation @ on_mirror)
        norms.append(np.linalg.norm(u[-1]))
    assert found.growth == pytest.approx((np.max(norms[-50:]) / np.max(norms[150:200])) ** (1 / 200), abs=2e-3)
    assert found.radius == pytest.approx(abs(value))


def test_with_the_true_interaction_matrix_only_the_filter_is_left(mini: System) -> None:
    reconstructor, G = implicit(mini)
    found = stability(mismatch(reconstructor, G), 0.3, 2.0)
    assert found.radius < 1e-5
    assert found.growth == pytest.approx(0.7, abs=1e-3)


def test_a_wrong_gain_and_a_moved_mirror(mini: System) -> None:
    reconstructor, G = implicit(mini)
    largest = np.abs(np.linalg.eigvals(reconstructor.R[0] @ G)).max()
    assert predict.misplaced(mini, reconstructor, gain_error=1.5).radius == pytest.approx(0.5 * largest, rel=1e-4)
    radii = [predict.misplaced(mini, reconstructor, shift=(x * 0.5, 0.0)).radius for x in (0.0, 0.1, 0.2, 0.4)]
    assert radii == sorted(radii)
    assert radii[-1] > 1
    # turning the mirror and all sensors together, and back, is no change
    turned = moved_mirrors(moved_mirrors(Layout(mini), (0.1, 0.0), 0.2), rotation=-0.2)
    np.testing.assert_allclose(
        turned.mirrors[0].actuators - Layout(mini).mirrors[0].actuators,
        np.broadcast_to([0.1 * math.cos(0.2), -0.1 * math.sin(0.2)], (turned.n_commands, 2)),
        atol=1e-12,
    )
    ninety = moved_mirrors(Layout(mini), rotation=math.pi / 2)
    x, y = Layout(mini).mirrors[0].actuators.T
    np.testing.assert_allclose(ninety.mirrors[0].actuators, np.stack([-y, x], axis=1), atol=1e-12)


def test_limit_is_where_one_is_passed() -> None:
    assert predict.limit(lambda x: x / 0.37, 0.0, 1.0, 1e-3) == pytest.approx(0.37, abs=1e-3)
    assert predict.limit(lambda x: 0.0, 0.0, 1.0, 1e-3) == 1.0


def test_a_mirror_of_the_wrong_gain_is_made_up_for(mini: System, prediction: Prediction, R: np.ndarray) -> None:
    """Pseudo-open-loop control with a mirror 1.2 times too strong settles at what the sky asks for, but for Q < 1."""
    reconstructor, G = implicit(mini)
    strong = [b.wfe for b in prediction.budgets(R, mismatch(reconstructor, 1.2 * G))]
    # the commands shrink by 1.2 where R G = 1, and the true mirror gives 1.2 of them
    x = np.linalg.solve(np.eye(len(R)) - mismatch(reconstructor, 1.2 * G), R)
    as_seen = [b.wfe for b in prediction.budgets(1.2 * x)]
    right = [b.wfe for b in prediction.budgets(R)]
    for a, b in zip(as_seen, right):
        assert a == pytest.approx(b, rel=0.02)
    assert all(a > b for a, b in zip(strong, right))


# --- drift ----------------------------------------------------------------------------------------------------------


def test_drift_of_strength_alone_is_linear_in_variance(mini: System, R: np.ndarray) -> None:
    end = mini.with_changes(
        {
            "atmosphere.r0": 0.1,
            **{f"atmosphere.layers.{i}.fraction": f for i, f in enumerate((0.2, 0.3, 0.5))},
        }
    )
    totals = [Prediction(drifted(mini, end, share)).budgets(R)[1] for share in (0.0, 0.3, 1.0)]
    noise = totals[0].noise
    a, b, c = (t.total - noise for t in totals)
    assert b == pytest.approx(0.7 * a + 0.3 * c, rel=1e-6)


def test_drift_has_the_right_ends_and_moves_the_wind(mini: System) -> None:
    end = mini.with_changes({"atmosphere.layers.1.wind_direction": 0.0, "atmosphere.layers.1.altitude": 5000.0})
    for share, expected in ((0.0, mini), (1.0, end)):
        sky = drifted(mini, end, share).atmosphere
        for got, wanted in zip(sky.layers, expected.atmosphere.layers):
            assert got.altitude == pytest.approx(wanted.altitude)
            assert got.fraction == pytest.approx(wanted.fraction)
            assert got.wind_speed == pytest.approx(wanted.wind_speed)
            assert math.cos(got.wind_direction - wanted.wind_direction) == pytest.approx(1)
    half = drifted(mini, end, 0.5).atmosphere.layers[1]
    assert half.altitude == 4000
    assert half.wind_direction == pytest.approx(math.radians(50))
    assert half.wind_speed == pytest.approx(12 * math.cos(math.radians(50)))
    fewer = mini.with_changes({"atmosphere.layers": [mini.atmosphere.layers[0].model_dump() | {"fraction": 1.0}]})
    with pytest.raises(ValueError, match="expected 3 at both ends of the drift, got 1"):
        drifted(mini, fewer, 0.5)


def test_the_interaction_matrix_follows_moved_mirrors(mini: System) -> None:
    """Moving mirror and sensors together changes nothing that the sensors see of it."""
    layout = Layout(mini)
    G = interaction_matrix(mini, layout)
    assert np.abs(interaction_matrix(mini, moved_mirrors(layout, (0.05, 0.0))) - G).max() > 0.1 * np.abs(G).max()
    names = moved_mirrors(layout, (0.05, 0.0), names=("another",))
    assert np.array_equal(interaction_matrix(mini, names), G)
