"""Measurement noise of slopes: photons and read-out, of a centre of gravity; elongated spots of laser stars.

A laser star is a column as long as the sodium layer is thick. From a point of the pupil it is seen from the side, the
more the farther that point is from where the laser leaves: the spot is stretched by ``thickness * distance / range^2``
along the line to it. Its photon noise is then larger along that line, and x and y of a sub-aperture go together
(section 3.1.3). The layer is taken to be Gaussian and the spot to fit into the sub-aperture's field.

A covariance measured on the sensor itself, from a file, takes the place of all this.
"""

from __future__ import annotations

import math
import zipfile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solve_triangular

from srtomo_core.layout import SensorLayout
from srtomo_core.system import Sensor, System

Array = NDArray[np.float64]

_FWHM_PER_SIGMA = 2.355
_SYMMETRIC = 1e-6  # how far a measured covariance may be from it, of its largest entry


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
    return read_noise(sensor.noise_covariance, layout.n_slopes)


def read_noise(path: str, n_slopes: int) -> MeasuredNoise:
    """Read ``covariance`` (n_slopes, n_slopes), rad^2, all x then all y, of one frame, from an ``.npz`` file.

    Raises:
        ValueError: in one line, what is wrong with it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            covariance = np.asarray(file["covariance"], dtype=np.float64)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except (KeyError, TypeError, ValueError, zipfile.BadZipFile):
        raise ValueError(f"{path}: expected an .npz file with numbers in 'covariance'") from None
    if covariance.shape != (n_slopes, n_slopes):
        raise ValueError(f"{path}: covariance: expected shape {(n_slopes, n_slopes)}, got {covariance.shape}")
    if not np.abs(covariance - covariance.T).max() <= _SYMMETRIC * np.abs(covariance).max() < math.inf:
        raise ValueError(f"{path}: covariance: expected finite numbers, symmetric")
    covariance = (covariance + covariance.T) / 2
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise ValueError(f"{path}: covariance: expected positive definite; are there frames enough?") from None
    return MeasuredNoise(covariance)


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


def _two_by_two(xx: Array, xy: Array, yx: Array, yy: Array) -> sparse.csr_array:
    """Each (n_valid,), on four diagonals; zeros are not kept."""
    n = len(xx)
    matrix = sparse.diags_array([np.concatenate([xx, yy]), xy, yx], offsets=[0, n, -n], shape=(2 * n, 2 * n))
    matrix = sparse.csr_array(matrix)
    matrix.eliminate_zeros()
    return matrix
