"""Decisions on frames drawn from a truth that is neither the candidate's model nor the active one's."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.decide import Action, Comparison, Decider, Decision, Rules, State, compare
from srtomo_srtc.health import OVERSAMPLING, Estimate, Health, SlopeModel
from srtomo_srtc.model import blind_modes, noise_covariance, project_both_sides, sightlines

Array = NDArray[np.float64]
BLOCKS, FRAMES = 12, 240


def sky(system: System, r0: float = 1.0, photons: float = 1.0, fractions: tuple[float, ...] | None = None) -> System:
    """Factors on r0 and flux, and other fractions of the layers."""
    layers = [layer.model_dump() for layer in system.atmosphere.layers]
    for layer, fraction in zip(layers, fractions or system.atmosphere.fractions, strict=True):
        layer["fraction"] = fraction
    changes: dict[str, Any] = {"atmosphere.r0": r0 * system.atmosphere.r0, "atmosphere.layers": layers}
    for w, sensor in enumerate(system.sensors):
        changes[f"sensors.{w}.photons"] = photons * sensor.photons
    return system.with_changes(changes)


def frames_of(system: System, seed: int = 1) -> Array:
    """(FRAMES, n_slopes) independent frames of a system, rad."""
    layout, profile = Layout(system), Profile.of(system)
    sensors = sightlines(system, layout, profile, OVERSAMPLING)
    S = slope_covariance(Turbulence.covering(profile, [sensor.nodes for sensor in sensors]), sensors)
    S += noise_covariance(system, layout, 1.0).toarray()
    project_both_sides(S, blind_modes(system, layout), gamma=S.trace() / len(S))
    return np.asarray(np.random.default_rng(seed).standard_normal((FRAMES, len(S))) @ np.linalg.cholesky(S).T)


BLOCK = np.arange(FRAMES) // (FRAMES // BLOCKS)

MINI = load_system("mini")
TRUTHS = {
    "as the file": MINI,
    "a fifth of the flux": sky(MINI, photons=0.2),
    "high layers": sky(MINI, fractions=(0.42, 0.325, 0.255)),
    "bad seeing": sky(MINI, r0=0.6),
}
NONSENSE = {
    "upside down": sky(MINI, fractions=(0.15, 0.25, 0.6)),
    "all at the ground": sky(MINI, fractions=(1.0, 0.0, 0.0)),
    "all at the top": sky(MINI, fractions=(0.0, 0.0, 1.0)),
    "r0 three times": sky(MINI, r0=3.0),
    "r0 a third": sky(MINI, r0=1 / 3),
    "no light": sky(MINI, photons=1e-2),
    "no noise": sky(MINI, photons=1e4),
    "both": sky(MINI, r0=3.0, photons=0.1),
}


class Clock:
    """Time that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope="module")
def models() -> Callable[[str], SlopeModel]:
    made: dict[str, SlopeModel] = {}

    def model(name: str) -> SlopeModel:
        if name not in made:
            made[name] = SlopeModel((TRUTHS | NONSENSE)[name])
        return made[name]

    return model


def compared(candidate: SlopeModel, active: SlopeModel, slopes: Array, block: NDArray[np.intp]) -> Comparison:
    return compare(candidate.scores(slopes), active.scores(slopes), candidate.n_seen, block)


def prefers(candidate: SlopeModel, active: SlopeModel, slopes: Array, block: NDArray[np.intp] = BLOCK) -> Decision:
    judge = Decider([sensor.name for sensor in MINI.sensors])
    return judge.prefers(compared(candidate, active, slopes, block), candidate.explained)


@pytest.mark.parametrize("truth", list(TRUTHS))
def test_held_out_frames_refuse_nonsense(truth: str, models: Callable[[str], SlopeModel]) -> None:
    """Whatever the sky now is, and however wrong the active model has become: ten wrong models a truth."""
    slopes = frames_of(TRUTHS[truth])
    active = models("as the file")
    for name in NONSENSE:
        decision = prefers(models(name), active, slopes)
        assert decision.action is Action.KEEP, f"{name}: {decision.reason}"
        assert "do not prefer" in decision.reason or "does not explain" in decision.reason


@pytest.mark.parametrize("truth", [name for name in TRUTHS if name != "as the file"])
def test_held_out_frames_prefer_the_truth(truth: str, models: Callable[[str], SlopeModel]) -> None:
    active = models("as the file")
    slopes = frames_of(TRUTHS[truth])
    decision = prefers(models(truth), active, slopes)
    assert decision.action is Action.COMMIT, decision.reason
    assert compared(models(truth), active, slopes, BLOCK).text in decision.reason


def test_the_log_score_is_the_divergence(models: Callable[[str], SlopeModel]) -> None:
    """Its expectation under the truth is the Kullback-Leibler divergence, here from eigenvalues: trace and log det."""
    truth = TRUTHS["bad seeing"]
    slopes = frames_of(truth)
    comparison = compared(models("bad seeing"), models("as the file"), slopes, BLOCK)

    def covariance(system: System) -> Array:
        layout, profile = Layout(system), Profile.of(system)
        sensors = sightlines(system, layout, profile, OVERSAMPLING)
        S = slope_covariance(Turbulence.covering(profile, [sensor.nodes for sensor in sensors]), sensors)
        S += noise_covariance(system, layout, 1.0).toarray()
        blind = blind_modes(system, layout)
        seen = np.linalg.svd(blind)[0][:, blind.shape[1] :]
        return np.asarray(seen.T @ S @ seen)

    ratio = np.linalg.eigvals(np.linalg.solve(covariance(MINI), covariance(truth))).real
    expected = 0.5 * float(np.sum(ratio - 1 - np.log(ratio)))
    assert float(comparison.log_score.mean) == pytest.approx(expected, abs=4 * float(comparison.log_score.error))


def test_nearly_the_same_model_is_not_preferred(models: Callable[[str], SlopeModel]) -> None:
    """5 % of r0, on frames of the active model: what a fit to other frames would come to."""
    decision = prefers(SlopeModel(sky(MINI, r0=1.05)), models("as the file"), frames_of(MINI))
    assert decision.action is Action.KEEP


@pytest.mark.parametrize("truth", ["as the file", "a fifth of the flux"])
def test_a_sensor_that_died_blocks_every_swap(truth: str, models: Callable[[str], SlopeModel]) -> None:
    """Its pseudo-open-loop slopes are what the mirror makes of the others: smoother than any sky and noise."""
    active = models("as the file")
    slopes = frames_of(TRUTHS[truth])
    own = Layout(MINI).slopes_of(1)
    slopes[:, own] = models(truth).foretold(slopes)[:, own]
    for name in (set(TRUTHS) | set(NONSENSE)) - {"as the file"}:
        decision = prefers(models(name), active, slopes)
        assert decision.action is Action.KEEP, f"{name}: {decision.reason}"


def test_a_sensor_that_others_cannot_foretell_blocks_nothing(models: Callable[[str], SlopeModel]) -> None:
    """Wind shake on the natural star's sensor: in no model, and none of the lasers' business."""
    slopes = frames_of(TRUTHS["a fifth of the flux"])
    slopes[:, Layout(MINI).slopes_of(3)] *= 5
    active, candidate = models("as the file"), models("a fifth of the flux")
    assert 3 in compared(candidate, active, slopes, BLOCK).candidate.ill(0.25)
    assert prefers(candidate, active, slopes).action is Action.COMMIT


def test_too_few_blocks_decide_nothing(models: Callable[[str], SlopeModel]) -> None:
    slopes = frames_of(TRUTHS["a fifth of the flux"])
    decision = prefers(models("a fifth of the flux"), models("as the file"), slopes[:60], np.arange(60) // 20)
    assert decision.action is Action.KEEP
    assert "3 blocks of held-out frames are too few" in decision.reason


# --- the states, with comparisons made up ---------------------------------------------------------------------------


def estimate(mean: float, error: float) -> Estimate:
    return Estimate(np.array(mean), np.array(error))


def made_up(log_score: float, residual: float, innovation: float = 1.0, blocks: int = 12) -> Comparison:
    """Differences in units of their errors."""
    health = Health(
        FRAMES, blocks, Estimate(np.full(4, innovation), np.full(4, 0.01)), Estimate(np.ones(4), np.ones(4))
    )
    return Comparison(health, health, estimate(log_score, 1.0), estimate(1e-3 * residual, 1e-3))


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def judge(clock: Clock) -> Decider:
    rules = Rules(floor=2e-9, every=10, watch=20, pause=60)
    return Decider(["a", "b", "c", "d"], rules, clock)


EXPLAINED = np.array([0.8, 0.8, 0.8, 0.1])
PREFERRED = Decision(Action.COMMIT, "held-out frames prefer it")


@pytest.mark.parametrize(
    ("comparison", "action"),
    [
        (made_up(3.1, 3.1), Action.COMMIT),
        (made_up(2.9, 9), Action.KEEP),
        (made_up(9, 2.9), Action.KEEP),
        (made_up(np.nan, 9), Action.KEEP),
        (made_up(0, 0), Action.KEEP),
        (made_up(9, 9, innovation=1.4), Action.KEEP),
        (made_up(9, 9, innovation=0.6), Action.KEEP),
        (made_up(9, 9, innovation=np.nan), Action.KEEP),
        (made_up(9, 9, blocks=5), Action.KEEP),
    ],
)
def test_both_numbers_by_three_errors(judge: Decider, comparison: Comparison, action: Action) -> None:
    assert judge.prefers(comparison, EXPLAINED).action is action


@pytest.mark.parametrize(
    ("before", "after", "action"),
    [
        (100e-9, 97e-9, Action.COMMIT),
        (100e-9, 98.5e-9, Action.KEEP),
        (100e-9, 120e-9, Action.KEEP),
        (100e-9, np.nan, Action.KEEP),
    ],
)
def test_the_gain_has_a_floor(judge: Decider, before: float, after: float, action: Action) -> None:
    decision = judge.gains(PREFERRED, before, after)
    assert decision.action is action
    assert "predicted 100.0 ->" in decision.reason


def test_at_most_one_swap_in_so_many_seconds(judge: Decider, clock: Clock) -> None:
    assert judge.gains(PREFERRED, 100e-9, 90e-9).action is Action.COMMIT
    clock.now += 9
    decision = judge.gains(PREFERRED, 100e-9, 90e-9)
    assert decision.action is Action.KEEP
    assert "the last swap was 9 s ago" in decision.reason
    clock.now += 1.5
    assert judge.gains(PREFERRED, 100e-9, 90e-9).action is Action.COMMIT


def test_the_watch_ends_well(judge: Decider, clock: Clock) -> None:
    assert judge.state is State.IDLE
    judge.committed(0.1)
    assert judge.state is State.WATCHING
    clock.now += 5
    assert judge.watch(made_up(5, 5), EXPLAINED, estimate(0.1, 0.01)).action is Action.KEEP
    assert judge.state is State.WATCHING
    clock.now += 20
    assert "the swap was right" in judge.watch(made_up(1, -2), EXPLAINED, estimate(0.1, 0.01)).reason
    assert judge.state is State.IDLE
    # from now on the way back takes what every swap takes
    for comparison in (made_up(-4, 1), made_up(1, -4)):
        assert judge.watch(comparison, EXPLAINED, estimate(0.9, 0.01)).action is Action.KEEP
    assert judge.watch(made_up(-4, -4), EXPLAINED, estimate(0.1, 0.01)).action is Action.ROLL_BACK
    assert judge.state is State.PAUSED


@pytest.mark.parametrize(
    ("comparison", "left", "why"),
    [
        (made_up(-4, 1), 0.1, "by its log-score the one before is better"),
        (made_up(4, -4), 0.1, "by its unforetold slopes the one before is better"),
        (made_up(5, 5), 0.3, "30.0 % of the slopes' power, 10.0 % before"),
    ],
)
def test_the_watch_rolls_back(judge: Decider, clock: Clock, comparison: Comparison, left: float, why: str) -> None:
    judge.committed(0.1)
    clock.now += 5
    decision = judge.watch(comparison, EXPLAINED, estimate(left, 0.01))
    assert decision.action is Action.ROLL_BACK
    assert why in decision.reason
    judge.rolled_back()
    assert judge.state is State.PAUSED
    clock.now += 59
    assert "rolled back 59 s ago" in judge.gains(PREFERRED, 100e-9, 90e-9).reason
    clock.now += 2
    assert judge.state is State.IDLE
    assert judge.gains(PREFERRED, 100e-9, 90e-9).action is Action.COMMIT


def test_no_pause_is_for_a_model_that_explains_nothing(judge: Decider, clock: Clock) -> None:
    ill = judge.ill(made_up(0, 0, innovation=0.2).candidate, EXPLAINED)
    assert ill.startswith("a at 0.20 +- 0.01, ")
    judge.rolled_back()
    assert judge.gains(PREFERRED, 100e-9, 90e-9).action is Action.KEEP
    assert judge.gains(PREFERRED, 100e-9, 90e-9, ill).action is Action.COMMIT
    judge.committed(0.1)
    judge.rolled_back()
    assert "the last swap was 0 s ago" in judge.gains(PREFERRED, 100e-9, 90e-9, ill).reason


def test_a_step_farther_back_takes_both_numbers(judge: Decider) -> None:
    judge.committed(0.1)
    judge.rolled_back()
    for comparison in (made_up(-9, 1), made_up(1, -9), made_up(-9, -2.9)):
        assert judge.watch(comparison, EXPLAINED, estimate(0.9, 0.01)).action is Action.KEEP
    assert judge.watch(made_up(-4, -4), EXPLAINED, estimate(0.1, 0.01)).action is Action.ROLL_BACK


def test_an_older_one_takes_both_numbers(judge: Decider) -> None:
    judge.committed(0.1)
    same, left = made_up(0, 0), estimate(0.1, 0.01)
    assert judge.watch(same, EXPLAINED, left, [made_up(-9, 1), made_up(1, -9)]).action is Action.KEEP
    decision = judge.watch(same, EXPLAINED, left, [made_up(-9, 1), made_up(-4, -4)])
    assert (decision.action, decision.steps) == (Action.ROLL_BACK, 3)


def test_what_an_operator_commits_is_not_watched(judge: Decider) -> None:
    judge.committed(0.1)
    judge.left_alone()
    assert judge.state is State.IDLE
    judge.rolled_back()
    judge.left_alone()
    assert judge.state is State.PAUSED


def test_two_errors_do_not_roll_back(judge: Decider) -> None:
    judge.committed(0.1)
    assert judge.watch(made_up(-2.9, -2.9), EXPLAINED, estimate(0.2, 0.03)).action is Action.KEEP


def test_what_the_loop_leaves_under_another_sky_says_nothing(judge: Decider) -> None:
    """A cloud: the model explains the sensors no longer, but it is nearer than the one before."""
    judge.committed(0.1)
    assert judge.watch(made_up(5, 5, innovation=3.0), EXPLAINED, estimate(0.9, 0.01)).action is Action.KEEP
