from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma, j0

from srtomo_core.system import load_system
from srtomo_srtc.atmosphere import (
    METRES_PER_RADIAN,
    CovarianceTable,
    Profile,
    covariance,
    structure_function,
)


def test_covariance_has_its_closed_forms() -> None:
    assert covariance(0.0, 0.15, 25.0) == pytest.approx(0.08631432991183458 * (25 / 0.15) ** (5 / 3), rel=1e-12)
    assert covariance([1.0, 10.0], 0.15, 25.0) == pytest.approx([395.253952, 64.46805737], rel=1e-8)


def test_covariance_at_long_baselines_decays() -> None:
    # a truncated power series of K_5/6 is wrong by orders of magnitude here
    assert covariance(40.0, 0.15, 25.0) == pytest.approx(_covariance_from_spectrum(40.0, 0.15, 25.0), rel=1e-3)


def test_structure_function_tends_to_kolmogorov() -> None:
    # D = 6.88 (rho/r0)^(5/3) (1 - c (rho/L0)^(1/3) + ...): eight times L0 halves the second term, so it cancels
    rho, r0 = 0.1, 0.15
    limit = 2 * structure_function(rho, r0, 8e3 * rho) - structure_function(rho, r0, 1e3 * rho)
    assert limit == pytest.approx(6.88387718229381 * (rho / r0) ** (5 / 3), rel=1e-4)


@pytest.mark.parametrize("rho", [0.05, 0.4, 3.0])
def test_structure_function_is_that_of_the_spectrum(rho: float) -> None:
    expected = 2 * (_covariance_from_spectrum(0.0, 0.16, 25.0) - _covariance_from_spectrum(rho, 0.16, 25.0))
    assert structure_function(rho, 0.16, 25.0) == pytest.approx(expected, rel=1e-3)


def _covariance_from_spectrum(rho: float, r0: float, outer_scale: float) -> float:
    """2 pi integral of W(f) J0(2 pi f rho) f df with von Karman's W, up to frequencies that do not matter."""
    constant = gamma(11 / 6) ** 2 / (2 * np.pi ** (11 / 3)) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)

    def integrand(f: float) -> float:
        return (
            2 * np.pi * constant * r0 ** (-5 / 3) * (f * f + outer_scale**-2) ** (-11 / 6) * j0(2 * np.pi * f * rho) * f
        )

    edges = np.concatenate([[0], np.geomspace(1e-3, 2e3, 60)])
    if rho > 0:  # whole oscillations of J0
        edges = np.unique(np.concatenate([edges[edges < 0.5 / rho], np.arange(0.5, 200, 0.5) / rho]))
    return sum(quad(integrand, a, b, epsabs=1e-9, epsrel=1e-9)[0] for a, b in pairwise(edges))


def test_table_is_as_good_as_it_says() -> None:
    rho = np.random.default_rng(1).uniform(0, 20, 5000)
    rho[:2500] = 10 ** (-5 + 6 * rho[:2500] / 20)
    table = CovarianceTable.build(0.15, 30.0, reach=20.0)
    exact = structure_function(rho, 0.15, 30.0)
    found = -2 * table(rho) / METRES_PER_RADIAN**2
    far = rho > 0.2
    assert np.abs(found / exact - 1)[far].max() < 1e-6
    assert np.abs(found - exact)[~far].max() < 1e-4


def test_table_reaches_its_reach() -> None:
    table = CovarianceTable.build(0.15, 30.0, reach=1.0)
    assert table(1.0) == pytest.approx(-0.5 * METRES_PER_RADIAN**2 * structure_function(1.0, 0.15, 30.0), rel=1e-6)


def test_profile_is_along_the_line_of_sight() -> None:
    system = load_system(
        "mini", {"zenith_angle": "60 deg", "atmosphere.layers.1.fraction": 0.0, "atmosphere.layers.0.fraction": 0.85}
    )
    profile = Profile.of(system)
    assert profile.r0 == pytest.approx(0.16 * 0.5**0.6)
    assert profile.heights == pytest.approx([0.0, 20000.0])
    assert profile.fractions == pytest.approx([0.85, 0.15])
