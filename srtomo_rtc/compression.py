"""What 16 bits cost, against what the sensors' noise costs anyway."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_rtc.vmm import quantise

INT16_LIMIT = 0.1
"""Of :func:`int16_to_noise`: above it 16 bits are refused. In quadrature, a tenth adds half a percent."""

_FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))


def int16_to_noise(system: System, layout: Layout, R: NDArray[np.floating]) -> float:
    """Rms error that 16 bits leave in R y, over the rms that photon noise leaves in it; all commands together.

    Slopes are taken as they are without a mirror, which no closed loop exceeds in the long run: the mean tilt of a
    sub-aperture of side d has a variance of ``0.170 (lambda/d)^2 (d/r0)^(5/3)`` an axis (Kolmogorov; the outer scale
    makes it less), plus noise. Of noise, a sensor has at least its photons': ``(fwhm / 2.355)^2 excess^2 / N``. Sensors
    are scaled each on its own, as the loop does.

    Args:
        R: (n_commands, n_slopes), m/rad.

    Raises:
        ValueError: R cannot be held in 16 bits.
    """
    error = noise = 0.0
    for w, (sensor, own) in enumerate(zip(system.sensors, layout.sensors, strict=True)):
        block = R[:, layout.slopes_of(w)].astype(np.float64)
        integers, scales = quantise(block)
        electrons = sensor.photons * own.size**2 * own.illumination / system.loop.rate
        photon = np.tile((sensor.spot_fwhm / _FWHM_PER_SIGMA * sensor.excess_noise) ** 2 / electrons, 2)
        tilt = 0.170 * (500e-9 / own.size) ** 2 * (own.size / system.los_r0) ** (5 / 3)
        error += float(np.sum((integers * scales.astype(np.float64)[:, None] - block) ** 2 @ (photon + tilt)))
        noise += float(np.sum(block**2 @ photon))
    return math.sqrt(error / noise) if noise else 0.0
