"""Measurement noise of slopes: photons and read-out, of a centre of gravity; elongated spots of laser stars.

A laser star is a column as long as the sodium layer is thick. From a point of the pupil it is seen from the side, the
more the farther that point is from where the laser leaves: the spot is stretched by ``thickness * distance / range^2``
along the line to it. Its photon noise is then larger along that line, and x and y of a sub-aperture go together
(section 3.1.3). The layer is taken to be Gaussian and the spot to fit into the sub-aperture's field.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import SensorLayout
from srtomo_core.system import Sensor, System

Array = NDArray[np.float64]

_FWHM_PER_SIGMA = 2.355


class SlopeNoise(NamedTuple):
    """Noise of one sensor, independent from one sub-aperture to the next; rad^2.

    Attributes:
        variance: (n_slopes,) all x then all y, along the sensor's own axes.
        covariance: (n_valid,) of x with y.
    """

    variance: Array
    covariance: Array


def slope_variance(sensor: Sensor, layout: SensorLayout, rate: float) -> Array:
    """Variance of each slope with a round spot, independent of the others, rad^2.

    With N electrons a frame: ``(fwhm / 2.355)^2 excess^2 / N`` from photons and ``ron^2 sum(x^2) / N^2`` from read-out,
    the sum over the sub-aperture's pixels. The spot moves by the wavefront's tilt, angle for angle.

    Args:
        sensor: photons, spot, pixels.
        layout: its sub-apertures and their light.
        rate: frame rate, Hz.

    Returns:
        (n_slopes,) all x then all y.
    """
    electrons = _electrons(sensor, layout, rate)
    photon = (sensor.spot_fwhm / _FWHM_PER_SIGMA * sensor.excess_noise) ** 2 / electrons
    # pixel centres at (i - (n-1)/2) p, n x n of them: mean square (n^2-1)/12 p^2
    squares = sensor.pixels**2 * (sensor.pixels**2 - 1) / 12 * sensor.pixel_scale**2
    return np.tile(photon + sensor.read_noise**2 * squares / electrons**2, 2)


def slope_noise(system: System, sensor: Sensor, layout: SensorLayout) -> SlopeNoise:
    """Noise of a sensor on its star, whose spots are elongated if the instrument says where its laser leaves."""
    variance = slope_variance(sensor, layout, system.loop.rate)
    star = system.star_of(sensor)
    if star.launch is None or star.sodium_thickness is None:
        return SlopeNoise(variance, np.zeros(layout.n_valid))
    x, y = layout.to_pupil(*layout.local.T)
    x, y = x - star.launch[0], y - star.launch[1]
    c, s = np.cos(layout.rotation), np.sin(layout.rotation)
    stretch = star.sodium_thickness * system.airmass / system.los_range(star) ** 2 / _FWHM_PER_SIGMA
    ex, ey = stretch * (c * x + s * y), stretch * (c * y - s * x)
    per_square = sensor.excess_noise**2 / _electrons(sensor, layout, system.loop.rate)
    return SlopeNoise(variance + np.concatenate([ex**2, ey**2]) * np.tile(per_square, 2), ex * ey * per_square)


def _electrons(sensor: Sensor, layout: SensorLayout, rate: float) -> Array:
    """(n_valid,) detected in a frame."""
    return sensor.photons * layout.size**2 * layout.illumination / rate
