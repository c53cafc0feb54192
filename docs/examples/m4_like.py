"""An M4-like mirror: actuators on triangles, and six petals that bend on their own, each to its edge.

    python docs/examples/m4_like.py FOLDER

writes ``m4_like.yaml``, an instrument of 8 m, and ``m4_like.npz``, its mirror's influence functions: Gaussian, and cut
where the petal of their actuator ends. Gaps are in the shadow of the spiders, as on the ELT. The real mirror's
functions would come from its finite-element model; the file has the same form.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout, MirrorLayout
from srtomo_core.system import load_system

PETALS = 6
SAMPLES = 8  # a pitch
REACH = 3  # pitches
FINE = 4  # points across a sample: a sample on the edge of a petal is the mean of its two sides

INSTRUMENT = """\
# Laser tomography with an M4-like mirror, scaled to 8 m. No real telescope.
name: m4_like
description: "8 m, 3 LGS + 1 NGS, 16x16 sensors, hexagonal mirror of six petals"

telescope:
  diameter: 8 m
  obscuration: 0.28
  spiders:                      # over the gaps between the petals
    - {width: 0.15 m, angle: 0 deg}
    - {width: 0.15 m, angle: 60 deg}
    - {width: 0.15 m, angle: 120 deg}
    - {width: 0.15 m, angle: 180 deg}
    - {width: 0.15 m, angle: 240 deg}
    - {width: 0.15 m, angle: 300 deg}
  altitude: 3046 m

zenith_angle: 30 deg

atmosphere:
  r0: 15 cm
  outer_scale: 25 m
  layers:
    - {altitude: 0 m,     fraction: 0.6,  wind_speed: 7 m/s,  wind_direction: 20 deg}
    - {altitude: 4500 m,  fraction: 0.25, wind_speed: 12 m/s, wind_direction: 100 deg}
    - {altitude: 11000 m, fraction: 0.15, wind_speed: 20 m/s, wind_direction: -60 deg}

guide_stars:
  - {name: lgs1, kind: laser, altitude: 90 km, position: {radius: 10 arcsec, angle: 15 deg}}
  - {name: lgs2, kind: laser, altitude: 90 km, position: {radius: 10 arcsec, angle: 135 deg}}
  - {name: lgs3, kind: laser, altitude: 90 km, position: {radius: 10 arcsec, angle: 255 deg}}
  - {name: ngs1, kind: natural, position: {x: 0 arcsec, y: 0 arcsec}}

sensors:
  - &lgs
    name: lgs1
    guide_star: lgs1
    subapertures: 16
    photons: 1.2e6 e/m2/s
    spot_fwhm: 1.2 arcsec
    read_noise: 0.5 e
    pixels: 6
    pixel_scale: 0.8 arcsec
  - {<<: *lgs, name: lgs2, guide_star: lgs2, shift: [0.33 subaperture, -0.33 subaperture]}
  - {<<: *lgs, name: lgs3, guide_star: lgs3, shift: [-0.33 subaperture, 0.33 subaperture]}
  - name: ngs1
    guide_star: ngs1
    subapertures: 1
    photons: 2e4 e/m2/s
    spot_fwhm: 0.1 arcsec
    read_noise: 0.5 e
    pixels: 8
    pixel_scale: 0.03 arcsec

mirrors:
  - {name: m4, altitude: 0 m, grid: hexagonal, actuators: 17, pitch: 0.52 m, coupling: 0.4, margin: 0.8, stroke: 20 um}

science:
  wavelength: 1650 nm
  targets:
    - {position: {x: 0 arcsec, y: 0 arcsec}}

loop:
  rate: 500 Hz
  delay: 2 frames
  gain: 0.5
"""


def petal_of(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.int64]:
    """0 to 5, counter-clockwise from +x; the gaps are where one ends and the next begins."""
    return np.floor(PETALS * (np.arctan2(y, x) % (2 * np.pi)) / (2 * np.pi)).astype(np.int64)


def influence_functions(mirror: MirrorLayout) -> NDArray[np.float64]:
    """(n_actuators, size, size) about each actuator, [y, x]."""
    step = mirror.pitch / SAMPLES
    size = 2 * REACH * SAMPLES + 1
    place = step * ((np.arange(size * FINE) + 0.5) / FINE - size / 2)
    dx, dy = np.meshgrid(place, place)
    gaussian = mirror.coupling ** ((dx**2 + dy**2) / mirror.pitch**2)
    out = []
    for x, y in mirror.actuators:
        same = petal_of(x + dx, y + dy) == petal_of(x, y)
        out.append((same * gaussian).reshape(size, FINE, size, FINE).mean(axis=(1, 3)))
    return np.array(out)


def main(folder: Path) -> None:
    """Write both files."""
    path = folder / "m4_like.yaml"
    path.write_text(INSTRUMENT, encoding="utf-8")
    mirror = Layout(load_system(path)).mirrors[0]
    np.savez_compressed(
        folder / "m4_like.npz", step=mirror.pitch / SAMPLES, functions=influence_functions(mirror).astype(np.float32)
    )
    path.write_text(INSTRUMENT.replace("coupling: 0.4,", "coupling: 0.4, influence: m4_like.npz,"), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
