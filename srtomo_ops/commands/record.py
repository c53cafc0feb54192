"""``srtomo record``."""

from __future__ import annotations

import argparse
from pathlib import Path

from srtomo_ops.options import add_json, add_system, system_of, write_json

EXAMPLE = "example:\n  srtomo record gnao_ltao_sr -o night1 --namespace gnao"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    parser.add_argument("-o", "--output", metavar="BAG", type=Path, required=True, help="directory to make")
    parser.add_argument("--namespace", default="", help="of the topics (default: none)")
    parser.add_argument("--topics", metavar="NAME", nargs="+", help="only these, e.g. wfs/slopes (default: all)")
    parser.add_argument("--split", metavar="MB", type=float, help="begin a new file at this size")
    parser.add_argument(
        "--limit", metavar="MB", type=float, help="remove the oldest files beyond this size; needs --split"
    )
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Record until SIGINT or SIGTERM; exit code 1 if something that should be in the bag is not."""
    system = system_of(options)
    from srtomo_rtc.recorder_node import run, table

    split, limit = (None if size is None else int(size * 1e6) for size in (options.split, options.limit))
    report = run(
        options.output,
        system,
        namespace=options.namespace,
        topics=options.topics,
        split_bytes=split,
        limit_bytes=limit,
    )
    print(table(report))
    write_json(options.json, report)
    return 1 if report["lost"] else 0
