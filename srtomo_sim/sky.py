"""A stretch of sky as one instrument sees it, computed ahead: a frame then costs a product and some noise.

In each science direction the wavefront is kept as what is needed for the residual of any mirror shape m: with N the
mirrors' shapes at the pupil, piston and tip-tilt removed from both, ``mean |phi - N m|^2`` is
``mean |phi|^2 - 2 m . N^T phi / n + m . (N^T N / n) m``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from srtomo_core.layout import Array, Layout, transmission
from srtomo_core.system import Direction, System, Telescope
from srtomo_sim.course import Change, Course, moved, sensor_places
from srtomo_sim.mirror import interaction_matrix, mirror_phase
from srtomo_sim.shack_hartmann import atmospheric_slopes
from srtomo_sim.spline import add_values
from srtomo_sim.turbulence import Screens

_POINTS_ACROSS = 160  # of the pupil, in science directions
_BLOCK = 256  # science frames whose wavefronts are held at a time


class WavefrontError(NamedTuple):
    """Residual in each science direction, m rms over the pupil, piston removed: (n_targets,) each.

    Attributes:
        high_order: without tip and tilt.
        tip_tilt: of tip and tilt alone.
    """

    high_order: Array
    tip_tilt: Array


def strehl(error: ArrayLike, wavelength: float) -> Array:
    """Strehl ratio of a wavefront error (m rms) by Marechal's approximation, exp(-(2 pi error / wavelength)^2)."""
    return np.exp(-((2 * np.pi * np.asarray(error) / wavelength) ** 2))


@dataclass(frozen=True, eq=False)
class ScienceTarget:
    """Wavefronts towards one science direction, as the coefficients of the residual's quadratic form.

    Attributes:
        power: (n_science,) mean square without piston, tip and tilt, m^2.
        projection: (n_science, n_commands) N^T phi / n, m.
        tip_tilt: (n_science, 2) rms of tip and of tilt, signed, m.
        gram: (n_commands, n_commands) N^T N / n.
        mirror_tip_tilt: (2, n_commands) tip and tilt of unit commands.
    """

    power: Array
    projection: Array
    tip_tilt: Array
    gram: Array
    mirror_tip_tilt: Array

    def residual(self, index: int, commands: Array) -> tuple[float, float]:
        """Mean square residual with ``commands`` (n_commands,) on the mirrors: high order, tip-tilt; m^2."""
        high_order = self.power[index] + commands @ (self.gram @ commands - 2 * self.projection[index])
        tip_tilt = self.tip_tilt[index] - self.mirror_tip_tilt @ commands
        return max(float(high_order), 0.0), float(tip_tilt @ tip_tilt)

    def fitting_error(self) -> Array:
        """What the mirrors cannot make: (n_science,) m rms of the best residual, tip-tilt removed."""
        # the smallest eigenvalues belong to shapes that the pupil hardly sees, piston and tip-tilt among them
        values, vectors = np.linalg.eigh(self.gram)
        seen = values > 1e-9 * values[-1]
        made = (self.projection @ vectors[:, seen]) ** 2 @ (1 / values[seen])
        return np.sqrt(np.maximum(self.power - made, 0))


class Place(NamedTuple):
    """Where sensors are from an exposure on.

    Attributes:
        first: that exposure.
        interaction: (n_slopes, n_commands) true response of the sensors, rad/m.
    """

    first: int
    layout: Layout
    interaction: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sky:
    """Frames 0 .. n_frames-1 of turbulence for one layout and frame rate. Photons and noise play no part in it.

    Slopes and targets hold r0 as it is in exposure 0; :meth:`turbulence`, :meth:`error` and :meth:`uncorrected` have
    what the course makes of it.

    Attributes:
        layout, interaction: where the sensors are in exposure 0, and their response there.
        slopes: (n_frames, n_slopes) of the turbulence, rad.
        science_every: science directions are known in frames that this divides.
        targets: one a science direction.
        course: what changes in which frame.
        moves: where the sensors are from later exposures on.
    """

    system: System
    layout: Layout
    seed: int
    slopes: NDArray[np.float32]
    interaction: NDArray[np.float32]
    science_every: int
    targets: tuple[ScienceTarget, ...]
    course: Course
    moves: tuple[Place, ...] = ()

    @property
    def n_frames(self) -> int:
        """Number of exposures."""
        return len(self.slopes)

    def turbulence(self, frame: int) -> NDArray[np.float32]:
        """Slopes of the turbulence in an exposure: (n_slopes,) rad."""
        return np.float32(self._amplitude(frame)) * self.slopes[frame]

    def place(self, frame: int) -> Place:
        """Where the sensors are in an exposure."""
        return next(
            (place for place in reversed(self.moves) if place.first <= frame), Place(0, self.layout, self.interaction)
        )

    def error(self, frame: int, commands: ArrayLike) -> WavefrontError:
        """Residual at the middle of exposure ``frame`` with ``commands`` (n_commands,) on the mirrors.

        Raises:
            ValueError: not a science frame.
        """
        index, amplitude = self._science(frame), self._amplitude(frame)
        # mean |a phi - N m|^2 is a^2 times that of the shape m / a
        shape = np.asarray(commands, np.float64) / amplitude
        squares = amplitude**2 * np.array([target.residual(index, shape) for target in self.targets])
        return WavefrontError(np.sqrt(squares[:, 0]), np.sqrt(squares[:, 1]))

    def uncorrected(self, frame: int) -> Array:
        """The turbulence's wavefront at the middle of an exposure, m rms without piston and tip-tilt: (n_targets,).

        Raises:
            ValueError: not a science frame.
        """
        index = self._science(frame)
        return self._amplitude(frame) * np.sqrt([target.power[index] for target in self.targets])

    def fitting_error(self, target: int = 0) -> Array:
        """What the mirrors cannot make towards a science direction: (n_science,) m rms, tip-tilt removed."""
        frames = np.arange(0, self.n_frames, self.science_every)
        return self.course.amplitude(frames) * self.targets[target].fitting_error()

    def _amplitude(self, frame: int) -> float:
        return float(self.course.amplitude(np.array([frame]))[0]) if self.course.changes else 1.0

    def _science(self, frame: int) -> int:
        index, rest = divmod(frame, self.science_every)
        if rest or not 0 <= frame < self.n_frames:
            raise ValueError(f"frame: expected a multiple of {self.science_every} below {self.n_frames}, got {frame}")
        return index

    def changed(self, change: Change) -> Sky:
        """This sky with one more change to its course.

        Frames and arrays are shared with this one; unless :func:`~srtomo_sim.course.alters_turbulence` says that they
        need not, those from the change on have to be computed anew: :meth:`compute`.

        Raises:
            InstrumentError: the change is refused.
        """
        course = self.course.extended(change)
        return replace(self, course=course, moves=_moves(self.system, self.layout, course))

    def compute(self, screens: Screens, first: int, stop: int, progress: Callable[[float], None]) -> Part:
        """Frames ``first`` to ``stop - 1`` anew.

        Args:
            screens: of this system, seed and course.
        """
        parts = []
        for stretch in self.course.between(first, stop):
            start, end = max(first, stretch.start), min(stop, stretch.stop)
            parts.append(
                atmospheric_slopes(
                    self.system,
                    self.place(start).layout,
                    screens,
                    end - start,
                    _part_of(progress, 0.8 * (start - first) / (stop - first), 0.8 * (end - start) / (stop - first)),
                    start,
                )
            )
        slopes = parts[0] if len(parts) == 1 else np.concatenate(parts)
        science = np.arange(-(-first // self.science_every) * self.science_every, stop, self.science_every)
        return Part(first, slopes, _science(self.system, self.layout, screens, science, progress))

    def put(self, part: Part) -> None:
        """Take in what was computed anew."""
        self.slopes[part.first : part.first + len(part.slopes)] = part.slopes
        start = -(-part.first // self.science_every)
        for target, new in zip(self.targets, part.targets, strict=True):
            rows = slice(start, start + len(new.power))
            target.power[rows], target.projection[rows], target.tip_tilt[rows] = new.power, new.projection, new.tip_tilt


def _part_of(progress: Callable[[float], None], begun: float, share: float) -> Callable[[float], None]:
    """What a part of the work that takes ``share`` of it, and begins when ``begun`` is done, calls with its own."""
    return lambda done: progress(begun + share * done)


class Part(NamedTuple):
    """Some frames of a sky from ``first`` on, as in :class:`Sky`."""

    first: int
    slopes: NDArray[np.float32]
    targets: tuple[ScienceTarget, ...]


def prepare(
    system: System,
    n_frames: int,
    seed: int,
    *,
    layout: Layout | None = None,
    science_every: int = 1,
    changes: Sequence[Change] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> Sky:
    """Let ``n_frames`` exposures of sky pass over an instrument.

    One seed gives one sky: instruments of one diameter, outer scale and frame rate see the same turbulence.

    Memory: the result (4 bytes a slope and frame, 8 a command and science frame), two float32 screens a layer and
    some eight more in work, and 8 bytes for each of some 20000 pupil points times 256 frames and times the commands.

    Args:
        layout: where sensors and actuators truly are; by default where the system says.
        science_every: know the science directions only in every so many frames.
        changes: of sky, light and sensors, in order of their frames. A layer that is to gain strength has to be there
            from the beginning, with a fraction of 0.
        progress: called with the share that is done, 0 to 1.

    Raises:
        ValueError: the sky does not fit in memory (outer scale, field).
        InstrumentError: a change is refused.
    """
    layout = layout or Layout(system)
    course = Course(system, changes)
    moves = _moves(system, layout, course)
    response = interaction_matrix(system, layout).astype(np.float32)
    empty = Sky(system, layout, seed, np.zeros((0, 0), np.float32), response, science_every, (), course, moves)
    part = empty.compute(Screens(system, seed, course), 0, n_frames, progress)
    progress(1.0)
    return replace(empty, slopes=part.slopes, targets=part.targets)


def _moves(system: System, layout: Layout, course: Course) -> tuple[Place, ...]:
    moves: list[Place] = []
    last = system
    for stretch in course.stretches:
        if sensor_places(stretch.after) != sensor_places(last):
            there = moved(layout, system.telescope, system, stretch.after)
            moves.append(Place(stretch.start, there, interaction_matrix(system, there).astype(np.float32)))
            last = stretch.after
    return tuple(moves)


def pupil_points(telescope: Telescope) -> tuple[Array, Array]:
    """Points of the pupil at which science wavefronts are known: x, y, (n_points,) each, m."""
    line = ((np.arange(_POINTS_ACROSS) + 0.5) / _POINTS_ACROSS - 0.5) * telescope.diameter
    y, x = np.meshgrid(line, line, indexing="ij")
    lit = transmission(telescope, x, y) > 0
    return x[lit], y[lit]


def wavefronts(screens: Screens, frames: NDArray[np.integer], x: Array, y: Array, direction: Direction) -> Array:
    """The turbulence's wavefront towards a star at infinity at the middle of exposures: (n_frames, n_points), m.

    r0 is that of exposure 0.

    Args:
        x, y: (n_points,) pupil coordinates, m.
    """
    phase = np.zeros((len(frames), len(x)))
    step, weights = screens.grid.step, screens.course.weights(frames)
    for l, phase_of_layer in enumerate(screens.phases):
        if weights[:, l].any():
            drift = screens.drift(l, frames, direction)
            add_values(phase_of_layer, x / step, y / step, drift, weights[:, l], phase)
    return phase


def _science(
    system: System,
    layout: Layout,
    screens: Screens,
    frames: NDArray[np.integer],
    progress: Callable[[float], None],
) -> tuple[ScienceTarget, ...]:
    x, y = pupil_points(system.telescope)
    # orthonormal over the pupil's points: piston, tip, tilt
    low, signs = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1))
    low *= np.sqrt(len(x)) * np.sign(np.diag(signs))
    directions = [target.position for target in system.science.targets]
    targets: list[ScienceTarget] = []
    shapes = gram = mirror_low = np.empty(0)
    for d, direction in enumerate(directions):
        if d == 0 or any(mirror.altitude for mirror in layout.mirrors):
            shapes = mirror_phase(layout, x, y, direction)
            mirror_low = low.T @ shapes / len(x)
            shapes -= low @ mirror_low
            gram = shapes.T @ shapes / len(x)
        power, tip_tilt = np.empty(len(frames)), np.empty((len(frames), 2))
        projection = np.empty((len(frames), layout.n_commands))
        for first in range(0, len(frames), _BLOCK):
            block = slice(first, first + _BLOCK)
            phase = wavefronts(screens, frames[block], x, y, direction)
            coefficients = phase @ low / len(x)
            power[block] = np.einsum("fp,fp->f", phase, phase) / len(x) - (coefficients**2).sum(axis=1)
            tip_tilt[block] = coefficients[:, 1:]
            projection[block] = phase @ shapes / len(x)
            progress(0.8 + 0.2 * (d + min(block.stop / len(frames), 1)) / len(directions))
        targets.append(ScienceTarget(power, projection, tip_tilt, gram, mirror_low[1:]))
    return tuple(targets)
