"""``srtomo reconstruct --method learn_apply --measured``: covariances that were drawn, and files that hold none."""

from pathlib import Path

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_ops.cli import main
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.model import noise_covariance, sightlines
from srtomo_srtc.predict import Prediction
from srtomo_srtc.reconstructors.learn_apply import learn_apply, slope_cross_covariance, virtual_system

TRUTH = 8  # sub-apertures across


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def modelled(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of all slopes, and of a truth sensor's with them."""
    profile, layout, virtual = Profile.of(system), Layout(system), virtual_system(system, TRUTH)
    sensors, seen = sightlines(system, layout, profile), sightlines(virtual, Layout(virtual), profile)
    turbulence = Turbulence.covering(profile, [s.nodes for s in [*sensors, *seen]])
    slopes = slope_covariance(turbulence, sensors) + noise_covariance(system, layout, 1.0).toarray()
    return slopes, slope_cross_covariance(turbulence, sensors, seen).T


def reconstructed(folder: Path, *more: str, **content: object) -> Reconstructor:
    np.savez(folder / "measured.npz", **content)
    words = ["reconstruct", "mini", "--method", "learn_apply", "--measured", str(folder / "measured.npz")]
    assert main([*words, "-o", str(folder / "out.npz"), *more]) == 0
    return Reconstructor.load(folder / "out.npz")


def test_measured_covariances_are_used(mini: System, tmp_path: Path) -> None:
    slopes, truth = modelled(mini)
    fingerprint = Layout(mini).fingerprint.hex()
    # measured under another sky than the instrument file's
    found = reconstructed(
        tmp_path,
        "--set",
        "atmosphere.r0=30 cm",
        slopes=slopes,
        truth=truth,
        truth_subapertures=TRUTH,
        fingerprint=fingerprint,
    )
    assert found.provenance["measured"] == ["slopes", "truth"]
    expected = learn_apply(mini, noise_gain=1.0, virtual=virtual_system(mini, TRUTH))[0].R[0]
    np.testing.assert_allclose(found.R[0], expected, atol=1e-6 * np.abs(expected).max())


def test_from_drawn_exposures(mini: System, tmp_path: Path) -> None:
    """Ten times as many exposures as slopes leave within 6 % of what the model itself leaves."""
    slopes, truth = modelled(mini)
    virtual = virtual_system(mini, TRUTH)
    profile = Profile.of(mini)
    seen = sightlines(virtual, Layout(virtual), profile)
    own = slope_covariance(Turbulence.covering(profile, [s.nodes for s in seen]), seen)
    joint = np.block([[slopes, truth.T], [truth, own]])
    values, vectors = np.linalg.eigh(joint)
    n, n_exposures = len(slopes), 10 * len(slopes)
    drawn = (
        np.random.default_rng(1).standard_normal((n_exposures, len(joint)))
        @ (vectors * np.sqrt(np.maximum(values, 0))).T
    )
    s, t = drawn[:, :n], drawn[:, n:]
    found = reconstructed(tmp_path, slopes=s.T @ s / n_exposures, truth=t.T @ s / n_exposures, truth_subapertures=TRUTH)
    prediction = Prediction(mini, lag=False)
    measured, best = (
        np.sqrt(sum(b.weight * b.total for b in prediction.budgets(R)))
        for R in (found.R[0], learn_apply(mini, noise_gain=1.0, virtual=virtual)[0].R[0])
    )
    assert best < measured < 1.06 * best


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({}, "expected 'slopes', the covariance of all slopes"),
        ({"slopes": np.eye(3)}, "slopes: expected shape"),
        ({"slopes": "ones"}, "slopes: expected positive definite; were there more exposures than"),
        ({"slopes": "nan"}, "slopes: expected finite numbers"),
        ({"slopes": "tril"}, "slopes: expected a symmetric matrix"),
        ({"slopes": "eye", "truth": np.eye(3)}, "truth: expected shape"),
        ({"slopes": "eye", "truth_subapertures": 8}, "truth_subapertures: expected 'truth' with it"),
        ({"slopes": "eye", "fingerprint": "00"}, "fingerprint: of another instrument than mini"),
        ({"slopes": "eye", "noise": 1}, "noise: expected one of slopes, truth, truth_subapertures, fingerprint"),
    ],
)
def test_files_that_do_not_fit(
    content: dict[str, object], problem: str, mini: System, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    n = Layout(mini).n_slopes
    made = {"ones": np.ones((n, n)), "nan": np.full((n, n), np.nan), "tril": np.tri(n), "eye": np.eye(n)}
    content = {k: made.get(v, v) if isinstance(v, str) else v for k, v in content.items()}
    np.savez(tmp_path / "measured.npz", **content)
    words = ["reconstruct", "mini", "--method", "learn_apply", "--measured", str(tmp_path / "measured.npz")]
    assert main([*words, "-o", str(tmp_path / "out.npz")]) == 2
    assert problem in capsys.readouterr().err


def test_only_learn_apply_takes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "mini", "--measured", "none.npz", "-o", str(tmp_path / "out.npz")]) == 2
    assert "--measured: expected with --method learn_apply, not implicit" in capsys.readouterr().err
    words = [
        "reconstruct",
        "mini",
        "--method",
        "learn_apply",
        "--measured",
        "none.npz",
        "-o",
        str(tmp_path / "out.npz"),
    ]
    assert main(words) == 2
    assert "none.npz: No such file or directory" in capsys.readouterr().err
