"""Every method of making a reconstructor, in the loop's own law against the plant, which shares no model with it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_ops.simulate import Run, program_of, run
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky, prepare
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.reconstructors.glao import glao
from srtomo_srtc.reconstructors.learn_apply import learn_apply
from srtomo_srtc.reconstructors.least_squares import least_squares
from srtomo_srtc.reconstructors.moao import moao
from srtomo_srtc.reconstructors.modal import modal
from srtomo_srtc.wind import effective_lag

FRAMES, SETTLED = 240, 40


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def sky(mini: System) -> Sky:
    return prepare(mini, FRAMES, seed=1, science_every=4)


def _residual(result: Run) -> tuple[np.ndarray, np.ndarray]:
    """Rms over the settled frames in each direction, nm: high order, tip-tilt."""
    settled = result.frames >= SETTLED
    high_order, tip_tilt = (
        np.sqrt(np.mean(values[settled] ** 2, axis=0)) * 1e9 for values in (result.high_order, result.tip_tilt)
    )
    return high_order, tip_tilt


@pytest.fixture(scope="module")
def reference(mini: System, sky: Sky) -> tuple[np.ndarray, np.ndarray]:
    return _residual(run(Plant(mini, sky), {0: program_of(sky.layout, implicit(mini)[0])}))


Method = Callable[..., tuple[Reconstructor, Any]]


@pytest.mark.parametrize(
    ("method", "keywords", "low", "high"),
    [
        (implicit, {"split": True}, 0.99, 1.01),
        (learn_apply, {}, 0.99, 1.02),
        (learn_apply, {"split": True}, 0.99, 1.02),
        (modal, {}, 0.99, 1.03),
        (modal, {"kept": 0.25}, 1.03, 1.12),
        (glao, {}, 1.02, 1.15),
        (glao, {"averaging": "numerical"}, 0.95, 1.05),
        (least_squares, {}, 1.03, 1.12),
    ],
)
def test_closed_loop(
    mini: System,
    sky: Sky,
    reference: tuple[np.ndarray, np.ndarray],
    method: Method,
    keywords: dict[str, Any],
    low: float,
    high: float,
) -> None:
    """Stable with the plant's own mirrors, and as much worse than the implicit estimate as the method is poorer."""
    reconstructor, _ = method(mini, **keywords)
    mismatch = reconstructor.Q[0] - reconstructor.R[0] @ sky.interaction
    assert np.abs(np.linalg.eigvals(mismatch)).max() < 0.1
    high_order, tip_tilt = _residual(run(Plant(mini, sky), {0: program_of(sky.layout, reconstructor)}))
    assert np.all(high_order > low * reference[0])
    assert np.all(high_order < high * reference[0])
    assert np.all(tip_tilt < 1.2 * reference[1])


def test_prediction_gains(mini: System, sky: Sky, reference: tuple[np.ndarray, np.ndarray]) -> None:
    lag = effective_lag(mini.loop)
    ahead, behind = (
        _residual(run(Plant(mini, sky), {0: program_of(sky.layout, learn_apply(mini, lag=by)[0])}))[0]
        for by in (lag, -lag)
    )
    assert np.all(ahead < 0.9 * reference[0])
    assert np.all(behind > 1.1 * reference[0])


def test_one_arm_a_direction(mini: System, sky: Sky, reference: tuple[np.ndarray, np.ndarray]) -> None:
    """In open loop: the sensors do not see these mirrors."""
    unseen = replace(sky, interaction=np.zeros_like(sky.interaction))
    arms = [
        _residual(run(Plant(mini, unseen), {0: program_of(sky.layout, moao(mini, target=target)[0])}))[0]
        for target in range(2)
    ]
    for target in range(2):
        assert arms[target][target] < reference[0][target]
        assert arms[1 - target][target] > 1.05 * arms[target][target]
