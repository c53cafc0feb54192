"""``srtomo reconstruct``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from srtomo_ops.options import add_json, add_system, system_of, writable_file, write_json
from srtomo_ops.progress import Progress
from srtomo_srtc.model import ground_prior
from srtomo_srtc.reconstructors import implicit

EXAMPLE = "example:\n  srtomo reconstruct gnao_ltao_sr -o sr.npz"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="the .npz to write")
    parser.add_argument(
        "--prior",
        choices=("file", "ground"),
        default="file",
        help="turbulence profile supposed: the instrument file's, or all of it at the ground (default: file)",
    )
    parser.add_argument("--label", default="", help="a name for people (default: the prior)")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    writable_file(options.output)
    believed = ground_prior(system) if options.prior == "ground" else system
    start = time.perf_counter()
    with Progress("reconstructor") as progress:
        reconstructor, G = implicit(believed, label=options.label or options.prior, progress=progress.stage)
    seconds = time.perf_counter() - start
    reconstructor.save(options.output, G)
    print(
        f"{options.output}: {reconstructor.id:016x}, {reconstructor.n_commands} commands x "
        f"{reconstructor.n_slopes} slopes, gain {reconstructor.gain:g}, {seconds:.1f} s"
    )
    write_json(
        options.json,
        {
            "system": system.name,
            "id": f"{reconstructor.id:016x}",
            "sha256": reconstructor.sha256.hex(),
            "commands": reconstructor.n_commands,
            "slopes": reconstructor.n_slopes,
            "seconds": seconds,
            "output": str(options.output),
            "provenance": dict(reconstructor.provenance),
        },
    )
    return 0
