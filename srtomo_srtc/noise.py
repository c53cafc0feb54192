"""Measurement noise of slopes: photons and read-out, of a centre of gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import SensorLayout
from srtomo_core.system import Sensor

Array = NDArray[np.float64]

_FWHM_PER_SIGMA = 2.355


def slope_variance(sensor: Sensor, layout: SensorLayout, rate: float) -> Array:
    """Variance of each slope, independent of the others, rad^2.

    With N electrons a frame: ``(fwhm / 2.355)^2 excess^2 / N`` from photons and ``ron^2 sum(x^2) / N^2`` from read-out,
    the sum over the sub-aperture's pixels. The spot moves by the wavefront's tilt, angle for angle.

    Args:
        sensor: photons, spot, pixels.
        layout: its sub-apertures and their light.
        rate: frame rate, Hz.

    Returns:
        (n_slopes,) all x then all y.
    """
    electrons = sensor.photons * layout.size**2 * layout.illumination / rate
    photon = (sensor.spot_fwhm / _FWHM_PER_SIGMA * sensor.excess_noise) ** 2 / electrons
    # pixel centres at (i - (n-1)/2) p, n x n of them: mean square (n^2-1)/12 p^2
    squares = sensor.pixels**2 * (sensor.pixels**2 - 1) / 12 * sensor.pixel_scale**2
    return np.tile(photon + sensor.read_noise**2 * squares / electrons**2, 2)
