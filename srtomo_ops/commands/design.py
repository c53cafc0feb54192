"""``srtomo design``."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np

from srtomo_ops.options import add_json, add_system, system_of, writable_file, write_json
from srtomo_ops.progress import Progress
from srtomo_ops.report import design_figure
from srtomo_srtc.design import VARIABLES, changed, cuts, misalignment, optimise

EXAMPLE = """examples:
  srtomo design mini --vary shifts -o shifts.png
  srtomo design gnao_ltao --vary clockings --evaluations 100 -o clockings.png --json clockings.json"""

_AMOUNTS = (0.0, 0.05, 0.1, 0.15, 0.2)


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    parser.add_argument(
        "--vary", choices=sorted(VARIABLES), default="shifts", help="what may change (default: shifts of the sensors)"
    )
    parser.add_argument("--evaluations", type=int, default=200, help="of the search, at most (default: 200)")
    parser.add_argument("--seed", type=int, default=1, help="of the search's second start (default: 1)")
    parser.add_argument("--points", type=int, default=7, help="of each cut through the optimum (default: 7)")
    cores = os.cpu_count() or 1
    parser.add_argument("--threads", type=int, default=cores, help=f"to compute with (default: {cores}, all cores)")
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, help="write a figure: cuts, cost of misalignment")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    if options.output:
        writable_file(options.output)
    if options.points < 3:
        raise ValueError(f"--points: expected at least 3, got {options.points}")
    if options.threads < 1:
        raise ValueError(f"--threads: expected at least 1, got {options.threads}")
    start = time.perf_counter()
    threads = options.threads
    variables = VARIABLES[options.vary](system)
    with Progress(f"design, {options.vary}") as progress:
        found = optimise(
            system,
            variables,
            evaluations=options.evaluations,
            seed=options.seed,
            threads=threads,
            progress=progress.share,
        )
    print(f"{system.name}, {options.vary}: still sky, best reconstructor, nm rms without tip-tilt")
    print(f"  as it is  {found.start_wfe * 1e9:8.2f}")
    print(f"  best      {found.wfe * 1e9:8.2f}   after {found.evaluations} evaluations")
    for variable, value in zip(variables, found.values, strict=True):
        print(f"    {variable.name:<36} {variable.start:+8.3f} -> {value:+8.3f}")
    with Progress("flatness") as progress:
        lines = cuts(system, variables, found.values, points=options.points, threads=threads, progress=progress.share)
    with Progress("misalignment") as progress:
        chosen = changed(system, variables, found.values)
        cost = misalignment(chosen, _AMOUNTS, threads=threads, progress=progress.share)
    extra = (f"{amount:g}: {(wfe - cost[0]) * 1e9:+.1f} nm" for amount, wfe in zip(_AMOUNTS[1:], cost[1:]))
    print("  sensors off by an unknown shift [sub-aperture]: " + ", ".join(extra))
    if options.output:
        design_figure(options.output, f"{system.name}: {options.vary}", found, lines, np.array(_AMOUNTS), cost)
    write_json(
        options.json,
        {
            "system": system.name,
            "vary": options.vary,
            "start_wfe_nm": found.start_wfe * 1e9,
            "best_wfe_nm": found.wfe * 1e9,
            "evaluations": found.evaluations,
            "variables": [
                {"name": v.name, "start": v.start, "best": float(value), "low": v.low, "high": v.high}
                for v, value in zip(variables, found.values, strict=True)
            ],
            "cuts": [
                {"name": cut.variable.name, "values": cut.values.tolist(), "wfe_nm": (cut.wfe * 1e9).tolist()}
                for cut in lines
            ],
            "misalignment": [
                {"shift_subaperture": a, "wfe_nm": float(w) * 1e9} for a, w in zip(_AMOUNTS, cost, strict=True)
            ],
            "seconds": time.perf_counter() - start,
        },
    )
    return 0
