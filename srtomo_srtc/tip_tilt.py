"""Reconstructors for an instrument whose natural stars have a loop of their own (``loop.tip_tilt``)::

    R = [ (I - R_t G_t) R_h,  R_t ],      R_t = A (W G_t A)^-1 W,      Q = (I - R_t G_t) R_h G_h

R_h is the estimate from the sensors on blind stars alone (h), whatever the method. R_t is what the other loop steps by:
W is the stars' mean tip-tilt in the pupil's axes, each weighted by the inverse variance of its noise, A the commands of
tip and tilt on the lowest mirror. ``I - R_t G_t`` takes out of the high orders what the stars' mean sees of them: the
stars see it in the sky too, and answer for it. ``R_t G_t A = A``: that loop's gain is what it says.

Q counts the slopes of the high orders' sensors alone. It acts on all that is on the mirrors, tip-tilt's command t
included: ``y_h + G_h m~`` is the open loop's whatever t was. Without t, what blind stars do see of it, the mirror's
ripple on a tilt, would be answered for.

With mirrors at several altitudes this loop controls tip-tilt and no plate scale: what lasers do not see of that is left
to the prior.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.closures import bits
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import layout_of
from srtomo_srtc.noise import sensor_noise
from srtomo_srtc.split import focus_is_controlled, low_order_commands

Array = NDArray[np.float64]
Method = TypeVar("Method", bound=Callable[..., tuple[Reconstructor, Array]])


def in_two_loops(method: Method) -> Method:
    """A method (:mod:`srtomo_srtc.reconstructors`) that also serves instruments with ``loop.tip_tilt``, see the head.

    ``split`` is theirs already. The decorated method raises ValueError also where stars would control focus.
    """

    @functools.wraps(method)
    def build(system: System, layout: Layout | None = None, **options: Any) -> tuple[Reconstructor, Array]:
        if system.loop.tip_tilt is None:
            return method(system, layout, **options)
        layout = layout_of(system, layout)
        if focus_is_controlled(system, layout):
            raise ValueError("loop.tip_tilt: the lasers are blind to focus, and this loop does not control it")
        options.pop("split", None)
        made, _ = method(blind_stars_alone(system), _blind_sensors_alone(layout), **options)
        G = interaction_matrix(system, layout)
        return _joined(made, G, tip_tilt_matrix(system, layout, G), system, layout), G

    return cast(Method, build)


def blind_stars_alone(system: System) -> System:
    """The instrument with the high orders' sensors and loop alone; all stars stay, since mirrors cover their beams."""
    sensors = tuple(sensor for i, sensor in enumerate(system.sensors) if i not in system.tip_tilt_sensors)
    loop = system.loop.model_copy(update={"tip_tilt": None})
    return system.model_copy(update={"sensors": sensors, "loop": loop})


def _blind_sensors_alone(layout: Layout) -> Layout:
    kept = copy.copy(layout)
    kept.sensors = tuple(sensor for i, sensor in enumerate(layout.sensors) if i not in layout.tip_tilt_sensors)
    kept.slope_start = np.concatenate([[0], np.cumsum([sensor.n_slopes for sensor in kept.sensors])])
    kept.tip_tilt_sensors = ()
    return kept


def tip_tilt_matrix(system: System, layout: Layout, G: Array) -> Array:
    """R_t of the head: (n_commands, n_slopes) m/rad, 0 for slopes of the high orders' sensors.

    Args:
        G: (n_slopes, n_commands) interaction matrix, rad/m.
    """
    mean = np.zeros((2, layout.n_slopes))
    total = 0.0
    for i in layout.tip_tilt_sensors:
        place, own = layout.sensors[i], layout.slopes_of(i)
        weight = place.n_valid / sensor_noise(system, system.sensors[i], place).matrix().diagonal().mean()
        c, s = np.cos(place.rotation), np.sin(place.rotation)
        mean[:, own] = weight / place.n_valid * np.kron([[c, -s], [s, c]], np.ones(place.n_valid))
        total += weight
    mean /= total
    commands = low_order_commands(system, layout)[:, :2]
    matrix: Array = commands @ np.linalg.solve(mean @ G @ commands, mean)
    return matrix


def _joined(made: Reconstructor, G: Array, R_t: Array, system: System, layout: Layout) -> Reconstructor:
    own = np.zeros(layout.n_slopes, bool)
    for i in layout.tip_tilt_sensors:
        own[layout.slopes_of(i)] = True
    seen = R_t @ G

    def whole(R_h: NDArray[np.float32], newest: bool) -> Array:
        R = np.zeros((layout.n_commands, layout.n_slopes))
        R[:, ~own] = R_h - seen @ R_h
        return R + R_t if newest else R

    high = [i for i in range(len(layout.sensors)) if i not in layout.tip_tilt_sensors]
    return Reconstructor.from_matrices(
        np.stack([whole(R_h, epoch == 0) for epoch, R_h in enumerate(made.R)]),
        np.where(own[:, None], 0.0, G),
        fingerprint=Layout(system).fingerprint,
        gain=made.gain,
        command_limit=made.command_limit,
        label=made.label,
        provenance={**made.provenance, "tip_tilt_rate_hz": system.loop.rate / system.loop.tip_tilt_frames},
        fallback=None if made.fallback_R is None else whole(made.fallback_R, True),
        closures={
            bits(i for w, i in enumerate(high) if closure.sensors >> w & 1): whole(closure.R, True)
            for closure in made.closures
        },
    )
