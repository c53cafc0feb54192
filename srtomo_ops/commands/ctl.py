"""``srtomo ctl``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from srtomo_ops.options import add_json, write_json

if TYPE_CHECKING:
    from srtomo_ops.operator import Operator

EXAMPLE = """examples:
  srtomo ctl configure                      allocate, load, lock, warm
  srtomo ctl activate                       run
  srtomo ctl publish file                   have the SRTC publish its reconstructor 'file'
  srtomo ctl commit 0123456789abcdef 0123...   id and SHA-256, in hex, as 'srtomo ctl publish' printed them
  srtomo ctl close                          close the loop
  srtomo ctl status"""

_ACTIONS = (
    "status", "configure", "activate", "deactivate", "cleanup", "close", "open", "start-sim", "publish", "commit",
    "roll-back",
)  # fmt: skip


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("action", choices=_ACTIONS, metavar="ACTION", help=", ".join(_ACTIONS))
    parser.add_argument("words", metavar="WORD", nargs="*", help="publish: LABEL; commit, roll-back: ID SHA256 (hex)")
    parser.add_argument("--namespace", default="", help="of the instrument (default: none)")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    import rclpy

    from srtomo_ops.operator import TRANSITIONS, Operator

    expected = {"publish": 1, "commit": 2, "roll-back": 2}.get(options.action, 0)
    if len(options.words) != expected:
        raise ValueError(f"{options.action}: expected {expected} words after it, got {len(options.words)}")
    rclpy.init()
    operator = Operator(options.namespace, "ctl")
    numbers: dict[str, object] = {}
    try:
        if options.action in TRANSITIONS:
            operator.transition(options.action)
        elif options.action in ("close", "open"):
            operator.close_loop(options.action == "close")
        elif options.action == "start-sim":
            operator.start_sim()
        elif options.action == "publish":
            identity, sha256 = operator.publish(options.words[0])
            operator.wait_staged(identity)
            numbers = {"id": f"{identity:016x}", "sha256": sha256.hex()}
        elif options.action in ("commit", "roll-back"):
            identity, sha256 = int(options.words[0], 16), bytes.fromhex(options.words[1])
            numbers = {"first_frame": operator.commit(identity, sha256, roll_back=options.action == "roll-back")}
        else:
            numbers = _status(operator)
    finally:
        operator.destroy_node()
        rclpy.shutdown()
    for name, value in numbers.items():
        print(f"{name:<22} {value}")
    if not numbers:
        print("done")
    write_json(options.json, numbers)
    return 0


def _status(operator: Operator) -> dict[str, object]:
    operator.spin(1.5)
    if operator.hrtc is None:
        raise ValueError(f"no HRTC in namespace {operator.get_namespace()}")
    return {
        name: getattr(operator.hrtc, name)
        for name in operator.hrtc.get_fields_and_field_types()
        if name not in ("header",)
    }
