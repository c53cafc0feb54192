from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from srtomo_core.system import System
from srtomo_sim.mirror import OnMirror
from srtomo_sim.plant import Plant
from srtomo_sim.shack_hartmann import noise_correlation, noise_sigma
from srtomo_sim.sky import Sky, prepare


@pytest.fixture(scope="module")
def sky(mini: System) -> Sky:
    return prepare(mini, 400, 3, science_every=2)


def quiet(system: System) -> System:
    """No jitter, hardly any noise."""
    return system.with_changes({"guide_stars.*.jitter": 0.0, "sensors.*.photons": 1e20})


def test_slopes_are_sky_less_mirror(mini: System, sky: Sky) -> None:
    plant = Plant(quiet(mini).with_changes({"loop.delay": 1.3}), sky)
    rng = np.random.default_rng(0)
    commands = 1e-7 * rng.standard_normal((20, sky.layout.n_commands)).astype(np.float32)
    for k in range(20):
        slopes = plant.measure(k)
        assert slopes.dtype == np.float32
        shape = 0.7 * commands[k - 1] * (k >= 1) + 0.3 * commands[k - 2] * (k >= 2)
        expected = sky.slopes[k] - sky.interaction.astype(float) @ shape
        assert slopes == pytest.approx(expected, abs=1e-5 * float(sky.slopes.std()))
        if k % 2 == 0:
            squares = [sky.error(k, commands[max(k - j, 0)] * (k >= j)).high_order ** 2 for j in (1, 2)]
            assert plant.wfe(k).high_order == pytest.approx(np.sqrt(0.7 * squares[0] + 0.3 * squares[1]), rel=1e-6)
        plant.command(k, commands[k])
    assert plant.on_mirror(19) == OnMirror(18, 17, pytest.approx(0.7))
    assert plant.late_commands == 0


def test_late_commands_are_counted_and_the_mirror_holds(mini: System, sky: Sky) -> None:
    plant = Plant(mini, sky)
    for k in range(10):
        plant.measure(k)
        if k != 4:
            plant.command(k, np.zeros(sky.layout.n_commands))
        if k == 6:
            # due in exposure 6, handed in after it
            assert plant.on_mirror(6).frame == 3
            plant.command(4, np.ones(sky.layout.n_commands))
            assert plant.on_mirror(6).frame == 3
    assert plant.late_commands == 1
    assert plant.on_mirror(7).frame == 5


def test_arrival_in_time_is_up_to_the_move(mini: System, sky: Sky) -> None:
    plant = Plant(mini.with_changes({"loop.delay": 1.5}), sky)
    plant.measure(0)
    plant.command(0, np.zeros(sky.layout.n_commands), arrival=1.5)
    plant.measure(1)
    assert plant.on_mirror(1) == OnMirror(0, -1, 0.5)
    plant.command(1, np.zeros(sky.layout.n_commands), arrival=2.51)
    plant.measure(2)
    assert plant.on_mirror(2) == OnMirror(0, 0, 0.5)
    assert plant.late_commands == 1


def test_same_bits_in_any_order(mini: System, sky: Sky) -> None:
    plant, again = Plant(mini, sky), Plant(mini, sky)
    forward = [plant.measure(k) for k in range(30)]
    backward = [again.measure(k) for k in reversed(range(30))]
    assert all(a.tobytes() == b.tobytes() for a, b in zip(forward, reversed(backward), strict=True))
    other = Plant(mini, sky, seed=4).measure(0)
    assert abs(other - forward[0]).max() > noise_sigma(mini, sky.layout).min()


def test_noise_statistics_and_other_photons_under_one_sky(mini: System, sky: Sky) -> None:
    still = mini.with_changes({"guide_stars.*.jitter": 0.0})
    noise = np.array([Plant(still, sky).measure(k) - sky.slopes[k] for k in range(400)])
    sigma = noise_sigma(mini, sky.layout)
    assert (noise / sigma).std() == pytest.approx(1, abs=0.01)
    assert np.corrcoef(noise[:-1].ravel(), noise[1:].ravel())[0, 1] == pytest.approx(0, abs=0.01)
    assert (noise / sigma).std(axis=0) == pytest.approx(np.ones_like(sigma), abs=0.2)
    fainter = still.with_changes({"sensors.*.photons": 1e4, "sensors.*.read_noise": 0.0})
    faint = Plant(fainter, sky).measure(7) - sky.slopes[7]
    assert faint / noise_sigma(fainter, sky.layout) == pytest.approx(noise[7] / sigma, abs=1e-2)


def test_jitter_is_each_laser_stars_own(mini: System, sky: Sky) -> None:
    plant, calm = Plant(mini, sky), Plant(mini.with_changes({"guide_stars.*.jitter": 0.0}), sky)
    jitter = np.array([plant.measure(k) - calm.measure(k) for k in range(400)])
    tilts = []
    for i, layout in enumerate(sky.layout.sensors):
        mine = jitter[:, sky.layout.slopes_of(i)].reshape(400, 2, -1)
        # a tilt of the whole beam, the same in every sub-aperture
        assert abs(mine - mine[:, :, :1]).max() < 1e-10
        c, s = np.cos(layout.rotation), np.sin(layout.rotation)
        x, y = mine[:, 0, 0], mine[:, 1, 0]
        tilts.append((c * x - s * y, s * x + c * y))
    laser, natural = np.array(tilts[:3]).reshape(6, 400), np.array(tilts[3])
    assert abs(natural).max() < 1e-10
    assert laser.std(axis=1) == pytest.approx(np.full(6, mini.guide_stars[0].jitter), rel=0.15)
    assert np.corrcoef(laser) == pytest.approx(np.eye(6), abs=0.2)
    assert abs(np.mean(laser[:, 1:] * laser[:, :-1])) < 0.1 * laser.var()


def test_refuses_another_sky(mini: System, sky: Sky) -> None:
    for changes, message in (
        ({"loop.rate": 100.0}, "loop.rate: the sky was prepared for 200 Hz"),
        ({"atmosphere.r0": 0.1}, "atmosphere: the sky was prepared for another"),
        ({"sensors.1.rotation": 0.0}, "sensors or guide_stars: the sky was prepared for others"),
        ({"mirrors.0.coupling": 0.2}, "mirrors: the sky was prepared for another"),
    ):
        with pytest.raises(ValueError, match=message):
            Plant(mini.with_changes(changes), sky)
    with pytest.raises(IndexError, match="prepared for 400 frames"):
        Plant(mini, sky).measure(400)


def test_noise_of_elongated_spots_is_correlated(mini: System, sky: Sky) -> None:
    still = mini.with_changes(
        {"guide_stars.*.jitter": 0.0, "guide_stars.0.launch": (5.0, 0.0), "guide_stars.0.sodium_thickness": 60e3}
    )
    noise = np.array([Plant(still, sky).measure(k) - sky.slopes[k] for k in range(400)])
    sigma, rho = noise_sigma(still, sky.layout), noise_correlation(still, sky.layout)[0]
    n = sky.layout.sensors[0].n_valid
    assert noise.std(axis=0) == pytest.approx(sigma, rel=0.2)
    x, y = noise[:, :n] / sigma[:n], noise[:, n : 2 * n] / sigma[n : 2 * n]
    assert abs(rho).max() > 0.5
    assert (x * y).mean(axis=0) == pytest.approx(rho, abs=0.25)
    assert np.mean((x * y).mean(axis=0) * np.sign(rho)) == pytest.approx(np.mean(abs(rho)), abs=0.02)


def test_measured_noise_is_drawn_as_it_was_measured(mini: System, sky: Sky, tmp_path: Path) -> None:
    """Over the whole sensor: neighbours here go together, which no model of spots says."""
    n = sky.layout.sensors[1].n_slopes
    near = np.exp(-np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 3.0)
    scale = np.linspace(1e-7, 3e-7, n)
    covariance = near * np.outer(scale, scale)
    np.savez(tmp_path / "noise.npz", covariance=covariance)
    still = mini.with_changes({"guide_stars.*.jitter": 0.0})
    plant = Plant(still.with_changes({"sensors.1.noise_covariance": str(tmp_path / "noise.npz")}), sky)
    noise = np.array([plant.measure(k) - sky.slopes[k] for k in range(400)])
    own = sky.layout.slopes_of(1)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), noise[:, own].T)
    assert whitened.std() == pytest.approx(1, abs=0.02)
    beside = np.mean(noise[:, own][:, 1:] * noise[:, own][:, :-1] / (scale[1:] * scale[:-1]))
    assert beside == pytest.approx(np.exp(-1 / 3), abs=0.02)
    # the others have theirs
    unmeasured = np.array([Plant(still, sky).measure(k) - sky.slopes[k] for k in range(5)])
    assert np.array_equal(unmeasured[:, : own.start], noise[:5, : own.start])
    assert np.array_equal(unmeasured[:, own.stop :], noise[:5, own.stop :])
