"""``srtomo demo``."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

from srtomo_ops.options import add_json, add_system, changes_of, system_of, write_json

EXAMPLE = "example:\n  srtomo demo gnao_ltao_sr --seconds 20 --seed 1 --json demo.json"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser, "gnao_ltao_sr")
    parser.add_argument("--seconds", type=float, default=20.0, help="of loop, s (default: 20)")
    parser.add_argument("--seed", type=int, default=1, help="of sky, noise and jitter (default: 1)")
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, help="for bag, figure and logs (default: demo-DATE-TIME)"
    )
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command; exit code 1 if a frame was lost or the loop opened by itself."""
    system = system_of(options)
    if not options.seconds >= 1:
        raise ValueError(f"--seconds: expected at least 1, got {options.seconds:g}")
    folder = options.output or Path(time.strftime("demo-%Y%m%d-%H%M%S"))
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise ValueError(f"{folder}: {error.strerror or error}") from None

    from domain_coordinator import domain_id
    from rich.console import Console

    from srtomo_ops.demo import Demo, summary

    # in a file nothing is to be wrapped at 80 columns, paths least of all
    console = Console(width=None if sys.stdout.isatty() else 160)
    with domain_id() as domain:
        # a domain of its own: two demos on one machine must not mix
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        demo = Demo(system, options.system, changes_of(options), options.seconds, options.seed, folder, console)
        numbers = demo.run()
    console.print(summary(numbers), highlight=False)
    write_json(options.json, numbers)
    whole = numbers["frames"] == numbers["frames_recorded"] == numbers["frames_answered"]
    return 0 if whole and numbers["messages_lost"] == 0 and numbers["loop_opened_by_faults"] == 0 else 1
