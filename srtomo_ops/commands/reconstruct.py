"""``srtomo reconstruct``."""

from __future__ import annotations

import argparse
import inspect
import time
from pathlib import Path
from typing import Any

from srtomo_ops.options import add_json, add_system, assignments, system_of, writable_file, write_json
from srtomo_ops.progress import Progress
from srtomo_srtc.model import ground_prior
from srtomo_srtc.reconstructors import METHODS

EXAMPLE = """examples:
  srtomo reconstruct gnao_ltao_sr -o sr.npz
  srtomo reconstruct mini --prior ground --with kappa=1e-3 -o mini.npz"""


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
    parser.add_argument(
        "--method", choices=sorted(METHODS), default="implicit", help="how (default: implicit); see the docstrings"
    )
    parser.add_argument(
        "--with",
        dest="keywords",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="a parameter of the method, e.g. --with kappa=1e-3",
    )
    parser.add_argument("--label", default="", help="a name for people (default: the prior)")
    add_json(parser)


def keywords_of(options: argparse.Namespace) -> dict[str, Any]:
    """The method's own parameters from ``--with``.

    Raises:
        ValueError: the method has no such parameter.
    """
    names = inspect.signature(METHODS[options.method]).parameters
    own = [name for name in names if name not in ("system", "layout", "label", "progress")]
    keywords = assignments(options.keywords, "--with")
    for key in keywords:
        if key not in own:
            raise ValueError(f"--with {key}: method {options.method} takes {', '.join(own)}")
    return keywords


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    writable_file(options.output)
    keywords = keywords_of(options)
    believed = ground_prior(system) if options.prior == "ground" else system
    start = time.perf_counter()
    with Progress("reconstructor") as progress:
        reconstructor, G = METHODS[options.method](
            believed, label=options.label or options.prior, progress=progress.stage, **keywords
        )
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
