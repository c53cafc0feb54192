"""Judgements and profiles as the fields of their messages; without ROS."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from srtomo_core.system import System
from srtomo_srtc.learn import winds_at
from srtomo_srtc.learned_sky import LearnedSky
from srtomo_srtc.learner import Judgement, Outcome
from srtomo_srtc.telemetry import NoWindow, Statistics


def believed_fields(system: System) -> dict[str, Any]:
    """Fields of an AtmosphereProfile for a sky that was not learned."""
    atmosphere = system.atmosphere
    return {
        "r0": atmosphere.r0,
        "outer_scale": atmosphere.outer_scale,
        "altitude": [layer.altitude for layer in atmosphere.layers],
        "fraction": list(atmosphere.fractions),
        "wind_speed": [layer.wind_speed for layer in atmosphere.layers],
        "wind_direction": [layer.wind_direction for layer in atmosphere.layers],
        "r0_error": math.nan,
        "outer_scale_low": math.nan,
        "outer_scale_high": math.nan,
        **{
            f"{name}_error": [math.nan] * len(atmosphere.layers)
            for name in ("fraction", "wind_speed", "wind_direction")
        },
    }


def learned_fields(system: System, sky: LearnedSky, window: Statistics) -> dict[str, Any]:
    """Fields of an AtmosphereProfile for what was learned from a window: a layer for each group that can be told.

    Args:
        system: the instrument; its winds are supposed where none were learned.
    """
    learned, groups = sky.learned, sky.learned.groups
    winds, wind_error = winds_at(system, np.array([group.altitude for group in groups])), np.full(len(groups), math.nan)
    for g, group in enumerate(groups):
        wind = sky.wind_of(group)
        if wind is not None and not wind.reason:
            winds[g], wind_error[g] = wind.velocity, wind.sigma
    speed = np.hypot(*winds.T)
    low, high = learned.outer_scale_range
    noise = np.full((2, len(system.sensors)), math.nan)
    for level in learned.noise:
        rms = math.sqrt(level.factor)
        noise[:, level.sensor] = rms, level.sigma / (2 * rms)
    return {
        "r0": learned.r0,
        "outer_scale": learned.outer_scale,
        "altitude": [group.altitude for group in groups],
        "fraction": [group.fraction for group in groups],
        "wind_speed": speed.tolist(),
        "wind_direction": np.arctan2(winds[:, 1], winds[:, 0]).tolist(),
        "session": window.session,
        "first_frame": window.first_frame,
        "last_frame": window.last_frame,
        "n_frames": learned.n_frames,
        "n_effective": learned.n_effective,
        "r0_error": learned.r0_sigma,
        "outer_scale_low": low,
        "outer_scale_high": high,
        "fraction_error": [group.sigma for group in groups],
        "wind_speed_error": wind_error.tolist(),
        "wind_direction_error": (wind_error / np.maximum(speed, wind_error)).tolist(),
        "noise": noise[0].tolist(),
        "noise_error": noise[1].tolist(),
        "text": "; ".join(f"at {group.altitude:.0f} m: {group.reason}" for group in groups if group.reason),
    }


def health_fields(judgement: Judgement) -> dict[str, Any]:
    """Fields of a ModelHealth."""
    window, active, candidate, health = judgement.window, judgement.active, judgement.candidate, judgement.health
    fields: dict[str, Any] = {
        "session": window.session,
        "first_frame": window.first_frame,
        "last_frame": window.last_frame,
        "reconstructor": active.reconstructor.id if active is not None else 0,
        "candidate": candidate.reconstructor.id if candidate is not None else 0,
        "source": active.source if active is not None else "",
        "decision": int(judgement.outcome),
        "text": judgement.reason,
    }
    if health is not None:
        fields |= {
            "n_frames": health.n_frames,
            "n_blocks": health.n_blocks,
            "innovation": health.innovation.mean.tolist(),
            "innovation_error": health.innovation.error.tolist(),
            "residual": health.residual.mean.tolist(),
            "residual_error": health.residual.error.tolist(),
        }
    if judgement.comparison is not None:
        comparison = judgement.comparison
        fields |= {
            "candidate_innovation": comparison.candidate.innovation.mean.tolist(),
            "candidate_innovation_error": comparison.candidate.innovation.error.tolist(),
            "score_gain": float(comparison.log_score.mean),
            "score_gain_error": float(comparison.log_score.error),
            "residual_gain": float(comparison.residual.mean),
            "residual_gain_error": float(comparison.residual.error),
        }
    if judgement.predicted is not None:
        before, after = judgement.predicted
        fields["predicted_gain"] = math.copysign(math.sqrt(abs(before**2 - after**2)), before - after)
    return fields


def refusal_fields(why: NoWindow, reconstructor: int, source: str) -> dict[str, Any]:
    """Fields of a ModelHealth where there was no window to judge: its frames are the newest one that was answered.

    Args:
        reconstructor, source: that is active; 0 and "" for none, or none that is known.
    """
    frame = max(why.frame, 0)
    return {
        "session": why.session,
        "first_frame": frame,
        "last_frame": frame,
        "reconstructor": reconstructor,
        "source": source,
        "decision": int(Outcome.FAILED),
        "text": str(why),
    }


def diagnosis(judgement: Judgement) -> tuple[int, str]:
    """Level (0 OK, 1 WARN, 2 ERROR as in DiagnosticStatus) and message."""
    level = {Outcome.FAILED: 1, Outcome.ROLLED_BACK: 1}.get(judgement.outcome, 0)
    return level, judgement.reason
