"""Judgements and skies as messages: every field is one of the message's, and says what the judgement says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from srtomo_core.messages import decode, encode
from srtomo_core.system import System, load_system
from srtomo_srtc.decide import Comparison, compare
from srtomo_srtc.health import Health, SlopeModel
from srtomo_srtc.learn import Group, Learned, NoiseLevel
from srtomo_srtc.learn_wind import LayerWind
from srtomo_srtc.learned_sky import LearnedSky
from srtomo_srtc.learner import Belief, Judgement, Learner, Outcome
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.report import believed_fields, diagnosis, health_fields, learned_fields
from srtomo_srtc.telemetry import HeldOut, Statistics
from srtomo_srtc.worker import Worker

N = 286  # slopes of mini


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def window() -> Statistics:
    rng = np.random.default_rng(2)
    held = HeldOut(
        slopes=rng.standard_normal((80, N), np.float32) * np.float32(1e-6),
        measured=rng.standard_normal((80, N), np.float32) * np.float32(1e-6),
        frames=np.arange(80),
        block=np.arange(80) // 10,
        reconstructor=np.zeros(80, np.uint64),
    )
    return Statistics(np.eye(N, dtype=np.float32), np.zeros(N), 500, 0.008, 4.0, {}, {}, held, 7, 100, 1100)


def sent(kind: str, fields: dict[str, Any]) -> Any:
    return decode(f"msgs_schema/msg/{kind}", encode(f"msgs_schema/msg/{kind}", **fields))


def learned(outer_scale_range: tuple[float, float] = (15.0, 28.0)) -> Learned:
    groups = (Group((0, 1, 2), 500.0, 0.7, 0.02, 50.0, "they correlate"), Group((3,), 9000.0, 0.3, 0.01, 80.0, ""))
    noise = (NoiseLevel(0, 4.0, 0.4), NoiseLevel(2, 1.0, 0.1))
    altitudes, fractions = np.array([0.0, 500.0, 1000.0, 9000.0]), np.array([0.5, 0.0, 0.2, 0.3])
    values: dict[str, Any] = dict.fromkeys(("measured", "fitted", "sampling"))
    return Learned(
        r0=0.1, r0_sigma=0.002, outer_scale=20.0, outer_scale_range=outer_scale_range, altitudes=altitudes,
        fractions=fractions, groups=groups, noise=noise, n_frames=500, n_effective=60.0, iterations=4, **values,
    )  # fmt: skip


def test_a_learned_sky(mini: System, window: Statistics) -> None:
    winds = (
        LayerWind(0.0, 0.5, (8.0, 0.0), np.diag([0.04, 0.01]), ""),
        LayerWind(1000.0, 0.2, (1.0, 0.0), np.diag([0.81, 0.01]), ""),
        LayerWind(9000.0, 0.3, (0.0, 7.0), np.diag([9.0, 9.0]), "not seen"),
    )
    message = sent("AtmosphereProfile", learned_fields(mini, LearnedSky(learned(), mini, winds), window))
    assert (message.session, message.first_frame, message.last_frame, message.n_frames) == (7, 100, 1100, 500)
    assert message.altitude == pytest.approx([500, 9000])
    assert message.fraction_error == pytest.approx([0.02, 0.01])
    assert message.text == "at 500 m: they correlate"
    # rms over the file's, of the sensors that told
    assert message.noise == pytest.approx([2.0, math.nan, 1.0, math.nan], nan_ok=True)
    assert message.noise_error == pytest.approx([0.1, math.nan, 0.05, math.nan], nan_ok=True)
    # of two that are told as one the mean by strength, whose error is largest where theirs go together
    assert message.wind_speed[0] == pytest.approx(6.0)
    assert message.wind_speed_error[0] == pytest.approx(0.4)
    assert message.wind_direction_error[0] == pytest.approx(0.4 / 6.0)
    # what is not seen is supposed to be the file's
    assert message.wind_speed[1] > 10 and math.isnan(message.wind_speed_error[1])


@pytest.mark.parametrize("high", [28.0, math.inf])
def test_an_outer_scale_is_told_by_its_interval_seen_or_not(mini: System, window: Statistics, high: float) -> None:
    message = sent("AtmosphereProfile", learned_fields(mini, LearnedSky(learned((15.0, high)), mini, ()), window))
    assert (message.outer_scale_low, message.outer_scale, message.outer_scale_high) == (15.0, 20.0, high)
    assert "outer scale" not in message.text


def test_a_sky_that_was_not_learned(mini: System) -> None:
    message = sent("AtmosphereProfile", believed_fields(mini))
    assert message.r0 == pytest.approx(0.16)
    assert message.outer_scale == 25.0
    assert math.isnan(message.outer_scale_low) and math.isnan(message.outer_scale_high)
    assert np.isnan(message.fraction_error).all() and len(message.fraction_error) == 3


def test_a_judgement(mini: System, window: Statistics) -> None:
    active = Belief("file", mini, implicit(mini)[0])
    model, held = SlopeModel(mini), window.held_out
    other = SlopeModel(mini.with_changes({"atmosphere.r0": 0.2}))
    comparison: Comparison = compare(other.scores(held.slopes), model.scores(held.slopes), model.n_seen, held.block)
    judgement = Judgement(
        window,
        active,
        health=Health.of(model.scores(held.slopes), held.block),
        comparison=comparison,
        candidate=Belief("learned", mini, active.reconstructor),
        predicted=(130e-9, 50e-9),
    ).ended(Outcome.PUBLISHED, "why")
    message = sent("ModelHealth", health_fields(judgement))
    assert (message.reconstructor, message.candidate) == (active.reconstructor.id, active.reconstructor.id)
    assert (message.source, message.decision, message.text) == ("file", 1, "why")
    assert message.n_blocks == 8 and len(message.innovation) == len(message.candidate_innovation) == 4
    assert message.score_gain == pytest.approx(float(comparison.log_score.mean), rel=1e-5)
    assert message.predicted_gain == pytest.approx(120e-9)
    assert diagnosis(judgement) == (0, "why")


def test_a_failed_judgement_is_a_message_too(window: Statistics) -> None:
    message = sent("ModelHealth", health_fields(Judgement(window).ended(Outcome.FAILED, "too few frames")))
    assert (message.decision, message.text, len(message.innovation)) == (3, "too few frames", 0)
    assert diagnosis(Judgement(window).ended(Outcome.FAILED, "too few frames")) == (1, "too few frames")


def test_the_worker_outlives_whatever_a_fit_does(mini: System, window: Statistics) -> None:
    def fails(telemetry: Statistics) -> LearnedSky:
        raise MemoryError("needs 80 GiB")

    learner = Learner(mini, fails, lambda system: implicit(system)[0])
    belief = Belief("file", mini, implicit(mini)[0])
    learner.know(belief)
    worker: Worker[Statistics] = Worker("fits", learner.judge)
    worker.start()
    worker.judge(window)
    first = worker.judgements.get(timeout=30)
    learner.running(belief.reconstructor.id)
    worker.judge(window)
    second = worker.judgements.get(timeout=30)
    worker.finish()
    worker.join(timeout=30)
    assert not worker.is_alive()
    assert first is not None and second is not None
    assert first.outcome is second.outcome is Outcome.FAILED
    assert "no reconstructor whose model is known" in first.reason
    assert "MemoryError: needs 80 GiB" in second.reason
