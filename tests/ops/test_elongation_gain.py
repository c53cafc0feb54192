"""What it is worth to tell the reconstructor of elongated spots (section 3.1.3: some 10 nm at 8 m, 100 nm at 40 m).

From covariances alone, a still sky. The large telescope has few, large sub-apertures, with the light of its own on the
same area and read noise to match: a spot's length depends on the way to its laser, not on the sub-aperture, and what
the noise of a sub-aperture does to low orders depends on its variance times its area. So fitting is left out.
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.model import noise_covariance
from srtomo_srtc.predict import Prediction
from srtomo_srtc.reconstructors import implicit


def launched_beside(system: System, radius: float, thickness: float) -> System:
    """Every laser leaves outside the pupil, at the side where its star is; the sodium layer's FWHM."""
    changes: dict[str, object] = {}
    for i, star in enumerate(system.guide_stars):
        if star.kind == "laser":
            angle = math.atan2(star.position.y, star.position.x)
            changes[f"guide_stars.{i}.launch"] = (radius * math.cos(angle), radius * math.sin(angle))
            changes[f"guide_stars.{i}.sodium_thickness"] = thickness
    return system.with_changes(changes)


def coarse_harmoni(subapertures: int, read_noise: float) -> System:
    """HARMONI with other sub-apertures and a mirror to match; read noise in electrons, of its own sub-apertures."""
    system = load_system("harmoni_ltao")
    larger = system.sensors[0].subapertures / subapertures
    lasers = {
        "subapertures": subapertures,
        "read_noise": read_noise * larger,
    }
    changes: dict[str, object] = {f"sensors.{i}.{key}": value for i in range(6) for key, value in lasers.items()}
    return system.with_changes(
        {**changes, "mirrors.0.actuators": subapertures + 3, "mirrors.0.pitch": 39.0 / subapertures}
    )


def with_variances(system: System, lasers: Callable[[np.ndarray], np.ndarray], folder: Path) -> System:
    """x and y supposed to be independent; of the lasers' true variances (2, all sub-apertures) what to suppose."""
    layout = Layout(system)
    N = noise_covariance(system, layout, 1.0).diagonal()
    blind = [w for w, sensor in enumerate(system.sensors) if system.star_of(sensor).kind == "laser"]
    true = [N[layout.slopes_of(w)].reshape(2, -1) for w in blind]
    supposed = np.split(lasers(np.hstack(true)), np.cumsum([part.shape[1] for part in true])[:-1], axis=1)
    changes = {}
    for w, variances in zip(blind, supposed, strict=True):
        file = folder / f"{system.sensors[w].name}.npz"
        np.savez(file, covariance=np.diag(variances.ravel()))
        changes[f"sensors.{w}.noise_covariance"] = str(file)
    return system.with_changes(changes)


DIAGONALS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "own": lambda N: N,
    "mean of x and y": lambda N: N.mean(axis=0, keepdims=True) + 0 * N,
    "one for all": lambda N: N.mean() + 0 * N,
}
"""What a diagonal prior may take from the true variances; one more is that of compact spots."""


def gains(compact: System, radius: float, thickness: float, folder: Path) -> tuple[float, dict[str, float]]:
    """nm rms of tomography and noise with the elongated prior; what it gains over each diagonal one, in quadrature."""
    true = launched_beside(compact, radius, thickness)
    prediction = Prediction(true, lag=False)

    def left(believed: System) -> float:
        budget = prediction.budgets(implicit(believed, fast=True)[0].R[0])[0]
        return 1e18 * (budget.tomography + budget.noise)

    elongated = left(true)
    others = {name: left(with_variances(true, supposed, folder)) for name, supposed in DIAGONALS.items()}
    others["compact"] = left(compact)
    return math.sqrt(elongated), {name: math.sqrt(other - elongated) for name, other in others.items()}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_gain_of_elongated_priors(tmp_path: Path) -> None:
    telescopes = {
        f"8 m, {electrons} electrons": (
            load_system(
                "gnao_ltao", {"loop.rate": 1e3} | {f"sensors.{i}.photons": electrons * 1e3 / 0.16 for i in range(4)}
            ),
            4.5,
        )
        for electrons in (372, 186, 40)
    } | {f"39 m, read noise {read_noise} e": (coarse_harmoni(10, read_noise), 21.0) for read_noise in (0.5, 3)}
    found = {}
    for name, telescope in telescopes.items():
        for km in (10, 20):
            left, gained = gains(*telescope, 1e3 * km, tmp_path)
            found[name, km] = gained
            plain = {other: math.hypot(left, gain) - left for other, gain in gained.items()}
            print(f"{name}, sodium {km} km: {left:.1f} nm; gain over")
            print("  " + ", ".join(f"{other} {gained[other]:.1f} (plainly {plain[other]:.1f})" for other in gained))
    for gained in found.values():
        assert gained["own"] < gained["mean of x and y"] < gained["one for all"]
    # the paper's: a covariance is diagonal for compact sources, and a laser's prior may know the sodium layer or not
    for power in ("8 m, 186 electrons", "8 m, 372 electrons"):
        assert 4 < found[power, 10]["compact"] < 10 < found[power, 20]["compact"] < 20
    quiet, noisy = (f"39 m, read noise {read_noise} e" for read_noise in (0.5, 3))
    assert 38 < found[quiet, 10]["compact"] < 47
    assert 95 < found[quiet, 20]["compact"] < 112
    assert found[noisy, 20]["compact"] < 0.75 * found[quiet, 20]["compact"]
