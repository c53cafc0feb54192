"""Layered von Karman turbulence: profile along the line of sight, covariance and structure function.

Everything after :class:`Profile` is along the line of sight: r0 has lost its ``cos(z)^0.6`` and heights have gained
their ``sec z``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import factorial, gamma, kv

from srtomo_core.system import System

Array = NDArray[np.float64]

WAVELENGTH = 500e-9
"""Wavelength of r0, m."""

METRES_PER_RADIAN = WAVELENGTH / (2 * math.pi)
"""Optical path of a phase of one radian at 500 nm, m."""

TABLE_STEP = 0.5e-3
"""Grid of :class:`CovarianceTable`, m. Linear interpolation is then good to 1e-6 of D(rho) from rho = 0.2 m on, and to
1e-4 rad^2 at any rho for r0 = 0.15 m."""

_SMOOTH = 3  # degree of the polynomial in rho^2 that takes the place of the covariance's cusp


@dataclass(frozen=True)
class Profile:
    """Turbulence along the line of sight.

    Attributes:
        r0: Fried parameter of the whole path at 500 nm, m.
        outer_scale: m, of every layer.
        heights: (n_layers,) distance to each layer, m.
        fractions: (n_layers,) of the integrated Cn2, all above 0, summing to 1.
    """

    r0: float
    outer_scale: float
    heights: Array
    fractions: Array

    @classmethod
    def of(cls, system: System) -> Profile:
        """The profile of a system's atmosphere; layers without turbulence are left out."""
        fractions = np.array(system.atmosphere.fractions)
        turbulent = fractions > 0
        return cls(
            system.los_r0, system.atmosphere.outer_scale, np.array(system.los_heights)[turbulent], fractions[turbulent]
        )


def covariance(rho: ArrayLike, r0: float, outer_scale: float) -> Array:
    """Covariance C(rho) of von Karman phase, rad^2 at 500 nm (eq. 24-25).

    Args:
        rho: separations, m; any shape.
        r0: Fried parameter, m.
        outer_scale: m.
    """
    z = 2 * np.pi * np.asarray(rho, dtype=np.float64) / outer_scale
    # 2^(1/6) z^(5/6) K_5/6(z) tends to Gamma(5/6) and is 0 times infinity at z = 0
    bessel = np.full(z.shape, gamma(5 / 6))
    apart = z > 0
    bessel[apart] = 2 ** (1 / 6) * z[apart] ** (5 / 6) * kv(5 / 6, z[apart])
    return _variance_factor() * (outer_scale / r0) ** (5 / 3) * bessel


def structure_function(rho: ArrayLike, r0: float, outer_scale: float) -> Array:
    """Structure function D(rho) = 2 (C(0) - C(rho)), rad^2 at 500 nm. Arguments as :func:`covariance`."""
    return 2 * (covariance(0.0, r0, outer_scale) - covariance(rho, r0, outer_scale))


def _variance_factor() -> float:
    """C(0) of eq. 25 over (L0/r0)^(5/3) Gamma(5/6)."""
    return float(gamma(11 / 6) / (2 * np.pi ** (8 / 3)) * (24 / 5 * gamma(6 / 5)) ** (5 / 6))


@dataclass(frozen=True)
class CovarianceTable:
    """C(rho) - C(0) in m^2 of optical path, on a uniform grid of rho, for linear interpolation in compiled loops.

    The constant C(0) never shows in slopes or in piston-removed phase; without it nothing large cancels.

    Attributes:
        r0, outer_scale: as :func:`covariance` takes them, m.
        step: m.
        values: (n,) at rho = 0, step, 2 step, ...
    """

    r0: float
    outer_scale: float
    step: float
    values: Array

    @classmethod
    def build(cls, r0: float, outer_scale: float, reach: float, step: float = TABLE_STEP) -> CovarianceTable:
        """Tabulate from 0 to just beyond ``reach`` (m). Other arguments as :func:`covariance`."""
        rho = step * np.arange(math.ceil(reach / step) + 2)
        values = -0.5 * METRES_PER_RADIAN**2 * structure_function(rho, r0, outer_scale)
        return cls(r0, outer_scale, step, values)

    def split(self, core: float) -> tuple[CovarianceTable, CovarianceTable]:
        """In two that add up to this one: one without the cusp at rho = 0, and one that is 0 from ``core`` (m) on.

        Within the core the first is the covariance's Taylor polynomial in rho^2 about the core's edge.
        """
        n = min(math.ceil(core / self.step), len(self.values))
        edge = 2 * np.pi * core / self.outer_scale
        # of C as a function of z^2: d/d(z^2) z^v K_v(z) = -1/2 z^(v-1) K_(v-1)(z)
        orders = np.arange(_SMOOTH + 1)
        bessel = (-0.5) ** orders * edge ** (5 / 6 - orders) * kv(5 / 6 - orders, edge) / factorial(orders)
        away = (2 * np.pi * self.step * np.arange(n) / self.outer_scale) ** 2 - edge**2
        variance = covariance(0.0, self.r0, self.outer_scale)
        scale = float(variance) / (gamma(5 / 6) / 2 ** (1 / 6))
        polynomial = METRES_PER_RADIAN**2 * (scale * np.polynomial.polynomial.polyval(away, bessel) - variance)
        smooth = np.concatenate([polynomial, self.values[n:]])
        return replace(self, values=smooth), replace(self, values=self.values - smooth)

    def __call__(self, rho: ArrayLike) -> Array:
        """Interpolate as the compiled loops do; ``rho`` up to the table's reach, m."""
        t = np.asarray(rho) / self.step
        i = t.astype(np.int64)
        return self.values[i] + (t - i) * (self.values[i + 1] - self.values[i])
