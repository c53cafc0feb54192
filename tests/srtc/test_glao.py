"""Ground-layer correction: means over stars, and the limit in which the tomographic estimate becomes one."""

import math

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_core.units import ARCSEC
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance, slope_wavefront_covariance
from srtomo_srtc.estimator import commands_from
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import pupil_grid
from srtomo_srtc.mirrors import mirror_wavefronts
from srtomo_srtc.model import noise_covariance, sightlines
from srtomo_srtc.reconstructors.glao import glao, over_field


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def _natural(mini: System, positions: list[tuple[float, float]], sensors: list[int]) -> System:
    """The instrument with natural stars on some of its laser sensors, each star a science target too."""
    places = [{"x": x, "y": y} for x, y in positions]
    stars = [{"name": f"lgs{i + 1}", "kind": "natural", "position": place} for i, place in zip(sensors, places)]
    return mini.with_changes(
        {
            "guide_stars": stars,
            "sensors": [mini.sensors[i].model_dump() for i in sensors],
            "science.targets": [{"position": place} for place in places],
        }
    )


def _implicit(system: System) -> np.ndarray:
    """Eq. 19 in float64."""
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    targets = list(fit.footprints(profile.heights))
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *(points for _, points in targets)])
    noise = noise_covariance(system, layout, 0.5)
    right = sum(slope_wavefront_covariance(turbulence, sensors, p) @ view.projection.T for view, p in targets)
    S = slope_covariance(turbulence, sensors) + noise.toarray()
    return commands_from(S, right, np.zeros((len(S), 0)), fit.solve, None, noise)


def test_stars_that_share_nothing_are_averaged(mini: System) -> None:
    """beta = alpha, equal weights, no covariance between stars: the mean of the single-star estimates."""
    high = mini.atmosphere.layers[2].model_dump() | {"fraction": 1.0}
    # 50 m apart on the layer, 50 outer scales: what is left of the covariance is below 1e-100
    sky = mini.with_changes({"atmosphere.layers": [high], "atmosphere.outer_scale": 1.0})
    positions = [(0.0, 0.0), (1000 * ARCSEC, 200 * ARCSEC), (-300 * ARCSEC, 900 * ARCSEC)]
    together = _implicit(_natural(sky, positions, [0, 1, 2]))
    alone = [_implicit(_natural(sky, [position], [i])) for i, position in enumerate(positions)]
    np.testing.assert_allclose(together, np.hstack(alone) / 3, atol=1e-10 * np.abs(together).max())
    # and a shared ground layer makes it something else
    mixed = [mini.atmosphere.layers[0].model_dump() | {"fraction": 0.5}, high | {"fraction": 0.5}]
    sky = sky.with_changes({"atmosphere.layers": mixed})
    together = _implicit(_natural(sky, positions, [0, 1, 2]))
    alone = [_implicit(_natural(sky, [position], [i])) for i, position in enumerate(positions)]
    assert np.abs(together - np.hstack(alone) / 3).max() > 0.1 * np.abs(together).max()


def test_optical_averaging_is_the_mean_of_the_sensors_inverses(mini: System) -> None:
    positions = [(0.0, 0.0), (20 * ARCSEC, 5 * ARCSEC), (-10 * ARCSEC, 15 * ARCSEC)]
    system = _natural(mini, positions, [0, 1, 2])
    reconstructor, G = glao(system)
    single = [glao(_natural(mini, [position], [i]))[0].R[0] for i, position in enumerate(positions)]
    R = reconstructor.R[0]
    np.testing.assert_allclose(R, np.hstack(single) / 3, atol=1e-6 * np.abs(R).max())
    # with all singular values each sensor is inverted: G G^+ G = G
    own = Layout(system).slopes_of(0)
    inverse = glao(_natural(mini, positions[:1], [0]), cutoff=1e-9)[0].R[0].astype(float)
    np.testing.assert_allclose(G[own] @ inverse @ G[own], G[own], atol=1e-4 * np.abs(G).max())


@pytest.mark.parametrize("averaging", ["optical", "numerical"])
def test_a_shape_on_the_ground_is_seen_at_its_size_by_all_stars(mini: System, averaging: str) -> None:
    """Tip-tilt too, though only one star in four sees it."""
    reconstructor, G = glao(mini, averaging=averaging)  # type: ignore[arg-type]
    layout, grid = Layout(mini), pupil_grid(mini.telescope, 0.1)
    N = mirror_wavefronts(layout, grid.x, grid.y, mini.science.targets[0].position)
    N -= grid.weight @ N
    for shape in (grid.x, grid.y, grid.x**2 + grid.y**2, grid.x * grid.y, grid.x**3):
        commands = np.linalg.lstsq(N, shape - grid.weight @ shape, rcond=1e-4)[0]
        before, after = N @ commands, N @ (reconstructor.R[0] @ (G @ commands))
        assert (grid.weight * before) @ after / ((grid.weight * before) @ before) == pytest.approx(1, abs=0.06)


def test_directions_fill_the_field(mini: System) -> None:
    targets = over_field(mini, 30 * ARCSEC, 200).science.targets
    radius = np.hypot([t.position.x for t in targets], [t.position.y for t in targets]) / (30 * ARCSEC)
    # a uniform disc: mean square radius 1/2, mean radius 2/3
    assert np.mean(radius**2) == pytest.approx(1 / 2, abs=1e-3)
    assert np.mean(radius) == pytest.approx(2 / 3, abs=1e-3)
    assert abs(np.mean([t.position.x for t in targets])) < 0.01 * 30 * ARCSEC
    stars = [math.hypot(star.position.x, star.position.y) for star in mini.guide_stars]
    reach = [math.hypot(t.position.x, t.position.y) for t in over_field(mini).science.targets]
    assert 0.9 * max(stars) < max(reach) < max(stars)
