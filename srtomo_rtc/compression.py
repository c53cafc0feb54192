"""What a compressed R costs, against what the sensors' noise costs anyway.

Any thread may call any of these but the loop's, which they would hold up.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_rtc.vmm import quantise

LIMIT = 0.1
"""Of :func:`int16_to_noise` and :func:`error_to_noise`: above it a compressed R is refused. In quadrature, a tenth adds
half a percent."""

Array = NDArray[np.float64]

_FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))


class SlopeStatistics:
    """Variances and covariances of one sensor's slopes, rad^2, as they are without a mirror.

    No closed loop exceeds them in the long run. Turbulence: a sub-aperture's slope is taken as the difference of phase
    between the middles of two opposite sides, whose covariances the structure function ``6.88 (r/r0)^(5/3)``
    (Kolmogorov) gives in closed form; the variance is then ``0.174 (lambda/d)^2 (d/r0)^(5/3)``, 3 % more than that of
    the mean slope. An outer scale makes all of it less. Noise: at least the photons' is there,
    ``(fwhm / 2.355)^2 excess^2 / N`` an axis.
    """

    def __init__(self, system: System, layout: Layout) -> None:
        self._system, self._layout = system, layout

    def photons(self, sensor: int) -> Array:
        """(n_valid,) variance that photon noise gives each of a sub-aperture's slopes."""
        of, own = self._system.sensors[sensor], self._layout.sensors[sensor]
        electrons = of.photons * own.size**2 * own.illumination / self._system.loop.rate
        return np.asarray((of.spot_fwhm / _FWHM_PER_SIGMA * of.excess_noise) ** 2 / electrons)

    def covariance(self, sensor: int, subapertures: NDArray[np.intp]) -> Array:
        """(2 n, 2 n) of some sub-apertures' slopes, x0 y0 x1 y1 ..., noise included."""
        own = self._layout.sensors[sensor]
        y, x = (places[subapertures] for places in np.nonzero(own.mask))
        middle = len(own.mask) - 1
        table = _tilt_covariances(len(own.mask), own.size, self._system.los_r0)
        pairs = table[:, :, y[:, None] - y + middle, x[:, None] - x + middle]
        found = pairs.transpose(2, 0, 3, 1).reshape(2 * len(x), 2 * len(x))
        return found + np.diag(np.repeat(self.photons(sensor)[subapertures], 2))


def _tilt_covariances(n: int, d: float, r0: float) -> Array:
    """(2, 2, 2n - 1, 2n - 1): of slope a of one and slope b of another sub-aperture, by how far apart they are along y
    and x, from -(n - 1) to n - 1 sides; rad^2."""
    steps = np.arange(1 - n, n) * d
    y, x = np.meshgrid(steps, steps, indexing="ij")
    half = (d / 2, 0.0), (0.0, d / 2)

    def structure(dx: float, dy: float) -> Array:
        return np.asarray(6.88387718 * (np.hypot(x + dx, y + dy) / r0) ** (5 / 3))

    def covariance(a: tuple[float, float], b: tuple[float, float]) -> Array:
        (ax, ay), (bx, by) = a, b
        outer = structure(ax + bx, ay + by) + structure(-ax - bx, -ay - by)
        return (outer - structure(ax - bx, ay - by) - structure(bx - ax, by - ay)) / 2

    return (500e-9 / (2 * np.pi * d)) ** 2 * np.array([[covariance(a, b) for b in half] for a in half])


def error_to_noise(system: System, layout: Layout, R: NDArray[np.floating], applied: NDArray[np.floating]) -> float:
    """Rms error that ``applied`` instead of R leaves in R y, over the rms that photon noise leaves in it; all commands.

    With the correlations of all slopes of a sensor (:class:`SlopeStatistics`), which an error that has a shape does not
    average out; not with those from sensor to sensor.

    Args:
        R, applied: (n_commands, n_slopes), m/rad.
    """
    statistics = SlopeStatistics(system, layout)
    error = noise = 0.0
    for w, own in enumerate(layout.sensors):
        columns = layout.slopes_of(w)
        block = R[:, columns].astype(np.float64)
        wrong = (applied[:, columns] - block).reshape(len(R), 2, -1).transpose(0, 2, 1).reshape(len(R), -1)
        half = np.linalg.cholesky(statistics.covariance(w, np.arange(own.n_valid)))
        error += float(np.sum((wrong.astype(np.float32) @ half.astype(np.float32)).astype(np.float64) ** 2))
        noise += float(np.sum(block**2 @ np.tile(statistics.photons(w), 2)))
    return math.sqrt(error / noise) if noise else 0.0


def int16_to_noise(system: System, layout: Layout, R: NDArray[np.floating]) -> float:
    """Rms error that 16 bits leave in R y, over the rms that photon noise leaves in it; all commands together.

    Slopes are taken as they are without a mirror, which no closed loop exceeds in the long run: the mean tilt of a
    sub-aperture of side d has a variance of ``0.170 (lambda/d)^2 (d/r0)^(5/3)`` an axis (Kolmogorov; the outer scale
    makes it less), plus noise; rounding errors are as good as random, and correlations average out. Of noise, a sensor
    has at least its photons' (:class:`SlopeStatistics`). Sensors are scaled each on its own, as the loop does.

    Args:
        R: (n_commands, n_slopes), m/rad.

    Raises:
        ValueError: R cannot be held in 16 bits.
    """
    statistics = SlopeStatistics(system, layout)
    error = noise = 0.0
    for w, own in enumerate(layout.sensors):
        block = R[:, layout.slopes_of(w)].astype(np.float64)
        integers, scales = quantise(block)
        photon = np.tile(statistics.photons(w), 2)
        tilt = 0.170 * (500e-9 / own.size) ** 2 * (own.size / system.los_r0) ** (5 / 3)
        error += float(np.sum((integers * scales.astype(np.float64)[:, None] - block) ** 2 @ (photon + tilt)))
        noise += float(np.sum(block**2 @ photon))
    return math.sqrt(error / noise) if noise else 0.0
