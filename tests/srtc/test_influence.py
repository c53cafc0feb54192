"""Influence functions from a file, against closed forms and sums over points."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from srtomo_core.layout import Layout, transmission
from srtomo_core.system import Direction, System, load_system
from srtomo_srtc.mirrors import influence, interaction_matrix, mirror_wavefronts, sparse_wavefronts
from srtomo_srtc.predict import moved_mirrors
from srtomo_srtc.reconstructors import implicit

ACROSS, SAMPLES = 9, 8  # actuators; samples a pitch


def lopsided(actuator: int, x: np.ndarray, y: np.ndarray, pitch: float) -> np.ndarray:
    """Some function of its own for each actuator, of x and y in m."""
    u, v = x / pitch, y / pitch
    return (1 + 0.3 * np.cos(actuator) * u + 0.2 * u * v) * np.exp(-1.2 * u * u - (1 + 0.05 * actuator % 1) * v * v)


@pytest.fixture(scope="module")
def gaussian() -> System:
    return load_system("mini", {"mirrors.0.actuators": ACROSS, "mirrors.0.altitude": 4000.0})


@pytest.fixture(scope="module")
def from_file(gaussian: System, tmp_path_factory: pytest.TempPathFactory) -> System:
    mirror = Layout(gaussian).mirrors[0]
    step = mirror.pitch / SAMPLES
    x, y = np.meshgrid(*2 * [step * np.arange(-4 * SAMPLES, 4 * SAMPLES + 1)])
    path = tmp_path_factory.mktemp("mirror") / "functions.npz"
    np.savez(path, step=step, functions=[lopsided(a, x, y, mirror.pitch) for a in range(mirror.n_actuators)])
    return gaussian.with_changes({"mirrors.0.influence": str(path)})


def test_a_gaussian_from_a_file_is_a_gaussian(gaussian: System, tmp_path: Path) -> None:
    mirror = Layout(gaussian).mirrors[0]
    step = mirror.pitch / SAMPLES
    x, y = np.meshgrid(*2 * [step * np.arange(-4 * SAMPLES, 4 * SAMPLES + 1)])
    np.savez(tmp_path / "one.npz", step=step, functions=mirror.coupling ** ((x**2 + y**2) / mirror.pitch**2))
    read = gaussian.with_changes({"mirrors.0.influence": str(tmp_path / "one.npz")})
    a, b = Layout(gaussian), Layout(read)
    px, py = np.random.default_rng(1).uniform(-2, 2, (2, 500))
    towards = Direction(x=3e-5, y=-2e-5)
    np.testing.assert_allclose(mirror_wavefronts(b, px, py, towards), mirror_wavefronts(a, px, py, towards), atol=1e-4)
    dense = mirror_wavefronts(b, px, py, towards)
    np.testing.assert_array_equal(sparse_wavefronts(b, px, py, towards).toarray(), dense)
    G = interaction_matrix(gaussian, a)
    np.testing.assert_allclose(interaction_matrix(read, b), G, atol=2e-4 * np.abs(G).max())
    R, expected = (implicit(system)[0].R[0] for system in (read, gaussian))
    assert np.linalg.norm(R - expected) < 1e-3 * np.linalg.norm(expected)


def test_every_actuator_has_its_own(from_file: System) -> None:
    mirror = Layout(from_file).mirrors[0]
    x, y = np.random.default_rng(2).uniform(-2.5, 2.5, (2, 400))
    for a in (0, 11, mirror.n_actuators - 1):
        dx, dy = x - mirror.actuators[a, 0], y - mirror.actuators[a, 1]
        expected = lopsided(a, dx, dy, mirror.pitch)
        np.testing.assert_allclose(influence(mirror, x, y)[:, a], expected, atol=3e-4)


def test_a_turned_mirror_takes_its_functions_along(from_file: System) -> None:
    layout, angle = Layout(from_file), 0.4
    turned = moved_mirrors(layout, rotation=angle, shift=(0.1, -0.2)).mirrors[0]
    x, y = np.random.default_rng(3).uniform(-2, 2, (2, 100))
    c, s = math.cos(angle), math.sin(angle)
    np.testing.assert_allclose(
        influence(turned, c * x - s * y + 0.1, s * x + c * y - 0.2), influence(layout.mirrors[0], x, y), atol=1e-12
    )


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_mean_gradients_over_lenslets(from_file: System, angle: float) -> None:
    """Against differences of the function itself between points close by, over the light of each lenslet."""
    layout = Layout(from_file)
    layout.mirrors = (replace(layout.mirrors[0], rotation=angle),)
    G, mirror = interaction_matrix(from_file, layout), layout.mirrors[0]
    near, w = 1e-4, 1
    place, star = layout.sensors[w], from_file.star_of(from_file.sensors[w])
    x, y = place.points(64)
    lit = transmission(from_file.telescope, x, y)
    cone = 1 - mirror.altitude / from_file.los_range(star)
    c, s = math.cos(angle), math.sin(angle)
    for a in (5, 22, 40):

        def seen(px: np.ndarray, py: np.ndarray, a: int = a) -> np.ndarray:
            dx = cone * px + mirror.altitude * star.position.x - mirror.actuators[a, 0]
            dy = cone * py + mirror.altitude * star.position.y - mirror.actuators[a, 1]
            return lopsided(a, c * dx + s * dy, c * dy - s * dx, mirror.pitch)

        expected = []
        for ax, ay in (
            (math.cos(place.rotation), math.sin(place.rotation)),
            (-math.sin(place.rotation), math.cos(place.rotation)),
        ):
            slope = (seen(x + near * ax, y + near * ay) - seen(x - near * ax, y - near * ay)) / (2 * near)
            expected.append((slope * lit).sum(axis=(1, 2)) / lit.sum(axis=(1, 2)))
        found = G[layout.slopes_of(w), a]
        np.testing.assert_allclose(found, np.concatenate(expected), atol=4e-3 * np.abs(G).max())


def test_a_hexagonal_mirror_corrects_as_well(gaussian: System) -> None:
    """Wavefronts that a square grid fits, a hexagonal one of as many actuators fits too."""
    system = load_system("mini", {"mirrors.0.grid": "hexagonal", "mirrors.0.actuators": 11})
    reconstructor, G = implicit(system)
    layout = Layout(system)
    assert G.shape == (layout.n_slopes, layout.n_commands)
    x, y = np.random.default_rng(4).uniform(-1.2, 1.2, (2, 200))
    shape = mirror_wavefronts(layout, x, y, Direction())
    wanted = np.sin(2 * x + y)
    commands = np.linalg.lstsq(shape, wanted, rcond=1e-6)[0]
    assert np.std(shape @ commands - wanted) < 0.02
    # its own slopes of a smooth shape come back as the commands that make it
    smooth = np.cos(layout.mirrors[0].actuators @ np.array([1.1, -0.7]))
    back = reconstructor.R[0] @ (G @ smooth)
    made = shape @ (back - smooth)
    made -= (
        np.column_stack([np.ones_like(x), x, y])
        @ np.linalg.lstsq(np.column_stack([np.ones_like(x), x, y]), made, rcond=None)[0]
    )
    assert np.std(made) < 0.2 * np.std(shape @ smooth)
