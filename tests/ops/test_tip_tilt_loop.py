"""Tip-tilt in a loop of its own against the plant, which shares no model with the reconstructor: closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_ops.simulate import Run, plain_settings, program_of, run
from srtomo_rtc.loop import Loop
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky, prepare
from srtomo_srtc.reconstructors import implicit

STAR = 3  # of mini's sensors, the only one that sees tip-tilt


def own_loop(system: System, rate: float, gain: float = 0.5, delay: float | None = None) -> System:
    return system.with_changes({"loop.tip_tilt": {"rate": rate, "gain": gain, "delay": delay}})


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini", {"guide_stars.*.jitter": 0.0})


@pytest.fixture(scope="module")
def sky(mini: System) -> Sky:
    return prepare(mini, 480, seed=1, science_every=4)


def over(sky: Sky, system: System) -> Sky:
    """The same sky over an instrument with the same sensors and mirrors."""
    return replace(sky, system=system, layout=Layout(system), moves=())


def measured(system: System, sky: Sky) -> Run:
    mine = over(sky, system)
    settings = plain_settings(mine.layout, tip_tilt=system.loop.tip_tilt)
    return run(Plant(system, mine), {0: program_of(mine.layout, implicit(system)[0], settings)})


def residual(result: Run) -> tuple[float, float]:
    """Rms of the first target after the beginning, m: high order, tip-tilt."""
    settled = result.frames >= 60
    return tuple(float(np.sqrt(np.mean(part[settled, 0] ** 2))) for part in (result.high_order, result.tip_tilt))


def lockstep(system: System, sky: Sky, lost: range = range(0)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slopes (n, 2) of the star's frames, and states u and commands t of the loop in every frame, in m.

    ``lost``: the star's frames that do not come.
    """
    layout = sky.layout
    settings = plain_settings(layout, tip_tilt=system.loop.tip_tilt)
    plant, loop = Plant(system, sky), Loop(layout, system.loop.delay)
    loop.post(program_of(layout, implicit(system)[0], settings))
    loop.request(True)
    seen, states, tilts = [], [], []
    for k in range(sky.n_frames):
        loop.prepare()
        slopes = plant.measure(k)
        if (stars := plant.tip_tilt(k)) is not None:
            seen.append(stars[1][layout.slopes_of(STAR)])
            if stars[0] not in lost:
                loop.give_tip_tilt(stars[0], 1 << STAR, stars[1])
        for sensor in range(STAR):
            loop.add(sensor, slopes[layout.slopes_of(sensor)])
        loop.answer(*plant.on_mirror(k))
        plant.command(k, loop.command)
        states.append(loop.state.copy())
        tilts.append(loop.tip_tilt.copy())
    return np.array(seen), np.array(states), np.array(tilts)


def amplitude(values: np.ndarray, w: float) -> float:
    """Of the sine of a frequency (rad a sample) in the second half of a series, by least squares."""
    k = np.arange(len(values) // 2, len(values))
    parts = np.stack([np.cos(w * k), np.sin(w * k), np.ones(len(k))], axis=1)
    return float(np.hypot(*np.linalg.lstsq(parts, values[k], rcond=None)[0][:2]))


@pytest.mark.parametrize(
    ("delay", "own_delay", "every", "gain"),
    [(2.0, None, 5, 0.5), (2.0, 1.6, 5, 0.3), (1.5, 1.375, 4, 0.5), (2.0, None, 1, 0.4)],
)
def test_rejection_of_a_sine(mini: System, sky: Sky, delay: float, own_delay: float | None, every: int, gain: float):
    """``1 / (1 + g z^-n (1 - f + f/z) / (1 - 1/z))`` at ``z = exp(i w)``, with n + f the delay in the stars' frames.

    Lasers see none of that sky, but all of t: the high orders answer for neither.
    """
    slower = mini.with_changes({"loop.delay": delay})
    system = own_loop(slower, mini.loop.rate / every, gain, own_delay).with_changes(
        {"sensors.*.photons": 1e20, "sensors.*.read_noise": 0.0}
    )
    whole, share = divmod(own_delay or 1 + (delay - 1) / every, 1)
    column = sky.layout.slopes_of(STAR).start
    # what the plant's mirror makes of the model's idea of a tilt
    scale = sky.interaction[column] @ implicit(system)[0].R[0][:, column]
    assert scale == pytest.approx(1, abs=0.02)
    n_own = 90
    for w in (0.12, 0.5, 1.4):
        tilt = 1e-6 * np.cos(w * (np.arange(n_own * every) + 0.5) / every)
        slopes = np.zeros((len(tilt), sky.layout.n_slopes), np.float32)
        slopes[:, column] = tilt  # along x: this sensor is not rotated
        seen, states, tilts = lockstep(system, replace(over(sky, system), slopes=slopes))
        z = np.exp(1j * w)
        expected = abs(1 / (1 + scale * gain * z**-whole * (1 - share + share / z) / (1 - 1 / z)))
        found = amplitude(seen[:, 0], w) / amplitude(tilt.reshape(n_own, every).mean(axis=1), w)
        assert found == pytest.approx(expected, rel=1e-3)
        assert np.abs(states).max() < 1e-2 * np.abs(tilts).max()


def test_high_orders_are_those_of_the_joint_estimate(mini: System, sky: Sky):
    """On a bright star; tip-tilt is as good at the same rate, and worse by what a slower rate costs."""
    joint = residual(measured(mini, sky))
    fast, slow = (residual(measured(own_loop(mini, rate), sky)) for rate in (200.0, 40.0))
    assert fast[0] == pytest.approx(joint[0], rel=0.01)
    assert slow[0] == pytest.approx(joint[0], rel=0.01)
    assert fast[1] == pytest.approx(joint[1], rel=0.15)
    assert 1.5 * fast[1] < slow[1] < 3 * fast[1]


def test_a_lost_star(mini: System, sky: Sky):
    """Tip-tilt stays where it was, the high orders go on as ever, and it comes back with the star."""
    system = own_loop(mini, 40.0)
    whole = lockstep(system, over(sky, system))
    seen, states, tilts = lockstep(system, over(sky, system), lost=range(30, 60))
    assert np.all(tilts[150:300] == tilts[150])
    assert np.abs(states - whole[1]).max() < 0.02 * np.abs(whole[1]).max()
    after = slice(70, None)
    assert np.std(seen[after]) == pytest.approx(np.std(whole[0][after]), rel=0.05)
    assert np.std(seen[35:60]) > 2 * np.std(whole[0][35:60])
