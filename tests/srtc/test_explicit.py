"""The explicit reconstructor: its forms against each other and against the implicit one."""

import json
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc import memory
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import (
    Sightline,
    Turbulence,
    slope_covariance,
    slope_wavefront_covariance,
    wavefront_covariance,
)
from srtomo_srtc.estimator import estimator
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.layer_estimate import covariance_form, information_form
from srtomo_srtc.layer_prior import exact_covariance, exact_inverse
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.raytrace import LayerGrid, layer_grids, propagation
from srtomo_srtc.reconstructors.explicit import explicit
from srtomo_srtc.reconstructors.implicit import implicit


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def _matrix(system: System, **options: object) -> np.ndarray:
    return explicit(system, **options)[0].R[0].astype(np.float64)  # type: ignore[arg-type]


class Problem(NamedTuple):
    """Slopes of layer nodes, and what is wanted of the layers in the pupil."""

    profile: Profile
    sensors: list[Sightline]
    grids: list[LayerGrid]
    T_alpha: list[sparse.csr_array]
    H: sparse.csr_array
    T_beta: sparse.csr_array
    noise: np.ndarray
    blind: np.ndarray


def _problem(system: System, step: float) -> Problem:
    layout, profile = Layout(system), Profile.of(system)
    sensors = sightlines(system, layout, profile)
    _, points = next(Fit(system, layout).footprints(profile.heights))
    grids = layer_grids([points, *(s.nodes for s in sensors)], [step] * len(profile.heights))
    T = [propagation(grids, s.nodes) for s in sensors]
    H = sparse.vstack([s.gradient @ t for s, t in zip(sensors, T)], format="csr")
    noise, blind = noise_covariance(system, layout, 1.0).diagonal(), blind_modes(system, layout)
    return Problem(profile, sensors, grids, T, H, propagation(grids, points), noise, blind)


# --- identities -----------------------------------------------------------------------------------------------------


def test_both_forms_of_eq_13_are_one_matrix(mini: System) -> None:
    problem = _problem(mini, 0.3)
    everything = np.eye(problem.H.shape[1])
    layers = list(enumerate(problem.grids))
    first = covariance_form(
        everything,
        problem.H,
        [exact_covariance(grid, problem.profile, l) for l, grid in layers],
        sparse.diags_array(problem.noise),
        problem.blind,
    )
    second = information_form(
        everything,
        problem.H,
        [exact_inverse(grid, problem.profile, l) for l, grid in layers],
        sparse.diags_array(1 / problem.noise),
        problem.blind,
    )
    # the constants of the layers are seen by nobody: only the prior, which is the same, says anything about them
    assert _relative(second, first) < 1e-8
    # neither form sees what lasers are blind to
    assert np.abs(second @ problem.blind).max() < 1e-8 * np.linalg.norm(second, axis=1).max()


def test_both_forms_with_correlated_noise(mini: System) -> None:
    """2 x 2 blocks of x and y, as those of elongated spots."""
    problem = _problem(mini, 0.5)
    layout = Layout(mini)
    noise = sparse.diags_array(problem.noise).tolil()
    for w, place in enumerate(layout.sensors[:3]):
        x = layout.slopes_of(w).start + np.arange(place.n_valid)
        y = x + place.n_valid
        noise[x, y] = noise[y, x] = 0.6 * np.sqrt(problem.noise[x] * problem.noise[y])
    precision = sparse.csr_array(np.linalg.inv(noise.toarray()))
    rows = problem.T_beta.toarray()
    layers = list(enumerate(problem.grids))
    first = covariance_form(
        rows,
        problem.H,
        [exact_covariance(grid, problem.profile, l) for l, grid in layers],
        noise.tocsr(),
        problem.blind,
    )
    second = information_form(
        rows,
        problem.H,
        [exact_inverse(grid, problem.profile, l) for l, grid in layers],
        precision,
        problem.blind,
    )
    assert _relative(second, first) < 1e-8


def test_implicit_is_the_layers_seen_towards_the_target_on_one_grid(mini: System) -> None:
    """``W_SA = T_beta W_L`` (eq. 14), with W_SA from pupil-plane covariances alone."""
    problem = _problem(
        mini.with_changes({"atmosphere.layers": [mini.atmosphere.layers[2].model_dump() | {"fraction": 1.0}]}), 0.25
    )
    (grid,) = problem.grids
    Sigma = exact_covariance(grid, problem.profile, 0)
    G = sparse.block_diag([s.gradient for s in problem.sensors]).tocsr()
    T_alpha = sparse.vstack(problem.T_alpha).toarray()
    phases = T_alpha @ Sigma @ T_alpha.T
    S = G @ (G @ phases).T + np.diag(problem.noise)
    cross = G @ (T_alpha @ Sigma @ problem.T_beta.T)
    W_SA = estimator(S, cross, problem.blind).T
    W_L = information_form(
        np.eye(grid.n_nodes),
        problem.H,
        [exact_inverse(grid, problem.profile, 0)],
        sparse.diags_array(1 / problem.noise),
        problem.blind,
    )
    assert _relative(problem.T_beta @ W_L, W_SA) < 1e-8


def test_nodes_at_the_rays_own_intercepts_make_the_explicit_reconstructor_the_implicit_one(mini: System) -> None:
    system = mini.with_changes({"mirrors.0.actuators": 7})  # fewer points in the fit
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    targets = list(fit.footprints(profile.heights))
    everyone = [*(s.nodes for s in sensors), *(points for _, points in targets)]
    turbulence = Turbulence.covering(profile, everyone)
    noise, blind = noise_covariance(system, layout, 1.0).diagonal(), blind_modes(system, layout)

    S = slope_covariance(turbulence, sensors)
    S[np.diag_indices_from(S)] += noise
    cross = sum(slope_wavefront_covariance(turbulence, sensors, points) @ view.projection.T for view, points in targets)
    spatio_angular = fit.solve(estimator(S, np.asarray(cross), blind).T)

    # every ray has a node of its own on every layer: T picks them
    ends = np.cumsum([rays.x.shape[1] for rays in everyone])
    nodes = sparse.eye_array(ends[-1], format="csr")
    picks = [
        sparse.hstack([part] * len(profile.heights), format="csr")
        for part in (nodes[e - rays.x.shape[1] : e] for e, rays in zip(ends, everyone))
    ]
    H = sparse.vstack([s.gradient @ T for s, T in zip(sensors, picks)], format="csr")
    wanted = fit.solve(sum(view.projection @ T for (view, _), T in zip(targets, picks[len(sensors) :])))
    layers = []
    for l in range(len(profile.heights)):
        x, y = (np.concatenate([getattr(rays, axis)[l] for rays in everyone]) for axis in "xy")
        own = Footprints(x[None], y[None])
        one = replace(turbulence, fractions=turbulence.fractions[l : l + 1])
        layers.append(wavefront_covariance(one, own, own))
    layered = covariance_form(wanted, H, layers, sparse.diags_array(noise), blind)
    assert _relative(layered, spatio_angular) < 1e-8


def test_finer_grids_come_nearer_to_the_implicit_reconstructor(mini: System) -> None:
    reference = implicit(mini)[0].R[0].astype(float)
    half, quarter = (_relative(_matrix(mini, oversampling=n), reference) for n in (2, 4))
    assert quarter < 0.5 * half
    assert 0.05 < half < 0.4


def test_over_sampling_goes_by_layer(mini: System) -> None:
    reconstructor, _ = explicit(mini, oversampling=(4, 2, 1))
    assert reconstructor.provenance["grid_steps_m"] == [0.125, 0.25, 0.5]
    uniform, _ = explicit(mini, oversampling=(2.0, 2.0, 2.0))
    assert np.array_equal(uniform.R, explicit(mini)[0].R)


# --- solvers --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prior", ["exact", "laplacian"])
def test_conjugate_gradients_reach_the_factorisation(mini: System, prior: str) -> None:
    direct = _matrix(mini, prior=prior, form="information", oversampling=1)
    assert _relative(_matrix(mini, prior=prior, solver="cg", oversampling=1, tolerance=1e-8), direct) < 1e-6


def test_the_sparse_prior_is_nearly_as_good_as_the_exact_one(mini: System) -> None:
    exact, sparse_prior = _matrix(mini), _matrix(mini, prior="laplacian")
    assert 1e-3 < _relative(sparse_prior, exact) < 0.15


def test_systems_without_blind_stars_or_long_rows(mini: System) -> None:
    lasers = {
        "sensors": [s.model_dump() for s in mini.sensors[:3]],
        "guide_stars": [s.model_dump() | {"tip_tilt": "seen"} for s in mini.guide_stars[:3]],
    }
    trusted = mini.with_changes(lasers)
    assert _relative(_matrix(trusted, form="information"), _matrix(trusted)) < 1e-6
    blind = trusted.with_changes({"guide_stars.*.tip_tilt": "blind"})
    assert _relative(_matrix(blind, form="information"), _matrix(blind)) < 1e-6
    R = _matrix(blind, prior="laplacian")
    assert np.abs(R @ blind_modes(blind, Layout(blind))).max() < 1e-6 * np.linalg.norm(R, axis=1).max()


# --- arguments ------------------------------------------------------------------------------------------------------


def test_options_that_exclude_each_other_are_refused(mini: System) -> None:
    for options in ({"prior": "laplacian"}, {"solver": "cg"}):
        with pytest.raises(ValueError, match="form: covariance goes with the exact prior and the direct solver"):
            explicit(mini, form="covariance", **options)  # type: ignore[arg-type]
    for oversampling in (0, (2, 2), (2, 2, float("nan"))):
        with pytest.raises(ValueError, match="oversampling: expected a positive number, or 3"):
            explicit(mini, oversampling=oversampling)
    with pytest.raises(ValueError, match="layout: expected the slopes and commands of the system"):
        explicit(mini, Layout(mini.with_changes({"sensors.0.illumination_threshold": 0.9})))


def test_what_does_not_fit_is_refused_beforehand(mini: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 1e6)
    stages: list[str] = []
    with pytest.raises(MemoryError, match=r"explicit information form on \d+ nodes: needs 0\.\d GiB of memory"):
        explicit(mini, prior="laplacian", progress=lambda stage, done: stages.append(stage))
    assert stages == ["geometry"]


def test_progress_and_provenance(mini: System) -> None:
    seen: list[tuple[str, float]] = []
    reconstructor, G = explicit(
        mini, label="test", prior="laplacian", progress=lambda stage, done: seen.append((stage, done))
    )
    shares = [done for _, done in seen]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    provenance = json.loads(json.dumps(dict(reconstructor.provenance)))
    assert [provenance[key] for key in ("method", "prior", "form", "solver")] == [
        "explicit",
        "laplacian",
        "information",
        "direct",
    ]
    assert reconstructor.fingerprint == Layout(mini).fingerprint
    assert reconstructor.gain == mini.loop.gain
    np.testing.assert_allclose(reconstructor.Q[0], reconstructor.R[0] @ G, atol=1e-5)
