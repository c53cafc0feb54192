"""Frozen flow: every layer moves with its wind, unchanged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
    return [
        replace(
            sensor,
            nodes=carried(sensor.nodes, velocity, time),
            seen=sensor.seen and replace(sensor.seen, offsets=sensor.seen.offsets + time * velocity),
        )
        for sensor in sensors
    ]


def with_trusted_winds(system: System, uncertainty: float | Sequence[float]) -> System:
    """The system with every layer's wind believed only as far as it is known: ``max(0, 1 - 3 sigma^2 / |v|^2)`` of it.

    A measured wind v is too fast on average, by ``2 sigma^2`` in its square, and a share of it has the smaller error,
    and so the prediction made with it. It takes half as much again, since a wrong wind costs more than a right one
    gains (the best of 0 to 4 times sigma^2 on ``mini``, for sigma of 4 to 10 m/s). Prediction goes over into the static
    reconstructor, which it is for ``sigma >= |v| / sqrt(3)``: a direction that is wrong by some 30 degrees.

    Args:
        uncertainty: 1 sigma of each component of a layer's velocity, m/s; one for all layers, or one for each.

    Raises:
        ValueError: a negative one, or a wrong number of them.
    """
    layers = system.atmosphere.layers
    sigma = np.atleast_1d(np.asarray(uncertainty, dtype=np.float64))
    if sigma.shape not in ((1,), (len(layers),)) or not np.all(sigma >= 0):
        raise ValueError(f"wind_uncertainty: expected one or {len(layers)} speeds of at least 0, got {uncertainty}")
    if not np.any(sigma):
        return system
    speed = np.array([layer.wind_speed for layer in layers])
    share = np.maximum(0.0, 1 - 3 * (sigma / np.maximum(speed, np.finfo(float).tiny)) ** 2)
    return system.with_changes(
        {f"atmosphere.layers.{l}.wind_speed": float(value) for l, value in enumerate(share * speed)}
    )


def effective_lag(loop: LoopSettings) -> float:
    """Mean age of what a loop's command is made of when it is on the mirror: ``delay + (1-g)/g`` frames; s."""
    return (loop.delay + (1 - loop.gain) / loop.gain) / loop.rate
