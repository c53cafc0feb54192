"""Quantities with units, as written in instrument files: ``"7.5 arcsec"`` in, SI floats out."""

from __future__ import annotations

import math
import re
from typing import Annotated

from pydantic import BeforeValidator, ValidationInfo

_UNITS = {
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "km": 1e3},
    "angle": {"rad": 1.0, "deg": math.pi / 180, "arcmin": math.pi / 10800, "arcsec": math.pi / 648000,
              "mas": math.pi / 648e6},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6},
    "frequency": {"Hz": 1.0, "kHz": 1e3},
    "flux": {"e/m2/s": 1.0, "e/cm2/s": 1e4},
    "charge": {"e": 1.0},
    "delay": {"frame": 1.0, "frames": 1.0},
    "shift": {"subaperture": 1.0},
}  # fmt: skip
_EXAMPLE = {
    "length": "8 m",
    "angle": "7.5 arcsec",
    "speed": "5.6 m/s",
    "frequency": "500 Hz",
    "flux": "1.16e6 e/m2/s",
    "charge": "0.5 e",
    "delay": "2 frames",
    "shift": "0.25 subaperture",
}
_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z][A-Za-z0-9/]*)\s*$")

ARCSEC = math.pi / 648000
"""One second of arc in radians."""


def parse(kind: str, value: object) -> float:
    """Read a quantity of ``kind`` (a key of the table above) into SI units.

    Raises:
        ValueError: if the value has no unit, or one that does not measure ``kind``.
    """
    units = _UNITS[kind]
    match = _QUANTITY.match(value) if isinstance(value, str) else None
    if match is None or match.group(2) not in units:
        article = "an" if kind == "angle" else "a"
        raise ValueError(
            f"expected {article} {kind} such as '{_EXAMPLE[kind]}' (units: {', '.join(units)}), got {value!r}"
        )
    number = float(match.group(1)) * units[match.group(2)]
    if not math.isfinite(number):
        raise ValueError(f"expected a finite {kind}, got {value!r}")
    return number


def _reader(kind: str) -> BeforeValidator:
    def read(value: object, info: ValidationInfo) -> float:
        # Models are also built, and copied with changes, in Python, where a number is SI already;
        # in a file a bare number is a missing unit.
        number = isinstance(value, float | int) and not isinstance(value, bool)
        if number and not (info.context or {}).get("from_file"):
            return float(value)  # type: ignore[arg-type]
        return parse(kind, value)

    return BeforeValidator(read)


Length = Annotated[float, _reader("length")]
Angle = Annotated[float, _reader("angle")]
Speed = Annotated[float, _reader("speed")]
Frequency = Annotated[float, _reader("frequency")]
Flux = Annotated[float, _reader("flux")]
Charge = Annotated[float, _reader("charge")]
Delay = Annotated[float, _reader("delay")]
Shift = Annotated[float, _reader("shift")]
