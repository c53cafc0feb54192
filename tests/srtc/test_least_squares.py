"""Least squares on the tomographic interaction matrix: it inverts what it was built on, and weights by the noise."""

import json

import numpy as np
import pytest
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.model import blind_modes, noise_covariance
from srtomo_srtc.reconstructors.least_squares import least_squares, weighted_inverse


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def test_commands_come_back_from_noise_free_slopes(mini: System) -> None:
    # 9 actuators across instead of 11: every one of them is seen by some lenslet
    system = mini.with_changes({"mirrors.0.actuators": 9, "mirrors.0.margin": 0.0})
    reconstructor, G = least_squares(system, kappa=1e-9)
    commands = np.random.default_rng(1).standard_normal(Layout(system).n_commands)
    found = reconstructor.R[0].astype(float) @ (G @ commands)
    # all but what makes piston, which is nearly equal commands
    error = found - commands
    level = error.mean()
    assert np.abs(error - level).max() < 0.05 * np.abs(commands).max()
    assert np.linalg.norm(G @ error) < 1e-3 * np.linalg.norm(G @ commands)


def test_blind_modes_are_of_infinite_variance(mini: System) -> None:
    layout = Layout(mini)
    _, G = least_squares(mini)
    variance, blind = noise_covariance(mini, layout, 1.0).diagonal(), blind_modes(mini, layout)
    covariance = np.diag(variance) + 1e6 * variance.max() * blind @ blind.T
    normal = G.T @ np.linalg.solve(covariance, G)
    kappa = 1e-2
    explicit = np.linalg.solve(
        normal + kappa * np.trace(normal) / len(normal) * np.eye(len(normal)), np.linalg.solve(covariance, G).T
    )
    R = weighted_inverse(G, sparse.diags_array(1 / variance), blind, kappa)
    np.testing.assert_allclose(R, explicit, atol=1e-4 * np.abs(R).max())
    assert np.abs(R @ blind).max() < 1e-9 * np.abs(R).max()


def test_a_sensor_in_the_dark_has_no_say(mini: System) -> None:
    layout = Layout(mini)
    dark, _ = least_squares(mini.with_changes({"sensors.1.photons": 1.0}))
    even, _ = least_squares(mini)
    own = layout.slopes_of(1)
    assert np.abs(dark.R[0][:, own]).max() < 1e-4 * np.abs(even.R[0][:, own]).max()


def test_turbulence_plays_no_part(mini: System) -> None:
    windless = mini.with_changes({"atmosphere.r0": 0.1, "atmosphere.outer_scale": 100.0})
    assert np.array_equal(least_squares(mini)[0].R, least_squares(windless)[0].R)


def test_provenance(mini: System) -> None:
    reconstructor, G = least_squares(mini, label="test")
    assert json.loads(json.dumps(reconstructor.provenance))["method"] == "least_squares"
    assert (reconstructor.label, reconstructor.fingerprint) == ("test", Layout(mini).fingerprint)
    np.testing.assert_allclose(reconstructor.Q[0], reconstructor.R[0] @ G, atol=1e-5)
