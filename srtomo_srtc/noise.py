"""Measurement noise of slopes: photons and read-out, of a centre of gravity; elongated spots of laser stars.

A laser star is a column as long as the sodium layer is thick. From a point of the pupil it is seen from the side, the
more the farther that point is from where the laser leaves: the spot is stretched by ``thickness * distance / range^2``
along the line to it. Its photon noise is then larger along that line, and x and y of a sub-aperture go together
(section 3.1.3). The layer is taken to be Gaussian.

A field stop cuts a long spot off. With S the spot's second moments, T those of what is left, and a share of the light
that passes, a shift of the spot by d moves the centre of gravity by ``T S^-1 d`` only (the derivative of a Gaussian is
``S^-1`` times itself and the distance). Slopes that are calibrated for this have the noise ::

    S T^-1 (excess^2 T / (share N) + read-out / (share N)^2) T^-1 S

for N electrons: ``excess^2 S / N`` without a stop, and along a spot much longer than the stop next to no information,
as Bechet et al. (JOSA A 27 (11), A1, 2010) suppose of truncated spots from the start. The bias of a truncated spot
whose sodium layer changes is no noise, and not in it.

A covariance measured on the sensor itself, from a file, takes the place of all this.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.special import ndtr

from srtomo_core.layout import SensorLayout
from srtomo_core.noise import read_noise
from srtomo_core.system import GuideStar, Sensor, System

Array = NDArray[np.float64]

_FWHM_PER_SIGMA = 2.355
_TAILS = 8.0  # standard deviations: nothing is beyond
_NODES = 96  # of the quadrature across a spot


class SlopeNoise(NamedTuple):
    """Noise of one sensor, independent from one sub-aperture to the next; rad^2.

    Attributes:
        variance: (n_slopes,) all x then all y, along the sensor's own axes.
        covariance: (n_valid,) of x with y.
    """

    variance: Array
    covariance: Array

    def matrix(self) -> sparse.csr_array:
        """(n_slopes, n_slopes) N, rad^2."""
        x, y = np.split(self.variance, 2)
        return _two_by_two(x, self.covariance, self.covariance, y)

    def whitening(self) -> sparse.csr_array:
        """(n_slopes, n_slopes) W with ``W N W^T = I``, the inverse of N's Cholesky factor, 1/rad."""
        x, y = np.split(self.variance, 2)
        left = np.sqrt(y - self.covariance**2 / x)
        return _two_by_two(1 / np.sqrt(x), np.zeros(len(x)), -self.covariance / (x * left), 1 / left)


class MeasuredNoise(NamedTuple):
    """Noise of one sensor as it was measured.

    Attributes:
        covariance: (n_slopes, n_slopes) rad^2.
    """

    covariance: Array

    def matrix(self) -> sparse.csr_array:
        """(n_slopes, n_slopes) N, rad^2."""
        return sparse.csr_array(self.covariance)

    def whitening(self) -> sparse.csr_array:
        """(n_slopes, n_slopes) W with ``W N W^T = I``, the inverse of N's Cholesky factor, 1/rad."""
        factor = np.linalg.cholesky(self.covariance)
        return sparse.csr_array(solve_triangular(factor, np.eye(len(factor)), lower=True))


def sensor_noise(system: System, sensor: Sensor, layout: SensorLayout) -> SlopeNoise | MeasuredNoise:
    """Noise of a sensor: measured if its file is given, else by :func:`slope_noise`.

    Raises:
        ValueError: the file cannot be read, or does not hold a covariance of this sensor's slopes.
    """
    if sensor.noise_covariance is None:
        return slope_noise(system, sensor, layout)
    return MeasuredNoise(read_noise(sensor.noise_covariance, layout.n_slopes))


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
    return np.tile(photon + sensor.read_noise**2 * _pixel_squares(sensor) / electrons**2, 2)


def slope_noise(system: System, sensor: Sensor, layout: SensorLayout) -> SlopeNoise:
    """Noise of a sensor on its star: elongated spots if the instrument says where its laser leaves, cut by its stop."""
    rate = system.rate_of(sensor)
    variance = slope_variance(sensor, layout, rate)
    star = system.star_of(sensor)
    ex, ey = _elongation(system, star, layout)
    if sensor.field_stop is not None:
        return _behind_a_stop(sensor, layout, ex, ey, rate)
    per_square: Array = sensor.excess_noise**2 / _electrons(sensor, layout, rate)
    return SlopeNoise(variance + np.concatenate([ex**2, ey**2]) * np.tile(per_square, 2), ex * ey * per_square)


def _elongation(system: System, star: GuideStar, layout: SensorLayout) -> tuple[Array, Array]:
    """x and y, each (n_valid,), of the rms length that the sodium layer adds to each spot, along the sensor's axes."""
    if star.launch is None or star.sodium_thickness is None:
        return np.zeros(layout.n_valid), np.zeros(layout.n_valid)
    x, y = layout.to_pupil(*layout.local.T)
    x, y = x - star.launch[0], y - star.launch[1]
    c, s = np.cos(layout.rotation), np.sin(layout.rotation)
    stretch = star.sodium_thickness * system.airmass / system.los_range(star) ** 2 / _FWHM_PER_SIGMA
    return stretch * (c * x + s * y), stretch * (c * y - s * x)


def _behind_a_stop(sensor: Sensor, layout: SensorLayout, ex: Array, ey: Array, rate: float) -> SlopeNoise:
    assert sensor.field_stop is not None
    round_spot = (sensor.spot_fwhm / _FWHM_PER_SIGMA) ** 2
    S = _symmetric(ex**2 + round_spot, ex * ey, ey**2 + round_spot)
    share, T = truncated_moments(S, sensor.field_stop / 2)
    electrons = (share * _electrons(sensor, layout, rate))[:, None, None]
    gain = T @ np.linalg.inv(S)
    read = sensor.read_noise**2 * _pixel_squares(sensor) * np.eye(2)
    once = np.linalg.solve(gain, sensor.excess_noise**2 * T / electrons + read / electrons**2)
    N: Array = np.linalg.solve(gain, once.swapaxes(1, 2)).astype(np.float64)
    return SlopeNoise(np.concatenate([N[:, 0, 0], N[:, 1, 1]]), N[:, 0, 1])


def truncated_moments(S: Array, half: float) -> tuple[Array, Array]:
    """What of Gaussians about the centre of a square lies in it.

    Args:
        S: (n, 2, 2) their second moments.
        half: side of the square, half of it.

    Returns:
        (n,) the share; (n, 2, 2) second moments of what lies inside, for a share of 1.
    """
    across = np.sqrt(S[:, 0, 0])
    reach = np.minimum(half, _TAILS * across)[:, None]
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    x = reach * nodes
    density = reach * weights * np.exp(-0.5 * (x / across[:, None]) ** 2) / (across[:, None] * math.sqrt(2 * math.pi))
    # y at a given x is Gaussian, and cut at both ends
    middle = (S[:, 0, 1] / S[:, 0, 0])[:, None] * x
    width = np.sqrt(S[:, 1, 1] - S[:, 0, 1] ** 2 / S[:, 0, 0])[:, None]
    low, high = (-half - middle) / width, (half - middle) / width
    at_low, at_high = (np.exp(-0.5 * t**2) / math.sqrt(2 * math.pi) for t in (low, high))
    inside = ndtr(high) - ndtr(low)
    first = middle * inside + width * (at_low - at_high)
    second = middle * first + width**2 * (inside + low * at_low - high * at_high) + middle * width * (at_low - at_high)
    share = (density * inside).sum(axis=1)
    moments = ((density * part).sum(axis=1) / share for part in (x**2 * inside, x * first, second))
    return share, _symmetric(*moments)


def _symmetric(xx: Array, xy: Array, yy: Array) -> Array:
    """(n, 2, 2)"""
    return np.moveaxis(np.array([[xx, xy], [xy, yy]]), -1, 0)


def _pixel_squares(sensor: Sensor) -> float:
    """Sum over a sub-aperture's pixels of their squared distance from the middle along an axis, rad^2."""
    # pixel centres at (i - (n-1)/2) p, n x n of them: mean square (n^2-1)/12 p^2
    return sensor.pixels**2 * (sensor.pixels**2 - 1) / 12 * sensor.pixel_scale**2


def _electrons(sensor: Sensor, layout: SensorLayout, rate: float) -> Array:
    """(n_valid,) detected in a frame."""
    return sensor.photons * layout.size**2 * layout.illumination / rate


def _two_by_two(xx: Array, xy: Array, yx: Array, yy: Array) -> sparse.csr_array:
    """Each (n_valid,), on four diagonals; zeros are not kept."""
    n = len(xx)
    matrix = sparse.diags_array([np.concatenate([xx, yy]), xy, yx], offsets=[0, n, -n], shape=(2 * n, 2 * n))
    matrix = sparse.csr_array(matrix)
    matrix.eliminate_zeros()
    return matrix
