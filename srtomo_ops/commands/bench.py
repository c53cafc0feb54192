"""``srtomo bench``."""

from __future__ import annotations

import argparse
import os

from srtomo_ops.bench.reconstruct import measure
from srtomo_ops.options import add_json, add_system, system_of, write_json
from srtomo_ops.progress import Progress

EXAMPLE = """examples:
  srtomo bench reconstruct gnao_ltao_sr
  srtomo bench reconstruct mavis --threads 2 --json mavis.json"""

_GIB = 2**30


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("what", metavar="WHAT", choices=("reconstruct",), help="reconstruct: build a reconstructor")
    add_system(parser, default="gnao_ltao_sr")
    cores = len(os.sched_getaffinity(0))
    parser.add_argument("--threads", type=int, default=cores, help=f"to compute with (default: {cores}, all cores)")
    parser.add_argument(
        "--exact", action="store_true", help="float64, nothing interpolated (default: as fast as it goes)"
    )
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.threads < 1:
        raise ValueError(f"--threads: expected at least 1, got {options.threads}")
    system = system_of(options)
    with Progress("reconstructor") as progress:
        build = measure(system, fast=not options.exact, threads=options.threads, progress=progress.stage)
    fraction = build.solving_rate / build.gemm_flops
    precision = "float64" if options.exact else "float32"
    print(
        f"{system.name}: {build.commands} commands x {build.slopes} slopes, {options.threads} threads, {precision}; "
        f"residual {build.residual:.1e}"
    )
    for stage, seconds in build.stages.items():
        print(f"  {stage:<28} {seconds:9.2f} s")
    print(f"  {'all':<28} {build.seconds:9.2f} s")
    print(f"  {'peak memory':<28} {build.peak_bytes / _GIB:9.2f} GiB")
    print(f"  {'solution':<28} {build.solving_rate / 1e9:9.1f} GFLOP/s, {fraction:.0%} of a matrix product's")
    write_json(
        options.json,
        {
            "system": system.name,
            "commands": build.commands,
            "slopes": build.slopes,
            "threads": options.threads,
            "precision": precision,
            "seconds": build.seconds,
            "stage_seconds": build.stages,
            "peak_bytes": build.peak_bytes,
            "solving_gflops": build.solving_rate / 1e9,
            "gemm_gflops": build.gemm_flops / 1e9,
            "fraction_of_gemm": fraction,
            "residual": build.residual,
        },
    )
    return 0
