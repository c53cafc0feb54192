"""Modes that stars are blind to: out of the slopes, in the hands of those that see them, and counted once."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from srtomo_core.layout import Layout, transmission
from srtomo_core.system import InstrumentError, System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.estimator import estimator
from srtomo_srtc.geometry import pupil_grid
from srtomo_srtc.mirrors import interaction_matrix, mirror_wavefronts
from srtomo_srtc.model import blind_modes, noise_covariance, project, sightlines
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.split import Split, low_order_commands

BLIND_LASERS = {f"guide_stars.{i}.focus": "blind" for i in range(3)}
STAR_POSITIONS = [(14e-5, -3e-5), (-5e-5, 16e-5), (-11e-5, -9e-5)]  # rad


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def with_focus(mini: System) -> System:
    """Lasers blind to focus too; the natural star's sensor has 2 x 2 lenslets and is bright."""
    natural = {"sensors.3.subapertures": 2, "sensors.3.photons": 1e6, "sensors.3.illumination_threshold": 0.2}
    return mini.with_changes({**BLIND_LASERS, **natural})


@pytest.fixture(scope="module")
def multi_conjugate(mini: System) -> System:
    """Three mirrors and three natural stars, with one-lens sensors."""
    ground = mini.mirrors[0].model_dump()
    upper = [
        ground | {"name": name, "altitude": height, "actuators": n, "pitch": 0.5}
        for name, height, n in (("middle", 4e3, 13), ("high", 9e3, 17))
    ]
    stars = [star.model_dump() for star in mini.guide_stars[:3]]
    sensors = [sensor.model_dump() for sensor in mini.sensors[:3]]
    for i, (x, y) in enumerate(STAR_POSITIONS):
        own = {"name": f"ngs{i}", "position": {"x": x, "y": y}}
        stars.append(mini.guide_stars[3].model_dump() | own)
        sensors.append(mini.sensors[3].model_dump() | {"name": f"ngs{i}", "guide_star": f"ngs{i}"})
    # the mirrors are only shaped where some science target looks through them, natural stars are to be among these
    targets = [{"position": {"x": x, "y": y}} for x, y in [(0.0, 0.0), *STAR_POSITIONS]]
    return mini.with_changes(
        {"mirrors": [ground, *upper], "guide_stars": stars, "sensors": sensors, "science.targets": targets}
    )


# --- which modes ----------------------------------------------------------------------------------------------------


def test_focus_is_part_of_the_instrument(mini: System) -> None:
    assert {star.focus for star in mini.guide_stars} == {"seen"}
    blind = mini.with_changes(BLIND_LASERS)
    assert Layout(blind).fingerprint != Layout(mini).fingerprint
    with pytest.raises(InstrumentError, match=r"guide_stars\[0\].focus"):
        mini.with_changes({"guide_stars.0.focus": "hazy"})


def test_each_blind_sensor_loses_its_own_modes(mini: System, with_focus: System) -> None:
    for system, modes in ((mini, 6), (with_focus, 9), (mini.with_changes({"guide_stars.*.focus": "blind"}), 9)):
        M = blind_modes(system, Layout(system))
        assert M.shape[1] == modes
        np.testing.assert_allclose(M.T @ M, np.eye(modes), atol=1e-12)
        sensors = [np.any(M[Layout(system).slopes_of(w)], axis=0) for w in range(4)]
        assert np.sum(sensors, axis=0).tolist() == [1] * modes


def _focus_slopes(system: System, sensor: int) -> np.ndarray:
    """Slopes of x^2 + y^2: mean gradient over the lit points of each sub-aperture, turned into the sensor's axes."""
    place = Layout(system).sensors[sensor]
    x, y = place.points(40)
    light = transmission(system.telescope, x, y)
    gradient = np.stack([np.average(2 * axis, axis=(1, 2), weights=light) for axis in (x, y)])
    c, s = np.cos(place.rotation), np.sin(place.rotation)
    return (np.array([[c, s], [-s, c]]) @ gradient).ravel()


def test_focus_is_that_of_the_pupil_and_not_of_the_sensor(with_focus: System) -> None:
    layout = Layout(with_focus)
    M = blind_modes(with_focus, layout)
    for w in range(3):
        slopes = np.zeros(layout.n_slopes)
        slopes[layout.slopes_of(w)] = _focus_slopes(with_focus, w)
        assert np.linalg.norm(project(slopes, M)) < 2e-3 * np.linalg.norm(slopes)


def test_projection_is_the_limit_of_modes_of_any_size(with_focus: System) -> None:
    """Sigma_nn + t M M^T for t without bound, which is what blindness means."""
    layout, profile = Layout(with_focus), Profile.of(with_focus)
    sensors = sightlines(with_focus, layout, profile)
    S = slope_covariance(Turbulence.covering(profile, [s.nodes for s in sensors]), sensors)
    S[np.diag_indices_from(S)] += noise_covariance(with_focus, layout, 0.5).diagonal()
    M = blind_modes(with_focus, layout)
    right = np.random.default_rng(0).standard_normal((len(S), 3))
    limit = np.linalg.solve(S + 1e6 * S.trace() * M @ M.T, right)
    np.testing.assert_allclose(estimator(S.copy(), right, M), limit, atol=1e-5 * np.abs(limit).max())


# --- what is done with them -----------------------------------------------------------------------------------------


Built = Callable[[str, bool], tuple[System, np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def built(mini: System, with_focus: System, multi_conjugate: System) -> Built:
    """System, R and G by the fixture's name, each built once."""
    systems = {"mini": mini, "with_focus": with_focus, "multi_conjugate": multi_conjugate}

    @cache
    def build(name: str, split: bool) -> tuple[System, np.ndarray, np.ndarray]:
        reconstructor, G = implicit(systems[name], split=split)
        return systems[name], reconstructor.R[0].astype(float), G

    return build


@pytest.mark.parametrize("split", [False, True])
def test_laser_focus_is_not_seen(built: Built, split: bool) -> None:
    mini, seen, _ = built("mini", split)
    _, blind, _ = built("with_focus", split)
    for w in range(3):
        own = Layout(mini).slopes_of(w)
        focus = _focus_slopes(mini, w)
        assert np.abs(blind[:, own] @ focus).max() < 1e-2 * np.abs(seen[:, own] @ focus).max()


Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]
SMOOTH: list[Shape] = [
    lambda x, y: x,
    lambda x, y: y,
    lambda x, y: x * x + y * y - 2,
    lambda x, y: x * x - y * y,
    lambda x, y: x**3 - y * x,
]


def _response(system: System, R: np.ndarray, G: np.ndarray, shape: Shape) -> float:
    """How much of a shape made by the first mirror comes back through G and R towards the first target."""
    layout, grid = Layout(system), pupil_grid(system.telescope, 0.1)
    N = mirror_wavefronts(layout, grid.x, grid.y, system.science.targets[0].position)
    N -= grid.weight @ N
    first = layout.commands_of(0)
    commands = np.zeros(layout.n_commands)
    wanted = shape(grid.x, grid.y)
    commands[first] = np.linalg.lstsq(N[:, first], wanted - grid.weight @ wanted, rcond=1e-4)[0]
    before, after = N @ commands, N @ (R @ (G @ commands))
    return float((grid.weight * before) @ after / ((grid.weight * before) @ before))


@pytest.mark.parametrize("name", ["mini", "with_focus", "multi_conjugate"])
@pytest.mark.parametrize("split", [False, True])
def test_every_smooth_shape_is_counted_once(name: str, split: bool, built: Built) -> None:
    for shape in SMOOTH:
        assert _response(*built(name, split), shape) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("name", ["mini", "with_focus", "multi_conjugate"])
def test_lasers_leave_low_orders_to_the_natural_stars(name: str, built: Built) -> None:
    system, R, G = built(name, True)
    layout = Layout(system)
    split = Split.of(system, layout, G)
    np.testing.assert_allclose(split.low_order @ split.low_order, split.low_order, atol=1e-9)
    lasers, natural = R[:, split.blind], R[:, split.seeing]
    assert np.abs(split.low_order @ lasers).max() < 1e-6 * np.abs(split.low_order @ built(name, False)[1]).max()
    n_modes = low_order_commands(system, layout).shape[1]
    size = np.linalg.svd(natural, compute_uv=False)
    assert np.sum(size > 1e-5 * size[0]) == n_modes
    assert n_modes == {"mini": 2, "with_focus": 3, "multi_conjugate": 5}[name]


def test_plate_scale_is_a_tilt_over_the_field_that_lasers_cannot_see(multi_conjugate: System) -> None:
    system, layout = multi_conjugate, Layout(multi_conjugate)
    G = interaction_matrix(system, layout)
    split = Split.of(system, layout, G)
    height, radius = layout.mirrors[-1].altitude, system.telescope.diameter / 2
    seen = (split.measured @ G @ low_order_commands(system, layout)).reshape(3, 2, 5)
    apart = np.array(STAR_POSITIONS)
    # of x^2 + y^2, x^2 - y^2 and 2xy in pupil radii, between two stars: the tilt is 2 h (theta_i - theta_j) / radius^2
    for i, j in ((0, 1), (0, 2), (1, 2)):
        x, y = 2 * height * (apart[i] - apart[j]) / radius**2
        for mode, expected in zip((2, 3, 4), ([x, y], [x, -y], [y, x])):
            # the sign and the order of QR's columns are its own; 1 x 1 sensors are not rotated: x is x
            difference = np.abs((seen[i] - seen[j])[:, mode])
            np.testing.assert_allclose(difference, np.abs(expected), rtol=0.05, atol=0.02 * np.hypot(x, y))
    M = blind_modes(system, layout)[split.blind]
    commands = low_order_commands(system, layout)[:, 2:]
    high = layout.commands_of(2)
    both = project(G[split.blind] @ commands, M)
    alone = project(G[split.blind][:, high] @ commands[high], M)
    # what is left of the high mirror's quadratics; the rest is the ripple of influence functions
    assert np.abs(np.linalg.lstsq(alone, both, rcond=None)[0]).max() < 0.04
    assert np.linalg.norm(both) < 0.15 * np.linalg.norm(alone)


def test_nothing_to_split_is_refused(mini: System) -> None:
    for word in ("seen", "blind"):
        with pytest.raises(ValueError, match="split: expected some stars that see tip-tilt and some that do not"):
            implicit(mini.with_changes({"guide_stars.*.tip_tilt": word}), split=True)


@pytest.mark.parametrize("name", ["mini", "with_focus", "multi_conjugate"])
def test_low_orders_come_back_as_the_natural_stars_see_them(name: str, built: Built) -> None:
    system, R, G = built(name, True)
    layout = Layout(system)
    made = low_order_commands(system, layout)
    seen = Split.of(system, layout, G).measured @ G
    before, after = seen @ made, seen @ (R @ (G @ made))
    # but for the noise that is smoothed
    assert np.linalg.norm(after - before) < 0.02 * np.linalg.norm(before)
