"""Shack-Hartmann slopes: the true gradient of the wavefront, averaged over the lit part of each sub-aperture.

A sub-aperture that is lit all over is one square, any other is cut into cells that count by how much of each is lit.
Over a square, and over an exposure, the average is exact: a filter on the layer's spectrum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Array, Layout, SensorLayout, transmission
from srtomo_core.noise import read_noise
from srtomo_core.system import Sensor, System, Telescope
from srtomo_sim.course import travel
from srtomo_sim.spline import add_weighted_pairs
from srtomo_sim.turbulence import Screens

_CELL = 0.05  # m, at most, where a sub-aperture is lit in part
_MAX_CELLS = 40  # across a sub-aperture: larger lenses average over more
_FINE = 64  # points across a sub-aperture, at least, to see which part of it is lit
_STOP_POINTS = 80  # across a field stop


def lit_fractions(layout: SensorLayout, telescope: Telescope, across: int) -> Array:
    """Mean transmission of the pupil over ``across`` x ``across`` equal cells of each sub-aperture.

    Returns:
        (n_valid, across, across), [sub-aperture, y, x] in the sensor's own axes.
    """
    light = np.ones((layout.n_valid, across, across))
    part = np.flatnonzero(layout.illumination < 1)
    edge = replace(layout, local=layout.local[part], illumination=layout.illumination[part])
    fine = max(_FINE // across, 8)
    points = transmission(telescope, *edge.points(across * fine))
    light[part] = points.reshape(-1, across, fine, across, fine).mean(axis=(2, 4))
    return light


@dataclass(frozen=True)
class Squares:
    """Equal squares over which the gradient is averaged, grouped by sub-aperture.

    Attributes:
        side: m.
        x, y: (n_squares,) centres in pupil coordinates, m.
        weight: (n_squares,); they sum to 1 over each sub-aperture.
        start: (n_groups + 1,) first square of each group.
        subaperture: (n_groups,) whose group it is.
    """

    side: float
    x: Array
    y: Array
    weight: Array
    start: NDArray[np.int64]
    subaperture: NDArray[np.int64]


def cut(layout: SensorLayout, telescope: Telescope, max_cell: float = _CELL) -> list[Squares]:
    """The squares of all sub-apertures: those lit all over whole, the others in cells of at most ``max_cell`` m."""
    across = min(_MAX_CELLS, math.ceil(layout.size / max_cell - 1e-9))
    light = lit_fractions(layout, telescope, across)
    whole = layout.illumination == 1
    squares = []
    for n, chosen, lit in ((1, whole, np.ones((len(light), 1, 1))), (across, ~whole, light)):
        index = np.flatnonzero(chosen)
        if not len(index):
            continue
        x, y = (p[index] for p in layout.points(n))
        weight = lit[index] / lit[index].sum(axis=(1, 2), keepdims=True)
        used = weight > 0
        start = np.concatenate([[0], np.cumsum(used.sum(axis=(1, 2)))])
        squares.append(Squares(layout.size / n, x[used], y[used], weight[used], start, index))
    return squares


def atmospheric_slopes(
    system: System,
    layout: Layout,
    screens: Screens,
    n_frames: int,
    progress: Callable[[float], None] = lambda done: None,
    first: int = 0,
) -> NDArray[np.float32]:
    """Slopes of the turbulence alone, averaged over exposures ``first .. first+n_frames-1``: (n_frames, n_slopes), rad.

    r0 is that of exposure 0. In a drift of the wind, what an exposure averages over is that of the mean wind.

    Args:
        screens: with a course that has all these exposures in one stretch.
        progress: called with the share that is done, 0 to 1.
    """
    frames = np.arange(first, first + n_frames)
    stretch = screens.course.at(first)
    slopes = np.zeros((n_frames, layout.n_slopes), np.float32)
    parts = [(i, squares) for i, sensor in enumerate(layout.sensors) for squares in cut(sensor, system.telescope)]
    stars = [system.star_of(sensor) for sensor in system.sensors]
    along = (travel(stretch.before) + travel(stretch.after)) / 2
    weights = screens.course.weights(frames)
    done = 0
    for l, height in enumerate(screens.heights):
        if not weights[:, l].any():
            continue

        def filter_of(part: tuple[int, Squares], height: float = height) -> tuple[float, float]:
            i, squares = part
            return squares.side * (1 - height / system.los_range(stars[i])), layout.sensors[i].rotation

        # sensors that share a filter share its transform
        for averaging, members in groupby(sorted(parts, key=filter_of), filter_of):
            spline = screens.gradient(l, *averaging, along[l])
            for i, squares in members:
                cone = 1 - height / system.los_range(stars[i])
                mine, n = layout.slopes_of(i), layout.sensors[i].n_valid
                add_weighted_pairs(
                    spline,
                    squares.x * cone / screens.grid.step,
                    squares.y * cone / screens.grid.step,
                    squares.weight * cone,
                    squares.start,
                    screens.drift(l, frames, stars[i].position),
                    weights[:, l],
                    squares.subaperture,
                    slopes[:, mine.start : mine.start + n],
                    slopes[:, mine.start + n : mine.stop],
                )
                done += 1
                progress(done / (len(parts) * len(screens)))
    return slopes


def noise_sigma(system: System, layout: Layout) -> Array:
    """Standard deviation of each slope's measurement noise, unless it was measured: (n_slopes,) rad.

    Centre of gravity of N electrons over ``pixels`` x ``pixels``: the spot's rms width along the slope times the excess
    noise over sqrt(N), and read noise summed over the pixels' squared distances, over N. Behind a field stop, of the
    electrons that pass, and divided by how far the centre of gravity moves for a spot moved by 1. In the dark, that of
    a place anywhere on the pixels.
    """
    sigma = np.sqrt(np.concatenate([noise[[0, 1], [0, 1]].ravel() for noise in _noise(system, layout)]))
    windows = np.repeat([s.pixels * s.pixel_scale for s in system.sensors], np.diff(layout.slope_start))
    dark = dark_slopes(system, layout)
    sigma[dark] = windows[dark] / math.sqrt(12)
    return sigma


def dark_slopes(system: System, layout: Layout) -> NDArray[np.intp]:
    """Slopes (indices) of sub-apertures that get less than one electron a frame: a star that went away."""
    dark = [
        np.tile(_electrons(system, sensor, place) < 1, 2)
        for sensor, place in zip(system.sensors, layout.sensors, strict=True)
    ]
    return np.flatnonzero(np.concatenate(dark))


def noise_correlation(system: System, layout: Layout) -> list[Array]:
    """Correlation of each sub-aperture's noise in x with that in y, sensor by sensor: (n_valid,), 0 for round spots."""
    return [noise[0, 1] / np.sqrt(noise[0, 0] * noise[1, 1]) for noise in _noise(system, layout)]


def measured_noise(system: System, layout: Layout) -> list[tuple[slice, Array]]:
    """Of each sensor whose noise was measured: its slopes, and the factor (n_slopes, n_slopes) that makes it of white.

    Raises:
        ValueError: its file cannot be used.
    """
    out = []
    for i, sensor in enumerate(system.sensors):
        if sensor.noise_covariance is not None:
            covariance = read_noise(sensor.noise_covariance, layout.sensors[i].n_slopes)
            out.append((layout.slopes_of(i), np.asarray(np.linalg.cholesky(covariance), np.float64)))
    return out


def _noise(system: System, layout: Layout) -> list[Array]:
    """(2, 2, n_valid) noise covariance of x and y along each sensor's own axes, rad^2."""
    return [
        _subaperture_noise(system, sensor, sensor_layout)
        for sensor, sensor_layout in zip(system.sensors, layout.sensors, strict=True)
    ]


def _electrons(system: System, sensor: Sensor, layout: SensorLayout) -> Array:
    """(n_valid,) detected in a frame."""
    return sensor.photons * layout.size**2 * layout.illumination / system.rate_of(sensor)


def _subaperture_noise(system: System, sensor: Sensor, layout: SensorLayout) -> Array:
    electrons = _electrons(system, sensor, layout)
    pixel = (np.arange(sensor.pixels) - (sensor.pixels - 1) / 2) * sensor.pixel_scale
    read = sensor.read_noise**2 * sensor.pixels * (pixel**2).sum() * np.eye(2)[:, :, None]
    spot = _spot_covariance(system, sensor, layout)
    if sensor.field_stop is None:
        return sensor.excess_noise**2 * spot / electrons + read / electrons**2
    passed, left, moves = np.stack([_through_stop(one, sensor.field_stop) for one in np.moveaxis(spot, -1, 0)], axis=-1)
    electrons = electrons * passed[0, 0]
    noise = sensor.excess_noise**2 * left / electrons + read / electrons**2
    calibration = np.linalg.inv(np.moveaxis(moves, -1, 0))
    return np.einsum("nij,jkn,nlk->iln", calibration, noise, calibration)


def _through_stop(spot: Array, side: float) -> Array:
    """(3, 2, 2) of a Gaussian spot (2, 2) in a square: the share that passes, the second moments of that, and how far
    its centre of gravity moves for a spot moved by 1, by small moves.
    """
    place = side * ((np.arange(_STOP_POINTS) + 0.5) / _STOP_POINTS - 0.5)
    x, y = np.meshgrid(place, place)
    inverse = np.linalg.inv(spot)

    def light(dx: float, dy: float) -> Array:
        u, v = x - dx, y - dy
        return np.exp(-0.5 * (inverse[0, 0] * u**2 + 2 * inverse[0, 1] * u * v + inverse[1, 1] * v**2))

    def centre(light: Array) -> Array:
        return np.array([np.vdot(light, x), np.vdot(light, y)]) / light.sum()

    still, step = light(0.0, 0.0), 1e-3 * side
    everything = 2 * math.pi * math.sqrt(np.linalg.det(spot)) * (_STOP_POINTS / side) ** 2
    left = [[np.vdot(still, a * b) / still.sum() for b in (x, y)] for a in (x, y)]
    moves = [(centre(light(*shift)) - centre(light(*-shift))) / (2 * step) for shift in step * np.eye(2)]
    return np.array([np.full((2, 2), still.sum() / everything), left, np.transpose(moves)])


def _spot_covariance(system: System, sensor: Sensor, layout: SensorLayout) -> Array:
    """(2, 2, n_valid) second moments of each sub-aperture's spot, rad^2: an ellipse along the line from the launch."""
    across = np.full(layout.n_valid, sensor.spot_fwhm / math.sqrt(8 * math.log(2)))
    star = system.star_of(sensor)
    if star.launch is None or star.sodium_thickness is None:
        return np.eye(2)[:, :, None] * across**2
    from_launch = np.stack(layout.to_pupil(*layout.local.T), axis=1) - star.launch
    # seen from the pupil, both ends of a column along the beam lie in the direction of the launch, so far apart:
    thickness = star.sodium_thickness / math.cos(system.zenith_angle)
    length = thickness * np.hypot(*from_launch.T) / system.los_range(star) ** 2
    along = np.hypot(across, length / math.sqrt(8 * math.log(2)))
    angle = np.arctan2(from_launch[:, 1], from_launch[:, 0]) - layout.rotation
    axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.einsum("ikn,kn,jkn->ijn", axes, np.stack([along, across]) ** 2, axes)
