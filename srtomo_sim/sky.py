"""A stretch of sky as one instrument sees it, computed ahead: a frame then costs a product and some noise.

In each science direction the wavefront is kept as what is needed for the residual of any mirror shape m: with N the
mirrors' shapes at the pupil, piston and tip-tilt removed from both, ``mean |phi - N m|^2`` is
``mean |phi|^2 - 2 m . N^T phi / n + m . (N^T N / n) m``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from srtomo_core.layout import Array, Layout, transmission
from srtomo_core.system import Direction, System, Telescope
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


@dataclass(frozen=True, eq=False)
class Sky:
    """Frames 0 .. n_frames-1 of turbulence for one layout and frame rate. Photons and noise play no part in it.

    Attributes:
        slopes: (n_frames, n_slopes) of the turbulence, rad.
        interaction: (n_slopes, n_commands) true response of the sensors, rad/m.
        science_every: science directions are known in frames that this divides.
        targets: one a science direction.
    """

    system: System
    layout: Layout
    seed: int
    slopes: NDArray[np.float32]
    interaction: NDArray[np.float32]
    science_every: int
    targets: tuple[ScienceTarget, ...]

    @property
    def n_frames(self) -> int:
        """Number of exposures."""
        return len(self.slopes)

    def error(self, frame: int, commands: ArrayLike) -> WavefrontError:
        """Residual at the middle of exposure ``frame`` with ``commands`` (n_commands,) on the mirrors.

        Raises:
            ValueError: not a science frame.
        """
        index, rest = divmod(frame, self.science_every)
        if rest or not 0 <= frame < self.n_frames:
            raise ValueError(f"frame: expected a multiple of {self.science_every} below {self.n_frames}, got {frame}")
        shape = np.asarray(commands, np.float64)
        squares = np.array([target.residual(index, shape) for target in self.targets])
        return WavefrontError(np.sqrt(squares[:, 0]), np.sqrt(squares[:, 1]))


def prepare(
    system: System,
    n_frames: int,
    seed: int,
    *,
    layout: Layout | None = None,
    science_every: int = 1,
    progress: Callable[[float], None] = lambda done: None,
) -> Sky:
    """Let ``n_frames`` exposures of sky pass over an instrument.

    One seed gives one sky: instruments of one diameter, outer scale and frame rate see the same turbulence.

    Memory: the result (4 bytes a slope and frame, 8 a command and science frame), two float32 screens a layer and
    some eight more in work, and 8 bytes for each of some 20000 pupil points times 256 frames and times the commands.

    Args:
        layout: where sensors and actuators truly are; by default where the system says.
        science_every: know the science directions only in every so many frames.
        progress: called with the share that is done, 0 to 1.

    Raises:
        ValueError: the sky does not fit in memory (outer scale, field).
    """
    layout = layout or Layout(system)
    screens = Screens(system, seed)
    slopes = atmospheric_slopes(system, layout, screens, n_frames, lambda done: progress(0.8 * done))
    response = interaction_matrix(system, layout).astype(np.float32)
    targets = _science(system, layout, screens, np.arange(0, n_frames, science_every), progress)
    progress(1.0)
    return Sky(system, layout, seed, slopes, response, science_every, targets)


def pupil_points(telescope: Telescope) -> tuple[Array, Array]:
    """Points of the pupil at which science wavefronts are known: x, y, (n_points,) each, m."""
    line = ((np.arange(_POINTS_ACROSS) + 0.5) / _POINTS_ACROSS - 0.5) * telescope.diameter
    y, x = np.meshgrid(line, line, indexing="ij")
    lit = transmission(telescope, x, y) > 0
    return x[lit], y[lit]


def wavefronts(screens: Screens, frames: NDArray[np.integer], x: Array, y: Array, direction: Direction) -> Array:
    """The turbulence's wavefront towards a star at infinity at the middle of exposures: (n_frames, n_points), m.

    Args:
        x, y: (n_points,) pupil coordinates, m.
    """
    phase = np.zeros((len(frames), len(x)))
    step = screens.grid.step
    for l, phase_of_layer in enumerate(screens.phases):
        add_values(phase_of_layer, x / step, y / step, screens.drift(l, frames, direction), phase)
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
