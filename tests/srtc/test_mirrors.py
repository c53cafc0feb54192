import numpy as np
import pytest

from srtomo_core.layout import Layout, transmission
from srtomo_core.system import System, load_system
from srtomo_srtc.mirrors import influence, interaction_matrix, mirror_wavefronts


@pytest.fixture(scope="module")
def two_mirrors() -> System:
    mini = load_system("mini")
    ground = mini.mirrors[0].model_dump()
    high = {**ground, "name": "high", "altitude": 6000.0, "actuators": 13, "pitch": 0.5, "coupling": 0.2}
    return mini.with_changes({"mirrors": [ground, high]})


def test_influence_at_its_own_and_the_next_actuator() -> None:
    mirror = Layout(load_system("mini")).mirrors[0]
    i = int(np.argmin(np.hypot(*mirror.actuators.T)))
    x, y = mirror.actuators[i]
    at = influence(mirror, np.array([x, x + mirror.pitch, x + mirror.pitch]), np.array([y, y, y - mirror.pitch]))
    assert at[:, i] == pytest.approx([1.0, mirror.coupling, mirror.coupling**2])


def test_interaction_matrix_against_finite_differences(two_mirrors: System) -> None:
    layout = Layout(two_mirrors)
    G = interaction_matrix(two_mirrors, layout)
    step = 1e-4
    for w, (sensor, place) in enumerate(zip(two_mirrors.sensors, layout.sensors)):
        star = two_mirrors.star_of(sensor)
        distance = np.inf if star.altitude is None else star.altitude / np.cos(two_mirrors.zenith_angle)
        axis_x, axis_y = (
            (np.cos(place.rotation), np.sin(place.rotation)),
            (-np.sin(place.rotation), np.cos(place.rotation)),
        )
        expected = np.zeros((place.n_slopes, layout.n_commands))
        x, y = place.points(128)
        light = transmission(two_mirrors.telescope, x, y)
        for s in range(0, place.n_valid, 7):
            lit = light[s] > 0
            px, py = x[s][lit], y[s][lit]
            for row, (ex, ey) in ((s, axis_x), (place.n_valid + s, axis_y)):
                ahead, behind = (
                    mirror_wavefronts(layout, px + sign * step * ex, py + sign * step * ey, star.position, distance)
                    for sign in (0.5, -0.5)
                )
                expected[row] = (ahead - behind).mean(axis=0) / step
        rows = expected.any(axis=1)
        np.testing.assert_allclose(G[layout.slopes_of(w)][rows], expected[rows], atol=1.5e-2 * np.abs(expected).max())


def test_a_ramp_of_commands_gives_its_tilt(two_mirrors: System) -> None:
    # far from the edge, Gaussians at every pitch sum to the integral of one over pitch^2: pi / ln(1 / coupling)
    layout = Layout(two_mirrors)
    mirror = layout.mirrors[0]
    commands = np.zeros(layout.n_commands)
    commands[layout.commands_of(0)] = mirror.actuators @ [0.3, -0.7] * np.log(1 / mirror.coupling) / np.pi
    slopes = interaction_matrix(two_mirrors, layout) @ commands
    for w, place in enumerate(layout.sensors[:3]):
        c, s = np.cos(place.rotation), np.sin(place.rotation)
        inner = (np.hypot(*place.local.T) < 0.9) & (place.illumination == 1)
        along_x, along_y = np.split(slopes[layout.slopes_of(w)], 2)
        assert inner.sum() >= 3
        np.testing.assert_allclose(along_x[inner], 0.3 * c - 0.7 * s, atol=5e-3)
        np.testing.assert_allclose(along_y[inner], -0.3 * s - 0.7 * c, atol=5e-3)
