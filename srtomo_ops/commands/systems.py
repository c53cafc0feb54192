"""``srtomo systems``."""

from __future__ import annotations

import argparse
import json
from typing import Any

import yaml

from srtomo_core.layout import Layout
from srtomo_core.system import System, describe, load_system, system_names
from srtomo_ops.options import add_json, changes_of, write_json

EXAMPLE = "example:\n  srtomo systems gnao_ltao_sr --json gnao.json"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("system", metavar="NAME", nargs="?", help="name or path of a .yaml file; none: list them all")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", action="append", default=[], help="change it, e.g. 'loop.rate=1 kHz'"
    )
    add_json(parser)


def derived(system: System) -> dict[str, Any]:
    """What follows from an instrument's file: sizes, rate, and the sky along the line of sight."""
    layout = Layout(system)
    return {
        "slopes": layout.n_slopes,
        "commands": layout.n_commands,
        "matrix_bytes": 4 * layout.n_slopes * layout.n_commands,
        "subapertures": {s.name: s.n_valid for s in layout.sensors},
        "actuators": {m.name: m.n_actuators for m in layout.mirrors},
        "rate_hz": system.loop.rate,
        **describe(system),
        "fingerprint": layout.fingerprint.hex(),
    }


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.system is None:
        rows = {name: load_system(name) for name in system_names()}
        for name, system in rows.items():
            print(f"{name:<18} {system.description}")
        write_json(options.json, {name: derived(system) for name, system in rows.items()})
        return 0
    system = load_system(options.system, changes_of(options))
    print("# SI units: m, rad, s, Hz, electrons; heights and r0 at zenith")
    print(yaml.safe_dump(json.loads(system.model_dump_json()), sort_keys=False, allow_unicode=True).rstrip())
    numbers = derived(system)
    print("\n# derived; sky along the line of sight at 500 nm")
    print(yaml.safe_dump(numbers, sort_keys=False).rstrip())
    write_json(options.json, {"system": json.loads(system.model_dump_json()), "derived": numbers})
    return 0
