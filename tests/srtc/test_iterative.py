"""The iterative reconstructor and its products by FFT, against dense matrices."""

import json

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc import memory
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.estimator import estimator
from srtomo_srtc.model import blind_modes, noise_covariance, noise_whitening, sightlines
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.reconstructors.iterative import iterative, solver
from srtomo_srtc.toeplitz import ToeplitzCovariance

ELONGATED = {"guide_stars.0.launch": (2.5, -1.0), "guide_stars.0.sodium_thickness": 50e3}
TURNED_TOGETHER = {
    **{f"sensors.{i}.rotation": 0.11 for i in range(3)},
    "guide_stars.2.altitude": 90e3,
}
"""Changes to mini after which its laser sensors are only shifted against each other, by unequal amounts."""


@pytest.fixture(scope="module")
def shifted() -> System:
    return load_system("mini", TURNED_TOGETHER)


def _operator(system: System) -> ToeplitzCovariance:
    profile = Profile.of(system)
    return ToeplitzCovariance(profile, sightlines(system, Layout(system), profile), [s.name for s in system.sensors])


def _dense(system: System) -> np.ndarray:
    profile = Profile.of(system)
    sensors = sightlines(system, Layout(system), profile)
    return slope_covariance(Turbulence.covering(profile, [s.nodes for s in sensors]), sensors)


def test_product_by_fft_is_the_dense_product(shifted: System) -> None:
    S = _dense(shifted)
    np.testing.assert_allclose(_operator(shifted).product(np.eye(len(S))), S, atol=1e-11 * np.abs(S).max())


def test_sensors_need_not_stand_in_order(shifted: System) -> None:
    changed = shifted.with_changes({"sensors": [shifted.sensors[i].model_dump() for i in (1, 3, 0, 2)]})
    S = _dense(changed)
    slopes = np.random.default_rng(5).normal(size=(len(S), 3))
    np.testing.assert_allclose(_operator(changed).product(slopes), S @ slopes, rtol=1e-9, atol=1e-11 * np.abs(S).max())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"sensors.1.rotation": 0.12}, "lgs2 is rotated against lgs3"),
        ({"guide_stars.1.altitude": 85e3}, "lgs2 looks at a star at another range than lgs3"),
        ({"sensors.2.subapertures": 7}, "lgs3 has sub-apertures of another size than lgs1"),
    ],
)
def test_sensors_that_are_not_only_shifted_are_refused(shifted: System, change: dict[str, float], reason: str) -> None:
    with pytest.raises(ValueError, match=f"^products by FFT: expected sensors that are only shifted, {reason}$"):
        iterative(shifted.with_changes(change))


def test_iteration_solves_to_its_tolerance(shifted: System) -> None:
    shifted = shifted.with_changes(ELONGATED)
    layout = Layout(shifted)
    N, blind = noise_covariance(shifted, layout, 0.5).toarray(), blind_modes(shifted, layout)
    factor = np.linalg.cholesky(N)
    whitened = np.random.default_rng(6).normal(size=(layout.n_slopes, 7))
    right = factor @ whitened
    S = _dense(shifted)
    expected = estimator(S + N, right, blind)
    whitening = noise_whitening(shifted, layout, 0.5)
    for tolerance in (1e-4, 1e-8):
        found = solver(_operator(shifted).product, whitening, blind, 40, tolerance=tolerance)(right)
        # in standard deviations of the noise the matrix has no eigenvalue below 1: the error is below the residual
        error = np.linalg.norm(factor.T @ (found - expected), axis=0)
        assert np.all(error < tolerance * np.linalg.norm(whitened, axis=0))


def test_iterative_is_implicit(shifted: System) -> None:
    R = implicit(shifted)[0].R[0].astype(float)
    found, G = iterative(shifted, tolerance=1e-9)
    assert np.linalg.norm(found.R[0] - R) < 1e-6 * np.linalg.norm(R)
    # by default good enough for any use
    found, G = iterative(shifted)
    assert np.linalg.norm(found.R[0] - R) < 3e-4 * np.linalg.norm(R)
    np.testing.assert_allclose(found.Q[0], found.R[0] @ G, atol=1e-5)


def test_what_does_not_fit_is_refused_beforehand(shifted: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 1e6)
    with pytest.raises(MemoryError, match=r"^iterative reconstructor: needs 0\.\d GiB of memory"):
        iterative(shifted)


def test_progress_and_provenance(shifted: System) -> None:
    seen: list[tuple[str, float]] = []
    reconstructor, _ = iterative(shifted, label="test", progress=lambda stage, done: seen.append((stage, done)))
    shares = [done for _, done in seen]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    provenance = json.loads(json.dumps(dict(reconstructor.provenance)))
    assert (provenance["method"], provenance["tolerance"]) == ("iterative", 1e-6)
    assert reconstructor.label == "test"
    assert reconstructor.fingerprint == Layout(shifted).fingerprint
