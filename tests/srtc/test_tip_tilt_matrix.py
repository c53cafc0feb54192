"""Reconstructors for tip-tilt in a loop of its own: what each loop answers for, method by method."""

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, noise_covariance
from srtomo_srtc.reconstructors import METHODS, implicit, moao
from srtomo_srtc.tip_tilt import tip_tilt_matrix

STARS = (1, 4, 5)


@pytest.fixture(scope="module")
def system():
    return load_system("mini_tip_tilt")


@pytest.fixture(scope="module")
def layout(system):
    return Layout(system)


def slopes_of_stars(layout):
    own = np.zeros(layout.n_slopes, bool)
    for w in STARS:
        own[layout.slopes_of(w)] = True
    return own


def tilts(layout):
    """(n_slopes, 2) what the stars' sensors see of a tip and of a tilt along the pupil's axes."""
    out = np.zeros((layout.n_slopes, 2))
    for w in STARS:
        place = layout.sensors[w]
        c, s = np.cos(-place.rotation), np.sin(-place.rotation)
        out[layout.slopes_of(w)] = np.repeat([[c, -s], [s, c]], place.n_valid, axis=0)
    return out


@pytest.mark.parametrize("method", ["implicit", "explicit", "glao", "least_squares", "modal", "predictive"])
def test_each_loop_answers_for_its_own(system, layout, method):
    reconstructor, G = METHODS[method](system)
    own, tilt = slopes_of_stars(layout), tilts(layout)
    assert reconstructor.fingerprint == layout.fingerprint
    R = reconstructor.parts[-1][0].astype(float)  # the one for the newest exposure alone, if there are several
    # what the stars' loop makes of a tilt is that tilt as they see it, and nothing else
    mean = np.linalg.lstsq(tilt[own], (G @ R[:, own] @ tilt[own])[own], rcond=None)[0]
    np.testing.assert_allclose(mean, np.eye(2), atol=0.02)
    # to the other sensors it is little but a tilt, which they are blind to
    seen = (G @ R[:, own] @ tilt[own])[~own]
    blind = blind_modes(system, layout)[~own]
    assert np.linalg.norm(seen - blind @ (blind.T @ seen)) < 0.15 * np.linalg.norm(seen)
    # and of what those see nothing comes to the stars' mean
    stars_mean = R[:, own] @ (G @ R[:, ~own])[own]
    assert np.linalg.norm(stars_mean) < 1e-5 * np.linalg.norm(R[:, ~own])
    for R_j, Q_j in reconstructor.parts:
        high = np.where(own, 0, R_j.astype(float))
        np.testing.assert_allclose(Q_j, high @ G, atol=1e-5 * np.abs(Q_j).max())


def test_stars_count_by_their_noise(system, layout):
    """The noise of a mean with these weights is the least: 1 over the sum of the stars' information."""
    R = tip_tilt_matrix(system, layout, interaction_matrix(system, layout))
    noise = noise_covariance(system, layout, 1.0).toarray()  # gain 1: as measured
    information = 0.0
    for w in STARS:
        own = layout.slopes_of(w)
        information += layout.sensors[w].n_valid / np.trace(noise[own, own]) * 2 * layout.sensors[w].n_valid
    made = R @ noise @ R.T
    unit = R @ tilts(layout)[:, :1]
    assert np.trace(made) / np.linalg.norm(unit) ** 2 == pytest.approx(2 / information, rel=0.02)


def test_what_it_is_not_for(system):
    with pytest.raises(ValueError, match="no sensor does"):
        moao(system)
    with pytest.raises(ValueError, match="blind to focus"):
        implicit(system.with_changes({"guide_stars.0.focus": "blind"}))
