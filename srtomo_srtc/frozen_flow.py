"""How many independent frames a stretch of moving sky is worth, for one parameter or another.

What an estimate takes from a frame is a quadratic form ``s^T M s``. In frozen flow two such forms, of frames a time t
apart, have the covariance ``2 tr(M C_t M C_t^T)``, C_t that of slopes with those t earlier: a wind that has carried
the sky across a sub-aperture has renewed what small scales tell, for large ones it has to cross the pupil.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from srtomo_srtc.likelihood import inverse_of
from srtomo_srtc.sky_model import SkyModel

Array = NDArray[np.float64]
Single = NDArray[np.float32]

_PROBES = 64  # random vectors that stand for a trace
_FIRST = 0.2  # of the time in which the fastest layer crosses a sub-aperture: the first time that is looked at
_FARTHEST = 500.0  # m that the fastest layer goes: beyond, nothing resembles what was
_RATIO = 2.2  # of such times
_NEGLIGIBLE = 0.002  # correlation
_SLOWEST = 1e-3  # m/s


def independent_frames(
    model: SkyModel,
    strengths: Array,
    outer_scale: float,
    covariance: Array,
    bases: Sequence[Single] | Single,
    influences: Array,
    velocity: Array,
    size: float,
    interval: float,
    n_frames: int,
) -> Array:
    """Number of independent frames with the variance of ``n_frames`` in sequence, (n_influences,).

    An influence of nothing, as the share of a group that holds all turbulence has, is known without any: ``n_frames``.

    Args:
        model: of the turbulence; a coarse one will do.
        covariance: (n, n) C of the slopes with their noise.
        bases: (n, n) each, B_i.
        influences: (n_influences, n_bases) w of each parameter: ``sum_i w_i B_i``, with C^-1 on both sides, is its M.
        velocity: (n_layers, 2) m/s, where each layer goes.
        size: of a sub-aperture, m.
        interval: between frames, s; infinite where frames are independent.
    """
    if not math.isfinite(interval) or n_frames < 2:
        return np.full(len(influences), float(n_frames))
    speed = max(_SLOWEST, float(np.hypot(*velocity[strengths > 0].T).max(initial=0.0)))
    end = min(interval * n_frames, _FARTHEST / speed)
    draw = np.random.default_rng(0)
    Z = draw.choice(np.array([-1, 1], np.float32), (len(covariance), _PROBES))
    A, weights = inverse_of(covariance).astype(np.float32), influences.astype(np.float32)

    def through(vectors: Single) -> Single:
        """Each parameter's M, times vectors (n, n_vectors): (n, n_influences * n_vectors)."""
        seen = A @ vectors
        parts = np.stack([basis @ seen for basis in bases])
        return np.asarray(A @ np.tensordot(parts, weights, (0, 1)).transpose(0, 2, 1).reshape(len(A), -1))

    first = through(Z)

    def correlated(C: Single) -> Array:
        both = (C.T @ first) * through(C.T @ Z)
        return both.reshape(len(A), len(influences), -1).sum(axis=(0, 2), dtype=np.float64)

    alone = correlated(covariance.astype(np.float32))

    def relative(time: float) -> Array:
        """Of turbulence with that a ``time`` (s) ago."""
        there = correlated(model.lagged(strengths, outer_scale, velocity, time))
        return np.divide(there, alone, out=np.zeros_like(alone), where=alone > 0)

    times, correlations = [0.0], [relative(0.0)]
    while times[-1] < end and correlations[-1].max() > _NEGLIGIBLE:
        times.append(_RATIO * times[-1] or _FIRST * size / speed)
        correlations.append(relative(times[-1]))
    times.append(_RATIO * times[-1])
    correlations.append(np.zeros(len(influences)))
    k = np.arange(1, n_frames)
    share = 2 * (1 - k / n_frames)
    sums = [share @ np.interp(k * interval, times, correlation) for correlation in np.transpose(correlations)]
    return n_frames / (1 + np.maximum(sums, 0))
