"""Predictions from covariances against the simulated plant, which shares none of their code."""

from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_ops.reproduce.trials import with_electrons
from srtomo_ops.simulate import SETTLING, program_of, run
from srtomo_sim.mirror import interaction_matrix as true_response
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky, prepare
from srtomo_srtc.lqg import Lqg
from srtomo_srtc.predict import Prediction, limit, misplaced, moved_mirrors
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.reconstructors.predictive import predictive

AT_1_KHZ = {"loop.rate": 1000.0}


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def sky(mini: System) -> Sky:
    return prepare(mini, 400, 3, science_every=5)


def _measured(system: System, sky: Sky, reconstructor: Reconstructor) -> np.ndarray:
    """(n_targets,) rms after settling, m."""
    result = run(Plant(system, sky), {0: program_of(sky.layout, reconstructor)})
    return np.sqrt(np.mean(result.high_order[result.frames >= SETTLING] ** 2, axis=0))


def _three_mirrors() -> System:
    mini = load_system("mini")
    dm = mini.mirrors[0].model_dump()
    return mini.with_changes(
        {
            "mirrors": [
                dm,
                dm | {"name": "dm4", "altitude": 4000.0, "pitch": 0.5},
                dm | {"name": "dm9", "altitude": 9000.0, "pitch": 0.6, "actuators": 9},
            ]
        }
    )


# --- residual -------------------------------------------------------------------------------------------------------


def _check_residual(system: System, frames: int, tolerance: float) -> None:
    reconstructor, _ = implicit(system)
    predicted = [budget.wfe for budget in Prediction(system).budgets(reconstructor.R[0])]
    skies = (prepare(system, frames, seed, science_every=5) for seed in (1, 2, 3))
    measured = np.mean([_measured(system, sky, reconstructor) for sky in skies], axis=0)
    np.testing.assert_allclose(predicted, measured, rtol=tolerance)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("electrons", [186, 40])
@pytest.mark.parametrize("name", ["gnao_ltao", "gnao_ltao_sr"])
def test_residual_of_laser_tomography(name: str, electrons: int) -> None:
    _check_residual(with_electrons(load_system(name, AT_1_KHZ), electrons), 1000, 0.05)


@pytest.mark.slow
def test_residual_with_three_mirrors() -> None:
    _check_residual(_three_mirrors(), 800, 0.05)


def test_residual_of_one_short_sky(mini: System, sky: Sky) -> None:
    """A quick look: one seed of two seconds scatters by some per cent."""
    reconstructor, _ = implicit(mini)
    predicted = [budget.wfe for budget in Prediction(mini).budgets(reconstructor.R[0])]
    np.testing.assert_allclose(predicted, _measured(mini, sky, reconstructor), rtol=0.08)
    # a delay with a fraction, and another gain, under the same sky
    other = mini.with_changes({"loop.delay": 2.5, "loop.gain": 0.35})
    slower, _ = implicit(other)
    after = [budget.wfe for budget in Prediction(other).budgets(slower.R[0])]
    change = _measured(other, sky, slower) - _measured(mini, sky, reconstructor)
    np.testing.assert_allclose(np.subtract(after, predicted), change, rtol=0.2)


# --- prediction -----------------------------------------------------------------------------------------------------


def test_the_predictive_reconstructor_gains_what_it_should(mini: System, sky: Sky) -> None:
    prediction = Prediction(mini)
    static, moving = implicit(mini)[0], predictive(mini)[0]
    gain = _measured(mini, sky, static) - _measured(mini, sky, moving)
    expected = [a.wfe - b.wfe for a, b in zip(prediction.budgets(static.R[0]), prediction.budgets(moving.R[0]))]
    np.testing.assert_allclose(gain, expected, rtol=0.25)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("rate", "gain_nm"), [(1000.0, 2.0), (500.0, 8.0)])
def test_the_predictive_reconstructor_s_gain_at_full_size(rate: float, gain_nm: float) -> None:
    system = load_system("gnao_ltao_sr", {"loop.rate": rate})  # 186 electrons at 1 kHz
    sky = prepare(system, 1000, 1, science_every=5)
    found = _measured(system, sky, implicit(system)[0]) - _measured(system, sky, predictive(system)[0])
    assert found[0] * 1e9 == pytest.approx(gain_nm, rel=0.3)


# --- misplaced mirrors ----------------------------------------------------------------------------------------------


def _with_mirrors_at(sky: Sky, shift: tuple[float, float]) -> Sky:
    """The same sky over an instrument whose sensors see mirrors that have moved; science directions do not follow."""
    response = true_response(sky.system, moved_mirrors(sky.layout, shift)).astype(np.float32)
    return replace(sky, interaction=response)


def _diverges(system: System, sky: Sky, reconstructor: Reconstructor, shift: tuple[float, float]) -> bool:
    result = run(Plant(system, _with_mirrors_at(sky, shift)), {0: program_of(sky.layout, reconstructor)})
    return bool(result.high_order[-1, 0] > 1e-6)


def _check_limit(system: System, sky: Sky, direction: tuple[float, float]) -> None:
    reconstructor, _ = implicit(system)
    size = sky.layout.sensors[0].size

    def place(shift: float) -> tuple[float, float]:
        return shift * size * direction[0], shift * size * direction[1]

    predicted = limit(lambda x: misplaced(system, reconstructor, shift=place(x)).growth, 0.1, 0.7, 0.005)
    assert not _diverges(system, sky, reconstructor, place(predicted - 0.02))
    assert _diverges(system, sky, reconstructor, place(predicted + 0.02))


def test_limit_of_stability(mini: System, sky: Sky) -> None:
    for direction in ((1.0, 0.0), (-0.7071, 0.7071)):
        _check_limit(mini, sky, direction)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_shifted_mirror_at_full_size() -> None:
    system = load_system("gnao_ltao_sr", AT_1_KHZ)
    layout = Layout(system)
    reconstructor, _ = implicit(system)
    shifted = moved_mirrors(layout, (0.2 * layout.sensors[0].size, 0.0))
    in_place, moved = (
        _measured(system, prepare(system, 1000, 1, layout=where, science_every=5), reconstructor)[0]
        for where in (layout, shifted)
    )
    assert moved - in_place < 6e-9
    _check_limit(system, prepare(system, 1001, 1, science_every=500), (1.0, 0.0))


# --- LQG ------------------------------------------------------------------------------------------------------------


def test_lqg_beats_what_has_no_memory(mini: System, sky: Sky) -> None:
    plant, controller = Plant(mini, sky), Lqg(mini)
    sent = {-1: np.zeros(sky.layout.n_commands)}
    squares = []
    for k in range(sky.n_frames):
        slopes, on = plant.measure(k), plant.on_mirror(k)
        if k % 5 == 0 and k >= SETTLING:
            squares.append(plant.wfe(k).high_order ** 2)
        sent[k] = controller.commands(slopes, on.fraction * sent[on.frame] + (1 - on.fraction) * sent[on.before])
        plant.command(k, sent[k])
    filtered = np.sqrt(np.mean(squares, axis=0))[0]
    static, moving = (_measured(mini, sky, built(mini)[0])[0] for built in (implicit, predictive))
    assert filtered < moving - 5e-9 < static - 20e-9
