"""What it is worth to tell the reconstructor of elongated spots (section 3.1.3: some 10 nm at 8 m, 100 nm at 40 m).

From covariances alone, a still sky. The large telescope has few, large sub-apertures, with the light of its own on the
same area and read noise to match: a spot's length depends on the way to its laser, not on the sub-aperture, and what
the noise of a sub-aperture does to low orders depends on its variance times its area. So fitting is left out.
"""

import math
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


def with_diagonal_prior(system: System, folder: Path) -> System:
    """The right variances, but x and y supposed to be independent."""
    layout = Layout(system)
    N = noise_covariance(system, layout, 1.0).diagonal()
    changes = {}
    for w, sensor in enumerate(system.sensors):
        np.savez(folder / sensor.name, covariance=np.diag(N[layout.slopes_of(w)]))
        changes[f"sensors.{w}.noise_covariance"] = str(folder / f"{sensor.name}.npz")
    return system.with_changes(changes)


def gains(round_spots: System, radius: float, thickness: float, folder: Path) -> tuple[float, float, float]:
    """nm rms of tomography and noise with the elongated prior; what it gains, in quadrature, over right variances
    without x-y covariance, and over round spots."""
    true = launched_beside(round_spots, radius, thickness)
    prediction = Prediction(true, lag=False)

    def left(believed: System) -> float:
        budget = prediction.budgets(implicit(believed, fast=True)[0].R[0])[0]
        return 1e18 * (budget.tomography + budget.noise)

    elongated, diagonal, unaware = left(true), left(with_diagonal_prior(true, folder)), left(round_spots)
    return math.sqrt(elongated), math.sqrt(diagonal - elongated), math.sqrt(unaware - elongated)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_gain_of_elongated_priors(tmp_path: Path) -> None:
    small = {
        f"8 m, {electrons} electrons": (
            load_system(
                "gnao_ltao", {"loop.rate": 1e3} | {f"sensors.{i}.photons": electrons * 1e3 / 0.16 for i in range(4)}
            ),
            4.5,
            10e3,
        )
        for electrons in (186, 40)
    }
    large = {
        f"39 m, read noise {read_noise} e, sodium {thickness / 1e3:g} km": (
            coarse_harmoni(10, read_noise),
            21.0,
            thickness,
        )
        for read_noise in (0, 3)
        for thickness in (10e3, 20e3)
    }
    found = {}
    for name, case in (small | large).items():
        found[name] = gains(*case, tmp_path)
        print("{}: {:.0f} nm; gain {:.1f} nm over diagonal, {:.1f} nm over round spots".format(name, *found[name]))
    for name in small:
        assert 3 < found[name][1] < found[name][2] < 15
    # without read noise the large telescope's are what the paper says, with a thick layer
    thin, thick, _, noisy = (found[name] for name in large)
    assert thin[2] > 5 * found["8 m, 186 electrons"][2]
    assert 90 < thick[2] < 115
    assert noisy[2] < 0.75 * thick[2]
