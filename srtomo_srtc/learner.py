"""Learning in session: windows of telemetry in, judgements out. No ROS, no clock of its own, no thread.

Every window is fitted; what the fit believes is compared with what the loop runs on, on frames that the fit has not
seen; and what is better by :mod:`srtomo_srtc.decide`'s rules becomes a reconstructor. Whoever calls this publishes and
commits it, and says what the loop runs (:meth:`Learner.running`). What runs is judged by the latest frames apart from
that, without a fit; a swap that was asked for is watched so, and taken back, for as long as there is a way back. What
it replaced, and what that had replaced, are ways back: of two swaps in a cloud the second is wrong when the light is
back, and so is the first.
"""

from __future__ import annotations

import enum
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.decide import Action, Comparison, Decider, Rules, State, compare
from srtomo_srtc.health import FEWEST_BLOCKS, Estimate, FlowModel, Health, SlopeModel, block_mean
from srtomo_srtc.learned_sky import LearnedSky
from srtomo_srtc.predict import Prediction, mean_wfe
from srtomo_srtc.telemetry import HeldOut, Recent, Statistics


@dataclass(frozen=True, eq=False)
class Belief:
    """A reconstructor and the system that it was made from, whose models are kept once they are asked for.

    Attributes:
        source: where the system's sky comes from: "file", "ground" or "learned".
        layout: where its sensors are taken to be; None: as in the system.
    """

    source: str
    system: System
    reconstructor: Reconstructor
    layout: Layout | None = None
    models: dict[int, SlopeModel] = field(default_factory=dict)
    _making: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def model(self, ahead: int) -> SlopeModel:
        """What the system supposes of the slopes; with ``ahead``, also of how many exposures later. Any thread."""
        with self._making:
            if ahead not in self.models:
                self.models[ahead] = model_of(self.system, ahead, self.layout)
            return self.models[ahead]


def model_of(system: System, ahead: int, layout: Layout | None = None) -> SlopeModel:
    """As :meth:`Belief.model`."""
    return FlowModel(system, ahead / system.loop.rate, layout) if ahead else SlopeModel(system, layout)


class Outcome(enum.IntEnum):
    """Of a judgement; numbers as in ModelHealth."""

    KEPT = 0
    PUBLISHED = 1
    ROLLED_BACK = 2
    FAILED = 3


@dataclass(eq=False)
class Judgement:
    """What became of a window, or of the latest frames, and why.

    Attributes:
        window: the telemetry that was judged.
        active: what the loop ran; None when it is nothing of ours.
        previous: the nearest way back from it, or the one that is to be gone back to; None where there is none.
        outcome: PUBLISHED asks for ``candidate`` to be published and committed, ROLLED_BACK for the loop to go back to
            ``previous``, which may be older than what the HRTC kept.
        reason: for people.
        health: of the active model.
        sky: that was learned, unless the fit failed.
        comparison: of the candidate with the active model.
        watched: of the active model with the one before, where there is a way back.
        candidate: built where held-out frames prefer the learned sky.
        predicted: wavefront error of the active and of the candidate's reconstructor under the learned sky, m rms.
        seconds: that the stages took.
    """

    window: Statistics | Recent
    active: Belief | None = None
    previous: Belief | None = None
    outcome: Outcome = Outcome.KEPT
    reason: str = ""
    health: Health | None = None
    sky: LearnedSky | None = None
    comparison: Comparison | None = None
    watched: Comparison | None = None
    candidate: Belief | None = None
    predicted: tuple[float, float] | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def ended(self, outcome: Outcome, reason: str) -> Judgement:
        """Itself, with its end."""
        self.outcome, self.reason = outcome, reason
        return self


def left_by_loop(held: HeldOut, some: NDArray[np.bool_]) -> Estimate:
    """Mean square of the loop's slopes over that of the pseudo-open-loop ones, in some of the frames.

    Args:
        some: (n_held,) which frames, of at least two blocks.
    """
    power = float(np.mean(np.square(held.slopes[some], dtype=np.float64)))
    left = np.mean(np.square(held.measured[some], dtype=np.float64), axis=1)
    return block_mean(left / power, held.block[some])


def pairs(held: HeldOut, apart: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Which held-out frames have another one so many exposures later in the same block: indices of both."""
    at = {(block, frame): i for i, (block, frame) in enumerate(zip(held.block, held.frames, strict=True))}
    found = [(i, at.get((block, frame + apart))) for (block, frame), i in at.items()]
    now, later = np.array([(i, j) for i, j in found if j is not None], np.intp).reshape(-1, 2).T
    return now, later


@contextmanager
def _timed(judgement: Judgement, stage: str) -> Iterator[None]:
    since = time.perf_counter()
    yield
    judgement.seconds[stage] = round(time.perf_counter() - since, 3)


_LATEST = 2  # ways back that are kept, besides the oldest
_DROPPED = "dropped: the loop was given another reconstructor meanwhile"

Fit = Callable[[Statistics], LearnedSky]
"""The sky from a window; raises LearnError, or another ValueError."""

Build = Callable[[System], Reconstructor]
"""A system's reconstructor."""


class Learner:
    """The learning of one loop. One thread calls :meth:`judge`, another may call :meth:`watch`, any the others.

    Args:
        system: the instrument as its file says.
        fit: to windows.
        build: reconstructors of learned systems.
        rules: when a swap is worth it.
        clock: s; a monotonic one.
        ahead: exposures; models are judged by how well they foretell frames so much later. Of predictive
            reconstructors: single frames say nothing of the wind. 0: by single frames.
        layout: where sensors are taken to be, by fit and build too; as in the system when not given.
    """

    def __init__(
        self,
        system: System,
        fit: Fit,
        build: Build,
        rules: Rules | None = None,
        clock: Callable[[], float] = time.monotonic,
        ahead: int = 0,
        layout: Layout | None = None,
    ) -> None:
        self._fit = fit
        self._layout = layout
        self._build = build
        self._ahead = ahead
        self._sensors = [sensor.name for sensor in system.sensors]
        self.decider = Decider(self._sensors, rules, clock)
        self._known: dict[int, Belief] = {}
        self._active: Belief | None = None
        # what the swaps that were asked for here replaced, oldest first; none where somebody else chose what is active
        self._ways_back: tuple[Belief, ...] = ()
        self._going_back = False  # was asked for, and the loop has not done it yet
        self._offered = 0
        self._left = np.inf
        # of all of the above; never held while something is computed
        self._lock = threading.Lock()

    def know(self, belief: Belief) -> None:
        """A reconstructor that the loop may come to run."""
        with self._lock:
            self._known[belief.reconstructor.id] = belief

    def running(self, identity: int) -> None:
        """The loop now runs the reconstructor of this id: after every commit and roll-back, whoever asked for it."""
        with self._lock:
            if self._active is not None and identity == self._active.reconstructor.id:
                return
            before, self._active = self._active, self._known.get(identity)
            self._going_back = False
            ways = self._ways_back
            back = [step for step, belief in enumerate(ways) if belief.reconstructor.id == identity]
            if back:
                self._ways_back = ways[: back[0]]
                if before is not None and before.reconstructor.id == self._offered:
                    self._offered = 0  # whoever takes it up again has chosen it
                self.decider.rolled_back()
            elif identity == self._offered and before is not None:
                # the oldest is what people chose
                self._ways_back = (*ways[:1], *(*ways[1:], before)[-_LATEST:]) if ways else (before,)
                self.decider.committed(self._left)
            else:
                self._ways_back = ()
                self.decider.left_alone()
            if self._active is None:
                return  # the HRTC may have nothing yet, and come to what is known here
            # the one before, which is no way back where it was gone back from, is still the HRTC's previous one
            kept = (self._active, before, *self._ways_back)
            needed = {belief.reconstructor.id for belief in kept if belief is not None}
            needed.add(self._offered)
            self._known = {
                known: belief for known, belief in self._known.items() if known in needed or belief.source != "learned"
            }

    def watch(self, recent: Recent) -> Judgement | None:
        """Judge what the loop runs by the latest frames, and a swap that was asked for here at first by those since.

        Two products a model and frame, once the models are there: of what runs, and of each way back.

        Returns:
            with the health of the active model; ROLLED_BACK, once, where a way back is better. None: there are too few
            frames, or what is active is not known here or has just changed.
        """
        with self._lock:
            active, ways = self._active, self._ways_back
            closely = self.decider.state is State.WATCHING
            asked = self._going_back and self.decider.state is State.PAUSED
        previous = ways[-1] if ways else None
        held = recent.held_out
        if active is None or len(np.unique(held.block)) < FEWEST_BLOCKS:
            return None
        judgement = Judgement(recent, active, previous)
        model = active.model(self._ahead)
        health = judgement.health = Health.of(model.scores(held.slopes), held.block)
        ill = self.decider.ill(health, model.explained)
        judgement.reason = f"the active model {f'does not explain {ill}' if ill else 'explains its sensors'}"
        if asked or previous is None:
            return judgement
        some = np.ones(len(held.frames), bool)
        if closely:
            some = held.reconstructor == active.reconstructor.id
        # after a roll-back all: open-loop slopes are the same whatever answered them, and a step farther may be urgent
        if len(np.unique(held.block[some])) < FEWEST_BLOCKS:
            return judgement.ended(Outcome.KEPT, f"watching: too few frames since the swap; {judgement.reason}")
        try:
            judgement.watched, *older = (
                self._compared(model, way.model(self._ahead), held, some) for way in reversed(ways)
            )
        except ValueError as error:  # of frames in pairs there may be fewer
            return judgement.ended(Outcome.KEPT, f"watching: {error}; {judgement.reason}")
        left = left_by_loop(held, some)
        with self._lock:
            if self._active is not active:
                return None
            decision = self.decider.watch(judgement.watched, model.explained, left, older)
            self._going_back = decision.action is Action.ROLL_BACK
        if decision.action is not Action.ROLL_BACK:
            return judgement.ended(Outcome.KEPT, decision.reason)
        judgement.ended(Outcome.ROLLED_BACK, decision.reason)
        judgement.previous = target = ways[-decision.steps]
        for steps, way in enumerate(reversed(ways[: -decision.steps]), decision.steps + 1):
            comparison = self._compared(target.model(self._ahead), way.model(self._ahead), held, some)
            if worse := self.decider.worse(comparison, closely):
                judgement.previous = target = way
                judgement.reason += f"; {steps} steps back, better still by its {worse}: {comparison.text}"
        return judgement

    def judge(self, window: Statistics) -> Judgement:
        """Fit a window and decide. Takes seconds to minutes, and as much memory as a few covariances of slopes."""
        with self._lock:
            active = self._active
            judgement = Judgement(window, active, self._ways_back[-1] if self._ways_back else None)
        if active is None:
            return judgement.ended(Outcome.FAILED, "the loop runs no reconstructor whose model is known here")
        held = window.held_out
        if (blocks := len(np.unique(held.block))) < FEWEST_BLOCKS:
            reason = f"{blocks} blocks of held-out frames in the window, {FEWEST_BLOCKS} are needed"
            return judgement.ended(Outcome.FAILED, reason)
        model = active.model(self._ahead)
        judgement.health = Health.of(model.scores(held.slopes), held.block)
        if silent := model.silent(held.measured, held.block):
            names = ", ".join(self._sensors[w] for w in silent)
            return judgement.ended(Outcome.FAILED, f"no candidate: the slopes of {names} stand still")
        return self._consider(judgement, window)

    def _follow(self, judgement: Judgement, held: HeldOut) -> bool:
        """Take up what the loop has come to run during a fit, if that was asked for here; else the fit is void."""
        with self._lock:
            if self._active is judgement.active:
                return True
            if self._active is None or not self._ways_back or self._ways_back[-1] is not judgement.active:
                return False
            active = judgement.active = self._active
            judgement.previous = self._ways_back[-1]
        judgement.health = Health.of(active.model(self._ahead).scores(held.slopes), held.block)
        return True

    def _compared(
        self, candidate: SlopeModel, active: SlopeModel, held: HeldOut, some: NDArray[np.bool_] | None = None
    ) -> Comparison:
        """Two models by held-out frames, or by some of these."""
        chosen = np.ones(len(held.frames), bool) if some is None else some
        if not (isinstance(candidate, FlowModel) and isinstance(active, FlowModel)):
            slopes, block = held.slopes[chosen], held.block[chosen]
            return compare(candidate.scores(slopes), active.scores(slopes), candidate.n_seen, block)
        now, later = pairs(held, self._ahead)
        now, later = now[chosen[later]], later[chosen[later]]
        frames = held.slopes[now], held.slopes[later]
        new, old = candidate.scores_ahead(*frames), active.scores_ahead(*frames)
        return compare(new, old, candidate.n_seen, held.block[later])

    def _consider(self, judgement: Judgement, window: Statistics) -> Judgement:
        """Fit the window, compare, and build what is better."""
        held = window.held_out
        try:
            with _timed(judgement, "fit"):
                judgement.sky = self._fit(window)
                system = judgement.sky.system
            with _timed(judgement, "model"):
                model = model_of(system, self._ahead, self._layout)
            if not self._follow(judgement, held):
                return judgement.ended(Outcome.KEPT, _DROPPED)
            active = judgement.active
            assert active is not None
            with _timed(judgement, "comparison"):
                comparison = judgement.comparison = self._compared(model, active.model(self._ahead), held)
        except (ValueError, np.linalg.LinAlgError) as error:
            return judgement.ended(Outcome.FAILED, f"no candidate: {error}")
        preference = self.decider.prefers(comparison, model.explained)
        if preference.action is not Action.COMMIT:
            return judgement.ended(Outcome.KEPT, preference.reason)
        with _timed(judgement, "reconstructor"):
            candidate = Belief("learned", system, self._build(system), self._layout, {self._ahead: model})
        with _timed(judgement, "prediction"):
            two = active.reconstructor, candidate.reconstructor
            epochs = max(reconstructor.n_epochs for reconstructor in two)
            prediction = Prediction(system, self._layout, epochs=epochs)
            before, after = (mean_wfe(prediction.budgets(reconstructor.R)) for reconstructor in two)
        judgement.predicted = before, after
        running = held.reconstructor == active.reconstructor.id
        blocks = len(np.unique(held.block[running]))
        left = float(left_by_loop(held, running).mean) if blocks > 1 else np.inf
        ill = ""
        if blocks >= FEWEST_BLOCKS:
            active_model = active.model(self._ahead)
            health = Health.of(active_model.scores(held.slopes[running]), held.block[running])
            ill = self.decider.ill(health, active_model.explained)
        with self._lock:
            if self._active is not active:
                return judgement.ended(Outcome.KEPT, _DROPPED)
            decision = self.decider.gains(preference, before, after, ill)
            if decision.action is not Action.COMMIT:
                return judgement.ended(Outcome.KEPT, decision.reason)
            judgement.candidate = candidate
            self._offered, self._left = candidate.reconstructor.id, left
            self._known[self._offered] = candidate
        return judgement.ended(Outcome.PUBLISHED, decision.reason)
