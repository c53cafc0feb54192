"""Deformable mirrors: influence functions, the model's interaction matrix, and the phase they can fit.

Gaussians here; functions from a file in :mod:`srtomo_srtc.influence`.
"""

from __future__ import annotations

import math
from functools import partial

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout, MirrorLayout
from srtomo_core.system import Direction, System
from srtomo_srtc.geometry import cell_light, footprints
from srtomo_srtc.influence import Splines
from srtomo_srtc.parallel import run

Array = NDArray[np.float64]

_CELLS_PER_SUBAPERTURE = 8  # across, at least
_CELLS_PER_PITCH = 4
_FINE = 4  # points across a cell when its light is found
_NEGLIGIBLE = 36.0  # exp(-36) is below the rounding of 1
_FAINT = 25.0  # exp(-25) is 1e-11: left out where most actuators are far away


def influence(mirror: MirrorLayout, x: Array, y: Array) -> Array:
    """Influence functions at points of the mirror's conjugate plane: ``coupling^(rho^2 / pitch^2)`` or from its file.

    Args:
        x, y: (n_points,) m.

    Returns:
        (n_points, n_actuators) metres of wavefront per metre of command.
    """
    if mirror.functions is not None:
        return Splines.of(mirror.functions).values(mirror, x, y)
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


def sparse_wavefronts(layout: Layout, x: Array, y: Array, direction: Direction) -> sparse.csr_array:
    """As :func:`mirror_wavefronts`, without the influence that is below 1e-11. Towards infinity.

    Returns:
        (n_points, n_commands).
    """
    heights = np.array([mirror.altitude for mirror in layout.mirrors])
    seen = footprints(x, y, direction, math.inf, heights)
    parts = []
    for i, mirror in enumerate(layout.mirrors):
        if mirror.functions is not None:
            parts.append(Splines.of(mirror.functions).sparse_values(mirror, seen.x[i], seen.y[i]))
            continue
        reach = math.sqrt(_FAINT / _decay(mirror))
        start = np.concatenate([[0], np.cumsum(_count_near(seen.x[i], seen.y[i], mirror.actuators, reach))])
        indices, values = np.empty(start[-1], np.int32), np.empty(start[-1])
        _influence_near(seen.x[i], seen.y[i], mirror.actuators, reach, _decay(mirror), indices, values)
        parts.append(sparse.csr_array((values, indices, start), shape=(len(x), mirror.n_actuators)))
    return sparse.csr_array(sparse.hstack(parts, format="csr"))


def interaction_matrix(system: System, layout: Layout, threads: int = 1) -> Array:
    """Slopes of the mirrors' own wavefront, G in ``y = s - G m``.

    The influence functions' gradients, along each sensor's own axes, averaged over each sub-aperture's light.

    Args:
        threads: to compute with, sensor by sensor.

    Returns:
        (n_slopes, n_commands) rad of slope per metre of command.
    """
    out = np.empty((layout.n_slopes, layout.n_commands))
    run([partial(_sensor_response, system, layout, w, out) for w in range(len(layout.sensors))], threads)
    return out


def _sensor_response(system: System, layout: Layout, w: int, out: Array) -> None:
    place, star = layout.sensors[w], system.star_of(system.sensors[w])
    finest = min(mirror.pitch for mirror in layout.mirrors)
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
        at = cone * x + mirror.altitude * star.position.x, cone * y + mirror.altitude * star.position.y
        own = out[layout.slopes_of(w), layout.commands_of(m)]
        if mirror.functions is not None:
            Splines.of(mirror.functions).mean_gradients(mirror, *at, cone * light, place.rotation, own)
            continue
        axes = math.cos(place.rotation), math.sin(place.rotation)
        _mean_gradients(*at, cone * light, *axes, mirror.actuators, _decay(mirror), own)


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
def _count_near(x: Array, y: Array, actuators: Array, reach: float) -> NDArray[np.int64]:
    out = np.zeros(len(x), np.int64)
    for p in range(len(x)):
        for a in range(len(actuators)):
            out[p] += (x[p] - actuators[a, 0]) ** 2 + (y[p] - actuators[a, 1]) ** 2 < reach * reach
    return out


@numba.njit(cache=True, nogil=True)
def _influence_near(
    x: Array, y: Array, actuators: Array, reach: float, decay: float, indices: NDArray[np.int32], values: Array
) -> None:
    n = 0
    for p in range(len(x)):
        for a in range(len(actuators)):
            square = (x[p] - actuators[a, 0]) ** 2 + (y[p] - actuators[a, 1]) ** 2
            if square < reach * reach:
                indices[n], values[n] = a, np.exp(-decay * square)
                n += 1


@numba.njit(cache=True, nogil=True)
def _mean_gradients(
    x: Array, y: Array, weight: Array, cosine: float, sine: float, actuators: Array, decay: float, out: Array
) -> None:
    n_valid, n_points = x.shape
    reach = np.sqrt(_FAINT / decay)
    for s in range(n_valid):
        left, right, low, high = x[s].min(), x[s].max(), y[s].min(), y[s].max()
        for a in range(len(actuators)):
            gx, gy = 0.0, 0.0
            beside = max(left - actuators[a, 0], actuators[a, 0] - right)
            above = max(low - actuators[a, 1], actuators[a, 1] - high)
            if max(beside, above) > reach:
                out[s, a] = 0.0
                out[n_valid + s, a] = 0.0
                continue
            for p in range(n_points):
                dx, dy = x[s, p] - actuators[a, 0], y[s, p] - actuators[a, 1]
                exponent = decay * (dx * dx + dy * dy)
                if exponent < _FAINT:
                    slope = -2 * decay * weight[s, p] * np.exp(-exponent)
                    gx += slope * dx
                    gy += slope * dy
            out[s, a] = cosine * gx + sine * gy
            out[n_valid + s, a] = cosine * gy - sine * gx
