"""The reconstructor against symmetry, identities and its own predicted residual."""

import copy
import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_srtc import memory
from srtomo_srtc.atmosphere import METRES_PER_RADIAN, Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance, slope_wavefront_covariance, wavefront_covariance
from srtomo_srtc.geometry import footprints, pupil_grid
from srtomo_srtc.mirrors import mirror_wavefronts
from srtomo_srtc.model import ground_prior, noise_covariance, sightlines
from srtomo_srtc.reconstructors import implicit

Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def built(mini: System) -> tuple[Reconstructor, np.ndarray]:
    return implicit(mini)


def _matrix(system: System, layout: Layout | None = None) -> np.ndarray:
    return implicit(system, layout)[0].R[0].astype(np.float64)


# --- symmetry -------------------------------------------------------------------------------------------------------


def _moved(system: System, T: np.ndarray, rotations: list[float]) -> System:
    """The whole instrument with its pupil plane and sky mapped by the 2 x 2 matrix T."""

    def move(x: float, y: float) -> tuple[float, float]:
        moved = T @ [x, y]
        return float(moved[0]), float(moved[1])

    def direction(d: object) -> dict[str, float]:
        x, y = move(d.x, d.y)  # type: ignore[attr-defined]
        return {"x": x, "y": y}

    changes: dict[str, object] = {"telescope.obscuration_centre": move(*system.telescope.obscuration_centre)}
    for i, star in enumerate(system.guide_stars):
        changes[f"guide_stars.{i}.position"] = direction(star.position)
    for i, target in enumerate(system.science.targets):
        changes[f"science.targets.{i}.position"] = direction(target.position)
    for i, (sensor, rotation) in enumerate(zip(system.sensors, rotations)):
        changes[f"sensors.{i}.shift"] = move(*sensor.shift)
        changes[f"sensors.{i}.rotation"] = rotation
    return system.with_changes(changes)


def _order(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """For each old point the index of the same point among the new ones."""
    distance = np.hypot(*(old[:, None] - new[None, :]).T).T
    assert len(old) == len(new)
    assert distance.min(axis=1).max() < 1e-9
    return distance.argmin(axis=1)


def _slope_map(old: Layout, new: Layout, T: np.ndarray) -> np.ndarray:
    """Matrix that turns old slopes into new ones when sensor axes stay and everything else is mapped by T."""
    out = np.zeros((new.n_slopes, old.n_slopes))
    for w, (a, b) in enumerate(zip(old.sensors, new.sensors)):
        place = _order(a.local @ T.T, b.local)
        block = out[new.slopes_of(w), old.slopes_of(w)]
        for i in range(2):
            for j in range(2):
                block[i * b.n_valid + place, j * a.n_valid + np.arange(a.n_valid)] = T[i, j]
    return out


def _command_map(old: Layout, new: Layout, T: np.ndarray) -> np.ndarray:
    out = np.zeros((new.n_commands, old.n_commands))
    for m, (a, b) in enumerate(zip(old.mirrors, new.mirrors)):
        block = out[new.commands_of(m), old.commands_of(m)]
        block[_order(a.actuators @ T.T, b.actuators), np.arange(a.n_actuators)] = 1
    return out


QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
MIRROR_IMAGE = np.array([[-1.0, 0.0], [0.0, 1.0]])


@pytest.mark.parametrize(
    ("T", "rotation_sign"), [(QUARTER_TURN, 1), (MIRROR_IMAGE, -1)], ids=["quarter turn", "mirror image"]
)
def test_a_moved_instrument_permutes_the_reconstructor(
    mini: System, built: tuple[Reconstructor, np.ndarray], T: np.ndarray, rotation_sign: int
) -> None:
    moved = _moved(mini, T, [rotation_sign * s.rotation for s in mini.sensors])
    slopes = _slope_map(Layout(mini), Layout(moved), T)
    commands = _command_map(Layout(mini), Layout(moved), T)
    assert not np.array_equal(commands, np.eye(len(commands)))
    reconstructor, G = implicit(moved)
    R = built[0].R[0]
    np.testing.assert_allclose(reconstructor.R[0], commands @ R @ slopes.T, atol=1e-6 * np.abs(R).max())
    np.testing.assert_allclose(G, slopes @ built[1] @ commands.T, atol=1e-12 * np.abs(G).max())


def test_sensors_turned_with_the_instrument_see_nothing_of_it(
    mini: System, built: tuple[Reconstructor, np.ndarray]
) -> None:
    turned = _moved(mini, QUARTER_TURN, [s.rotation + np.pi / 2 for s in mini.sensors])
    commands = _command_map(Layout(mini), Layout(turned), QUARTER_TURN)
    R = built[0].R[0]
    np.testing.assert_allclose(_matrix(turned), commands @ R, atol=1e-6 * np.abs(R).max())


def test_swapped_sensors_swap_columns(mini: System, built: tuple[Reconstructor, np.ndarray]) -> None:
    order = [2, 1, 0, 3]
    swapped = mini.with_changes({"sensors": [mini.sensors[i].model_dump() for i in order]})
    layout = Layout(mini)
    columns = np.concatenate([np.arange(layout.n_slopes)[layout.slopes_of(i)] for i in order])
    R = built[0].R[0]
    np.testing.assert_allclose(_matrix(swapped), R[:, columns], atol=1e-6 * np.abs(R).max())


def test_building_twice_gives_the_same_bytes(mini: System, built: tuple[Reconstructor, np.ndarray]) -> None:
    again, G = implicit(mini)
    assert again.sha256 == built[0].sha256
    assert G.tobytes() == built[1].tobytes()


# --- identities -----------------------------------------------------------------------------------------------------


def test_laser_tip_tilt_is_not_seen(mini: System, built: tuple[Reconstructor, np.ndarray]) -> None:
    layout, R = Layout(mini), built[0].R[0].astype(np.float64)
    for w in range(3):
        for axis in range(2):
            tilt = np.zeros(layout.n_slopes)
            np.split(tilt[layout.slopes_of(w)], 2)[axis][:] = 1
            assert np.abs(R @ tilt).max() < 1e-6 * (np.abs(R) @ tilt).max()


def _response(system: System, reconstructor: Reconstructor, G: np.ndarray, shape: Shape) -> float:
    """How much of a shape of the wavefront comes back through G and R, over the pupil and without piston."""
    grid = pupil_grid(system.telescope, 0.1)
    N = mirror_wavefronts(Layout(system), grid.x, grid.y, system.science.targets[0].position)
    commands = np.linalg.lstsq(N, shape(grid.x, grid.y), rcond=1e-4)[0]
    before, after = N @ commands, N @ (reconstructor.R[0] @ (G @ commands))
    before -= grid.weight @ before
    return float((grid.weight * before) @ after / ((grid.weight * before) @ before))


SMOOTH: list[Shape] = [
    lambda x, y: x,
    lambda x, y: y,
    lambda x, y: x * x + y * y - 2,
    lambda x, y: x * x - y * y,
    lambda x, y: x * y,
    lambda x, y: x**3 - y * x,
]


def test_smooth_shapes_are_seen_at_their_size(mini: System, built: tuple[Reconstructor, np.ndarray]) -> None:
    for shape in SMOOTH:
        assert _response(mini, *built, shape) == pytest.approx(1, abs=0.05)


def test_without_a_natural_star_tip_tilt_is_left_alone(mini: System) -> None:
    lasers = mini.with_changes(
        {
            "sensors": [s.model_dump() for s in mini.sensors[:3]],
            "guide_stars": [s.model_dump() for s in mini.guide_stars[:3]],
        }
    )
    reconstructor, _ = implicit(lasers)
    layout = Layout(lasers)
    # all sensors see the same ramp across the pupil, each along its own axes
    tilt = np.concatenate([np.repeat([np.cos(p.rotation), -np.sin(p.rotation)], p.n_valid) for p in layout.sensors])
    R = reconstructor.R[0].astype(np.float64)
    assert np.abs(R @ tilt).max() < 1e-6 * (np.abs(R) @ np.abs(tilt)).max()


def test_trusted_lasers_give_tip_tilt(mini: System) -> None:
    trusted = mini.with_changes(
        {
            "guide_stars.*.tip_tilt": "seen",
            "sensors": [s.model_dump() for s in mini.sensors[:3]],
            "guide_stars": [s.model_dump() | {"tip_tilt": "seen"} for s in mini.guide_stars[:3]],
        }
    )
    reconstructor, G = implicit(trusted)
    for shape in SMOOTH[:2]:
        assert _response(trusted, reconstructor, G, shape) == pytest.approx(1, abs=0.05)


# --- residual -------------------------------------------------------------------------------------------------------


class Prediction:
    """Residual variance: trace of Sigma_phi - 2 N R Sigma_s_phi + N R (Sigma_ss + Sigma_nn) R^T N^T."""

    def __init__(self, system: System, spacing: float, gain: float | None = None) -> None:
        layout, profile = Layout(system), Profile.of(system)
        sensors = sightlines(system, layout, profile)
        grid = pupil_grid(system.telescope, spacing)
        direction = system.science.targets[0].position
        points = footprints(grid.x, grid.y, direction, np.inf, profile.heights)
        turbulence = Turbulence.covering(profile, [points, *(s.nodes for s in sensors)])
        self.noise = noise_covariance(system, layout, system.loop.gain if gain is None else gain).diagonal()
        self.S = slope_covariance(turbulence, sensors)
        root = np.sqrt(grid.weight)
        shapes = np.stack([root, root * grid.x, root * grid.y], axis=1)
        basis = np.linalg.qr(shapes)[0]

        def project(matrix: np.ndarray) -> np.ndarray:
            weighted = root[:, None] * matrix
            return weighted - basis @ (basis.T @ weighted)

        self.N = project(mirror_wavefronts(layout, grid.x, grid.y, direction))
        self.cross = project(slope_wavefront_covariance(turbulence, sensors, points).T)
        self.phase = project(project(wavefront_covariance(turbulence, points, points)).T)

    def wfe(self, R: np.ndarray) -> float:
        """m rms, piston and tip-tilt removed."""
        A = self.N @ R
        variance = (
            np.trace(self.phase) - 2 * np.sum(A * self.cross) + np.sum((A @ self.S) * A) + np.sum(A**2 * self.noise)
        )
        return float(np.sqrt(variance))

    def fitting(self) -> float:
        """m rms of what the mirror cannot make."""
        q = np.linalg.qr(self.N)[0]
        return float(np.sqrt(np.trace(self.phase) - np.sum((self.phase @ q) * q)))


@pytest.fixture(scope="module")
def on_axis(mini: System) -> System:
    return mini.with_changes({"science.targets": [mini.science.targets[0].model_dump()]})


@pytest.fixture(scope="module")
def prediction(on_axis: System) -> Prediction:
    return Prediction(on_axis, spacing=0.1)


def test_fitting_error_is_that_of_a_square_cut_off(on_axis: System, prediction: Prediction) -> None:
    # the grid of the prediction has a fitting error of its own, which it does not see
    def square(d: float) -> float:
        return float(METRES_PER_RADIAN**2 * 0.23126 * (d / on_axis.los_r0) ** (5 / 3))

    assert prediction.fitting() ** 2 + square(0.1) == pytest.approx(square(0.4), rel=0.05)


def test_the_best_prior_is_the_right_one(on_axis: System, prediction: Prediction) -> None:
    best = prediction.wfe(_matrix(on_axis))
    assert prediction.fitting() < best < 2 * prediction.fitting()
    assert np.sqrt(np.trace(prediction.phase)) > 3 * best
    for wrong in (
        ground_prior(on_axis),
        on_axis.with_changes({"atmosphere.r0": 0.3}),
        on_axis.with_changes({"sensors.*.photons": 1e5}),
        on_axis.with_changes({"sensors.*.photons": 1e8}),
    ):
        assert prediction.wfe(_matrix(wrong)) > best + 0.3e-9
    assert prediction.wfe(_matrix(ground_prior(on_axis))) > 1.2 * best


def test_fast_costs_next_to_nothing(on_axis: System, prediction: Prediction) -> None:
    fast, _ = implicit(on_axis, fast=True, threads=2)
    assert fast.R.tobytes() != implicit(on_axis)[0].R.tobytes()
    assert prediction.wfe(fast.R[0].astype(float)) - prediction.wfe(_matrix(on_axis)) < 0.01e-9


def test_more_memory_than_there_is_is_refused_at_once(mini: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 1e5)
    with pytest.raises(MemoryError, match=r"implicit reconstructor of mini: needs 0\.0 GiB of memory"):
        implicit(mini)


def test_ground_prior_moves_everything_down() -> None:
    system = load_system("mini")
    profile = Profile.of(ground_prior(system))
    assert (profile.heights.tolist(), profile.fractions.tolist()) == ([0.0], [1.0])
    assert (profile.r0, profile.outer_scale) == (system.los_r0, system.atmosphere.outer_scale)


def test_noise_is_what_the_loop_lets_through(mini: System) -> None:
    layout = Layout(mini)
    looped, open_loop = (noise_covariance(mini, layout, gain).diagonal() for gain in (0.5, 1.0))
    assert looped == pytest.approx(open_loop / 3)
    assert np.array_equal(implicit(mini, noise_gain=0.5)[0].R, implicit(mini)[0].R)
    assert not np.array_equal(implicit(mini, noise_gain=1.0)[0].R, implicit(mini)[0].R)


# --- arguments ------------------------------------------------------------------------------------------------------


def test_sensors_elsewhere(on_axis: System, prediction: Prediction) -> None:
    nominal = Layout(on_axis)
    aligned = copy.copy(nominal)
    aligned.sensors = tuple(replace(s, shift=(0.0, 0.0), rotation=0.0) for s in nominal.sensors)
    mistaken, _ = implicit(on_axis, aligned)
    # still a reconstructor for this instrument: it takes the same slopes
    assert mistaken.fingerprint == nominal.fingerprint
    assert prediction.wfe(mistaken.R[0].astype(float)) > 1.1 * prediction.wfe(_matrix(on_axis))


def test_another_instrument_s_layout_is_refused(mini: System) -> None:
    with pytest.raises(ValueError, match="layout: expected the slopes and commands of the system"):
        implicit(mini, Layout(mini.with_changes({"sensors.0.illumination_threshold": 0.9})))


def test_progress_and_provenance(mini: System) -> None:
    seen: list[tuple[str, float]] = []
    reconstructor, G = implicit(mini, label="test", progress=lambda stage, done: seen.append((stage, done)))
    shares = [done for _, done in seen]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    provenance = json.loads(json.dumps(reconstructor.provenance))
    assert provenance["method"] == "implicit"
    assert provenance["system"] == "mini"
    assert provenance["atmosphere"]["r0"] == mini.atmosphere.r0
    assert set(provenance["seconds"]) == {stage for stage, _ in seen[:-1]}
    assert reconstructor.label == "test"
    assert reconstructor.gain == mini.loop.gain
    assert reconstructor.fingerprint == Layout(mini).fingerprint
    np.testing.assert_allclose(reconstructor.Q[0], reconstructor.R[0] @ G, atol=1e-5)
