"""``srtomo bag info`` and ``srtomo bag repair``."""

from __future__ import annotations

import argparse
from pathlib import Path

from srtomo_core.bag import BagReader, repair
from srtomo_ops.options import add_json, write_json

EXAMPLE = "examples:\n  srtomo bag info night1\n  srtomo bag repair night1 -o night1_mended"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("action", choices=("info", "repair"), help="what to do")
    parser.add_argument("bag", metavar="BAG", type=Path, help="directory or .mcap file")
    parser.add_argument("-o", "--output", metavar="BAG", type=Path, help="repair: the directory to make")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.action == "repair":
        if options.output is None:
            raise ValueError("repair: expected -o BAG")
        count = repair(options.bag, options.output)
        print(f"{options.output}: {count} messages")
        write_json(options.json, {"messages": count, "output": str(options.output)})
        return 0
    with BagReader(options.bag) as reader:
        first, last = reader.time_range
        seconds = (last - first) * 1e-9
        print(f"{options.bag}: {reader.message_count} messages in {seconds:.1f} s")
        if reader.cut:
            print(reader.cut)
        for topic, kind in reader.topics.items():
            print(f"  {reader.counts[topic]:>8}  {topic:<32} {kind}")
        write_json(
            options.json,
            {
                "messages": reader.message_count,
                "seconds": seconds,
                "cut": reader.cut,
                "topics": {topic: reader.counts[topic] for topic in reader.topics},
                "created": reader.metadata.get("created"),
                "fingerprint": reader.metadata.get("fingerprint"),
            },
        )
    return 0
