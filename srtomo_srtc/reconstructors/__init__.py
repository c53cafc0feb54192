"""Reconstructors, one file each."""

from collections.abc import Callable
from typing import Any

from srtomo_srtc.reconstructors.explicit import explicit
from srtomo_srtc.reconstructors.glao import glao
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.reconstructors.iterative import iterative
from srtomo_srtc.reconstructors.learn_apply import learn_apply
from srtomo_srtc.reconstructors.least_squares import least_squares
from srtomo_srtc.reconstructors.moao import moao
from srtomo_srtc.reconstructors.modal import modal
from srtomo_srtc.reconstructors.predictive import predictive

METHODS: dict[str, Callable[..., Any]] = {
    "explicit": explicit,
    "glao": glao,
    "implicit": implicit,
    "iterative": iterative,
    "learn_apply": learn_apply,
    "least_squares": least_squares,
    "moao": moao,
    "modal": modal,
    "predictive": predictive,
}
"""By the name that ``srtomo reconstruct --method`` knows: ``method(system, layout=None, *, label, noise_gain, progress,
...)`` returns a Reconstructor and its G."""

__all__ = [
    "METHODS",
    "explicit",
    "glao",
    "implicit",
    "iterative",
    "learn_apply",
    "least_squares",
    "moao",
    "modal",
    "predictive",
]
