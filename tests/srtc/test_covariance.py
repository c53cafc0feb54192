from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import dblquad

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import METRES_PER_RADIAN, Profile, covariance, structure_function
from srtomo_srtc.covariance import Turbulence, slope_covariance, slope_wavefront_covariance
from srtomo_srtc.geometry import footprints
from srtomo_srtc.gradient import GradientOperator, gradient_operator
from srtomo_srtc.model import sightlines


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def _assembled(system: System) -> np.ndarray:
    profile = Profile.of(system)
    sensors = sightlines(system, Layout(system), profile)
    return slope_covariance(Turbulence.covering(profile, [s.nodes for s in sensors]), sensors)


@pytest.fixture(scope="module")
def operators(mini: System) -> list[GradientOperator]:
    return [gradient_operator(mini.telescope, place) for place in Layout(mini).sensors]


def _stencil(operator: GradientOperator, slope: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (as x + i y) and weights of one slope."""
    dense = operator.matrix.toarray()[slope]
    used = dense != 0
    return (operator.x + 1j * operator.y)[used], dense[used]


def _direct(system: System, operators: list[GradientOperator], a: tuple[int, int], b: tuple[int, int]) -> float:
    """One covariance by a plain double sum of the exact C over nodes and layers, eq. 23-27 as they stand."""
    total = 0.0
    for layer, fraction in zip(system.atmosphere.layers, system.atmosphere.fractions):
        places = []
        for w, slope in (a, b):
            star = system.star_of(system.sensors[w])
            nodes, weights = _stencil(operators[w], slope)
            xi = 1.0 if star.altitude is None else 1 - layer.altitude / star.altitude
            alpha = star.position.x + 1j * star.position.y
            places.append((xi * nodes + alpha * layer.altitude / np.cos(system.zenith_angle), weights))
        (z_a, w_a), (z_b, w_b) = places
        c = covariance(np.abs(z_a[:, None] - z_b[None, :]), system.los_r0, system.atmosphere.outer_scale)
        total += fraction * w_a @ c @ w_b
    return total * (500e-9 / (2 * np.pi)) ** 2


def test_assembled_matrix_against_direct_sums(mini: System, operators: list[GradientOperator]) -> None:
    S = _assembled(mini)
    starts = Layout(mini).slope_start
    rng = np.random.default_rng(3)
    for i in range(4):
        for j in range(4):  # rotated by different angles, stars at 90 and 85 km and at infinity
            p, q = (int(rng.integers(end - start)) for start, end in (starts[i : i + 2], starts[j : j + 2]))
            scale = np.sqrt(S[starts[i] + p, starts[i] + p] * S[starts[j] + q, starts[j] + q])
            assert S[starts[i] + p, starts[j] + q] == pytest.approx(
                _direct(mini, operators, (i, p), (j, q)), abs=2e-6 * scale
            )


def test_symmetric_positive_and_the_same_bytes_twice(mini: System) -> None:
    S = _assembled(mini)
    assert np.array_equal(S, S.T)
    assert np.linalg.eigvalsh(S).min() > -1e-9 * np.linalg.norm(S, 2)
    assert S.tobytes() == _assembled(mini).tobytes()


def test_slopes_and_wavefront_against_direct_sums(mini: System, operators: list[GradientOperator]) -> None:
    profile = Profile.of(mini)
    sensors = sightlines(mini, Layout(mini), profile)
    x, y = np.array([0.3, -1.1, 1.7]), np.array([0.9, 0.2, -0.4])
    target = mini.science.targets[1].position
    points = footprints(x, y, target, np.inf, profile.heights)
    turbulence = Turbulence.covering(profile, [points, *(s.nodes for s in sensors)])
    found = slope_wavefront_covariance(turbulence, sensors, points)
    starts = Layout(mini).slope_start
    for w, (start, end) in enumerate(pairwise(starts)):
        for slope in (0, (end - start) * 2 // 3):
            nodes, weights = _stencil(operators[w], slope)
            star = mini.star_of(mini.sensors[w])
            expected = np.zeros(3)
            for layer, fraction in zip(mini.atmosphere.layers, mini.atmosphere.fractions):
                h = layer.altitude / np.cos(mini.zenith_angle)
                xi = 1.0 if star.altitude is None else 1 - layer.altitude / star.altitude
                seen = xi * nodes + h * (star.position.x + 1j * star.position.y)
                z = x + 1j * y + h * (target.x + 1j * target.y)
                c = covariance(np.abs(seen[:, None] - z), mini.los_r0, mini.atmosphere.outer_scale)
                expected += fraction * weights @ c
            expected *= METRES_PER_RADIAN**2
            assert found[start + slope] == pytest.approx(expected, abs=1e-5 * np.abs(found[start:end]).max())


def test_stencils_against_true_mean_gradients() -> None:
    # two lit square sub-apertures of side d of one sensor on a ground layer: with A(v) = d - |v| the mean x-gradients
    # covary as int A(v) [C(x-d..) second difference in x] dv / d^4, an integral that knows no nodes
    system = load_system(
        "mini",
        {"atmosphere.layers": [{"altitude": 0.0, "fraction": 1.0, "wind_speed": 5.0, "wind_direction": 0.0}],
         "sensors.*.rotation": 0.0},
    )  # fmt: skip
    S = _assembled(system)
    place = Layout(system).sensors[0]
    d, lit = place.size, np.flatnonzero(place.illumination == 1)
    first = lit[np.argmin(np.hypot(*(place.local[lit] - [-0.8, 0.8]).T))]

    def expected(bx: float, by: float) -> float:
        def integrand(v: float, _: float) -> float:
            D = structure_function(np.hypot([bx - d, bx, bx + d], by + v), system.los_r0, 25.0)
            return (d - abs(v)) * (D[0] - 2 * D[1] + D[2]) / 2 / d**4

        return METRES_PER_RADIAN**2 * dblquad(integrand, 0, 1, -d, d, epsabs=1e-9, epsrel=1e-6)[0]

    variance = expected(0.0, 0.0)
    assert S[first, first] == pytest.approx(variance, rel=0.02)
    for second in lit[::5]:
        bx, by = place.local[second] - place.local[first]
        assert S[first, second] == pytest.approx(expected(bx, by), abs=0.02 * variance)
