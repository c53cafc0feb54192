"""Deformable mirrors: Gaussian influence functions, the model's interaction matrix, and the phase they can fit."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout, MirrorLayout
from srtomo_core.system import Direction, System
from srtomo_srtc.geometry import cell_light, footprints

Array = NDArray[np.float64]

_CELLS_PER_SUBAPERTURE = 8  # across, at least
_CELLS_PER_PITCH = 4
_FINE = 4  # points across a cell when its light is found
_NEGLIGIBLE = 36.0  # exp(-36) is below the rounding of 1


def influence(mirror: MirrorLayout, x: Array, y: Array) -> Array:
    """Influence functions ``coupling^(rho^2 / pitch^2)`` at points of the mirror's conjugate plane.

    Args:
        x, y: (n_points,) m.

    Returns:
        (n_points, n_actuators) metres of wavefront per metre of command.
    """
    out = np.empty((len(x), mirror.n_actuators))
    _influence(x, y, mirror.actuators, _decay(mirror), out)
    return out


def mirror_wavefronts(layout: Layout, x: Array, y: Array, direction: Direction, distance: float = math.inf) -> Array:
    """All mirrors' influence functions as seen through pupil points towards a star (N of eq. 15).

    Args:
        x, y: (n_points,) in the pupil, m.
        direction: of the star, rad.
        distance: to the star along the line of sight, m.

    Returns:
        (n_points, n_commands) metres of wavefront per metre of command.
    """
    heights = np.array([mirror.altitude for mirror in layout.mirrors])
    seen = footprints(x, y, direction, distance, heights)
    return np.concatenate([influence(m, seen.x[i], seen.y[i]) for i, m in enumerate(layout.mirrors)], axis=1)


def interaction_matrix(system: System, layout: Layout) -> Array:
    """Slopes of the mirrors' own wavefront, G in ``y = s - G m``.

    The influence functions' analytic gradients, along each sensor's own axes, averaged over each sub-aperture's light.

    Returns:
        (n_slopes, n_commands) rad of slope per metre of command.
    """
    out = np.empty((layout.n_slopes, layout.n_commands))
    finest = min(mirror.pitch for mirror in layout.mirrors)
    for w, (sensor, place) in enumerate(zip(system.sensors, layout.sensors, strict=True)):
        star = system.star_of(sensor)
        cells = max(_CELLS_PER_SUBAPERTURE, math.ceil(_CELLS_PER_PITCH * place.size / finest))
        light, u, v = (part.reshape(place.n_valid, -1) for part in cell_light(system.telescope, place, cells, _FINE))
        light /= light.sum(axis=1, keepdims=True)
        row, column = np.divmod(np.arange(cells**2), cells)
        x, y = place.to_pupil(
            place.local[:, :1] + place.size * ((column + u) / cells - 0.5),
            place.local[:, 1:] + place.size * ((row + v) / cells - 0.5),
        )
        for m, mirror in enumerate(layout.mirrors):
            cone = 1 - mirror.altitude / system.los_range(star)
            _mean_gradients(
                cone * x + mirror.altitude * star.position.x,
                cone * y + mirror.altitude * star.position.y,
                cone * light,
                math.cos(place.rotation),
                math.sin(place.rotation),
                mirror.actuators,
                _decay(mirror),
                out[layout.slopes_of(w), layout.commands_of(m)],
            )
    return out


def _decay(mirror: MirrorLayout) -> float:
    """k of the influence function ``exp(-k rho^2)``, 1/m^2."""
    return -math.log(mirror.coupling) / mirror.pitch**2


@numba.njit(cache=True, nogil=True)
def _influence(x: Array, y: Array, actuators: Array, decay: float, out: Array) -> None:
    for p in range(len(x)):
        for a in range(len(actuators)):
            exponent = decay * ((x[p] - actuators[a, 0]) ** 2 + (y[p] - actuators[a, 1]) ** 2)
            out[p, a] = np.exp(-exponent) if exponent < _NEGLIGIBLE else 0.0


@numba.njit(cache=True, nogil=True)
def _mean_gradients(
    x: Array, y: Array, weight: Array, cosine: float, sine: float, actuators: Array, decay: float, out: Array
) -> None:
    n_valid, n_points = x.shape
    for s in range(n_valid):
        for a in range(len(actuators)):
            gx, gy = 0.0, 0.0
            for p in range(n_points):
                dx, dy = x[s, p] - actuators[a, 0], y[s, p] - actuators[a, 1]
                exponent = decay * (dx * dx + dy * dy)
                if exponent < _NEGLIGIBLE:
                    slope = -2 * decay * weight[s, p] * np.exp(-exponent)
                    gx += slope * dx
                    gy += slope * dy
            out[s, a] = cosine * gx + sine * gy
            out[n_valid + s, a] = cosine * gy - sine * gx
