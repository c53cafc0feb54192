"""The same system given to pyTomoAO and to us: the same matrix, and how long each takes (``make rival``).

The system is pyTomoAO's own KAPA example. What of pyTomoAO is imitated for the matrix, outside the library:

- its noise rule, a multiple of the mean variance of all slopes on the diagonal, whatever the light;
- its sub-apertures, those of its map, each fully lit: where ours are cut by the pupil's edge, the pupil is widened to
  its padded support and no light is missing;
- its output, phase at the nodes of these sub-apertures, a quarter of a metre apart, and its tip-tilt, seen by lasers;
- its units and order: phase in radians at 500 nm, slopes in radians a sub-aperture, sub-apertures column by column.

The covariances, the geometry and the gradients (eq. 28, both) are each one's own. For the times alone, the whole way
from instrument to commands is ours (:func:`implicit`): noise, partial illumination, tip-tilt removal and mirror fit.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import Direction, System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Share, Turbulence, slope_products, slope_tiles
from srtomo_srtc.geometry import footprints
from srtomo_srtc.model import sightlines
from srtomo_srtc.reconstructors import implicit

Array = NDArray[np.float64]

PAD = 2  # sub-apertures that it adds on every side
THREADS = len(os.sched_getaffinity(0))
FASTER = 12


@pytest.fixture(scope="module")
def rival(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What pyTomoAO made, and its times."""
    python = os.environ.get("SRTOMO_RIVAL_PYTHON", "")
    if not python:
        pytest.skip("SRTOMO_RIVAL_PYTHON is not set: 'make rival' makes an environment with pyTomoAO and sets it")
    if subprocess.run([python, "-c", "import pyTomoAO"], capture_output=True, env={}, check=False).returncode:
        pytest.skip(f"{python} cannot import pyTomoAO")
    output = tmp_path_factory.mktemp("rival") / "rival.npz"
    # all cores for its products and its compiled loops, and nothing of this environment
    subprocess.run([python, str(Path(__file__).with_name("rival_pytomoao.py")), str(output)], env={}, check=True)
    with np.load(output) as file:
        return dict(file)


def kapa(configuration: dict[str, Any], pad: int) -> System:
    """The instrument of its configuration file, ``pad`` sub-apertures wider on every side."""
    sensor, mirror = configuration["lgs_wfs_parameters"], configuration["dm_parameters"]
    sky, stars = configuration["atmosphere_parameters"], configuration["lgs_asterism"]
    across = sensor["nLenslet"] + 2 * pad
    names = [f"lgs{i + 1}" for i in range(stars["nLGS"])]
    layers = zip(sky["altitude"], sky["fractionnalR0"], sky["windSpeed"], sky["windDirection"], strict=True)
    tree = {
        "name": "kapa",
        "telescope": {
            "diameter": f"{sensor['D'] * across / sensor['nLenslet']} m",
            "obscuration": 0.0 if pad else 0.18,  # its map of sub-apertures leaves out twelve in the middle
        },
        "zenith_angle": f"{sky['zenithAngleInDeg']} deg",
        "atmosphere": {
            "r0": f"{sky['r0']} m",
            "outer_scale": f"{sky['L0']} m",
            "layers": [
                {
                    "altitude": f"{altitude} km",
                    "fraction": fraction,
                    "wind_speed": f"{speed} m/s",
                    "wind_direction": f"{direction} deg",
                }
                for altitude, fraction, speed, direction in layers
            ],
        },
        "guide_stars": [
            {
                "name": name,
                "kind": "laser",
                "altitude": f"{stars['baseLGSHeight']} m",
                "position": {"radius": f"{stars['radiusAst']} arcsec", "angle": f"{i * 360 / len(names)} deg"},
            }
            for i, name in enumerate(names)
        ],
        "sensors": [
            {
                "name": name,
                "guide_star": name,
                "subapertures": across,
                "photons": "1e6 e/m2/s",
                "spot_fwhm": "1.5 arcsec",
                "read_noise": "0.5 e",
                "pixels": sensor["nPx"],
                "pixel_scale": "0.5 arcsec",
            }
            for name in names
        ],
        "mirrors": [
            {
                "name": "dm",
                "actuators": mirror["nActuators"][0] + 2 * pad,
                "pitch": f"{mirror['dmPitch'][0]} m",
                "coupling": mirror["dmCrossCoupling"],
                "margin": 0.5,
            }
        ],
        "science": {"wavelength": "1650 nm", "targets": [{"position": {"x": "0 arcsec", "y": "0 arcsec"}}]},
        "loop": {"rate": "500 Hz", "delay": "2 frames", "gain": 0.5},
    }
    return System.model_validate(tree, context={"from_file": True})


def imitated(system: System, valid: NDArray[np.bool_], grid: NDArray[np.bool_], alpha: float) -> Array:
    """Slopes (rad) to wavefront (m) at the points of a grid of half sub-apertures, by its noise rule."""
    layout = Layout(system)
    size = layout.sensors[0].size
    row, column = np.nonzero(valid)
    centres = size * (np.arange(len(valid)) - (len(valid) - 1) / 2)
    local, lit = np.stack([centres[column], centres[row]], axis=1), np.ones(len(row))
    layout.sensors = tuple(replace(place, mask=valid, local=local, illumination=lit) for place in layout.sensors)

    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile)
    y, x = ((index - (len(grid) - 1) / 2) * size / 2 for index in np.nonzero(grid))
    points = footprints(x, y, Direction(), np.inf, profile.heights)
    turbulence = Turbulence.covering(profile, [points, *(sensor.nodes for sensor in sensors)])
    every = Share(points, sparse.eye_array(len(x), format="csr"))
    S = slope_tiles(turbulence, sensors, threads=THREADS)
    R = slope_products(turbulence, sensors, [every], threads=THREADS)
    S.add(sparse.eye_array(len(S), format="csr") * (alpha * S.trace() / len(S)))
    S.factor(THREADS)
    S.divide(R, THREADS)
    return R


def in_its_order(R: Array, valid: NDArray[np.bool_], size: float) -> Array:
    """The same matrix in its units, columns by its order."""
    by_column = np.lexsort(np.nonzero(valid))
    n_valid = len(by_column)
    order = np.concatenate([first + by_column for first in range(0, R.shape[1], n_valid)])
    return R[:, order] / size


def best_of_five(work: Callable[[], object]) -> float:
    """Seconds, after a first time that is not counted: it compiles."""
    work()
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_same_matrix_in_a_twelfth_of_the_time(rival: dict[str, Any]) -> None:
    configuration = json.loads(str(rival["configuration"]))
    valid = np.pad(np.array(configuration["lgs_wfs_parameters"]["validLLMap"], bool), PAD)
    padded = kapa(configuration, PAD)

    R = in_its_order(imitated(padded, valid, rival["grid"], rival["alpha"]), valid, Layout(padded).sensors[0].size)
    apart = float(np.linalg.norm(R - rival["reconstructor"]) / np.linalg.norm(rival["reconstructor"]))

    its = float(rival["building"].min())
    ours = best_of_five(lambda: imitated(padded, valid, rival["grid"], rival["alpha"]))
    print(
        f"\npyTomoAO {rival['version']}, KAPA, {len(R)} points x {R.shape[1]} slopes, float64, {THREADS} threads: "
        f"{its:.2f} s, srtomo {ours:.2f} s, {its / ours:.1f} times faster; matrices {apart:.1e} of the norm apart"
    )
    assert apart < 1e-6
    assert its / ours > FASTER


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_commands_in_a_twelfth_of_the_time(rival: dict[str, Any]) -> None:
    configuration = json.loads(str(rival["configuration"]))
    system = kapa(configuration, 0)
    layout = Layout(system)
    valid = np.array(configuration["lgs_wfs_parameters"]["validLLMap"], bool)
    for place in layout.sensors:
        np.testing.assert_array_equal(place.mask, valid)
    np.testing.assert_array_equal(layout.mirrors[0].mask, configuration["dm_parameters"]["validActuators"])
    assert layout.n_commands == rival["commands"]

    its = float((rival["building"] + rival["fitting"]).min())
    fast, exact = (best_of_five(partial(implicit, system, fast=fast, threads=THREADS)) for fast in (True, False))
    print(
        f"\npyTomoAO {rival['version']}, KAPA, {layout.n_commands} commands x {layout.n_slopes} slopes, {THREADS} "
        f"threads: {its:.2f} s with its fit; srtomo implicit {fast:.2f} s ({its / fast:.1f} times faster), float64 and "
        f"nothing interpolated {exact:.2f} s ({its / exact:.1f} times faster)"
    )
    assert its / fast > FASTER
