"""Deformable mirrors: influence functions, what the sensors see of them, and the loop's delay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from scipy.special import erf

from srtomo_core.influence import InfluenceFunctions
from srtomo_core.layout import Array, Layout, MirrorLayout, SensorLayout
from srtomo_core.system import Direction, System
from srtomo_sim.shack_hartmann import lit_fractions

_CELL = 0.05  # m, at most: parts of a sub-aperture that are weighted by their light
_MAX_CELLS = 40  # across a sub-aperture


def _width(mirror: MirrorLayout) -> float:
    """Radius at which an influence function has fallen to 1/e: exp(-r^2/width^2) is the coupling at the pitch, m."""
    return mirror.pitch / math.sqrt(-math.log(mirror.coupling))


def mirror_phase(layout: Layout, x: Array, y: Array, direction: Direction) -> Array:
    """Wavefront of each unit command towards a star at infinity, at pupil points: (n_points, n_commands)."""
    phase = np.empty((len(x), layout.n_commands))
    for i, mirror in enumerate(layout.mirrors):
        dx = (x + mirror.altitude * direction.x)[:, None] - mirror.actuators[:, 0]
        dy = (y + mirror.altitude * direction.y)[:, None] - mirror.actuators[:, 1]
        if mirror.functions is None:
            phase[:, layout.commands_of(i)] = np.exp(-(dx**2 + dy**2) / _width(mirror) ** 2)
        else:
            for a, command in enumerate(range(layout.n_commands)[layout.commands_of(i)]):
                phase[:, command] = _from_file(mirror, mirror.functions, a, dx[:, a], dy[:, a])
    return phase


def interaction_matrix(system: System, layout: Layout) -> Array:
    """Slopes that unit commands add to the wavefront: (n_slopes, n_commands), rad per m.

    The gradient of each influence function is averaged over the lit part of each sub-aperture, in closed form over
    cells of at most 5 cm: a Gaussian is a product of Gaussians along any axes, the sensor's own included. Of a function
    from a file, a cell's mean gradient is the difference between opposite edges.
    """
    matrix = np.empty((layout.n_slopes, layout.n_commands))
    for i, sensor in enumerate(layout.sensors):
        across = min(_MAX_CELLS, math.ceil(sensor.size / _CELL - 1e-9))
        light = lit_fractions(sensor, system.telescope, across)
        light /= light.sum(axis=(1, 2), keepdims=True)
        star = system.star_of(system.sensors[i])
        for j, mirror in enumerate(layout.mirrors):
            cone = 1 - mirror.altitude / system.los_range(star)
            seen = _seen if mirror.functions is None else _seen_from_file
            block = seen(sensor, light, mirror, cone, star.position)
            matrix[layout.slopes_of(i), layout.commands_of(j)] = block
    return matrix


def _seen(sensor: SensorLayout, light: Array, mirror: MirrorLayout, cone: float, direction: Direction) -> Array:
    """(n_slopes, n_actuators) of one sensor and one mirror; ``light`` (n_valid, cells, cells) sums to 1."""
    across = light.shape[1]
    n = len(sensor.mask)
    at_x, at_y = _in_sensor_axes(sensor, mirror, cone, direction)
    width = _width(mirror) / cone
    edges = (np.arange(n * across + 1) / across - n / 2) * sensor.size
    mean_x, step_x = _means(edges, at_x, width)
    mean_y, step_y = _means(edges, at_y, width)
    block = np.empty((2, sensor.n_valid, len(at_x)))
    rows, columns = np.nonzero(sensor.mask)
    for k in range(sensor.n_valid):
        in_x = slice(columns[k] * across, (columns[k] + 1) * across)
        in_y = slice(rows[k] * across, (rows[k] + 1) * across)
        block[0, k] = (mean_y[in_y] * (light[k] @ step_x[in_x])).sum(axis=0)
        block[1, k] = (step_y[in_y] * (light[k] @ mean_x[in_x])).sum(axis=0)
    return block.reshape(-1, len(at_x))


def _in_sensor_axes(sensor: SensorLayout, mirror: MirrorLayout, cone: float, direction: Direction) -> Array:
    """(2, n_actuators) x and y, where a pupil point p is at p cone + altitude direction on the mirror."""
    away = (mirror.actuators - mirror.altitude * np.array([direction.x, direction.y])) / cone - np.array(sensor.shift)
    c, s = math.cos(sensor.rotation), math.sin(sensor.rotation)
    return np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]])


def _seen_from_file(
    sensor: SensorLayout, light: Array, mirror: MirrorLayout, cone: float, direction: Direction
) -> Array:
    """As :func:`_seen`, for influence functions from a file."""
    functions = mirror.functions
    assert functions is not None
    across, n = light.shape[1], len(sensor.mask)
    cell = sensor.size / across
    # edges of the cells, and the middles between them
    line = (np.arange(2 * n * across + 1) / (2 * across) - n / 2) * sensor.size
    reach = math.sqrt(2) * functions.reach / cone + cell
    block = np.zeros((2, sensor.n_valid, mirror.n_actuators))
    c, s = math.cos(sensor.rotation), math.sin(sensor.rotation)
    for a, (at_x, at_y) in enumerate(_in_sensor_axes(sensor, mirror, cone, direction).T):
        columns, rows = (_cells_near(line[::2], at, reach) for at in (at_x, at_y))
        if columns.start >= columns.stop or rows.start >= rows.stop:
            continue
        points = (line[2 * cells.start : 2 * cells.stop + 1] for cells in (columns, rows))
        x, y = np.meshgrid(*points)
        x, y = cone * (x - at_x), cone * (y - at_y)
        seen = _from_file(mirror, functions, a, c * x - s * y, s * x + c * y)
        # Simpson's rule along each edge
        on_x_edges = (seen[:-2:2, ::2] + 4 * seen[1::2, ::2] + seen[2::2, ::2]) / 6
        on_y_edges = (seen[::2, :-2:2] + 4 * seen[::2, 1::2] + seen[::2, 2::2]) / 6
        for axis, step in enumerate((np.diff(on_x_edges, axis=1), np.diff(on_y_edges, axis=0))):
            gradients = np.zeros((n * across, n * across))
            gradients[rows, columns] = step / cell
            of_lenslets = gradients.reshape(n, across, n, across).swapaxes(1, 2)[sensor.mask]
            block[axis, :, a] = (of_lenslets * light).sum(axis=(1, 2))
    return block.reshape(-1, mirror.n_actuators)


def _cells_near(edges: Array, centre: float, reach: float) -> slice:
    first, last = np.searchsorted(edges, [centre - reach, centre + reach])
    return slice(max(int(first) - 1, 0), min(int(last), len(edges) - 1))


def _from_file(mirror: MirrorLayout, functions: InfluenceFunctions, actuator: int, dx: Array, dy: Array) -> Array:
    """One influence function at places (m, any shape) from its actuator, by cubic interpolation."""
    c, s = math.cos(mirror.rotation), math.sin(mirror.rotation)
    middle = functions.reach / functions.step
    places = np.stack([c * dy - s * dx, c * dx + s * dy]) / functions.step + middle
    out = np.zeros(dx.shape)
    near = (np.abs(places - middle) <= middle).all(axis=0)
    out[near] = map_coordinates(functions.of(actuator), places[:, near], order=3)
    return out


def _means(edges: Array, centres: Array, width: float) -> tuple[Array, Array]:
    """Of exp(-(t - centre)^2/width^2) and of its derivative, the means between edges: (n_edges - 1, n_centres)."""
    u = (edges[:, None] - centres) / width
    lengths = np.diff(edges)[:, None]
    mean = np.diff(erf(u), axis=0) * (math.sqrt(math.pi) / 2 * width) / lengths
    return mean, np.diff(np.exp(-(u**2)), axis=0) / lengths


class OnMirror(NamedTuple):
    """Which commands were on the mirror in an exposure, by frame (-1: flat); as in SlopeFrame.

    Attributes:
        frame: at the end of the exposure.
        before: at its start.
        fraction: share of the exposure with ``frame`` on.
    """

    frame: int
    before: int
    fraction: float


@dataclass(frozen=True)
class _Entry:
    frame: int
    arrival: float
    commands: NDArray[np.float32]


class DelayLine:
    """The loop's delay d, mid-exposure to mid-command: the mirror moves once an exposure, at its share ``d % 1``.

    Time is counted in frames: exposure k lasts from k to k+1. With n = floor(d), f = d - n, the mirror takes at time
    k + f the newest command of a frame up to k - n that has arrived by then. On time, exposure k has command k-n-1 for
    the first share f and k-n for the rest; a late command leaves the mirror as it is until the next move.
    """

    _DEPTH = 64

    def __init__(self, delay: float, n_commands: int) -> None:
        self._whole = math.floor(delay)
        self._rest = delay - self._whole
        self._flat = _Entry(-1, -math.inf, np.zeros(n_commands, np.float32))
        self._entries: list[_Entry] = [self._flat] * self._DEPTH

    def put(self, frame: int, commands: ArrayLike, arrival: float) -> None:
        """A command came. The first that comes for a frame counts; one older than the line is dropped.

        Args:
            commands: (n_commands,) m of wavefront; copied.
            arrival: when, in frames.

        Raises:
            ValueError: wrong shape, or not finite.
        """
        values = np.array(commands, np.float32)
        if values.shape != self._flat.commands.shape:
            raise ValueError(f"commands: expected shape {self._flat.commands.shape}, got {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError("commands: expected finite values")
        place = frame % self._DEPTH
        if frame > self._entries[place].frame:
            self._entries[place] = _Entry(frame, arrival, values)

    def on(self, exposure: int) -> OnMirror:
        """What is on the mirror in an exposure, by what has come so far."""
        after = self._after_move(exposure)
        if self._rest == 0:
            return OnMirror(after.frame, after.frame, 1.0)
        return OnMirror(after.frame, self._after_move(exposure - 1).frame, 1 - self._rest)

    def is_late(self, exposure: int) -> bool:
        """Whether the command that was due in an exposure missed the mirror's move."""
        return self._after_move(exposure).frame < exposure - self._whole

    def commands(self, frame: int) -> NDArray[np.float32]:
        """The commands of a frame that :meth:`on` named: (n_commands,), not to be changed."""
        return self._flat.commands if frame < 0 else self._entries[frame % self._DEPTH].commands

    def shape(self, exposure: int) -> NDArray[np.float32]:
        """Commands on the mirror averaged over an exposure: (n_commands,) m."""
        state = self.on(exposure)
        after = self.commands(state.frame)
        if state.fraction == 1:
            return after
        return np.float32(state.fraction) * after + np.float32(1 - state.fraction) * self.commands(state.before)

    def _after_move(self, exposure: int) -> _Entry:
        newest = self._flat
        due, moment = exposure - self._whole, exposure + self._rest
        for entry in self._entries:
            if newest.frame < entry.frame <= due and entry.arrival <= moment:
                newest = entry
        return newest
