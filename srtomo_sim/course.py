"""How sky, light and sensors change while a plant runs: steps and drifts, each known frame by frame.

What varies in a drift goes linearly in time: a layer's Cn2 (and with r0 all of it), the vector of its wind, and the
variance of a sensor's noise. A sensor moves at once. Nothing is random, so that a course and a seed give one sky.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Array, Layout, SensorLayout, transmission
from srtomo_core.system import InstrumentError, Layer, System, Telescope

Frames = NDArray[np.integer]

_LAYER_KEYS = {"fraction", "wind_speed", "wind_direction"}
_LIGHT_KEYS = {"photons", "spot_fwhm", "excess_noise", "read_noise"}
_PLACE_KEYS = {"shift", "rotation"}
CHANGEABLE = (
    f"atmosphere.r0, atmosphere.layers.N.{{{','.join(sorted(_LAYER_KEYS))}}}, "
    f"sensors.N.{{{','.join(sorted(_LIGHT_KEYS | _PLACE_KEYS))}}}"
)
"""What may change while a plant runs, for people."""

_FOREVER = 2**62
_POINTS = 64  # across a sub-aperture, to see how much of a moved one is lit
_DARK = 0.05  # of a sub-aperture lit: less is no sub-aperture any more


@dataclass(frozen=True)
class Change:
    """One change of sky, light or sensors.

    Attributes:
        frame: the first exposure that it is in.
        values: dotted keys of the instrument and their values, as :meth:`System.with_changes` takes them.
        over: frames that it takes; 0 for a step.
    """

    frame: int
    values: Mapping[str, Any]
    over: int = 0


def scheduled(schedule: Sequence[Mapping[str, Any]], rate: float) -> tuple[Change, ...]:
    """Changes from entries ``{"at": s, "set": {dotted key: value}, "over": s}``; ``over`` may be left out.

    Args:
        rate: frames a second.

    Raises:
        InstrumentError: an entry is not of that form.
    """
    changes = []
    for entry in schedule:
        try:
            at, over, values = float(entry["at"]), float(entry.get("over", 0.0)), entry["set"]
            if set(entry) - {"at", "over", "set"} or not values or min(at, over) < 0:
                raise ValueError
            changes.append(Change(round(at * rate), dict(values), round(over * rate)))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            raise InstrumentError(
                f'schedule: expected {{"at": s, "set": {{key: value}}, "over": s}}, got {entry!r}'
            ) from None
    return tuple(changes)


class Stretch(NamedTuple):
    """Exposures ``start`` to ``stop - 1``, in which everything goes linearly from one state to another."""

    start: int
    stop: int
    before: System
    after: System

    def share(self, frames: Frames) -> Array:
        """How far between its two states the middle of exposures is, 0 to 1."""
        return (frames + 0.5 - self.start) / (self.stop - self.start)


class Course:
    """What holds in which exposure.

    Attributes:
        changes: that it was made from, in order.
        stretches: without gap, from exposure 0 on.
        kept_at: (n_layers,) fractions of the turbulence for which layers' screens are made: those of exposure 0, and
            all of it for a layer that has no strength then.
    """

    def __init__(self, system: System, changes: Sequence[Change] = ()) -> None:
        """Lay out a course.

        Args:
            system: in exposure 0.
            changes: in order of their frames; one begins when those before it have ended.

        Raises:
            InstrumentError: a key does not exist or may not change, a value is refused, or changes overlap.
        """
        self.changes = tuple(changes)
        stretches = [Stretch(0, _FOREVER, system, system)]
        for change in self.changes:
            last = stretches.pop()
            if change.frame < max(last.start, 0) or change.over < 0:
                raise InstrumentError(
                    f"{', '.join(change.values)}: expected a change from frame {max(last.start, 0)} on, when the one "
                    f"before it has ended, got frame {change.frame}"
                )
            after = _changed(last.after, change)
            if change.frame > last.start:
                stretches.append(last._replace(stop=change.frame))
            if change.over:
                stretches.append(Stretch(change.frame, change.frame + change.over, last.after, after))
            stretches.append(Stretch(change.frame + change.over, _FOREVER, after, after))
        self.stretches = tuple(stretches)
        first = system.atmosphere.layers
        self.kept_at = np.array([layer.fraction or 1.0 for layer in first]) / sum(layer.fraction for layer in first)
        self._strength = system.atmosphere.r0 ** (-5 / 3)
        # m that each layer has gone by the beginning of each stretch
        self._gone = [np.zeros((len(first), 2))]
        for stretch in self.stretches[:-1]:
            mean = (travel(stretch.before) + travel(stretch.after)) / 2
            self._gone.append(self._gone[-1] + (stretch.stop - stretch.start) * mean)

    def extended(self, change: Change) -> Course:
        """This course with one more change, before those that are still to come.

        Raises:
            InstrumentError: as the constructor.
        """
        return Course(self.stretches[0].before, sorted((*self.changes, change), key=attrgetter("frame")))

    def at(self, frame: int) -> Stretch:
        """The stretch that an exposure is in."""
        return next(stretch for stretch in self.stretches if frame < stretch.stop)

    def between(self, first: int, stop: int) -> list[Stretch]:
        """The stretches of exposures ``first`` to ``stop - 1``; where it is cut, one keeps its own start and stop."""
        return [stretch for stretch in self.stretches if stretch.start < stop and first < stretch.stop]

    def amplitude(self, frames: Frames) -> Array:
        """What r0 makes of the wavefront, relative to exposure 0's: (n_frames,)."""
        return np.sqrt(self._linear(frames, lambda system: np.array([system.atmosphere.r0 ** (-5 / 3)]))[:, 0]
                       / self._strength)  # fmt: skip

    def weights(self, frames: Frames) -> Array:
        """What the layers' fractions make of their wavefronts, relative to ``kept_at``'s: (n_frames, n_layers)."""
        share = self._linear(frames, lambda system: np.array(system.atmosphere.fractions))
        return np.sqrt(share / self.kept_at)

    def gone(self, layer: int, frames: Frames) -> Array:
        """How far a layer has gone since the beginning of exposure 0, at the middle of exposures: (n_frames, 2) m."""
        out = np.empty((len(frames), 2))
        for stretch, gone in zip(self.stretches, self._gone, strict=True):
            here = (stretch.start <= frames) & (frames < stretch.stop)
            time = (frames[here, None] + 0.5) - stretch.start
            before, after = travel(stretch.before)[layer], travel(stretch.after)[layer]
            out[here] = time * before
            if stretch.after is not stretch.before:
                out[here] += time**2 * (after - before) / (2 * (stretch.stop - stretch.start))
            out[here] += gone[layer]
        return out

    def truth(self, frame: int) -> System:
        """The system as it is in the middle of an exposure, numbers and all."""
        stretch = self.at(frame)
        if stretch.after is stretch.before:
            return stretch.after
        share = float(stretch.share(np.array([frame]))[0])
        frames = np.array([frame])
        atmosphere = stretch.before.atmosphere
        strength = self._linear(frames, lambda system: np.array([system.atmosphere.r0 ** (-5 / 3)]))[0, 0]
        fractions = self._linear(frames, lambda system: np.array(system.atmosphere.fractions))[0]
        velocities = (1 - share) * travel(stretch.before) + share * travel(stretch.after)
        velocities *= stretch.before.loop.rate
        layers = [
            layer.model_copy(
                update={
                    "fraction": float(fraction),
                    "wind_speed": math.hypot(*velocity),
                    "wind_direction": math.atan2(velocity[1], velocity[0]),
                }
            )
            for layer, fraction, velocity in zip(atmosphere.layers, fractions, velocities, strict=True)
        ]
        sensors = [
            # photon noise is what goes linearly
            before.model_copy(update={"photons": 1 / ((1 - share) / before.photons + share / after.photons)})
            for before, after in zip(stretch.before.sensors, stretch.after.sensors, strict=True)
        ]
        sky = atmosphere.model_copy(update={"r0": float(strength ** (-3 / 5)), "layers": tuple(layers)})
        return stretch.before.model_copy(update={"atmosphere": sky, "sensors": tuple(sensors)})

    def _linear(self, frames: Frames, value: Any) -> Array:
        """(n_frames, n) of what goes linearly between the states of a stretch."""
        n = len(value(self.stretches[0].before))
        out = np.empty((len(frames), n))
        for stretch in self.stretches:
            here = (stretch.start <= frames) & (frames < stretch.stop)
            before, after = value(stretch.before), value(stretch.after)
            out[here] = before if stretch.after is stretch.before else (
                before + stretch.share(frames[here])[:, None] * (after - before)
            )  # fmt: skip
        return out


def travel(system: System) -> Array:
    """(n_layers, 2) how far each layer goes in a frame time, m."""
    layers: tuple[Layer, ...] = system.atmosphere.layers
    speed = np.array([layer.wind_speed for layer in layers]) / system.loop.rate
    direction = np.array([layer.wind_direction for layer in layers])
    return np.stack([speed * np.cos(direction), speed * np.sin(direction)], axis=1)


def alters_turbulence(change: Change) -> bool:
    """Whether slopes of the turbulence have to be computed anew; r0 only scales them, and light is no part of them."""
    return any(key.split(".")[-1] not in {"r0", *_LIGHT_KEYS} for key in change.values)


def moved(layout: Layout, telescope: Telescope, before: System, after: System) -> Layout:
    """A layout whose sensors have moved as from one system to another; slopes and their order stay.

    Raises:
        InstrumentError: a sensor would lose the light of a sub-aperture.
    """
    there = copy.copy(layout)
    there.sensors = tuple(
        place
        if (was.shift, was.rotation) == (now.shift, now.rotation)
        else _moved(place, telescope, (now.shift[0] - was.shift[0], now.shift[1] - was.shift[1]),
                    now.rotation - was.rotation)
        for place, was, now in zip(layout.sensors, before.sensors, after.sensors, strict=True)
    )  # fmt: skip
    return there


def _moved(place: SensorLayout, telescope: Telescope, shift: tuple[float, float], rotation: float) -> SensorLayout:
    to = place.shift[0] + shift[0] * place.size, place.shift[1] + shift[1] * place.size
    there = replace(place, shift=to, rotation=place.rotation + rotation)
    light = transmission(telescope, *there.points(_POINTS)).mean(axis=(1, 2))
    if light.min() < _DARK:
        raise InstrumentError(f"sensor {place.name}: moved so far that a sub-aperture gets no light")
    return replace(there, illumination=light)


def _changed(system: System, change: Change) -> System:
    after = system.with_changes(change.values)
    if _fixed(after) != _fixed(system):
        raise InstrumentError(f"{', '.join(change.values)}: what may change while the plant runs is {CHANGEABLE}")
    if change.over and sensor_places(after) != sensor_places(system):
        raise InstrumentError("a sensor moves at once: leave out how long it takes")
    return after


def _fixed(system: System) -> dict[str, Any]:
    """All that may not change."""
    tree = system.model_dump(exclude={"atmosphere": {"r0"}})
    for layer in tree["atmosphere"]["layers"]:
        for key in _LAYER_KEYS:
            del layer[key]
    for sensor in tree["sensors"]:
        for key in _LIGHT_KEYS | _PLACE_KEYS:
            del sensor[key]
    return tree


def sensor_places(system: System) -> list[tuple[tuple[float, float], float]]:
    """Shift (sub-apertures) and rotation (rad) of each sensor."""
    return [(sensor.shift, sensor.rotation) for sensor in system.sensors]
