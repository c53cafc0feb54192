"""``srtomo calibrate``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import save_interaction_matrix
from srtomo_core.system import System
from srtomo_ops.options import add_json, add_registration, add_system, system_of, writable_file, write_json
from srtomo_sim.mirror import interaction_matrix
from srtomo_srtc.registration import registered_layout

EXAMPLE = "example:\n  srtomo calibrate gnao_ltao_sr -o gnao_gcal.npz"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="the .npz to write")
    add_registration(parser)
    add_json(parser)


def calibrate(system: System, path: Path, registration: Path | None = None) -> Layout:
    """Poke every actuator of the simulated instrument and write the interaction matrix, rad/m.

    Args:
        registration: file that says where its sensors are.
    """
    layout, places = registered_layout(registration, system)
    G = interaction_matrix(system, layout)
    source: dict[str, Any] = {"source": "simulated instrument", "system": system.name}
    save_interaction_matrix(path, G, layout.fingerprint, source | ({"registration": places} if places else {}))
    return layout


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    layout = calibrate(system, writable_file(options.output), options.registration)
    print(f"{options.output}: {layout.n_slopes} slopes x {layout.n_commands} commands, rad/m")
    write_json(
        options.json,
        {
            "system": system.name,
            "slopes": layout.n_slopes,
            "commands": layout.n_commands,
            "output": str(options.output),
        },
    )
    return 0
