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
from srtomo_srtc.decide import Action, Decider, Decision
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

    def begin(self) -> None:
        """Have a window fitted; returns in the middle of the fit."""
        held = self.held(0)
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

    learner = Learner(mini, fit, lambda system: implicit(system)[0])
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
    ("running", "staged", "previous", "now", "commit", "roll_back"),
    [
        (5, 0, 0, 0.0, Step.WAIT, Step.WAIT),
        (5, 0, 0, 31.0, Step.FAIL, Step.FAIL),
        (5, 1, 2, 0.0, Step.CALL, Step.WAIT),
        (5, 2, 1, 0.0, Step.WAIT, Step.CALL),
        (1, 1, 5, 0.0, Step.DONE, Step.DONE),
        # an operator's, whatever the HRTC holds
        (6, 1, 1, 0.0, Step.DROP, Step.DROP),
        (0, 1, 1, 0.0, Step.DROP, Step.DROP),
    ],
)
def test_only_what_was_judged_is_replaced(
    file: Belief, running: int, staged: int, previous: int, now: float, commit: Step, roll_back: Step
) -> None:
    identity = file.reconstructor.id
    names = {1: identity}
    held = names.get(running, running), names.get(staged, staged), names.get(previous, previous), now
    for back, step in ((False, commit), (True, roll_back)):
        assert Order(file.reconstructor, back, instead=5, until=30.0).step(*held) is step
