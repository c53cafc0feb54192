"""Whether a new reconstructor is worth a swap, and whether it was.

A minimum-variance reconstructor is the best there is under the model that it was made from: its own prediction proves
nothing. So two models are compared on frames that neither was fitted to, and only those decide; the prediction then
says whether the difference is worth anything. What each number stops:

- a fit that returned nonsense: the log-score, and that sensors foretell each other worse;
- a sensor that moved or measures something else: the candidate's own innovation, which no sky or noise explains; one
  that died would be explained by no noise at all, and is told by its slopes as measured, which stand still;
- too few frames, or too alike: errors by jackknife over blocks of frames, and the number of blocks;
- a better model that would not change the commands much: the predicted gain;
- a swap on data that no longer hold, or a matrix that is not what its model promises: the watch afterwards, by the same
  numbers on new frames, and by what the loop leaves of the slopes; once that is passed, or after a roll-back, as long
  as there is a way back, by the rule of every swap: both numbers;
- several swaps on data that no longer hold: the way back is as long as the same numbers make it;
- flapping between models that both explain what is measured: a pause after a roll-back.
"""

from __future__ import annotations

import enum
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srtomo_srtc.health import FEWEST_BLOCKS, Estimate, Health, Scores, block_mean

Array = NDArray[np.float64]

_VOUCHED = 0.5  # share of a sensor's variance that others foretell, from which on they can tell that it is ill


@dataclass(frozen=True)
class Rules:
    """When a swap is worth it.

    Attributes:
        floor: m rms, by which the wavefront error has to fall.
        every: s, from one swap to the next at least.
        watch: s, how long a new reconstructor is watched closely.
        pause: s, from a roll-back to the next swap, unless what runs does not explain its sensors.
        errors: standard errors by which held-out frames have to prefer a model.
        tolerance: how far the innovation of a sensor that others foretell may be from 1, as a factor less 1.
        left: factor by which the share of the slopes that the loop leaves may grow with a swap.
    """

    floor: float = 1e-9
    every: float = 10.0
    watch: float = 20.0
    pause: float = 60.0
    errors: float = 3.0
    tolerance: float = 0.25
    left: float = 1.5


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two models on the same frames.

    Attributes:
        candidate, active: each by itself.
        log_score: of the candidate less the active one's, a frame.
        residual: by how much less of the sensors' slopes is left unforetold (mean square, each sensor from the others)
            by the candidate, as a share of what the active one leaves.
    """

    candidate: Health
    active: Health
    log_score: Estimate
    residual: Estimate

    @property
    def differences(self) -> tuple[tuple[str, Estimate], tuple[str, Estimate]]:
        """Both, above 0 in favour of the candidate, with their names."""
        return ("log-score", self.log_score), ("unforetold slopes", self.residual)

    @property
    def text(self) -> str:
        """Both, for people."""
        return (
            f"log-score {float(self.log_score.mean):+.3g} +- {float(self.log_score.error):.2g} a frame, "
            f"unforetold slopes {-100 * float(self.residual.mean):+.2f} +- {100 * float(self.residual.error):.2f} %"
        )


def compare(candidate: Scores, active: Scores, n_seen: Array, block: NDArray[np.integer]) -> Comparison:
    """Put two models' scores of the same frames, which neither was fitted to, side by side.

    Args:
        n_seen: (n_sensors,) modes that each sensor is trusted with.
        block: (n_frames,) which stretch of successive frames each belongs to.

    Raises:
        ValueError: less than two blocks.
    """
    weight = n_seen / n_seen.sum()
    left = active.residual @ weight
    return Comparison(
        Health.of(candidate, block),
        Health.of(active, block),
        block_mean(candidate.log_score - active.log_score, block),
        block_mean((left - candidate.residual @ weight) / left.mean(), block),
    )


class State(enum.Enum):
    """Of a :class:`Decider`."""

    IDLE = "idle"
    WATCHING = "watching"
    PAUSED = "paused"


class Action(enum.Enum):
    """What a decision asks for."""

    KEEP = "keep"
    COMMIT = "commit"
    ROLL_BACK = "roll back"


@dataclass(frozen=True)
class Decision:
    """What to do, and why; for people, and for the bag. ``steps``: how far back, of a roll-back."""

    action: Action
    reason: str
    steps: int = 0


class Decider:
    """One loop's decisions: idle until a candidate is better, then watching it, and after a roll-back paused.

    A swap that is being watched may be followed by the next. Not for several threads at once.

    Args:
        sensors: their names.
        rules: when a swap is worth it.
        clock: s; a monotonic one.

    Attributes:
        rules: as given.
    """

    def __init__(
        self,
        sensors: Sequence[str],
        rules: Rules | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._sensors = tuple(sensors)
        self.rules = rules or Rules()
        self._clock = clock
        self._state = State.IDLE
        self._since = -np.inf
        self._swapped = -np.inf
        self._left_before = np.inf

    @property
    def state(self) -> State:
        """Where the decisions stand; time alone ends a pause."""
        if self._state is State.PAUSED and self._clock() - self._since >= self.rules.pause:
            self._state = State.IDLE
        return self._state

    def hindrance(self, ill: str = "") -> str:
        """Why no swap can be made now, whatever a fit finds; empty when one can.

        Args:
            ill: of the active model, since it runs, as :meth:`ill` gives it: no pause is for what is wrong.
        """
        if self.state is State.PAUSED and not ill:
            return f"rolled back {self._clock() - self._since:.0f} s ago, waiting {self.rules.pause:g} s"
        if (since := self._clock() - self._swapped) < self.rules.every:
            return f"the last swap was {since:.0f} s ago, one every {self.rules.every:g} s is allowed"
        return ""

    def ill(self, health: Health, explained: Array) -> str:
        """The sensors that a model does not explain, with their innovation; empty when it explains them.

        Args:
            explained: (n_sensors,) of the model: what others cannot foretell they cannot vouch for.
        """
        found = [w for w in health.ill(self.rules.tolerance) if explained[w] > _VOUCHED]
        mean, error = health.innovation
        return ", ".join(f"{self._sensors[w]} at {mean[w]:.2f} +- {error[w]:.2f}" for w in found)

    def prefers(self, comparison: Comparison, explained: Array) -> Decision:
        """Whether held-out frames speak for the candidate; what it would gain is not asked yet.

        Args:
            explained: of the candidate's model, as :meth:`ill` takes it.
        """
        rules = self.rules
        if comparison.candidate.n_blocks < FEWEST_BLOCKS:
            reason = f"{comparison.candidate.n_blocks} blocks of held-out frames are too few to judge by"
            return Decision(Action.KEEP, reason)
        if ill := self.ill(comparison.candidate, explained):
            return Decision(Action.KEEP, f"the candidate does not explain its sensors: innovation of {ill}")
        for name, difference in comparison.differences:
            if not difference.significance >= rules.errors:
                reason = f"held-out frames do not prefer the candidate by its {name}: {comparison.text}"
                return Decision(Action.KEEP, reason)
        return Decision(Action.COMMIT, f"held-out frames prefer the candidate: {comparison.text}")

    def gains(self, preference: Decision, before: float, after: float, ill: str = "") -> Decision:
        """Whether what held-out frames prefer is worth a swap; if so, the time to the next one begins.

        Args:
            preference: of :meth:`prefers`, in favour.
            before, after: wavefront error of the active and of the new reconstructor under the learned sky, m rms.
            ill: as :meth:`hindrance` takes it.
        """
        predicted = f"predicted {before * 1e9:.1f} -> {after * 1e9:.1f} nm"
        if not before - after >= self.rules.floor:
            return Decision(Action.KEEP, f"{predicted}, less than {self.rules.floor * 1e9:g} nm better")
        if hindrance := self.hindrance(ill):
            return Decision(Action.KEEP, f"{predicted}, but {hindrance}")
        self._swapped = self._clock()
        return Decision(Action.COMMIT, f"{preference.reason}; {predicted}")

    def committed(self, left: float) -> None:
        """The loop runs the new reconstructor: watch it from now on.

        Args:
            left: mean square of the closed loop's slopes over that of the pseudo-open-loop ones, before the swap.
        """
        self._state, self._since, self._left_before = State.WATCHING, self._clock(), left

    def worse(self, comparison: Comparison, closely: bool) -> str:
        """The numbers by which a model is worse than one before, if they are enough to go back; otherwise empty.

        Args:
            comparison: of the model, as the candidate, with the one before.
            closely: a swap is being watched: one number is enough. Later, and after a roll-back, it takes both.
        """
        found = [name for name, difference in comparison.differences if difference.significance <= -self.rules.errors]
        enough = closely or len(found) == len(comparison.differences)
        return " and ".join(found) if enough else ""

    def watch(
        self, comparison: Comparison, explained: Array, left: Estimate, older: Sequence[Comparison] = ()
    ) -> Decision:
        """Judge the reconstructor that the loop runs by frames since.

        The pause begins with the decision.

        Args:
            comparison: of its model, as the candidate, with the one before.
            explained: of its model, as :meth:`ill` takes it.
            left: as :meth:`committed` takes it, now. Where the model no longer explains the slopes, it is the sky or
                the light that has changed, and this share with it: then it says nothing of the reconstructor.
            older: of its model with those before that, latest first: the one before may be as wrong as it is. These
                always take both numbers.
        """
        rules, closely = self.rules, self.state is State.WATCHING
        if worse := self.worse(comparison, closely):
            return self._roll_back(f"by its {worse} the one before is better: {comparison.text}")
        for steps, other in enumerate(older, 2):
            if worse := self.worse(other, closely=False):
                return self._roll_back(f"by its {worse} the one {steps} steps before is better: {other.text}", steps)
        if not closely:
            return Decision(Action.KEEP, f"no worse than the one before: {comparison.text}")
        grown = left.mean - rules.errors * left.error > rules.left * self._left_before
        if grown and not self.ill(comparison.candidate, explained):
            return self._roll_back(
                f"the loop leaves {100 * float(left.mean):.1f} % of the slopes' power, "
                f"{100 * self._left_before:.1f} % before the swap"
            )
        if self._clock() - self._since >= rules.watch:
            self._state = State.IDLE
            return Decision(Action.KEEP, f"the swap was right: {comparison.text}")
        return Decision(Action.KEEP, f"watching: {comparison.text}")

    def rolled_back(self) -> None:
        """The loop went back to the reconstructor before, on this decider's word or an operator's."""
        self._state, self._since = State.PAUSED, self._clock()

    def left_alone(self) -> None:
        """The loop runs what somebody else chose: there is nothing to watch."""
        if self.state is State.WATCHING:
            self._state = State.IDLE

    def _roll_back(self, reason: str, steps: int = 1) -> Decision:
        self._state, self._since = State.PAUSED, self._clock()
        return Decision(Action.ROLL_BACK, f"roll back: {reason}", steps)
