"""Reconstructors for when lasers are closed, from the factors that made the one with all of them.

With ``A = S^-1`` the LMMSE without the sensors w is, by the inverse of a partitioned matrix::

    R' = R_rest - R_w A_ww^-1 A_w,rest

What blind stars' modes P takes out belongs to one sensor each, so that this is the estimate of a system without these
sensors also when ``S`` is ``P S P + gamma (I - P)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import LowOrder
from srtomo_core.system import System
from srtomo_srtc.model import project
from srtomo_srtc.solve import SymmetricTiles
from srtomo_srtc.split import low_order_commands, low_orders

Array = NDArray[np.float64]
Closures = Literal["none", "low_order", "singles", "pairs"]

_LOW_ORDER_MARGIN = 2.0  # of an integrator's gain, to where it is not stable any more


def sets_of_lasers(system: System, closures: Closures) -> list[tuple[int, ...]]:
    """The sensors (indices) that are closed together: each on a laser alone, with ``pairs`` also every two.

    Some sensor on a laser is left open in each.
    """
    lasers = [w for w, sensor in enumerate(system.sensors) if system.star_of(sensor).kind == "laser"]
    sizes = {"none": (), "low_order": (), "singles": (1,), "pairs": (1, 2)}[closures]
    return [closed for size in sizes if size < len(lasers) for closed in combinations(lasers, size)]


def bits(sensors: Iterable[int]) -> int:
    """Bit w set for each sensor w."""
    return sum(1 << w for w in sensors)


def without(
    R: NDArray[np.floating],
    S: SymmetricTiles,
    blind: Array,
    layout: Layout,
    closed: Iterable[tuple[int, ...]],
    threads: int = 1,
    progress: Callable[[float], None] = lambda done: None,
) -> dict[int, Array]:
    """R' for each set of sensors, by :func:`bits` of the set.

    Args:
        R: (n_commands, n_slopes) with all sensors, m/rad.
        S: ``P S P + gamma (I - P)`` that made R, factored.
        blind: (n_slopes, n_modes) orthonormal; what P removes.
        threads: to compute with.
        progress: called with the share of the work that is done.

    Returns:
        (n_commands, n_slopes) each; columns of closed sensors are 0.
    """
    found: dict[int, Array] = {}
    sets = list(closed)
    for done, sensors in enumerate(sets):
        progress(done / len(sets))
        own = np.concatenate([np.arange(layout.n_slopes)[layout.slopes_of(w)] for w in sensors])
        rows = np.zeros((len(own), layout.n_slopes), S.dtype)
        rows[np.arange(len(own)), own] = 1
        S.divide(rows, threads)
        inverse = rows.astype(np.float64)
        predicted = cho_solve(cho_factor(inverse[:, own]), inverse)
        left = R - R[:, own].astype(np.float64) @ predicted
        left = project(left.T, blind).T
        left[:, own] = 0
        found[bits(sensors)] = left
    return found


def low_order_of(system: System, layout: Layout, G: Array) -> LowOrder | None:
    """What goes on when every laser is closed: low orders, from the slopes of natural stars alone.

    Least squares from what those stars see of tip and tilt (and focus and plate scale, where they control them). Its
    gain beside the loop's is so small that it is half of what the loop's delay allows an integrator.

    Args:
        G: (n_slopes, n_commands) interaction matrix, rad/m.

    Returns:
        None where no sensor on a natural star sees tip-tilt, or no laser is there to be closed.
    """
    stars = [system.star_of(sensor) for sensor in system.sensors]
    if {star.kind for star in stars} != {"laser", "natural"}:
        return None
    natural = np.repeat([star.kind == "natural" for star in stars], np.diff(layout.slope_start))
    measured = low_orders(system, layout) * natural
    if not measured.any():
        return None
    commands = low_order_commands(system, layout)
    slopes = np.linalg.pinv(measured @ (G @ commands), rcond=1e-3) @ measured
    # u[k] = u[k-1] - g u[k-n] is stable up to this
    limit = 2 * math.sin(math.pi / (2 * (2 * math.ceil(system.loop.delay) - 1)))
    gain = min(1.0, limit / _LOW_ORDER_MARGIN / system.loop.gain)
    return LowOrder(commands.T.astype(np.float32), (gain * slopes).astype(np.float32))
