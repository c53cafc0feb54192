"""Pupil, valid sub-apertures and actuators: where they are, in which order; and the fingerprint of it all.

Right-handed: x to the right and y up looking at the sky through the pupil. Grids are C-ordered ``(y, x)`` masks.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from srtomo_core.influence import InfluenceFunctions, read_influence
from srtomo_core.system import Mirror, Sensor, System, Telescope

Array = NDArray[np.float64]

CONVENTIONS = "slopes rad x-then-y; commands m wavefront; y = s - G m; rotate then shift; C order (y, x); v1"
"""Part of every fingerprint: a change of convention is a change of instrument."""

_FINE = 32  # points across a sub-aperture when its illumination is averaged


def transmission(telescope: Telescope, x: Array, y: Array) -> Array:
    """Intensity transmission of the pupil, 0 or 1, at points in metres from the pupil's centre. Any shape."""
    radius = telescope.diameter / 2
    cx, cy = telescope.obscuration_centre
    inside = _within(x, y, radius)
    if telescope.obscuration > 0:
        inside &= ~_within(x - cx, y - cy, radius * telescope.obscuration)
    for spider in telescope.spiders:
        c, s = np.cos(spider.angle), np.sin(spider.angle)
        inside &= (c * x + s * y < 0) | (np.abs(c * y - s * x) >= spider.width / 2)
    return inside.astype(np.float64)


def is_lit_around(telescope: Telescope, x: Array, y: Array, reach: float) -> NDArray[np.bool_]:
    """Whether all of the pupil is open within ``reach`` (m) of points; now and then not where it only just is."""
    radius = telescope.diameter / 2
    cx, cy = telescope.obscuration_centre
    open_around = np.hypot(x, y) + reach < radius
    if telescope.obscuration > 0:
        open_around &= np.hypot(x - cx, y - cy) - reach > radius * telescope.obscuration
    for spider in telescope.spiders:
        c, s = np.cos(spider.angle), np.sin(spider.angle)
        open_around &= (c * x + s * y < -reach) | (np.abs(c * y - s * x) - reach > spider.width / 2)
    return np.asarray(open_around)


def _within(x: Array, y: Array, radius: float) -> NDArray[np.bool_]:
    """``hypot(x, y) <= radius``, where only points at the edge need the function's care."""
    square = x * x + y * y
    within = np.asarray(square <= radius**2)
    edge = np.abs(square - radius**2) < 1e-12 * radius**2
    within[edge] = np.hypot(x[edge], y[edge]) <= radius
    return within


@dataclass(frozen=True)
class SensorLayout:
    """Valid sub-apertures of one sensor.

    Attributes:
        size: side of a sub-aperture, m.
        shift: metres; applied after the rotation.
        rotation: rad, counter-clockwise.
        mask: (n, n) bool, ``[y, x]`` in the sensor's own axes.
        local: (n_valid, 2) centres x, y in the sensor's own axes, m, in C order of the mask.
        illumination: (n_valid,) mean intensity transmission over each sub-aperture, 0 to 1.
    """

    name: str
    size: float
    shift: tuple[float, float]
    rotation: float
    mask: NDArray[np.bool_]
    local: Array
    illumination: Array

    @property
    def n_valid(self) -> int:
        """Number of valid sub-apertures; the sensor has twice as many slopes."""
        return len(self.local)

    @property
    def n_slopes(self) -> int:
        """All x, then all y."""
        return 2 * self.n_valid

    def to_pupil(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Sensor axes to pupil coordinates: rotate about the centre, then shift (eq. 33-34). m."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return c * x - s * y + self.shift[0], s * x + c * y + self.shift[1]

    def points(self, across: int) -> tuple[Array, Array]:
        """Midpoints of ``across`` x ``across`` equal cells of each sub-aperture, in pupil coordinates.

        Returns:
            x, y: each (n_valid, across, across), indexed [sub-aperture, y, x] in the sensor's own axes; m.
        """
        step = self.size * ((np.arange(across) + 0.5) / across - 0.5)
        x = self.local[:, 0, None, None] + step[None, None, :]
        y = self.local[:, 1, None, None] + step[None, :, None]
        return self.to_pupil(*np.broadcast_arrays(x, y))


def _sensor_layout(telescope: Telescope, sensor: Sensor) -> SensorLayout:
    n = sensor.subapertures
    size = telescope.diameter / n
    centres = (np.arange(n) - (n - 1) / 2) * size
    grid_y, grid_x = np.meshgrid(centres, centres, indexing="ij")
    everything = SensorLayout(
        sensor.name,
        size,
        (sensor.shift[0] * size, sensor.shift[1] * size),
        sensor.rotation,
        np.ones((n, n), bool),
        np.stack([grid_x.ravel(), grid_y.ravel()], axis=1),
        np.ones(n * n),
    )
    # a one-lens sensor needs as fine a look at the pupil's edge as a many-lens one
    across = max(_FINE, -(-640 // n))
    light = transmission(telescope, *everything.points(across)).mean(axis=(1, 2))
    # the tolerance keeps a sub-aperture that is lit exactly to the threshold from depending on rounding
    valid = light >= sensor.illumination_threshold - 1e-9
    return SensorLayout(
        sensor.name,
        size,
        everything.shift,
        sensor.rotation,
        valid.reshape(n, n),
        everything.local[valid],
        light[valid],
    )


@dataclass(frozen=True)
class MirrorLayout:
    """Actuators of one mirror.

    Attributes:
        altitude: of the conjugate along the line of sight, m.
        pitch: at the conjugate, m.
        coupling: of the influence function at the next actuator, where it is Gaussian.
        stroke: limit of a command, m of wavefront.
        mask: (n, n) bool, ``[y, x]``. On a hexagonal grid (n_rows, n), every second row half a pitch to the right.
        actuators: (n_actuators, 2) x, y at the conjugate, m, in C order of the mask.
        functions: influence functions that are not Gaussian.
        rotation: of the mirror with its functions, already in ``actuators``; rad, counter-clockwise.
    """

    name: str
    altitude: float
    pitch: float
    coupling: float
    stroke: float
    mask: NDArray[np.bool_]
    actuators: Array
    functions: InfluenceFunctions | None = None
    rotation: float = 0.0

    @property
    def n_actuators(self) -> int:
        """Number of actuators, each one command."""
        return len(self.actuators)


def _mirror_layout(system: System, mirror: Mirror) -> MirrorLayout:
    pitch = mirror.pitch if mirror.pitch is not None else system.telescope.diameter / (mirror.actuators - 1)
    altitude = mirror.altitude * system.airmass
    field = max(
        np.hypot(d.x, d.y)
        for d in [s.position for s in system.guide_stars] + [t.position for t in system.science.targets]
    )
    reach = system.telescope.diameter / 2 + altitude * field + mirror.margin * pitch
    grid_x, grid_y = _grid(mirror.actuators, mirror.grid)
    grid_x, grid_y = grid_x * pitch, grid_y * pitch
    mask = np.hypot(grid_x, grid_y) <= reach + 1e-9
    n_actuators = int(np.count_nonzero(mask))
    return MirrorLayout(
        mirror.name,
        altitude,
        pitch,
        mirror.coupling,
        mirror.stroke,
        mask,
        np.stack([grid_x[mask], grid_y[mask]], axis=1),
        None if mirror.influence is None else read_influence(mirror.influence, n_actuators),
    )


def _grid(across: int, kind: str) -> tuple[Array, Array]:
    """x, y (n_rows, across) of a grid about its centre, in pitches; infinite where there is none."""
    centres = np.arange(across) - (across - 1) / 2
    if kind == "square":
        grid_y, grid_x = np.meshgrid(centres, centres, indexing="ij")
        return grid_x, grid_y
    above = math.floor((across - 1) / math.sqrt(3))
    rows = np.arange(-above, above + 1)
    grid_y, grid_x = np.meshgrid(rows * math.sqrt(3) / 2, centres, indexing="ij")
    beside = rows % 2 == 1
    grid_x[beside] += 0.5
    grid_x[beside, -1] = np.inf
    return grid_x, grid_y


class Layout:
    """Order and place of every slope and command of a system.

    Attributes:
        sensors, mirrors: in the system's order.
        slope_start: (n_sensors + 1,) first slope of each sensor; the last entry is n_slopes.
        command_start: (n_mirrors + 1,) first command of each mirror; the last entry is n_commands.
        tip_tilt_sensors: indices of the sensors that tip-tilt's own loop has, if there is one: their slopes have their
            place in the slope vector, but come in frames of their own count.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self.sensors = tuple(_sensor_layout(system.telescope, sensor) for sensor in system.sensors)
        self.mirrors = tuple(_mirror_layout(system, mirror) for mirror in system.mirrors)
        self.slope_start = np.concatenate([[0], np.cumsum([s.n_slopes for s in self.sensors])])
        self.command_start = np.concatenate([[0], np.cumsum([m.n_actuators for m in self.mirrors])])
        self.tip_tilt_sensors = system.tip_tilt_sensors
        for sensor in self.sensors:
            if sensor.n_valid == 0:
                raise ValueError(f"sensor {sensor.name}: no sub-aperture is lit to its illumination_threshold")

    @property
    def n_slopes(self) -> int:
        """Length of the slope vector."""
        return int(self.slope_start[-1])

    @property
    def n_commands(self) -> int:
        """Length of the command vector."""
        return int(self.command_start[-1])

    @property
    def stroke(self) -> Array:
        """(n_commands,) limit of each command, m of wavefront."""
        return np.concatenate([np.full(m.n_actuators, m.stroke) for m in self.mirrors])

    def slopes_of(self, sensor: int) -> slice:
        """Where a sensor's slopes are in the slope vector."""
        return slice(int(self.slope_start[sensor]), int(self.slope_start[sensor + 1]))

    def commands_of(self, mirror: int) -> slice:
        """Where a mirror's commands are in the command vector."""
        return slice(int(self.command_start[mirror]), int(self.command_start[mirror + 1]))

    @cached_property
    def fingerprint(self) -> bytes:
        """SHA-256 of everything that slopes and commands depend on (32 bytes).

        Conventions, pupil, pointing geometry, each sensor's star, place and valid sub-apertures, each mirror's
        actuators. Not the sky's turbulence, photons or loop settings: those change a reconstructor's quality, not its
        meaning.
        """
        system = self._system
        telescope = system.telescope
        content = {
            "conventions": CONVENTIONS,
            "pupil": [telescope.diameter, telescope.obscuration, *telescope.obscuration_centre]
            + [[spider.width, spider.angle] for spider in telescope.spiders],
            "zenith_angle": system.zenith_angle,
            "sensors": [
                {
                    "star": [star.position.x, star.position.y, star.altitude, star.tip_tilt, star.focus],
                    "place": [*layout.shift, layout.rotation, layout.size],
                    "valid": np.flatnonzero(layout.mask).tolist(),
                }
                | ({"own_count": True} if i in self.tip_tilt_sensors else {})
                for i, (sensor, layout) in enumerate(zip(system.sensors, self.sensors, strict=True))
                for star in [system.star_of(sensor)]
            ],
            "mirrors": [
                {
                    "place": [layout.altitude, layout.pitch, layout.coupling],
                    "shape": list(layout.mask.shape),
                    "valid": np.flatnonzero(layout.mask).tolist(),
                }
                # absent where they are as they always were: what is on disk keeps its fingerprint
                | ({} if mirror.grid == "square" else {"grid": mirror.grid})
                | ({} if layout.functions is None else {"functions": layout.functions.digest})
                for mirror, layout in zip(system.mirrors, self.mirrors, strict=True)
            ],
        }
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).digest()
