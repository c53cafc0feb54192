"""Modes: what Karhunen-Loeve means, and that a complete set of them changes nothing."""

from itertools import pairwise

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile, covariance
from srtomo_srtc.covariance import Turbulence, slope_covariance, slope_wavefront_covariance
from srtomo_srtc.estimator import commands_from
from srtomo_srtc.fitting import Fit
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.reconstructors import implicit
from srtomo_srtc.reconstructors.modal import LayerModes, karhunen_loeve, modal, reconstruct


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def test_modes_are_independent_and_without_piston() -> None:
    x, y = np.meshgrid(np.arange(7) * 0.3, np.arange(6) * 0.3)
    rho = np.hypot(*(np.subtract.outer(axis.ravel(), axis.ravel()) for axis in (x, y)))
    C = covariance(rho, 0.15, 25.0)
    modes, variances = karhunen_loeve(C)
    n = len(C)
    assert modes.shape == (n, n - 1)
    np.testing.assert_allclose(modes.T @ modes, np.eye(n - 1), atol=1e-10)
    np.testing.assert_allclose(modes.sum(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(modes.T @ C @ modes, np.diag(variances), atol=1e-9 * C[0, 0])
    assert np.all(np.diff(variances) <= 0)
    # a constant more, as tables of C(rho) - C(0) have it, is piston
    few, largest = karhunen_loeve(C - C[0, 0], kept=0.25)
    np.testing.assert_allclose(largest, variances[: len(largest)], rtol=1e-9)
    assert few.shape == (n, 10)


def test_a_complete_basis_is_the_zonal_estimate(mini: System) -> None:
    """All modes of every layer's wavefront at the rays' own intercepts: eq. 14 in other coordinates."""
    system = mini.with_changes(
        {
            "sensors": [s.model_dump() | {"subapertures": min(s.subapertures, 4)} for s in mini.sensors],
            "mirrors.0.actuators": 5,
            "atmosphere.layers": [
                layer.model_dump() | {"fraction": fraction}
                for layer, fraction in zip(mini.atmosphere.layers[:2], (0.7, 0.3))
            ],
        }
    )
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    targets = list(fit.footprints(profile.heights))
    points = [*(s.nodes for s in sensors), *(p for _, p in targets)]
    turbulence = Turbulence.covering(profile, points)
    noise, blind = noise_covariance(system, layout, 0.5), blind_modes(system, layout)

    starts = np.cumsum([0] + [p.x.shape[1] for p in points])
    layers = []
    for layer in range(2):
        x, y = np.concatenate([p.x[layer] for p in points]), np.concatenate([p.y[layer] for p in points])
        rho = np.hypot(np.subtract.outer(x, x), np.subtract.outer(y, y))
        modes, variances = karhunen_loeve(profile.fractions[layer] * turbulence.table(rho))
        rows = [modes[first:last] for first, last in pairwise(starts)]
        slopes = np.concatenate([s.gradient @ part for s, part in zip(sensors, rows)])
        wavefronts = sum(view.projection @ part for (view, _), part in zip(targets, rows[len(sensors) :]))
        layers.append(LayerModes(variances, slopes, wavefronts))
    R = reconstruct(layers, noise, layout.n_commands, blind, fit)

    S = slope_covariance(turbulence, sensors) + noise.toarray()
    right = sum(slope_wavefront_covariance(turbulence, sensors, p) @ view.projection.T for view, p in targets)
    zonal = commands_from(S, right, blind, fit.solve, None, noise)
    np.testing.assert_allclose(R, zonal, atol=1e-8 * np.abs(zonal).max())
    assert np.abs(zonal - implicit(system)[0].R[0]).max() < 1e-6 * np.abs(zonal).max()


def test_finer_virtual_mirrors_come_closer_to_the_zonal_estimate(mini: System) -> None:
    R = implicit(mini)[0].R[0]
    apart = [np.linalg.norm(modal(mini, pitch_factor=factor)[0].R[0] - R) for factor in (0.75, 1.0, 1.5, 2.0)]
    assert np.all(np.diff(apart) < 0)
    assert apart[-1] < 0.2 * np.linalg.norm(R)


@pytest.mark.parametrize(
    ("keyword", "value", "message"),
    [("pitch_factor", 0.0, "pitch_factor: expected above 0"), ("kept", 1.5, "kept: expected above 0 and at most 1")],
)
def test_parameters_out_of_range_are_refused(mini: System, keyword: str, value: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        modal(mini, **{keyword: value})  # type: ignore[arg-type]
