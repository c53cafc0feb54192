"""Arguments that several sub-commands share, and the JSON that those with numbers write."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from srtomo_core.system import System, load_system


def add_system(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """``SYSTEM`` and ``--set KEY=VALUE``."""
    text = "name (see 'srtomo systems') or path of a .yaml file"
    if default is None:
        parser.add_argument("system", metavar="SYSTEM", help=text)
    else:
        parser.add_argument("system", metavar="SYSTEM", nargs="?", default=default, help=f"{text} (default: {default})")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="change the instrument, with unit, e.g. --set 'loop.rate=1 kHz' --set 'sensors.*.photons=3e5 e/m2/s'",
    )


def add_registration(parser: argparse.ArgumentParser) -> None:
    """``--registration FILE``."""
    parser.add_argument(
        "--registration",
        metavar="FILE",
        type=Path,
        help="sensors where 'srtomo register --json FILE' found them; slopes, commands and fingerprint stay",
    )


def assignments(items: list[str], option: str) -> dict[str, Any]:
    """``KEY=VALUE`` items: values are JSON where they can be, otherwise strings.

    Raises:
        ValueError: one is not of that form.
    """
    values: dict[str, Any] = {}
    for item in items:
        key, separator, value = item.partition("=")
        if not separator or not key:
            raise ValueError(f"{option} {item}: expected KEY=VALUE")
        try:
            values[key] = json.loads(value)
        except json.JSONDecodeError:
            values[key] = value
    return values


def seconds(text: str) -> float:
    """A time as ``10`` or ``10 s``, for argparse.

    Raises:
        argparse.ArgumentTypeError: anything else, or less than 0.
    """
    try:
        value = float(text.strip().removesuffix("s"))
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a time such as '10 s', got {text!r}")
    return value


def add_schedule(parser: argparse.ArgumentParser) -> None:
    """``--at TIME KEY=VALUE ...``: what changes in the simulated plant on the way."""
    parser.add_argument(
        "--at",
        metavar=("TIME", "KEY=VALUE"),
        nargs="+",
        action="append",
        default=[],
        help="change sky, light or a sensor's place on the way; over=TIME lets it take that long: "
        "--at '2 s' 'atmosphere.r0=10 cm' 'over=5 s'; may be given again",
    )


def schedule_of(options: argparse.Namespace) -> list[dict[str, Any]]:
    """``--at`` as :func:`srtomo_sim.course.scheduled` takes it.

    Raises:
        ValueError: not of the form TIME KEY=VALUE.
    """
    schedule = []
    for time, *items in options.at:
        values = assignments(items, f"--at {time}")
        try:
            entry = {"at": seconds(time), "over": seconds(str(values.pop("over", 0))), "set": values}
        except argparse.ArgumentTypeError as error:
            raise ValueError(f"--at {time}: {error}") from None
        if not values:
            raise ValueError(f"--at {time}: expected KEY=VALUE after it")
        schedule.append(entry)
    return schedule


def changes_of(options: argparse.Namespace) -> dict[str, Any]:
    """``--set`` as dotted keys.

    Raises:
        ValueError: not of the form KEY=VALUE.
    """
    return assignments(options.set, "--set")


def system_of(options: argparse.Namespace) -> System:
    """The instrument that ``SYSTEM`` and ``--set`` describe."""
    return load_system(options.system, changes_of(options))


def add_json(parser: argparse.ArgumentParser) -> None:
    """``--json FILE``."""
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the numbers to FILE as JSON")


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Write ``content``, if a path was given.

    Raises:
        ValueError: the file cannot be written.
    """
    if path is None:
        return
    try:
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None


def writable_file(path: Path) -> Path:
    """A path that something will be written to, checked before any work.

    Raises:
        ValueError: its folder does not exist, or it is a folder.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: no such folder")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder")
    return path
