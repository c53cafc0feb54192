"""Frozen flow: every layer moves with its wind, unchanged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from srtomo_core.system import LoopSettings, System
from srtomo_srtc.covariance import Sightline
from srtomo_srtc.geometry import Footprints

Array = NDArray[np.float64]


def winds(system: System) -> Array:
    """(n_layers, 2) velocity x, y of each layer of :meth:`Profile.of`, where it goes, m/s."""
    layers = [
        layer
        for layer, fraction in zip(system.atmosphere.layers, system.atmosphere.fractions, strict=True)
        if fraction > 0
    ]
    speed = np.array([layer.wind_speed for layer in layers])
    direction = np.array([layer.wind_direction for layer in layers])
    return np.stack([speed * np.cos(direction), speed * np.sin(direction)], axis=1)


def carried(points: Footprints, velocity: Array, time: float) -> Footprints:
    """Where the turbulence now is that was at ``points`` a ``time`` (s) ago; ``velocity`` (n_layers, 2) m/s."""
    return Footprints(points.x + time * velocity[:, :1], points.y + time * velocity[:, 1:])


def sensors_carried(sensors: Sequence[Sightline], velocity: Array, time: float) -> list[Sightline]:
    """Sightlines through the turbulence that the sensors measured a ``time`` (s) ago, where it is now."""
    return [Sightline(carried(sensor.nodes, velocity, time), sensor.gradient) for sensor in sensors]


def effective_lag(loop: LoopSettings) -> float:
    """Mean age of what a loop's command is made of when it is on the mirror: ``delay + (1-g)/g`` frames; s."""
    return (loop.delay + (1 - loop.gain) / loop.gain) / loop.rate
