import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, slope_wavefront_covariance
from srtomo_srtc.crossterms import right_hand_side
from srtomo_srtc.fitting import Fit
from srtomo_srtc.mirrors import mirror_wavefronts
from srtomo_srtc.model import sightlines
from srtomo_srtc.wind import sensors_carried, winds

Case = tuple[Fit, Turbulence, list[Sightline], np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def case() -> Case:
    """Two mirrors and six unevenly weighted directions, and the right-hand side as the equations have it."""
    mini = load_system("mini")
    ground = mini.mirrors[0].model_dump()
    system: System = mini.with_changes(
        {
            "mirrors": [ground, {**ground, "name": "high", "altitude": 6000.0, "actuators": 13, "pitch": 0.5}],
            "science.targets": [
                {"position": {"x": 5e-6 * x, "y": 4e-6 * y}, "weight": 1.0 + 0.2 * x}
                for x in (-4.0, 0.0, 3.0)
                for y in (-5.0, 1.0)
            ],
        }
    )
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    targets = list(fit.footprints(profile.heights))
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *(points for _, points in targets)])
    total = sum(t.weight for t in system.science.targets)
    W = fit.grid.weight
    wanted = np.zeros((layout.n_commands, layout.n_slopes))
    for target, (_, points) in zip(system.science.targets, targets):
        N = mirror_wavefronts(layout, fit.grid.x, fit.grid.y, target.position)
        cross = slope_wavefront_covariance(turbulence, sensors, points)
        wanted += target.weight / total * (N - W @ N).T @ (W * cross).T
    return fit, turbulence, sensors, profile.heights, wanted


def test_directly(case: Case) -> None:
    fit, turbulence, sensors, heights, wanted = case
    found = right_hand_side(fit, turbulence, sensors, heights)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())
    threaded = right_hand_side(fit, turbulence, sensors, heights, threads=3)
    assert found.tobytes() == threaded.tobytes()


def test_from_tables(case: Case) -> None:
    fit, turbulence, sensors, heights, wanted = case
    found = right_hand_side(fit, turbulence, sensors, heights, fast=True)
    assert np.linalg.norm(found - wanted) < 1e-5 * np.linalg.norm(wanted)
    assert found.dtype == np.float32
    threaded = right_hand_side(fit, turbulence, sensors, heights, fast=True, threads=3)
    assert found.tobytes() == threaded.tobytes()


def test_from_tables_where_mirrors_are_coarse_and_sensors_fine() -> None:
    # neighbouring points are then far apart in the sensors' steps
    changes: dict[str, object] = {"mirrors.0.actuators": 8, "mirrors.0.pitch": 1.3, "sensors.0.subapertures": 40}
    system = load_system("mini", changes)
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    points = [points for _, points in fit.footprints(profile.heights)]
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *points])
    exact = right_hand_side(fit, turbulence, sensors, profile.heights)
    found = right_hand_side(fit, turbulence, sensors, profile.heights, fast=True)
    assert np.linalg.norm(found - exact) < 1e-5 * np.linalg.norm(exact)


def test_of_sensors_that_the_wind_carried_away(case: Case) -> None:
    fit, _, sensors, heights, _ = case
    mini = load_system("mini")
    later = sensors_carried(sensors, winds(mini), 0.02)
    points = [*(s.nodes for s in later), *(points for _, points in fit.footprints(heights))]
    turbulence = Turbulence.covering(Profile.of(mini), points)
    exact = right_hand_side(fit, turbulence, later, heights)
    found = right_hand_side(fit, turbulence, later, heights, fast=True)
    assert np.linalg.norm(found - exact) < 1e-5 * np.linalg.norm(exact)
    still = right_hand_side(fit, turbulence, sensors, heights)
    assert np.linalg.norm(still - exact) > 1e-2 * np.linalg.norm(exact)


def test_the_fit_in_float32(case: Case) -> None:
    fit, *_, wanted = case
    exact = fit.solve(wanted)
    found = fit.solve(wanted.astype(np.float32), threads=2)
    assert found.dtype == np.float32
    # as a wavefront: what the mirrors hardly make is known less well
    error, scale = (float(np.vdot(m, fit.normal @ m)) for m in (found - exact, exact))
    assert error < (1e-4) ** 2 * scale


def test_the_fit_is_that_of_dense_matrices(case: Case) -> None:
    fit = case[0]
    dense = sum(view.projection @ (view.modes.toarray() - view.pistons) for view in fit.views)
    dense += (fit.normal.trace() - np.trace(dense)) / len(dense) * np.eye(len(dense))
    np.testing.assert_allclose(fit.normal, dense, atol=1e-12)
    assert np.allclose(sum(view.projection for view in fit.views).sum(axis=1), 0, atol=1e-12)
