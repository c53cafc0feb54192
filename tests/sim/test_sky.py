from __future__ import annotations

import numpy as np
import pytest
import scipy.fft

from srtomo_core.layout import Layout
from srtomo_core.system import Direction, System
from srtomo_sim.mirror import mirror_phase
from srtomo_sim.shack_hartmann import atmospheric_slopes
from srtomo_sim.sky import Sky, prepare, pupil_points, strehl, wavefronts
from srtomo_sim.turbulence import METRES_PER_RADIAN, Screens, covariance


@pytest.fixture(scope="module")
def tall(mini: System) -> System:
    """``mini`` with a mirror in the air, whose shape differs between science directions."""
    return mini.with_changes({"mirrors.0.altitude": 4000.0})


@pytest.fixture(scope="module")
def sky(tall: System) -> Sky:
    return prepare(tall, 21, 6, science_every=5)


def test_residual_against_phase_maps(tall: System, sky: Sky) -> None:
    layout, screens = Layout(tall), Screens(tall, 6)
    x, y = pupil_points(tall.telescope)
    commands = 2e-7 * np.random.default_rng(1).standard_normal(layout.n_commands)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    for frame in (0, 20):
        error = sky.error(frame, commands)
        for t, target in enumerate(tall.science.targets):
            phase = wavefronts(screens, np.array([frame]), x, y, target.position)[0]
            phase -= mirror_phase(layout, x, y, target.position) @ commands
            fit, *_ = np.linalg.lstsq(plane, phase, rcond=None)
            flat = phase - plane @ fit
            assert error.high_order[t] == pytest.approx(flat.std(), rel=1e-9)
            assert error.tip_tilt[t] == pytest.approx((phase - flat).std(), rel=1e-9)
    for frame in (3, 25, -5):
        with pytest.raises(ValueError, match="expected a multiple of 5 below 21"):
            sky.error(frame, commands)


def test_fitting_error_is_the_least_residual(sky: Sky) -> None:
    for t, target in enumerate(sky.targets):
        best, *_ = np.linalg.lstsq(target.gram, target.projection[2], rcond=1e-9)
        fitting = target.fitting_error()[2]
        assert sky.error(10, best).high_order[t] == pytest.approx(fitting, rel=1e-5)
        for change in np.random.default_rng(2).standard_normal((5, len(best))):
            assert sky.error(10, best + 1e-7 * change).high_order[t] > fitting


def test_fitting_error_of_von_karman_turbulence(mini: System) -> None:
    """The trace of the closed-form covariance outside the space that mirror, piston and tip-tilt span."""
    layout = Layout(mini)
    x, y = pupil_points(mini.telescope)
    shapes = np.concatenate(
        [np.stack([np.ones_like(x), x, y], axis=1), mirror_phase(layout, x, y, Direction())], axis=1
    )
    basis, _ = np.linalg.qr(shapes)
    step = mini.telescope.diameter / 160
    column, row = (np.round(p / step + 79.5).astype(int) for p in (x, y))
    lag = np.minimum(np.arange(320), 320 - np.arange(320)) * step
    torus = covariance(np.hypot(lag[:, None], lag), mini.los_r0, mini.atmosphere.outer_scale)
    transform = scipy.fft.rfft2(torus)
    seen = 0.0
    for vector in basis.T:
        plane = np.zeros((320, 320))
        plane[row, column] = vector
        seen += vector @ scipy.fft.irfft2(scipy.fft.rfft2(plane) * transform, s=(320, 320))[row, column]
    expected = np.sqrt(torus[0, 0] - seen / len(x)) * METRES_PER_RADIAN
    # layers move by metres between frames; the sensors play no part
    slow = mini.with_changes({"loop.rate": 2.0, "sensors": [mini.sensors[3].model_dump()]})
    squares = [prepare(slow, 10, seed).targets[0].fitting_error() ** 2 for seed in range(3)]
    assert np.sqrt(np.mean(squares)) == pytest.approx(expected, rel=0.02)


def test_sensors_and_science_see_one_sky(mini: System) -> None:
    """A natural star in a science direction: slopes are mean differences of the science wavefront across a lens."""
    star = {"altitude": None, "kind": "natural", "jitter": 0.0, "position": mini.science.targets[1].position}
    changes = {f"guide_stars.0.{key}": value for key, value in star.items()}
    system = mini.with_changes(changes | {"loop.rate": 2000.0})
    layout, screens = Layout(system), Screens(system, 9)
    sensor = layout.sensors[0]
    slopes = atmospheric_slopes(system, layout, screens, 1)[0]
    edge = ((np.arange(50) + 0.5) / 50 - 0.5) * sensor.size
    for lens in np.flatnonzero(sensor.illumination == 1)[::5]:
        cx, cy = sensor.local[lens]
        for axis, across in ((0, (sensor.size / 2 + 0 * edge, edge)), (1, (edge, sensor.size / 2 + 0 * edge))):
            difference = 0.0
            for sign in (1, -1):
                local = list(across)
                local[axis] = sign * local[axis]
                x, y = sensor.to_pupil(cx + local[0], cy + local[1])
                phase = wavefronts(screens, np.array([0]), x, y, system.guide_stars[0].position)
                difference += sign * phase.mean() / sensor.size
            found = slopes[lens + axis * sensor.n_valid]
            assert found == pytest.approx(difference, abs=2e-2 * float(slopes.std()))


def test_prepared_twice_is_the_same(tall: System, sky: Sky) -> None:
    shares: list[float] = []
    again = prepare(tall, 21, 6, science_every=5, progress=shares.append)
    assert again.slopes.tobytes() == sky.slopes.tobytes()
    assert again.targets[1].projection.tobytes() == sky.targets[1].projection.tobytes()
    assert shares == sorted(shares)
    assert shares[-1] == 1
    other = prepare(tall, 3, 5, science_every=5)
    assert abs(other.slopes - sky.slopes[:3]).max() > sky.slopes.std()


def test_strehl() -> None:
    assert strehl([0.0, 1250e-9 / (2 * np.pi)], 1250e-9) == pytest.approx([1.0, np.exp(-1)])
