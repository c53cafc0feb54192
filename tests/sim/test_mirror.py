from __future__ import annotations

import math

import numpy as np
import pytest

from srtomo_core.layout import Layout, transmission
from srtomo_core.system import Direction, System
from srtomo_sim.mirror import DelayLine, OnMirror, interaction_matrix, mirror_phase


def test_influence_functions(mini: System) -> None:
    layout = Layout(mini)
    mirror = layout.mirrors[0]
    phase = mirror_phase(layout, *mirror.actuators.T, Direction())
    distance = np.hypot(*(mirror.actuators[:, None, i] - mirror.actuators[None, :, i] for i in range(2)))
    assert np.diag(phase) == pytest.approx(1)
    assert phase[abs(distance - mirror.pitch) < 1e-9] == pytest.approx(mirror.coupling)
    assert phase[abs(distance - math.sqrt(2) * mirror.pitch) < 1e-9] == pytest.approx(mirror.coupling**2)


@pytest.fixture(scope="module")
def two_mirrors(mini: System) -> System:
    """``mini`` with a second mirror at 6 km."""
    high = mini.mirrors[0].model_dump() | {"name": "high", "altitude": 6000.0, "actuators": 7, "pitch": 0.8}
    return mini.with_changes({"mirrors": [mini.mirrors[0].model_dump(), high]})


def test_interaction_matrix(two_mirrors: System) -> None:
    """Against the gradient at many points, in pupil coordinates, turned into the sensor's axes at the end."""
    layout = Layout(two_mirrors)
    matrix = interaction_matrix(two_mirrors, layout)
    assert matrix.shape == (layout.n_slopes, layout.n_commands)
    for i, sensor in enumerate(layout.sensors):
        star = two_mirrors.star_of(two_mirrors.sensors[i])
        x, y = sensor.points(90 if sensor.n_valid > 1 else 300)
        lit = transmission(two_mirrors.telescope, x, y)
        for j, mirror in enumerate(layout.mirrors):
            cone = 1 - mirror.altitude / two_mirrors.los_range(star)
            for actuator in range(3, mirror.n_actuators, 16):
                at_x, at_y = mirror.actuators[actuator]
                dx = cone * x + mirror.altitude * star.position.x - at_x
                dy = cone * y + mirror.altitude * star.position.y - at_y
                shape = mirror.coupling ** ((dx**2 + dy**2) / mirror.pitch**2)
                slope = 2 * math.log(mirror.coupling) / mirror.pitch**2 * cone * shape * lit
                gx, gy = ((slope * d).sum(axis=(1, 2)) / lit.sum(axis=(1, 2)) for d in (dx, dy))
                c, s = math.cos(sensor.rotation), math.sin(sensor.rotation)
                expected = np.concatenate([c * gx + s * gy, c * gy - s * gx])
                column = matrix[layout.slopes_of(i), layout.commands_of(j)][:, actuator]
                assert column == pytest.approx(expected, abs=6e-3 * abs(matrix).max())


@pytest.mark.parametrize("delay", [1, 1.3, 1.6, 2, 2.7, 3])
def test_delay(delay: float) -> None:
    """In lockstep: command k-n for the last 1-f of exposure k, k-n-1 before."""
    line = DelayLine(delay, 1)
    n, f = math.floor(delay), delay - math.floor(delay)
    u = np.random.default_rng(0).standard_normal(20).astype(np.float32)
    for k in range(20):
        expected = (1 - f) * (u[k - n] if k >= n else 0) + f * (u[k - n - 1] if k > n else 0)
        assert line.shape(k)[0] == pytest.approx(expected, rel=1e-6)
        assert not line.is_late(k)
        state = line.on(k)
        assert state.frame == max(k - n, -1)
        assert state.before == (state.frame if f == 0 else max(k - n - 1, -1))
        assert state.fraction == pytest.approx(1 - f)
        line.put(k, [u[k]], arrival=k + 1)


def test_late_commands_leave_the_mirror_as_it_is() -> None:
    line = DelayLine(2.5, 1)
    for frame in range(3):
        line.put(frame, [frame], arrival=frame + 1.2)
    # due at 3 + 2.5, comes a frame later
    line.put(3, [3], arrival=6.3)
    line.put(4, [4], arrival=5.9)
    assert line.on(4) == OnMirror(2, 1, 0.5)
    assert line.on(5) == OnMirror(2, 2, 0.5)
    assert line.is_late(5)
    # frame 4 is due now and there, frame 3 is of the past
    assert line.on(6) == OnMirror(4, 2, 0.5)
    assert not line.is_late(6)
    assert line.on(7) == OnMirror(4, 4, 0.5)
    assert line.is_late(7)
    assert line.shape(6) == pytest.approx([3.0])


def test_only_the_newest_late_command_and_never_an_early_one() -> None:
    line = DelayLine(1, 1)
    for frame in range(4):
        line.put(frame, [frame], arrival=10.0)
    line.put(3, [-1.0], arrival=10.0)  # a duplicate
    assert [line.on(k).frame for k in (3, 9, 10)] == [-1, -1, 3]
    assert line.on(2).frame == -1
    assert line.shape(10) == pytest.approx([3.0])
    with pytest.raises(ValueError, match=r"expected shape \(1,\), got \(2,\)"):
        line.put(5, [0.0, 0.0], arrival=6.0)
    with pytest.raises(ValueError, match="finite"):
        line.put(5, [np.nan], arrival=6.0)
