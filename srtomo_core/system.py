"""The instrument: telescope, sky, guide stars, sensors, mirrors and loop; validated and immutable.

A system is read from YAML (:func:`load_system`). Every quantity in a file carries its unit; inside, everything is
metres, radians and seconds. Heights are above the telescope and, like r0, given at zenith; the properties named
``los_...`` are along the line of sight (``r0 cos(z)^0.6``, heights and laser distances times ``sec z``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, model_validator

from srtomo_core.units import ARCSEC, Angle, Charge, Delay, Flux, Frequency, Length, Shift, Speed

_WHOLE = 1e-6  # what a ratio of rates may be off a whole number, as a share

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


def _beside_the_instrument(path: str, info: ValidationInfo) -> str:
    return str(Path((info.context or {}).get("folder", "")).absolute() / path)


DataFile = Annotated[str, Field(min_length=1), AfterValidator(_beside_the_instrument)]
"""Path of a file, absolute once read; in an instrument file, from the folder that this is in."""


class InstrumentError(ValueError):
    """An instrument file that cannot be used; one line that names the key and what was expected."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Direction(_Frozen):
    """A direction on the sky from the telescope's axis: ``{x, y}``, or in files also ``{radius, angle}``. rad."""

    x: Angle = 0.0
    y: Angle = 0.0

    @model_validator(mode="before")
    @classmethod
    def _from_polar(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, Mapping) and set(value) == {"radius", "angle"}:
            polar = _Polar.model_validate(value, context=info.context)
            return {
                "x": f"{polar.radius * math.cos(polar.angle)!r} rad",
                "y": f"{polar.radius * math.sin(polar.angle)!r} rad",
            }
        return value


class _Polar(_Frozen):
    radius: Annotated[Angle, Field(ge=0)]
    angle: Angle


class Spider(_Frozen):
    """One arm that holds the secondary mirror: from the pupil's centre outwards, counter-clockwise from +x."""

    width: Annotated[Length, Field(gt=0)]
    angle: Angle


class Telescope(_Frozen):
    """Circular pupil with a circular central obscuration, and spiders if any."""

    diameter: Annotated[Length, Field(gt=0)]
    obscuration: Annotated[float, Field(ge=0, lt=1, description="diameter of the obscuration over that of the pupil")]
    obscuration_centre: tuple[Length, Length] = (0.0, 0.0)
    spiders: tuple[Spider, ...] = ()
    altitude: Length = 0.0


class Layer(_Frozen):
    """A turbulent layer; the wind's direction is where the layer goes, counter-clockwise from +x."""

    altitude: Annotated[Length, Field(ge=0)]
    fraction: Annotated[float, Field(ge=0, le=1)]
    wind_speed: Annotated[Speed, Field(ge=0)]
    wind_direction: Angle


class Atmosphere(_Frozen):
    """Fried parameter (500 nm, zenith), outer scale and layers."""

    r0: Annotated[Length, Field(gt=0)]
    outer_scale: Annotated[Length, Field(gt=0)]
    layers: Annotated[tuple[Layer, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _sums_to_one(self) -> Atmosphere:
        total = sum(layer.fraction for layer in self.layers)
        if abs(total - 1) > 1e-3:
            raise ValueError(f"layers: expected fractions that sum to 1, got {total:.4f}")
        return self

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fractions of the layers, normalised exactly."""
        total = sum(layer.fraction for layer in self.layers)
        return tuple(layer.fraction / total for layer in self.layers)


class GuideStar(_Frozen):
    """A laser star at a finite height, or a natural one at infinity.

    ``tip_tilt`` and ``focus`` say whether a sensor on this star is trusted with overall tip-tilt, and with focus, which
    the sodium layer's height mimics: ``blind`` slopes have it projected out. ``jitter`` is the simulated tip-tilt
    jitter of a laser's uplink, rms on each axis.
    """

    name: Name
    kind: Literal["laser", "natural"]
    position: Direction
    altitude: Annotated[Length, Field(gt=0)] | None = None
    tip_tilt: Literal["seen", "blind"]
    focus: Literal["seen", "blind"] = "seen"
    jitter: Annotated[Angle, Field(ge=0)]
    launch: tuple[Length, Length] | None = None
    sodium_thickness: Annotated[Length, Field(gt=0)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _defaults_by_kind(cls, value: Any) -> Any:
        if isinstance(value, Mapping) and value.get("kind") in ("laser", "natural"):
            laser = value["kind"] == "laser"
            defaults = {"tip_tilt": "blind" if laser else "seen", "jitter": "0.5 arcsec" if laser else "0 arcsec"}
            return {**defaults, **value}
        return value

    @model_validator(mode="after")
    def _altitude_by_kind(self) -> GuideStar:
        if (self.kind == "laser") != (self.altitude is not None):
            raise ValueError("altitude: expected for a laser star, and only there")
        if (self.launch is None) != (self.sodium_thickness is None):
            raise ValueError("launch: expected together with sodium_thickness")
        if self.launch is not None and self.kind != "laser":
            raise ValueError("launch: expected for a laser star only")
        return self


class Sensor(_Frozen):
    """A Shack-Hartmann sensor on one guide star.

    Its lenslets are rotated about the pupil's centre, then moved by +shift (paper, eq. 33-34). ``photons`` are detected
    electrons per area of pupil and time; ``excess_noise`` multiplies the photon noise's standard deviation.
    ``field_stop`` is the side of the square, along the sensor's axes, beyond which no light of a spot arrives; without
    it spots are whole however long they are. Slopes are calibrated for what it does to a centre of gravity.
    ``noise_covariance`` is a file with what was measured, for estimators to suppose and the simulated sensor to have in
    place of all that: ``.npz`` with ``covariance`` (n_slopes, n_slopes), rad^2, of one frame.
    """

    name: Name
    guide_star: Name
    subapertures: Annotated[int, Field(ge=1, le=512, description="across the pupil")]
    illumination_threshold: Annotated[float, Field(gt=0, le=1)] = 0.5
    shift: tuple[Shift, Shift] = (0.0, 0.0)
    rotation: Angle = 0.0
    photons: Annotated[Flux, Field(gt=0)]
    spot_fwhm: Annotated[Angle, Field(gt=0)]
    excess_noise: Annotated[float, Field(ge=1)] = 1.0
    read_noise: Annotated[Charge, Field(ge=0)]
    pixels: Annotated[int, Field(ge=2, description="across a sub-aperture")]
    pixel_scale: Annotated[Angle, Field(gt=0)]
    field_stop: Annotated[Angle, Field(gt=0)] | None = None
    noise_covariance: DataFile | None = None


class Mirror(_Frozen):
    """A deformable mirror on a square grid, or a hexagonal one: equilateral triangles with one side along x, as M4's.

    ``pitch`` is at the mirror's conjugate and defaults to pupil diameter / (actuators - 1). Actuators farther than
    ``margin`` pitches outside the (meta)pupil do not exist. ``coupling`` is a Gaussian influence function's value at
    the next actuator; ``influence`` is a file with others (:mod:`srtomo_core.influence`), in which coupling plays no
    part. ``stroke`` limits each command, wavefront, both ways.
    """

    name: Name
    altitude: Annotated[Length, Field(ge=0)] = 0.0
    grid: Literal["square", "hexagonal"] = "square"
    actuators: Annotated[int, Field(ge=2, le=512, description="across the grid")]
    pitch: Annotated[Length, Field(gt=0)] | None = None
    coupling: Annotated[float, Field(gt=0, lt=1)]
    influence: DataFile | None = None
    margin: Annotated[float, Field(ge=0)] = 0.8
    stroke: Annotated[Length, Field(gt=0)] = 10e-6


class Target(_Frozen):
    """A science direction and its weight in the fit."""

    position: Direction
    weight: Annotated[float, Field(ge=0)] = 1.0


class Science(_Frozen):
    """Where the correction is wanted, and the wavelength at which Strehl ratios are stated."""

    wavelength: Annotated[Length, Field(gt=0)]
    targets: Annotated[tuple[Target, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _some_weight(self) -> Science:
        if sum(target.weight for target in self.targets) <= 0:
            raise ValueError("targets: expected at least one weight above 0")
        return self


class TipTiltLoop(_Frozen):
    """Tip-tilt in a loop of its own: an integrator on the sensors whose stars see tip-tilt.

    One exposure lasts a whole number of the high orders'. ``delay`` is from mid-exposure to mid-command in its own
    frames; without one it is the least there can be (:attr:`LoopSettings.tip_tilt_wait`). ``leak`` is of a frame.
    """

    rate: Annotated[Frequency, Field(gt=0)]
    delay: Annotated[Delay, Field(ge=1, le=8)] | None = None
    gain: Annotated[float, Field(gt=0, le=1)]
    leak: Annotated[float, Field(ge=0, lt=1)] = 0.0


class LoopSettings(_Frozen):
    """Frame rate, delay from mid-exposure to mid-command, gain, and the leak of a frame."""

    rate: Annotated[Frequency, Field(gt=0)]
    delay: Annotated[Delay, Field(ge=1, le=8)]
    gain: Annotated[float, Field(gt=0, le=1)]
    leak: Annotated[float, Field(ge=0, lt=1)] = 0.0
    tip_tilt: TipTiltLoop | None = None

    @model_validator(mode="after")
    def _tip_tilt_in_step(self) -> LoopSettings:
        own = self.tip_tilt
        if own is None:
            return self
        ratio = self.rate / own.rate
        if ratio < 1 - _WHOLE or abs(ratio - round(ratio)) > _WHOLE * ratio:
            raise ValueError(f"tip_tilt.rate: expected rate ({self.rate:g} Hz) over a whole number, got {own.rate:g}")
        frames = self.tip_tilt_frames
        least = 1 + (self.delay - 1) / frames
        wait = ((own.delay or least) - least) * frames
        if wait < -_WHOLE or abs(wait - round(wait)) > 1e-3:
            raise ValueError(
                f"tip_tilt.delay: expected {least:g} frames, or whole exposures of the high orders (1/{frames} frame) "
                f"more, got {own.delay:g}"
            )
        delay = least + self.tip_tilt_wait / frames
        whole = math.floor(delay)
        # of t[j] = (1 - leak) t[j-1] - g ((1-f) t[j-n] + f t[j-n-1])
        terms = np.zeros(whole + 2)
        terms[:2] = 1, own.leak - 1
        terms[whole] += own.gain * (1 - (delay - whole))
        terms[whole + 1] += own.gain * (delay - whole)
        if np.abs(np.roots(terms)).max() >= 1:
            raise ValueError(f"tip_tilt.gain: not stable with a delay of {delay:g} frames, got {own.gain:g}")
        return self

    @property
    def tip_tilt_frames(self) -> int:
        """Exposures of the high orders in one of tip-tilt's own loop; 1 without one."""
        return 1 if self.tip_tilt is None else round(self.rate / self.tip_tilt.rate)

    @property
    def tip_tilt_wait(self) -> int:
        """Exposures of the high orders from the end of a tip-tilt exposure to the end of that whose command has it.

        With N of the high orders' exposures in one of tip-tilt's, and their delay d, a wait of L makes tip-tilt's delay
        ``1 + (d - 1 + L) / N`` of its frames: half its exposure, L, the way to the mirror, half the command's time.
        """
        if self.tip_tilt is None or self.tip_tilt.delay is None:
            return 0
        return round((self.tip_tilt.delay - 1) * self.tip_tilt_frames - (self.delay - 1))


class System(_Frozen):
    """One instrument under one sky. Immutable: change it with :meth:`with_changes`."""

    name: Name
    description: str = ""
    telescope: Telescope
    zenith_angle: Annotated[Angle, Field(ge=0, le=math.radians(80))]
    atmosphere: Atmosphere
    guide_stars: Annotated[tuple[GuideStar, ...], Field(min_length=1)]
    sensors: Annotated[tuple[Sensor, ...], Field(min_length=1, max_length=32)]
    mirrors: Annotated[tuple[Mirror, ...], Field(min_length=1)]
    science: Science
    loop: LoopSettings

    @model_validator(mode="after")
    def _hangs_together(self) -> System:
        for key, items in (("guide_stars", self.guide_stars), ("sensors", self.sensors), ("mirrors", self.mirrors)):
            names = [item.name for item in items]
            for i, name in enumerate(names):
                if name in names[:i]:
                    raise ValueError(f"{key}[{i}].name: expected a name of its own, got {name!r} again")
        stars = {star.name for star in self.guide_stars}
        for i, sensor in enumerate(self.sensors):
            if sensor.guide_star not in stars:
                raise ValueError(
                    f"sensors[{i}].guide_star: expected one of {', '.join(sorted(stars))}, got {sensor.guide_star!r}"
                )
        top = max(layer.altitude for layer in self.atmosphere.layers)
        for i, star in enumerate(self.guide_stars):
            if star.altitude is not None and star.altitude <= top:
                raise ValueError(
                    f"guide_stars[{i}].altitude: expected above the top layer ({top:g} m), got {star.altitude:g} m"
                )
        for i, mirror in enumerate(self.mirrors):
            ranges = [star.altitude for star in self.guide_stars if star.altitude is not None]
            if ranges and mirror.altitude >= min(ranges):
                raise ValueError(f"mirrors[{i}].altitude: expected below the guide stars, got {mirror.altitude:g} m")
        if self.loop.tip_tilt is not None and not 0 < len(self.tip_tilt_sensors) < len(self.sensors):
            raise ValueError("loop.tip_tilt: expected some sensors on stars that see tip-tilt, and some on blind ones")
        return self

    @property
    def tip_tilt_sensors(self) -> tuple[int, ...]:
        """Indices of the sensors in tip-tilt's own loop, which count their own exposures: all whose stars see tip-tilt.
        None without such a loop."""
        if self.loop.tip_tilt is None:
            return ()
        return tuple(i for i, sensor in enumerate(self.sensors) if self.star_of(sensor).tip_tilt == "seen")

    def rate_of(self, sensor: Sensor) -> float:
        """Frame rate of a sensor, Hz."""
        own = self.loop.tip_tilt
        return self.loop.rate if own is None or self.star_of(sensor).tip_tilt == "blind" else own.rate

    @property
    def airmass(self) -> float:
        """sec z."""
        return 1 / math.cos(self.zenith_angle)

    @property
    def los_r0(self) -> float:
        """Fried parameter along the line of sight, 500 nm, m."""
        return self.atmosphere.r0 * math.cos(self.zenith_angle) ** 0.6

    @property
    def los_heights(self) -> tuple[float, ...]:
        """Distance to each layer along the line of sight, m."""
        return tuple(layer.altitude * self.airmass for layer in self.atmosphere.layers)

    def los_range(self, star: GuideStar) -> float:
        """Distance to a guide star along the line of sight, m; infinite for a natural one."""
        return math.inf if star.altitude is None else star.altitude * self.airmass

    def star_of(self, sensor: Sensor) -> GuideStar:
        """The guide star that a sensor looks at."""
        return next(star for star in self.guide_stars if star.name == sensor.guide_star)

    @property
    def theta0(self) -> float:
        """Isoplanatic angle along the line of sight at 500 nm, rad: 0.314 r0 / hbar."""
        moment = sum(f * h ** (5 / 3) for f, h in zip(self.atmosphere.fractions, self.los_heights, strict=True)) ** (
            3 / 5
        )
        return math.inf if moment == 0 else 0.314 * self.los_r0 / moment

    @property
    def tau0(self) -> float:
        """Coherence time along the line of sight at 500 nm, s: 0.314 r0 / vbar."""
        layers = self.atmosphere.layers
        moment = sum(
            f * layer.wind_speed ** (5 / 3) for f, layer in zip(self.atmosphere.fractions, layers, strict=True)
        ) ** (3 / 5)
        return math.inf if moment == 0 else 0.314 * self.los_r0 / moment

    @property
    def seeing(self) -> float:
        """Seeing along the line of sight at 500 nm, rad: 0.976 lambda / r0."""
        return 0.976 * 500e-9 / self.los_r0

    def with_changes(self, changes: Mapping[str, Any]) -> System:
        """A copy with ``{dotted key: value}`` replaced, e.g. ``{"loop.rate": 1000.0, "sensors.0.rotation": 0.01}``.

        ``*`` stands for every item of a list. Numbers are SI, strings carry their unit.

        Raises:
            InstrumentError: names the key that does not exist or whose value is refused.
        """
        return _validated(_changed(self.model_dump(mode="python"), changes), self.name, {"from_file": False})


def _changed(tree: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    for key, value in changes.items():
        _assign(tree, key.split("."), value, key)
    return tree


def _assign(node: Any, path: list[str], value: Any, key: str) -> None:
    head, rest = path[0], path[1:]
    if isinstance(node, list | tuple):
        if head == "*":
            places: Iterable[int] = range(len(node))
        elif head.isdecimal() and int(head) < len(node):
            places = [int(head)]
        else:
            raise InstrumentError(f"{key}: expected an index below {len(node)} or *, got {head!r}")
        for place in places:
            if rest:
                _assign(node[place], rest, value, key)
            else:
                raise InstrumentError(f"{key}: expected a key of the item after the index")
        return
    if not isinstance(node, dict):
        raise InstrumentError(f"{key}: no such key ({head!r} is inside a value)")
    if rest and head not in node:
        raise InstrumentError(f"{key}: no such key (expected one of {', '.join(node)})")
    if rest:
        _assign(node[head], rest, value, key)
    else:
        node[head] = value


def _validated(tree: Any, source: str, context: dict[str, Any]) -> System:
    try:
        return System.model_validate(tree, context=context)
    except ValidationError as error:
        raise InstrumentError(f"{source}: {_first_problem(error)}") from None


def _first_problem(error: ValidationError) -> str:
    problems = error.errors(include_url=False, include_context=False)
    # an optional quantity that is wrong is also reported as "not None"
    problems = [p for p in problems if p["type"] != "none_required"]
    # so is a list as too short when its only item is wrong
    problems = [p for p in problems if p["type"] != "too_short" or len(problems) == 1]
    # a misspelt key is reported as missing as well: the misspelling is the news
    problems.sort(key=lambda problem: problem["type"] != "extra_forbidden")
    first = problems[0]
    key = ""
    for part in first["loc"]:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else str(part)
    key = key.removesuffix(".float").removesuffix(".constrained-float")
    message = first["msg"]
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    if first["type"] == "value_error":
        message = message.removeprefix("Value error, ")
        # validators of a whole block name the key inside it themselves
        separator = ": " if message.startswith("expected") else "."
        return f"{key}{separator}{message}{more}" if key else f"{message}{more}"
    if first["type"] == "extra_forbidden":
        message = "unknown key"
    elif first["type"] == "missing":
        message = "expected this key"
    else:
        message = message[0].lower() + message[1:]
        if not isinstance(first["input"], dict | list | tuple):
            message += f", got {first['input']!r}"
    return f"{key}: {message}{more}" if key else f"{message}{more}"


def system_names() -> tuple[str, ...]:
    """Names of the instruments that come with srtomo."""
    folder = resources.files("srtomo_core") / "systems"
    return tuple(sorted(item.name.removesuffix(".yaml") for item in folder.iterdir() if item.name.endswith(".yaml")))


def load_system(name: str | Path, changes: Mapping[str, Any] | None = None) -> System:
    """Read an instrument by name (see :func:`system_names`) or from a user's own YAML file.

    Args:
        name: a name without a path, or a path to a file that ends in ``.yaml`` or ``.yml``.
        changes: dotted keys to replace, as in :meth:`System.with_changes`.

    Raises:
        InstrumentError: in one line, which key is wrong and what was expected.
    """
    text_name = str(name)
    if text_name.endswith((".yaml", ".yml")):
        try:
            text, source = Path(name).read_text(encoding="utf-8"), Path(name).name
            folder = Path(name).resolve().parent
        except OSError as error:
            raise InstrumentError(f"{text_name}: {error.strerror or error}") from None
        except UnicodeDecodeError:
            raise InstrumentError(f"{text_name}: not a text file") from None
    elif text_name in system_names():
        text = (resources.files("srtomo_core") / "systems" / f"{text_name}.yaml").read_text(encoding="utf-8")
        source, folder = f"{text_name}.yaml", Path()
    else:
        raise InstrumentError(f"{text_name}: expected the path of a .yaml file or one of {', '.join(system_names())}")
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark is not None else ""
        raise InstrumentError(f"{source}:{where} not valid YAML ({getattr(error, 'problem', error)})") from None
    if not isinstance(tree, dict):
        raise InstrumentError(f"{source}: expected keys such as telescope, sensors and mirrors")
    system = _validated(tree, source, {"from_file": True, "folder": folder})
    return system.with_changes(changes) if changes else system


def describe(system: System) -> dict[str, float]:
    """Derived quantities of the sky, SI: seeing, r0 and theta0 along the line of sight, tau0."""
    return {
        "los_r0_m": system.los_r0,
        "seeing_arcsec": system.seeing / ARCSEC,
        "theta0_arcsec": system.theta0 / ARCSEC,
        "tau0_s": system.tau0,
    }
