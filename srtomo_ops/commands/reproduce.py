"""``srtomo reproduce``."""

from __future__ import annotations

import argparse
import time

from srtomo_ops.options import add_json, write_json
from srtomo_ops.progress import Progress
from srtomo_ops.reproduce import gnao
from srtomo_ops.reproduce.trials import measure
from srtomo_ops.simulate import SETTLING

EXAMPLE = """example:
  srtomo reproduce gnao --seeds 3 --json gnao.json
  three GNAO-like systems at four brightnesses, 1000 frames at 1 kHz: 5 minutes and 1.3 GB on one core
exit code: 0 every statement holds, 1 one does not"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "study", metavar="STUDY", choices=("gnao",), help="gnao: laser tomography on 8 m with and without SR"
    )
    parser.add_argument("--seeds", type=int, default=3, help="skies to average over: 1, 2, ... (default: 3)")
    parser.add_argument("--frames", type=int, default=1000, help="exposures of each run (default: 1000)")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command; exit code 1 if a statement does not hold."""
    if options.seeds < 1:
        raise ValueError(f"--seeds: expected at least 1, got {options.seeds}")
    if options.frames <= SETTLING:
        raise ValueError(f"--frames: expected more than {SETTLING}, which are left out while the loop settles")
    start = time.perf_counter()
    with Progress("gnao") as progress:
        outcomes = measure(gnao.trials(), range(1, options.seeds + 1), options.frames, progress.stage)
    rows, fitting, statements = gnao.table(outcomes), gnao.fitting_table(outcomes), gnao.statements(outcomes)

    print(f"WFE on axis, tip-tilt removed, nm rms: mean of {options.seeds} seeds, {options.frames} frames at 1 kHz")
    print(f"{'system':<16} {'electrons':>9} {'scaled prior':>20} {'unscaled prior':>20} {'reference':>10}")
    for row in rows:
        scaled, unscaled = (
            f"{row[f'{prior}_nm']:.1f} ({row[f'{prior}_difference']:+.1%})" for prior in (gnao.SCALED, gnao.UNSCALED)
        )
        print(f"{row['system']:<16} {row['electrons']:>9} {scaled:>20} {unscaled:>20} {row['reference_nm']:>10.1f}")
    print("\npure fitting, nm rms")
    print(f"{'system':<16} {'measured':>9} {'closed form':>12} {'reference':>10}")
    for row in fitting:
        print(
            f"{row['system']:<16} {row['fitting_nm']:>9.1f} {row['closed_form_nm']:>12.1f} {row['reference_nm']:>10.1f}"
        )
    print()
    for statement in statements:
        print(
            f"{'holds' if statement.holds else 'FAILS'}  {statement.text}: {statement.found}; wanted {statement.wanted}"
        )
    write_json(
        options.json,
        {
            "study": options.study,
            "seeds": options.seeds,
            "frames": options.frames,
            "wfe": rows,
            "fitting": fitting,
            "statements": [statement._asdict() for statement in statements],
            "seconds": time.perf_counter() - start,
        },
    )
    return 0 if all(statement.holds for statement in statements) else 1
