"""Health on frames that are drawn from a model's own covariance, formed here in float64, and from others."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.health import OVERSAMPLING, FlowModel, Health, SlopeModel, block_mean
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.wind import sensors_carried, winds

Array = NDArray[np.float64]


def covariance_of(system: System, layout: Layout) -> Array:
    """P (Sigma_ss + Sigma_nn) P of one frame."""
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile, OVERSAMPLING)
    S = slope_covariance(Turbulence.covering(profile, [sensor.nodes for sensor in sensors]), sensors)
    S += noise_covariance(system, layout, 1.0).toarray()
    blind = blind_modes(system, layout)
    P = np.eye(len(S)) - blind @ blind.T
    return np.asarray(P @ S @ P)


def draws(S: Array, n: int, seed: int = 0) -> Array:
    """(n, n_slopes) independent frames."""
    values, vectors = np.linalg.eigh(S)
    return np.asarray(
        np.random.default_rng(seed).standard_normal((n, len(S))) * np.sqrt(np.maximum(values, 0)) @ vectors.T
    )


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def S(mini: System) -> Array:
    return covariance_of(mini, Layout(mini))


@pytest.fixture(scope="module")
def model(mini: System) -> SlopeModel:
    return SlopeModel(mini)


def test_each_sensor_is_foretold_by_regression_on_the_others(mini: System, S: Array, model: SlopeModel) -> None:
    slopes = draws(S, 5)
    layout = Layout(mini)
    foretold, scores = model.foretold(slopes), model.scores(slopes)
    for w, n in enumerate(model.n_seen):
        own = np.zeros(len(S), bool)
        own[layout.slopes_of(w)] = True
        regression = S[np.ix_(own, ~own)] @ np.linalg.pinv(S[np.ix_(~own, ~own)], rcond=1e-10, hermitian=True)
        error = slopes[:, own] - slopes[:, ~own] @ regression.T
        left = S[np.ix_(own, own)] - regression @ S[np.ix_(~own, own)]
        assert foretold[:, own] == pytest.approx(slopes[:, own] - error, abs=2e-3 * slopes.std())
        whitened = np.linalg.pinv(left, rcond=1e-8, hermitian=True)
        assert scores.innovation[:, w] == pytest.approx(np.einsum("fi,ij,fj->f", error, whitened, error) / n, rel=2e-3)
        assert scores.residual[:, w] == pytest.approx((error**2).sum(axis=1) / n, rel=2e-3)
        assert model.explained[w] == pytest.approx(1 - left.trace() / S[np.ix_(own, own)].trace(), abs=1e-3)


def test_the_log_score_is_the_density(S: Array, model: SlopeModel) -> None:
    slopes = draws(S, 5)
    values, vectors = np.linalg.eigh(S)
    seen = slice(len(S) - int(model.n_seen.sum()), None)
    assert np.all(values[: seen.start] < 1e-6 * values[seen.start])
    expected = norm.logpdf(slopes @ vectors[:, seen], scale=np.sqrt(values[seen])).sum(axis=1)
    assert model.scores(slopes).log_score == pytest.approx(expected, abs=0.1)


def test_what_is_in_blind_modes_does_not_count(mini: System, S: Array, model: SlopeModel) -> None:
    slopes = draws(S, 5)
    shaken = slopes + np.ones((5, 1)) * blind_modes(mini, Layout(mini)).sum(axis=1) * slopes.std()
    assert model.scores(shaken).log_score == pytest.approx(model.scores(slopes).log_score, rel=1e-5)
    assert model.foretold(shaken) == pytest.approx(model.foretold(slopes), abs=1e-4 * slopes.std())


def test_the_right_model_is_healthy(S: Array, model: SlopeModel) -> None:
    """Innovations are chi-square over n_w: mean 1, variance 2 / n_w."""
    n_frames = 2000
    innovation = model.scores(draws(S, n_frames)).innovation
    assert np.all(np.abs(innovation.mean(axis=0) - 1) < 4 * np.sqrt(2 / model.n_seen / n_frames))
    assert innovation.var(axis=0) == pytest.approx(2 / model.n_seen, rel=0.15)


def shifted(system: System, sensor: int, by: float) -> Layout:
    """One sensor moved along x, sub-apertures; the same ones are valid."""
    layout = Layout(system)
    places = list(layout.sensors)
    x, y = places[sensor].shift
    places[sensor] = replace(places[sensor], shift=(x + by * places[sensor].size, y))
    layout.sensors = tuple(places)
    return layout


@pytest.mark.parametrize("sensor", [0, 1, 2])
@pytest.mark.parametrize("ailment", ["shifted", "dim", "dead"])
def test_it_singles_out_a_sensor(mini: System, S: Array, model: SlopeModel, sensor: int, ailment: str) -> None:
    own = Layout(mini).slopes_of(sensor)
    if ailment == "shifted":
        slopes = draws(covariance_of(mini, shifted(mini, sensor, 0.3)), 400)
    elif ailment == "dim":
        photons = mini.sensors[sensor].photons / 4
        slopes = draws(covariance_of(mini.with_changes({f"sensors.{sensor}.photons": photons}), Layout(mini)), 400)
    else:
        # its pseudo-open-loop slopes are what the mirror makes of the others'
        slopes = draws(S, 400)
        slopes[:, own] = model.foretold(slopes)[:, own]
    health = Health.of(model.scores(slopes), np.arange(400) // 40)
    assert sensor in health.ill(0.1)
    departure = np.abs(np.log(np.maximum(health.innovation.mean[:3], 1e-6)))
    assert np.argmax(departure) == sensor


def test_a_dead_sensor_stands_still(mini: System, model: SlopeModel) -> None:
    """Whatever it shows, and be it for one block; ten times the light does not stand still."""
    layout = Layout(mini)
    sigma = 0.2 * model.noise.repeat(np.diff(layout.slope_start))
    measured = sigma * np.random.default_rng(4).standard_normal((60, layout.n_slopes))
    block = np.arange(60) // 10
    assert model.silent(measured, block) == []
    measured[20:30, layout.slopes_of(2)] = 3e-7
    assert model.silent(measured, block) == [2]


AHEAD = 0.012  # s


def joint_covariance(system: System) -> Array:
    """Of slopes later and now, (2 n_slopes, 2 n_slopes)."""
    layout, profile = Layout(system), Profile.of(system)
    later = sightlines(system, layout, profile, OVERSAMPLING)
    both = [*later, *sensors_carried(later, winds(system), AHEAD)]
    joint = slope_covariance(Turbulence.covering(profile, [sensor.nodes for sensor in both]), both)
    joint += np.kron(np.eye(2), noise_covariance(system, layout, 1.0).toarray())
    blind = blind_modes(system, layout)
    P = np.kron(np.eye(2), np.eye(len(blind)) - blind @ blind.T)
    return np.asarray(P @ joint @ P)


def turned(system: System, angle: float) -> System:
    """All winds turned, rad."""
    layers = [layer.model_dump() for layer in system.atmosphere.layers]
    for layer in layers:
        layer["wind_direction"] += angle
    return system.with_changes({"atmosphere.layers": layers})


def test_foretelling_later_slopes_is_the_conditional_density(mini: System, S: Array, model: SlopeModel) -> None:
    joint = joint_covariance(mini)
    later, now = np.hsplit(draws(joint, 300), 2)
    scores = FlowModel(mini, AHEAD).scores_ahead(now, later)
    values, vectors = np.linalg.eigh(joint)
    seen = slice(len(joint) - 2 * int(model.n_seen.sum()), None)
    both = norm.logpdf(np.hstack([later, now]) @ vectors[:, seen], scale=np.sqrt(values[seen])).sum(axis=1)
    assert scores.log_score == pytest.approx(both - model.scores(now).log_score, abs=0.2)
    left = S - joint[: len(S), len(S) :] @ np.linalg.pinv(S, rcond=1e-10, hermitian=True) @ joint[len(S) :, : len(S)]
    for w, n in enumerate(model.n_seen):
        own = Layout(mini).slopes_of(w)
        assert scores.residual[:, w].mean() == pytest.approx(left[own, own].trace() / n, rel=0.05)


def test_only_later_slopes_tell_of_the_wind(mini: System, model: SlopeModel) -> None:
    truth = turned(mini, np.pi / 2)
    later, now = np.hsplit(draws(joint_covariance(truth), 100), 2)
    right, wrong = FlowModel(truth, AHEAD), FlowModel(mini, AHEAD)
    assert right.scores(later).log_score == pytest.approx(wrong.scores(later).log_score, abs=0.1)
    gain = right.scores_ahead(now, later).log_score - wrong.scores_ahead(now, later).log_score
    assert gain.mean() > 10 * gain.std() / 10


def test_errors_of_correlated_frames() -> None:
    """The mean of n frames of a first-order process with memory a varies by (1+a)/(1-a) over n: blocks see that."""
    a, n, blocks = 0.9, 4000, 40
    rng = np.random.default_rng(1)
    stated, found = [], []
    for _ in range(60):
        values = np.empty(n)
        values[0] = rng.standard_normal()
        noise = np.sqrt(1 - a**2) * rng.standard_normal(n)
        for k in range(1, n):
            values[k] = a * values[k - 1] + noise[k]
        mean, error = block_mean(values, np.arange(n) // (n // blocks))
        found.append(float(mean))
        stated.append(float(error))
    expected = np.sqrt((1 + a) / (1 - a) / n)
    assert np.mean(stated) == pytest.approx(expected, rel=0.1)
    assert np.std(found) == pytest.approx(expected, rel=0.3)


def test_blocks_of_different_lengths() -> None:
    mean, error = block_mean(np.array([[1.0, 0.0], [2.0, 0.0], [6.0, 0.0]]), np.array([4, 4, 9]))
    assert mean == pytest.approx([3.0, 0.0])
    # without one or the other block: 6 and 1.5
    assert error == pytest.approx([np.std([6, 1.5]), 0.0])
    with pytest.raises(ValueError, match="at least 2 blocks"):
        block_mean(np.ones(3), np.zeros(3, int))
