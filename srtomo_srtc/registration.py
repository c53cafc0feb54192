"""The file that says where sensors were found: ``srtomo register --json`` writes it, others build for these places."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.register import Registration, moved_sensors

_PLACE = ("shift_x_subaperture", "shift_y_subaperture", "rotation_deg", "magnification")


def registration_content(system: System, layout: Layout, found: Registration, how: str) -> dict[str, Any]:
    """What the file holds: JSON values, each with its 1-sigma error.

    Args:
        layout: with respect to which the places are.
        how: they were found, for people.
    """
    rows = []
    for place in found.places:
        size = layout.sensors[place.sensor].size
        scale = np.array([1 / size, 1 / size, 180 / math.pi, 1, 1])
        values = np.array([*place.shift, place.rotation, place.magnification, place.gain])
        row: dict[str, Any] = {"sensor": place.name}
        for name, value, sigma in zip((*_PLACE, "gain"), values * scale, place.sigma * scale, strict=True):
            row |= {name: float(value), f"{name}_sigma": float(sigma)}
        row |= {"displacement_subaperture": place.displacement, "displacement_sigma": place.displacement_sigma}
        rows.append(row)
    return {"system": system.name, "fingerprint": layout.fingerprint.hex(), "from": how, "sensors": rows}


def registered_layout(path: Path | None, system: System) -> tuple[Layout, dict[str, Any]]:
    """The instrument's layout with its sensors where they were found, and what the file says; without one, as it is.

    Raises:
        ValueError: not such a file, of another instrument, or a sensor would lose the light of a sub-aperture.
    """
    layout = Layout(system)
    if path is None:
        return layout, {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except ValueError:
        raise ValueError(f"{path}: not JSON") from None
    sensors = {sensor.name: w for w, sensor in enumerate(layout.sensors)}
    moves = np.zeros((len(sensors), 4))
    try:
        fingerprint = content["fingerprint"]
        if fingerprint == layout.fingerprint.hex():
            for row in content["sensors"]:
                w = sensors[row["sensor"]]
                size = layout.sensors[w].size
                moves[w] = np.array([float(row[name]) for name in _PLACE]) * [size, size, math.pi / 180, 1]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected what 'srtomo register --json' writes ({error!r})") from None
    if fingerprint != layout.fingerprint.hex():
        raise ValueError(
            f"{path}: of another instrument (fingerprint {str(fingerprint)[:12]}, "
            f"expected {layout.fingerprint.hex()[:12]})"
        )
    there = moved_sensors(system, layout, moves)
    for sensor in there.sensors:
        if not (np.isfinite(sensor.illumination).all() and sensor.illumination.min() > 0):
            raise ValueError(f"{path}: sensor {sensor.name}: so far away that a sub-aperture gets no light")
    return there, content


def with_places(reconstructor: Reconstructor, content: dict[str, Any]) -> Reconstructor:
    """The reconstructor with what the file says in its provenance, if there was one."""
    if not content:
        return reconstructor
    return replace(reconstructor, provenance={**reconstructor.provenance, "registration": content})
