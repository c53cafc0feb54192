"""``srtomo bench``."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from srtomo_core.reconstructor import Reconstructor
from srtomo_ops.bench import kernels, latency, soak
from srtomo_ops.bench.latency_report import numbers, report
from srtomo_ops.bench.reconstruct import measure
from srtomo_ops.options import add_json, add_system, changes_of, system_of, write_json
from srtomo_ops.progress import Progress
from srtomo_rtc.crew import candidates
from srtomo_rtc.vmm import instructions

if TYPE_CHECKING:
    from srtomo_ops.bench.path import Paths

EXAMPLE = """examples:
  srtomo bench reconstruct gnao_ltao_sr
  srtomo bench reconstruct mavis --threads 2 --json mavis.json
  srtomo bench latency gnao_ltao_sr --json latency.json
  srtomo bench soak gnao_ltao_sr --frames 20000
  srtomo reconstruct gnao_ltao_sr -o sr.npz && srtomo bench kernels gnao_ltao_sr --reconstructor sr.npz"""

_GIB = 2**30
_FRAMES = {"latency": 250, "kernels": 250, "soak": 1_000_000}


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "what",
        metavar="WHAT",
        choices=("reconstruct", "latency", "kernels", "soak"),
        help="reconstruct: build a reconstructor; latency: slopes to command; kernels: float32, int16 and low rank "
        "beside each other; soak: a million frames with swaps and faults, each checked",
    )
    add_system(parser, default="gnao_ltao_sr")
    cores = len(os.sched_getaffinity(0))
    build = parser.add_argument_group("reconstruct")
    build.add_argument(
        "--threads",
        type=int,
        default=cores,
        help=f"to compute with (default: {cores}, all cores); kernels: the most to try",
    )
    build.add_argument(
        "--exact", action="store_true", help="float64, nothing interpolated (default: as fast as it goes)"
    )
    loop = parser.add_argument_group("latency")
    loop.add_argument(
        "--frames",
        type=int,
        help=f"of one turn (default: {_FRAMES['latency']}); of each kernel ({_FRAMES['kernels']}); "
        f"of a soak: all ({_FRAMES['soak']})",
    )
    loop.add_argument("--pairs", type=int, default=10, help="of turns, HRTC and echo, of each arrival (default: 10)")
    loop.add_argument("--packets", type=int, default=4, help="a sensor and frame when staggered (default: 4)")
    loop.add_argument("--fifo-priority", type=int, default=0, help="SCHED_FIFO, also of kernels (default: 0, none)")
    loop.add_argument("--compute-only", action="store_true", help="without processes, without ROS")
    loop.add_argument(
        "--reconstructor",
        metavar="FILE",
        type=Path,
        help="to run (default: least squares, of the same size); kernels: has to be given, ranks depend on it",
    )
    long = parser.add_argument_group("soak")
    long.add_argument("--swap-every", metavar="N", type=int, default=1000, help="frames (default: 1000)")
    long.add_argument("--split", metavar="MB", type=float, default=500.0, help="size of a recorded file (default: 500)")
    long.add_argument("--folder", metavar="DIR", type=Path, help="for recording and logs (default: a temporary one)")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command; exit code 1 if a target is missed."""
    if options.frames is None:
        options.frames = _FRAMES.get(options.what)
    run = {"latency": _latency, "kernels": _kernels, "soak": _soak, "reconstruct": _reconstruct}
    return run[options.what](options)


def _reconstruct(options: argparse.Namespace) -> int:
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
    print(f"  {'all':<28} {build.seconds:9.2f} s, {build.cpu_seconds:.2f} s of CPU time")
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
            "cpu_seconds": build.cpu_seconds,
            "stage_seconds": build.stages,
            "peak_bytes": build.peak_bytes,
            "solving_gflops": build.solving_rate / 1e9,
            "gemm_gflops": build.gemm_flops / 1e9,
            "fraction_of_gemm": fraction,
            "residual": build.residual,
        },
    )
    return 0


def _kernels(options: argparse.Namespace) -> int:
    if options.reconstructor is None:
        raise ValueError("--reconstructor: expected a file of 'srtomo reconstruct': ranks depend on it")
    for name in ("frames", "threads"):
        if getattr(options, name) < 1:
            raise ValueError(f"--{name}: expected at least 1, got {getattr(options, name)}")
    _check_priority(options)
    system = system_of(options)
    with Progress("kernels") as progress:
        rows = kernels.measure(
            system,
            Reconstructor.load(options.reconstructor),
            candidates(options.threads),
            options.frames,
            fifo_priority=options.fifo_priority,
            progress=progress.stage,
        )
    print("\n".join([f"{system.name}, {options.frames} frames each, {instructions()}", *kernels.table(rows)]))
    write_json(
        options.json,
        {
            "system": system.name,
            "frames": options.frames,
            "instructions": instructions(),
            "kernels": [{**vars(row), "median": row.median} for row in rows],
        },
    )
    return 0


def _check_priority(options: argparse.Namespace) -> None:
    if not 0 <= options.fifo_priority <= 99:
        raise ValueError(f"--fifo-priority: expected 0 to 99, got {options.fifo_priority}")


def _latency(options: argparse.Namespace) -> int:
    _check_priority(options)
    if options.fifo_priority and options.compute_only:
        raise ValueError("--fifo-priority: of the whole path, not of --compute-only")
    for name, least in (("frames", 5), ("pairs", 2), ("packets", 1)):
        if getattr(options, name) < least:
            raise ValueError(f"--{name}: expected at least {least}, got {getattr(options, name)}")
    if not options.compute_only:
        import rclpy  # noqa: F401  # before any work: without ROS there is only --compute-only
    system = system_of(options)
    given = Reconstructor.load(options.reconstructor) if options.reconstructor else None
    problem = latency.Problem.of(system, given, options.packets)
    compute = latency.measure_compute(problem, options.frames * options.pairs)
    paths = None if options.compute_only else _paths(options, problem)
    lines, met = report(problem, compute, paths)
    print("\n".join(lines))
    write_json(
        options.json,
        {"frames_per_turn": options.frames, "pairs": options.pairs, **numbers(problem, compute, paths)},
    )
    return 0 if met else 1


def _paths(options: argparse.Namespace, problem: latency.Problem) -> Paths:
    from domain_coordinator import domain_id

    from srtomo_ops.bench.path import measure_paths

    with domain_id() as domain, tempfile.TemporaryDirectory(prefix="srtomo-bench-") as folder:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        return measure_paths(
            problem,
            options.system,
            changes_of(options),
            options.pairs,
            options.frames,
            Path(folder),
            options.fifo_priority,
        )


def _soak(options: argparse.Namespace) -> int:
    for name, least in (("frames", 200), ("swap_every", 20)):
        if getattr(options, name) < least:
            raise ValueError(f"--{name.replace('_', '-')}: expected at least {least}, got {getattr(options, name)}")
    from domain_coordinator import domain_id

    system = system_of(options)
    folder = Path(tempfile.mkdtemp(prefix="srtomo-soak-", dir=options.folder))
    kept = False
    try:
        with domain_id() as domain, Progress("soak") as progress:
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            found = soak.soak(
                system,
                options.system,
                changes_of(options),
                options.frames,
                folder,
                options.swap_every,
                options.split,
                progress=progress.share,
            )
    except ValueError as error:
        kept = True
        raise ValueError(f"{error}; logs and what was not checked yet are in {folder}") from None
    finally:
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)
    print("\n".join(soak.lines(found, system)))
    write_json(options.json, {"system": system.name, **soak.numbers(found)})
    return 0 if found.flat else 1
