"""Where points of the pupil fall on the layers; where the light is, in sub-apertures and in the whole pupil."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import SensorLayout, is_lit_around, transmission
from srtomo_core.system import Direction, Telescope

Array = NDArray[np.float64]

_FINE = 8  # points across a cell of the pupil grid when its lit share is found


@dataclass(frozen=True)
class Footprints:
    """Points of the pupil, seen towards a star, on every layer.

    Attributes:
        x, y: (n_layers, n_points) m.
    """

    x: Array
    y: Array

    def only(self, layers: slice) -> Footprints:
        """The same on some of the layers."""
        return Footprints(self.x[layers], self.y[layers])

    def part(self, points: slice | NDArray[np.intp]) -> Footprints:
        """Some of the points."""
        return Footprints(self.x[:, points], self.y[:, points])


def footprints(x: Array, y: Array, direction: Direction, distance: float, heights: Array) -> Footprints:
    """Follow pupil points towards a star: ``xi_l x + h_l alpha`` with ``xi_l = 1 - h_l / distance`` (eq. 26).

    Args:
        x, y: (n_points,) in the pupil, m.
        direction: of the star, rad.
        distance: to the star along the line of sight, m; infinite for a natural star or science target.
        heights: (n_layers,) of the layers along the line of sight, m.
    """
    h = heights[:, None]
    cone = 1 - h / distance
    return Footprints(cone * x + h * direction.x, cone * y + h * direction.y)


@dataclass(frozen=True, eq=False)
class Lattice:
    """A sensor's nodes as part of a square lattice in its own axes. What follows from it is found once and kept.

    Attributes:
        step: m.
        origin: x, y of row 0 and column 0 in the sensor's own axes, m.
        rotation: rad; applied before the shift.
        shift: x, y, m.
        row, column: (n_nodes,) of each node; in C order.
    """

    step: float
    origin: tuple[float, float]
    rotation: float
    shift: tuple[float, float]
    row: NDArray[np.int64]
    column: NDArray[np.int64]

    @lru_cache(maxsize=64)  # noqa: B019 - few and small
    def points(self) -> tuple[Array, Array]:
        """x, y of the nodes in the pupil, m."""
        x, y = self.origin[0] + self.step * self.column, self.origin[1] + self.step * self.row
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return c * x - s * y + self.shift[0], s * x + c * y + self.shift[1]

    def to_steps(self, x: Array, y: Array) -> Array:
        """(n_points, 2) row and column, not whole, of points (n_points,) in the pupil (m)."""
        x, y = x - self.shift[0], y - self.shift[1]
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return np.stack([c * y - s * x - self.origin[1], c * x + s * y - self.origin[0]], axis=-1) / self.step

    @lru_cache(maxsize=64)  # noqa: B019 - few and small
    def rows(self, multiple: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Nodes that follow each other in a row of the lattice, in pieces of a multiple of so many columns.

        A gap is bridged when it is no longer than that.

        Returns:
            (n_pieces, 3) row, first column and number of columns of each.
            (n_nodes,) where each node is when these pieces follow each other.
        """
        new = np.ones(len(self.row), bool)
        new[1:] = (np.diff(self.row) != 0) | (np.diff(self.column) > multiple)
        begins = np.flatnonzero(new)
        first = self.column[begins]
        length = self.column[np.append(begins, len(new))[1:] - 1] - first + 1
        length = -(-length // multiple) * multiple
        place = (np.cumsum(length) - length - first)[np.cumsum(new) - 1] + self.column
        return np.stack([self.row[begins], first, length], axis=1), place


@dataclass(frozen=True)
class SeenLattice:
    """A sensor's lattice on every layer: ``cone * (point in the pupil) + offset``.

    Attributes:
        cones: (n_layers,)
        offsets: (n_layers, 2) x, y, m.
    """

    lattice: Lattice
    cones: Array
    offsets: Array

    @classmethod
    def towards(cls, lattice: Lattice, direction: Direction, distance: float, heights: Array) -> SeenLattice:
        """As :func:`footprints` has it."""
        return cls(lattice, 1 - heights / distance, heights[:, None] * np.array([direction.x, direction.y]))

    def only(self, layers: slice) -> SeenLattice:
        """The same on some of the layers."""
        return SeenLattice(self.lattice, self.cones[layers], self.offsets[layers])

    def centres(self, points: Footprints) -> Array:
        """(n_layers, n_points, 2) row and column, not whole, where rays from the star through points on the layers meet
        the lattice."""
        cones, (x, y) = self.cones[:, None], self.offsets.T[:, :, None]
        return self.lattice.to_steps((points.x - x) / cones, (points.y - y) / cones)


@dataclass(frozen=True)
class PupilGrid:
    """Square cells over the pupil, those with any light.

    Attributes:
        x, y: (n_points,) centres, m, in C order (y, x).
        weight: (n_points,) share of the pupil's light in each cell; sums to 1.
    """

    x: Array
    y: Array
    weight: Array

    @property
    def low_orders(self) -> Array:
        """(n_points, 3) piston, tip and tilt, times the root of the weight: orthonormal."""
        root = np.sqrt(self.weight)[:, None]
        return np.asarray(np.linalg.qr(root * np.stack([np.ones_like(self.x), self.x, self.y], axis=1))[0])

    @property
    def tilts(self) -> Array:
        """(n_points, 2) weights that turn a wavefront into its tip and tilt, each in units of its rms."""
        return np.asarray(np.sqrt(self.weight)[:, None] * self.low_orders[:, 1:])


def pupil_grid(telescope: Telescope, spacing: float) -> PupilGrid:
    """Cover the pupil with cells of at most ``spacing`` (m), symmetric about its centre."""
    across = math.ceil(telescope.diameter / spacing)
    fine = telescope.diameter * ((np.arange(across * _FINE) + 0.5) / (across * _FINE) - 0.5)
    light = transmission(telescope, *np.meshgrid(fine, fine)).reshape(across, _FINE, across, _FINE).mean(axis=(1, 3))
    centres = telescope.diameter * ((np.arange(across) + 0.5) / across - 0.5)
    x, y = np.meshgrid(centres, centres)
    lit = light > 0
    return PupilGrid(x[lit], y[lit], light[lit] / light.sum())


def cell_light(telescope: Telescope, sensor: SensorLayout, cells: int, fine: int) -> tuple[Array, Array, Array]:
    """Light in ``cells`` x ``cells`` equal cells of each sub-aperture, found from ``fine`` x ``fine`` points a cell.

    Returns:
        light: mean transmission of each cell, 0 to 1.
        u, v: its centroid along the sensor's x and y, 0 to 1 across the cell; 0 in a dark one.

        Each (n_valid, cells, cells), indexed [sub-aperture, y, x] in the sensor's own axes.
    """
    light, u, v = (np.full((sensor.n_valid, cells, cells), full) for full in (1.0, 0.5, 0.5))
    # most sub-apertures are far from every edge
    centres = sensor.to_pupil(*sensor.local.T)
    cut = np.flatnonzero(~is_lit_around(telescope, *centres, sensor.size * math.sqrt(0.5)))
    edge = replace(sensor, local=sensor.local[cut], illumination=sensor.illumination[cut])
    points = transmission(telescope, *edge.points(cells * fine)).reshape(len(cut), cells, fine, cells, fine)
    place = (np.arange(fine) + 0.5) / fine
    light[cut] = points.mean(axis=(2, 4))
    lit = np.where(light[cut] > 0, light[cut], 1)
    u[cut] = (points * place).mean(axis=(2, 4)) / lit
    v[cut] = (points * place[:, None, None]).mean(axis=(2, 4)) / lit
    return light, u, v
