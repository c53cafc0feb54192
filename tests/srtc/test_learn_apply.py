"""Learn & Apply: virtual slopes instead of wavefronts, from models or from measurements."""

import json

import numpy as np
import pytest
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, slope_covariance
from srtomo_srtc.estimator import commands_from, estimator
from srtomo_srtc.fitting import Fit
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, noise_covariance, project, sightlines
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.reconstructors.learn_apply import learn_apply, slope_cross_covariance, virtual_system
from srtomo_srtc.wind import sensors_carried, winds


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


class Model:
    """Covariances of slopes, with noise, and with virtual slopes some time later; of the virtual slopes themselves."""

    def __init__(self, system: System, virtual: System, lag: float = 0.0) -> None:
        self.layout, profile = Layout(system), Profile.of(system)
        sensors, others = sightlines(system, self.layout, profile), sightlines(virtual, Layout(virtual), profile)
        later = sensors_carried(others, winds(system), -lag)
        turbulence = Turbulence.covering(profile, [s.nodes for s in [*sensors, *later]])
        self.S = slope_covariance(turbulence, sensors) + noise_covariance(system, self.layout, 0.5).toarray()
        self.cross = slope_cross_covariance(turbulence, sensors, later)
        self.virtual = slope_covariance(turbulence, others)
        self.blind = blind_modes(system, self.layout)

    def residual(self, W: np.ndarray) -> float:
        """Mean square error of virtual slopes ``W s`` for W (n_virtual, n_slopes), rad^2."""
        return float(np.trace(self.virtual) - 2 * np.sum(W * self.cross.T) + np.sum((W @ self.S) * W))

    def best(self) -> np.ndarray:
        """W (n_virtual, n_slopes)."""
        return estimator(self.S.copy(), self.cross, self.blind).T


@pytest.fixture(scope="module")
def model(mini: System) -> Model:
    return Model(mini, virtual_system(mini))


def test_a_complete_set_of_virtual_slopes_is_the_implicit_estimate(mini: System) -> None:
    """Differences between neighbours of the fit's grid, which determine the wavefront but for piston."""
    layout, profile = Layout(mini), Profile.of(mini)
    sensors, fit = sightlines(mini, layout, profile), Fit(mini, layout)
    near = np.abs(np.subtract.outer(fit.grid.x, fit.grid.x)) + np.abs(np.subtract.outer(fit.grid.y, fit.grid.y))
    step = np.diff(np.unique(fit.grid.x.round(9))).min()
    first, second = np.nonzero(np.triu(near < 1.01 * step, 1))
    row = np.arange(len(first))
    ends = np.concatenate([first, second])
    values = np.repeat([-1 / step, 1 / step], len(first))
    differences = sparse.csr_array(sparse.coo_array((values, (np.tile(row, 2), ends)), shape=(len(row), len(near))))
    integral = np.linalg.pinv(differences.toarray(), rcond=1e-9)
    virtual, control = [], []
    for view, points in fit.footprints(profile.heights):
        virtual.append(Sightline(points, differences))
        control.append(fit.solve(view.projection @ integral))
    turbulence = Turbulence.covering(profile, [s.nodes for s in [*sensors, *virtual]])
    noise = noise_covariance(mini, layout, 0.5)
    R = commands_from(
        slope_covariance(turbulence, sensors) + noise.toarray(),
        slope_cross_covariance(turbulence, sensors, virtual) @ np.hstack(control).T,
        blind_modes(mini, layout),
        lambda commands: commands,
        None,
        noise,
    )
    expected = implicit(mini)[0].R[0]
    np.testing.assert_allclose(R, expected, atol=1e-6 * np.abs(expected).max())


def test_covariances_given_are_used_as_they_are(mini: System, model: Model) -> None:
    modelled = learn_apply(mini)[0]
    R = learn_apply(mini, slopes=model.S, truth=model.cross.T)[0].R[0]
    np.testing.assert_allclose(R, modelled.R[0], atol=1e-6 * np.abs(R).max())
    twice = learn_apply(mini, truth=2 * model.cross.T)[0].R[0]
    np.testing.assert_allclose(twice, 2 * R, atol=1e-6 * np.abs(R).max())
    virtual = virtual_system(mini)
    control = np.linalg.pinv(interaction_matrix(virtual, Layout(virtual)), rcond=0.05)
    given = learn_apply(mini, control_matrix=control)[0].R[0]
    np.testing.assert_allclose(given, control @ model.best(), atol=1e-6 * np.abs(given).max())


def test_enough_measurements_are_as_good_as_the_model(mini: System, model: Model) -> None:
    """N exposures of n slopes lose a factor 1 / (1 - n/N) in the residual's variance, as any regression does."""
    n, n_exposures = len(model.S), 6000
    joint = np.block([[model.S, model.cross], [model.cross.T, model.virtual + 1e-16 * np.eye(len(model.virtual))]])
    values, vectors = np.linalg.eigh(joint)
    root = vectors * np.sqrt(np.maximum(values, 0))
    exposures = np.random.default_rng(3).standard_normal((n_exposures, len(joint))) @ root.T
    slopes, truth = exposures[:, :n], exposures[:, n:]
    W = estimator(slopes.T @ slopes / n_exposures, slopes.T @ truth / n_exposures, model.blind).T
    free = n - model.blind.shape[1]
    assert model.residual(W) / model.residual(model.best()) == pytest.approx(1 / (1 - free / n_exposures), rel=0.02)
    # the same covariances by the front door
    virtual = virtual_system(mini)
    measured = learn_apply(
        mini, slopes=slopes.T @ slopes / n_exposures, truth=truth.T @ slopes / n_exposures, virtual=virtual
    )[0]
    assert measured.provenance["measured"] == ["slopes", "truth"]
    R = learn_apply(mini)[0].R[0]
    assert np.linalg.norm(measured.R[0] - R) < 0.5 * np.linalg.norm(R)


def test_prediction_goes_with_the_wind(mini: System) -> None:
    lag = 0.02
    virtual = virtual_system(mini)
    ahead = Model(mini, virtual, lag)
    static, right, wrong = (Model(mini, virtual, by).best() for by in (0.0, lag, -lag))
    assert ahead.residual(right) < 0.9 * ahead.residual(static)
    assert ahead.residual(static) < ahead.residual(wrong)
    # and that is what the reconstructor does
    R = [learn_apply(mini, lag=by)[0].R[0] for by in (0.0, lag)]
    control = learn_apply(mini, control_matrix=np.eye(Layout(mini).n_commands, Layout(virtual).n_slopes), lag=lag)[0]
    np.testing.assert_allclose(control.R[0], right[: len(R[0])], atol=1e-6 * np.abs(right).max())
    assert np.linalg.norm(R[1] - R[0]) > 0.05 * np.linalg.norm(R[0])
    still = mini.with_changes({f"atmosphere.layers.{i}.wind_speed": 0.0 for i in range(3)})
    np.testing.assert_allclose(learn_apply(still, lag=lag)[0].R[0], R[0], atol=1e-6 * np.abs(R[0]).max())


def test_blind_modes_stay_out(mini: System, model: Model) -> None:
    for R in (learn_apply(mini)[0].R[0], learn_apply(mini, slopes=model.S)[0].R[0]):
        assert np.abs(R.astype(float) @ model.blind).max() < 1e-5 * np.abs(R).max()
    assert project(model.blind, model.blind) == pytest.approx(0, abs=1e-12)


def test_virtual_sensors_stand_on_the_targets(mini: System) -> None:
    virtual = virtual_system(mini)
    assert [virtual.star_of(s).position for s in virtual.sensors] == [t.position for t in mini.science.targets]
    assert {(s.shift, s.rotation, s.subapertures) for s in virtual.sensors} == {((0.0, 0.0), 0.0, 10)}
    assert Layout(virtual).n_commands == Layout(mini).n_commands
    assert {s.subapertures for s in virtual_system(mini, 6).sensors} == {6}


def test_matrices_of_the_wrong_shape_are_refused(mini: System) -> None:
    n, n_virtual = Layout(mini).n_slopes, Layout(virtual_system(mini)).n_slopes
    for name, matrix in (("slopes", np.eye(3)), ("truth", np.zeros((n, n_virtual))), ("control_matrix", np.eye(n))):
        with pytest.raises(ValueError, match=f"{name}: expected shape"):
            learn_apply(mini, **{name: matrix})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="virtual: expected the mirrors of the system"):
        learn_apply(mini, virtual=virtual_system(mini.with_changes({"mirrors.0.actuators": 9})))


def test_provenance(mini: System) -> None:
    reconstructor, G = learn_apply(mini, label="test", lag=0.01)
    provenance = json.loads(json.dumps(reconstructor.provenance))
    assert (provenance["method"], provenance["lag_s"], provenance["measured"]) == ("learn_apply", 0.01, [])
    assert provenance["virtual_sensors"] == ["virtual_0", "virtual_1"]
    np.testing.assert_allclose(reconstructor.Q[0], reconstructor.R[0] @ G, atol=1e-5)
