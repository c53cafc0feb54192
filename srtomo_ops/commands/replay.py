"""``srtomo replay``."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from srtomo_core.bag import BagReader
from srtomo_core.reconstructor import Reconstructor
from srtomo_ops.options import add_json, write_json
from srtomo_ops.progress import Progress
from srtomo_rtc.replay import Replay

EXAMPLE = """examples:
  srtomo replay night1                    compare every command bit for bit
  srtomo replay night1 --from 20000       start in the middle
  srtomo replay night1 --publish          feed the slopes to a live HRTC at the recorded pace
exit code: 0 all equal, 1 some differ, 2 cannot be replayed"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("bag", metavar="BAG", type=Path, help="directory or .mcap file")
    parser.add_argument("--from", dest="start", metavar="FRAME", type=int, default=0, help="first frame (default: 0)")
    parser.add_argument(
        "--reconstructor",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="one that the HRTC had from a file, not from the wire; may be repeated",
    )
    parser.add_argument("--publish", action="store_true", help="publish the slopes to a live HRTC instead")
    parser.add_argument("--namespace", default="", help="with --publish: of the topics (default: none)")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    with BagReader(options.bag) as reader:
        if reader.cut:
            print(reader.cut)
        if options.publish:
            from srtomo_ops.publish import publish_slopes

            count = publish_slopes(reader, options.namespace, options.start)
            print(f"published {count} messages")
            write_json(options.json, {"published": count})
            return 0
        replay = Replay(reader, [Reconstructor.load(path) for path in options.reconstructor])
        with Progress("replay") as progress:
            outcome = replay.run(options.start, progress.share)
    print(
        f"{outcome.compared} frames compared ({outcome.first_frame} to {outcome.last_frame}, {outcome.held} held), "
        f"{outcome.differing} differ"
    )
    for line in outcome.first_differing:
        print(f"  {line}")
    if outcome.unanswered:
        print(f"{outcome.unanswered} frames with slopes have no recorded command")
    if outcome.skipped:
        print(f"{outcome.skipped} frames could not be replayed:")
    for line in outcome.gaps:
        print(f"  {line}")
    write_json(options.json, {**asdict(outcome), "cut": reader.cut})
    return 1 if outcome.differing else 0
