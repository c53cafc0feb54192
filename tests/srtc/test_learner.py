"""What runs is watched while a window is fitted, and what is fitted gives way to what an operator chose meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.decide import Action, Decider, Decision, State
from srtomo_srtc.health import OVERSAMPLING
from srtomo_srtc.learned_sky import LearnedSky
from srtomo_srtc.learner import Belief, Judgement, Learner, Outcome
from srtomo_srtc.model import blind_modes, ground_prior, noise_covariance, project_both_sides, sightlines
from srtomo_srtc.order import Order, Step
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.telemetry import HeldOut, Recent, Statistics
from srtomo_srtc.worker import Worker

BLOCKS, EACH = 8, 12


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def file(mini: System) -> Belief:
    return Belief("file", mini, implicit(mini)[0])


@pytest.fixture(scope="module")
def ground(mini: System) -> Belief:
    return Belief("ground", ground_prior(mini), implicit(ground_prior(mini))[0])


@pytest.fixture(scope="module")
def held(mini: System) -> Callable[[int], HeldOut]:
    """Independent frames of the file's sky, answered by a reconstructor."""
    layout, profile = Layout(mini), Profile.of(mini)
    sensors = sightlines(mini, layout, profile, OVERSAMPLING)
    S = slope_covariance(Turbulence.covering(profile, [sensor.nodes for sensor in sensors]), sensors)
    S += noise_covariance(mini, layout, 1.0).toarray()
    project_both_sides(S, blind_modes(mini, layout), gamma=S.trace() / len(S))
    n = BLOCKS * EACH
    frames = np.random.default_rng(1).standard_normal((n, len(S))) @ np.linalg.cholesky(S).T
    frames = frames.astype(np.float32)

    def answered(identity: int) -> HeldOut:
        return HeldOut(frames, frames, np.arange(n), np.arange(n) // EACH, np.full(n, identity, np.uint64))

    return answered


@dataclass
class Bench:
    """A learner beside a fit that waits to be told what to find."""

    learner: Learner
    fits: Worker[Statistics]
    held: Callable[[int], HeldOut]
    begun: threading.Semaphore
    found: list[System]
    told: threading.Semaphore

    def begin(self, identity: int = 0) -> None:
        """Have a window fitted, answered by a reconstructor; returns in the middle of the fit."""
        held = self.held(identity)
        n = held.slopes.shape[1]
        moments = np.eye(n, dtype=np.float32), np.zeros(n), 500
        self.fits.judge(Statistics(*moments, 0.008, 4.0, {}, {}, held, 7, 0, 9))
        assert self.begun.acquire(timeout=60)

    def end(self, found: System) -> Judgement:
        """Of the fit."""
        self.found.append(found)
        self.told.release()
        judgement = self.fits.judgements.get(timeout=60)
        assert judgement is not None
        return judgement

    def swap(self, found: System) -> int:
        """Have a fit find a system, and the loop run what is built of it: its id."""
        self.begin()
        candidate = self.end(found).candidate
        assert candidate is not None
        self.learner.running(candidate.reconstructor.id)
        return candidate.reconstructor.id

    def watch(self, identity: int) -> Judgement | None:
        """With the latest frames answered by a reconstructor."""
        return self.learner.watch(Recent(self.held(identity), 7, 0, 99))


@pytest.fixture
def bench(
    mini: System, file: Belief, ground: Belief, held: Callable[[int], HeldOut], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Bench]:
    """With every candidate believed; the loop runs the file's."""
    monkeypatch.setattr(Decider, "prefers", lambda *_: Decision(Action.COMMIT, "believed"))
    monkeypatch.setattr(Decider, "gains", lambda *_: Decision(Action.COMMIT, "believed"))
    begun, found, told = threading.Semaphore(0), list[System](), threading.Semaphore(0)

    def fit(window: Statistics) -> LearnedSky:
        begun.release()
        assert told.acquire(timeout=60)
        return LearnedSky(None, found.pop())  # type: ignore[arg-type]

    learner = Learner(mini, fit, lambda system: implicit(system, closures="none")[0])
    learner.know(file)
    learner.know(ground)
    learner.running(file.reconstructor.id)
    fits: Worker[Statistics] = Worker("fits", learner.judge)
    fits.start()
    yield Bench(learner, fits, held, begun, found, told)
    fits.finish()
    fits.join(timeout=60)
    assert not fits.is_alive()


def test_health_and_the_way_back_do_not_wait_for_a_fit(mini: System, file: Belief, bench: Bench) -> None:
    bench.begin()
    seen = bench.watch(file.reconstructor.id)
    assert seen is not None and seen.health is not None and seen.outcome is Outcome.KEPT
    assert seen.health.innovation.mean == pytest.approx(np.ones(4), abs=0.1)
    first = bench.end(mini.with_changes({"atmosphere.r0": 0.5}))
    assert first.outcome is Outcome.PUBLISHED and first.candidate is not None
    wrong = first.candidate.reconstructor.id
    bench.learner.running(wrong)
    bench.begin()
    seen = bench.watch(wrong)
    assert seen is not None and seen.outcome is Outcome.ROLLED_BACK and seen.previous is not None
    assert seen.previous.reconstructor.id == file.reconstructor.id
    # said once: then there is a pause
    again = bench.watch(wrong)
    assert again is not None and again.outcome is Outcome.KEPT
    bench.learner.running(file.reconstructor.id)
    assert bench.end(mini).reason == "dropped: the loop was given another reconstructor meanwhile"


def seeing(mini: System, factor: float) -> System:
    """Another r0 than that of the frames."""
    return mini.with_changes({"atmosphere.r0": factor * mini.atmosphere.r0})


def test_the_way_back_is_as_long_as_frames_make_it(mini: System, file: Belief, bench: Bench) -> None:
    """Each swap was farther from the frames' sky; of what was replaced the oldest and the two latest are kept."""
    for factor in (0.8, 0.6, 0.45, 0.3):
        runs = bench.swap(seeing(mini, factor))
    seen = bench.watch(runs)
    assert seen is not None and seen.outcome is Outcome.ROLLED_BACK and seen.previous is file
    assert "the one before is better" in seen.reason
    assert "; 2 steps back, better still by its log-score" in seen.reason
    assert "; 3 steps back" in seen.reason and "; 4 steps" not in seen.reason


def test_the_way_back_is_no_longer_than_frames_make_it(mini: System, ground: Belief, bench: Bench) -> None:
    bench.learner.running(ground.reconstructor.id)
    right = bench.swap(mini)
    seen = bench.watch(bench.swap(seeing(mini, 0.5)))
    assert seen is not None and seen.outcome is Outcome.ROLLED_BACK and seen.previous is not None
    assert seen.previous.reconstructor.id == right
    assert "steps" not in seen.reason


def test_the_one_before_may_be_as_wrong(mini: System, file: Belief, bench: Bench) -> None:
    """The second of two swaps in a cloud does little; when the light is back, it is no worse than the first."""
    bench.swap(seeing(mini, 0.5))
    seen = bench.watch(bench.swap(seeing(mini, 0.51)))
    assert seen is not None and seen.outcome is Outcome.ROLLED_BACK and seen.previous is file
    assert "by its log-score and unforetold slopes the one 2 steps before is better" in seen.reason


def test_what_was_gone_back_to_is_watched(mini: System, file: Belief, bench: Bench) -> None:
    """Though nothing else may be swapped yet."""
    first = bench.swap(seeing(mini, 0.5))
    bench.swap(seeing(mini, 0.6))
    bench.learner.running(first)  # an operator's roll-back
    assert bench.learner.decider.state is State.PAUSED
    seen = bench.watch(first)
    assert seen is not None and seen.outcome is Outcome.ROLLED_BACK and seen.previous is file
    assert "log-score and unforetold slopes" in seen.reason
    # said once
    for _ in range(2):
        again = bench.watch(first)
        assert again is not None and again.outcome is Outcome.KEPT and again.watched is None
    bench.learner.running(file.reconstructor.id)
    seen = bench.watch(file.reconstructor.id)
    assert seen is not None and seen.outcome is Outcome.KEPT and seen.previous is None


@pytest.mark.parametrize("again", [False, True])
def test_what_an_operator_chose_has_no_way_back(mini: System, ground: Belief, bench: Bench, again: bool) -> None:
    """Something else, or again what was gone back from."""
    first, chosen = bench.swap(seeing(mini, 0.5)), ground.reconstructor.id
    if again:
        chosen = bench.swap(seeing(mini, 0.4))
        bench.learner.running(first)
    bench.learner.running(chosen)
    seen = bench.watch(chosen)
    assert seen is not None and seen.outcome is Outcome.KEPT
    assert seen.previous is None and seen.watched is None


@pytest.mark.parametrize("since", [True, False])
def test_a_pause_knows_whether_the_model_explains_frames_since(
    mini: System, bench: Bench, monkeypatch: pytest.MonkeyPatch, since: bool
) -> None:
    said = list[str]()

    def gains(*given: object) -> Decision:
        said.append(str(given[-1]))
        return Decision(Action.KEEP, "not asked")

    wrong = bench.swap(seeing(mini, 0.5))
    monkeypatch.setattr(Decider, "gains", gains)
    bench.begin(wrong if since else 0)
    bench.end(mini)
    assert bool(said[0]) == since


def test_a_fit_gives_way_to_what_an_operator_chose_meanwhile(mini: System, ground: Belief, bench: Bench) -> None:
    bench.begin()
    bench.learner.running(ground.reconstructor.id)
    judgement = bench.end(mini.with_changes({"atmosphere.r0": 0.2}))
    assert judgement.outcome is Outcome.KEPT and judgement.candidate is None
    assert judgement.reason == "dropped: the loop was given another reconstructor meanwhile"


def test_a_fit_goes_on_over_a_swap_that_was_asked_for_here(mini: System, bench: Bench) -> None:
    """The HRTC takes its time to stage it: the next window is fitted already."""
    bench.begin()
    first = bench.end(mini.with_changes({"atmosphere.r0": 0.2}))
    assert first.candidate is not None
    bench.begin()
    bench.learner.running(first.candidate.reconstructor.id)
    second = bench.end(mini.with_changes({"atmosphere.r0": 0.21}))
    assert second.outcome is Outcome.PUBLISHED
    assert second.active is first.candidate


@pytest.mark.parametrize(
    ("running", "staged", "previous", "now", "published", "not_yet"),
    [
        (5, 0, 0, 0.0, Step.WAIT, Step.PUBLISH),
        (5, 0, 0, 31.0, Step.FAIL, Step.PUBLISH),
        (5, 1, 2, 0.0, Step.COMMIT, Step.COMMIT),
        (5, 2, 1, 31.0, Step.ROLL_BACK, Step.ROLL_BACK),
        (1, 1, 5, 0.0, Step.DONE, Step.DONE),
        # an operator's, whatever the HRTC holds
        (6, 1, 1, 0.0, Step.DROP, Step.DROP),
        (0, 1, 1, 0.0, Step.DROP, Step.DROP),
    ],
)
def test_only_what_was_judged_is_replaced(
    file: Belief, running: int, staged: int, previous: int, now: float, published: Step, not_yet: Step
) -> None:
    identity = file.reconstructor.id
    names = {1: identity}
    held = names.get(running, running), names.get(staged, staged), names.get(previous, previous), now
    for sent, step in ((True, published), (False, not_yet)):
        assert Order(file.reconstructor, instead=5, until=30.0, published=sent).step(*held) is step


def test_a_refused_roll_back_goes_by_way_of_a_commit(file: Belief) -> None:
    """The status said that the HRTC keeps it, but that was before another swap."""
    identity = file.reconstructor.id
    order = Order(file.reconstructor, instead=5, until=30.0, back=True)
    assert order.step(5, 0, identity, 0.0) is Step.ROLL_BACK
    order.refused = True
    assert order.step(5, 0, identity, 0.0) is Step.PUBLISH
    order.published = True
    assert order.step(5, 0, 6, 1.0) is Step.WAIT
    assert order.step(5, identity, 6, 2.0) is Step.COMMIT
