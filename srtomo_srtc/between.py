"""What turbulence between the altitudes of a grid does to a sky that is told at these altitudes.

The slopes' covariance of a layer between two of the grid is not quite what the two have when they share its strength:
what is left, D, is explained by all that is fitted, which moves by ``F^-1 g`` with ``g_i = 1/2 tr(C^-1 D C^-1 B_i)``.
No number of frames makes that smaller. (The smoothing error of Rodgers 2000, Inverse Methods for Atmospheric Sounding.)
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.likelihood import information, inverse_of, non_negative_step, score, with_ridge
from srtomo_srtc.sampling import Sampling
from srtomo_srtc.sky_model import POWER, SkyModel

Array = NDArray[np.float64]

_ANYWHERE = math.sqrt(8 / 15)  # rms of 4 t (1 - t) for t in 0 to 1: of D over where the layer is, to that half-way


def spread_between(
    system: System,
    layout: Layout,
    sampling: Sampling,
    heights: Array,
    strengths: Array,
    outer_scale: float,
    levels: Array,
    told: Array,
) -> Array:
    """1-sigma error of what is told, for want of layers between those of the grid, (n_told,).

    Half of the strength of each two neighbours is supposed to be at one altitude, which may be anywhere between them.
    A strength of zero may be one that the fit would have liked to be negative, or may not: the larger of the errors
    with and without that bound.

    Args:
        sampling: slopes to reckon with; a few hundred coarse ones will do.
        heights: (n_layers,) the grid, along the line of sight, m.
        strengths: (n_layers,) m^(-5/3).
        outer_scale: m.
        levels: (n_sensors,) of noise.
        told: (n_told, n_layers + 1 + n_sensors), each as a sum of strengths, L0^-POWER and levels.
    """
    n = len(heights)
    model = SkyModel(system, layout, sampling, np.concatenate([heights, (heights[1:] + heights[:-1]) / 2]))
    layers = [model.layer(l, outer_scale) for l in range(2 * n - 1)]
    turbulence = np.tensordot(strengths.astype(np.float32), layers[:n], axes=1)
    slope = model.by_outer_scale(np.concatenate([strengths, np.zeros(n - 1)]), outer_scale, turbulence)
    C = turbulence.astype(np.float64) + sum(level * noise for level, noise in zip(levels, model.noise, strict=True))
    inverse = inverse_of(C + model.unseen(float(C.trace()) / len(C))).astype(np.float32)
    bases = [*layers[:n], slope, *model.noise]
    F = with_ridge(information(inverse, bases))
    theta = np.concatenate([strengths, [outer_scale**-POWER], levels])
    squares = np.zeros((2, len(told)))
    for l in range(n - 1):
        strength = (strengths[l] + strengths[l + 1]) / 2
        left = np.asarray(layers[n + l] - (layers[l] + layers[l + 1]) / 2, np.float32)
        g = _ANYWHERE * strength * score(inverse, left, bases)
        moved = np.linalg.solve(F, g), non_negative_step(theta, g, F) - theta
        squares += np.square(np.array(moved) @ told.T)
    return np.asarray(np.sqrt(squares.max(axis=0)))
