"""Split tomography: natural stars' tip-tilt controls alone, lasers the rest, and nothing is counted twice::

    R = (I - Pi) R_h + A (B A)^+ W_t,          Pi = A (B A)^+ B

R_h is the estimate from the sensors on blind stars alone. A are commands that make low orders; B is what these and all
other commands look like to the other sensors' tip-tilt (and focus). W_t estimates that of the sky from those sensors'
slopes, with less noise. Pi takes out of R_h what they see of it: they see it in the sky too, and answer for it.

A holds tip and tilt of the lowest mirror; its focus, if lasers are blind to that and a natural star's sensor of several
lenslets is not; and with mirrors at different altitudes the plate-scale modes: a quadratic on the highest mirror and
its opposite on the lowest, of which lasers see at most tip-tilt, and natural stars a tip-tilt that changes over the
field. Three natural stars are needed to tell those from tip-tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.geometry import footprints, pupil_grid
from srtomo_srtc.mirrors import influence
from srtomo_srtc.model import low_order_slopes

Array = NDArray[np.float64]

_PLATE_SCALE_STARS = 3
_POINTS_PER_PITCH = 2
_COPIES = 3  # of influence functions, in a fit to shapes
_NEGLIGIBLE = 1e-3  # of the largest singular value, in fits of shapes and in what stars see of them


@dataclass(frozen=True)
class Split:
    """Who estimates what.

    Attributes:
        blind: slopes (indices) of sensors on stars that are blind to tip-tilt.
        seeing: all other slopes.
        measured: (n_low, n_slopes) seeing sensors' slopes to their low orders, one sensor after the other.
        answer: (n_commands, n_low) ``A (B A)^+``, low orders to the commands that correct them.
        low_order: (n_commands, n_commands) Pi.
    """

    blind: NDArray[np.intp]
    seeing: NDArray[np.intp]
    measured: Array
    answer: Array
    low_order: Array

    @classmethod
    def of(cls, system: System, layout: Layout, G: Array) -> Split:
        """Split a system's estimate.

        Args:
            G: (n_slopes, n_commands) interaction matrix, rad/m.

        Raises:
            ValueError: there is nothing to split: no sensor is blind to tip-tilt, or all are.
        """
        sees = np.repeat(
            [system.star_of(sensor).tip_tilt == "seen" for sensor in system.sensors], np.diff(layout.slope_start)
        )
        if sees.all() or not sees.any():
            raise ValueError("split: expected some stars that see tip-tilt and some that do not")
        measured = low_orders(system, layout)
        commands = low_order_commands(system, layout)
        answer = commands @ np.linalg.pinv(measured @ (G @ commands), rcond=_NEGLIGIBLE)
        return cls(np.flatnonzero(~sees), np.flatnonzero(sees), measured, answer, answer @ (measured @ G))


def bytes_needed(system: System, layout: Layout) -> float:
    """Memory of :meth:`Split.of` at its peak, about: the largest mirror's functions on all that is seen of it."""
    return max(
        _COPIES * 8.0 * place.n_actuators * len(_seen_points(system, layout, m)[0])
        for m, place in enumerate(layout.mirrors)
    )


def low_order_commands(system: System, layout: Layout) -> Array:
    """Commands (n_commands, n) of tip and tilt, and where natural stars control them of focus and plate scale."""
    lowest = min(range(len(layout.mirrors)), key=lambda m: layout.mirrors[m].altitude)
    highest = max(range(len(layout.mirrors)), key=lambda m: layout.mirrors[m].altitude)
    stars = [system.star_of(sensor) for sensor in system.sensors]
    tilts = _shapes(system, layout, lowest)
    modes = [tilts[:, :2]]
    if focus_is_controlled(system, layout):
        modes.append(tilts[:, 2:3])
    altitude, base = layout.mirrors[highest].altitude, layout.mirrors[lowest].altitude
    if altitude > base and len({star.position for star in stars if star.tip_tilt == "seen"}) >= _PLATE_SCALE_STARS:
        # a laser's beam is narrower up there: the opposite that hides a quadratic from it is smaller by its square
        narrower = [
            (system.los_range(star) - altitude) / (system.los_range(star) - base) if star.altitude else 1.0
            for star in stars
            if star.tip_tilt == "blind"
        ]
        modes.append(_shapes(system, layout, highest)[:, 2:] - np.mean(np.square(narrower)) * tilts[:, 2:])
    return np.hstack(modes)


def focus_is_controlled(system: System, layout: Layout) -> bool:
    """Whether some star is blind to focus and another, in more than one lenslet, is not."""
    stars = [system.star_of(sensor) for sensor in system.sensors]
    return any(star.focus == "blind" for star in stars) and any(
        star.tip_tilt == star.focus == "seen" and place.n_valid > 1
        for star, place in zip(stars, layout.sensors, strict=True)
    )


def low_orders(system: System, layout: Layout) -> Array:
    """(n_low, n_slopes) the low orders that seeing sensors measure, tip-tilt in rad whatever the number of lenslets."""
    with_focus = focus_is_controlled(system, layout)
    rows = []
    for w, sensor in enumerate(system.sensors):
        star, n_valid = system.star_of(sensor), layout.sensors[w].n_valid
        if star.tip_tilt == "seen":
            tip_tilt, focus = low_order_slopes(system, layout, w)
            seen = np.hstack([tip_tilt, focus] if with_focus and star.focus == "seen" and n_valid > 1 else [tip_tilt])
            rows.append(np.linalg.qr(seen)[0].T / math.sqrt(n_valid))
    return np.vstack(rows)


def _shapes(system: System, layout: Layout, mirror: int) -> Array:
    """Commands (n_commands, 5) of one mirror for x, y, x^2 + y^2, x^2 - y^2 and 2xy, in pupil radii, 1 m each."""
    x, y = _seen_points(system, layout, mirror)
    functions = influence(layout.mirrors[mirror], x, y)
    x, y = 2 * x / system.telescope.diameter, 2 * y / system.telescope.diameter
    wanted = np.stack([x, y, x * x + y * y, x * x - y * y, 2 * x * y], axis=1)
    commands = np.zeros((layout.n_commands, wanted.shape[1]))
    commands[layout.commands_of(mirror)] = np.linalg.lstsq(functions, wanted - wanted.mean(axis=0), rcond=_NEGLIGIBLE)[
        0
    ]
    return commands


def _seen_points(system: System, layout: Layout, mirror: int) -> tuple[Array, Array]:
    """Points of a mirror's conjugate plane that some star or science target is seen through, one a grid's cell; m."""
    place = layout.mirrors[mirror]
    grid = pupil_grid(system.telescope, place.pitch / _POINTS_PER_PITCH)
    heights = np.array([place.altitude])
    sights = [(star.position, system.los_range(star)) for star in map(system.star_of, system.sensors)]
    sights += [(target.position, math.inf) for target in system.science.targets]
    seen = [footprints(grid.x, grid.y, position, distance, heights) for position, distance in sights]
    x, y = (np.concatenate([getattr(p, axis)[0] for p in seen]) for axis in "xy")
    cells = np.floor(np.stack([x, y]) * (_POINTS_PER_PITCH / place.pitch))
    first = np.unique(cells, axis=1, return_index=True)[1]
    return x[first], y[first]
