"""``srtomo ctl``."""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import TYPE_CHECKING

from srtomo_core.system import load_system
from srtomo_core.units import parse
from srtomo_ops.options import add_json, assignments, seconds, write_json

if TYPE_CHECKING:
    from srtomo_ops.operator import Operator

EXAMPLE = """examples:
  srtomo ctl configure                      allocate, load, lock, warm
  srtomo ctl activate                       run
  srtomo ctl publish file                   have the SRTC publish its reconstructor 'file'
  srtomo ctl commit 0123456789abcdef 0123...   id and SHA-256, in hex, as 'srtomo ctl publish' printed them
  srtomo ctl close                          close the loop
  srtomo ctl flat                           open it, and put the static shape on at once
  srtomo ctl set slew_limit=1e-7 gain_ramp=50    parameters of the HRTC, in their own units (m; frames)
  srtomo ctl close-sensor lgs2              a laser goes away: the commands do without its sensor
  srtomo ctl open-sensor lgs2               it is back
  srtomo ctl sky --set 'atmosphere.r0=10 cm' --over 10s    change the simulated plant while it runs
  srtomo ctl dither gnao_ltao_sr --rms 5nm --over 30s      for 'srtomo register': shakes the mirrors, then flat
  srtomo ctl status"""

_PATIENCE = 10.0  # s to find a node: one that was just started takes some seconds

_ACTIONS = (
    "status", "configure", "activate", "deactivate", "cleanup", "close", "open", "flat", "set", "start-sim", "publish",
    "commit", "roll-back", "close-sensor", "open-sensor", "sky", "dither",
)  # fmt: skip

_SENSORS = ("close-sensor", "open-sensor")


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("action", choices=_ACTIONS, metavar="ACTION", help=", ".join(_ACTIONS))
    parser.add_argument(
        "words",
        metavar="WORD",
        nargs="*",
        help="publish: LABEL; commit, roll-back: ID SHA256 (hex); dither: SYSTEM; set: NAME=VALUE ...; "
        "close-sensor, open-sensor: NAME ...",
    )
    parser.add_argument("--namespace", default="", help="of the instrument (default: none)")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="sky: what changes, with unit: atmosphere.r0, a layer's fraction or wind, a sensor's photons or place",
    )
    parser.add_argument(
        "--over", metavar="TIME", type=seconds, default=0.0, help="sky, dither: how long it takes (default: 0)"
    )
    parser.add_argument("--after", metavar="TIME", type=seconds, default=0.0, help="sky: when it begins (default: now)")
    parser.add_argument(
        "--rms", metavar="LENGTH", default="5 nm", help="dither: of the wavefront, rms over the pupil (default: 5 nm)"
    )
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from srtomo_ops.operator import TRANSITIONS, Operator

    expected = {"publish": "LABEL", "commit": "ID SHA256", "roll-back": "ID SHA256", "dither": "SYSTEM"}.get(
        options.action, ""
    )
    values = _values(options.words) if options.action == "set" else {}
    if options.action in _SENSORS:
        if not options.words:
            raise ValueError(f"{options.action}: expected the name of a sensor, or of several, after it")
    elif not values and len(options.words) != len(expected.split()):
        raise ValueError(
            f"{options.action}: expected {expected or 'nothing'} after it, got {' '.join(options.words) or 'nothing'}"
        )
    if options.action in ("commit", "roll-back"):
        identity, sha256 = _identity(*options.words)
    changes = _changes(options)
    if options.action == "dither":
        if not options.over:
            raise ValueError("dither: expected --over TIME, how long it takes")
        from srtomo_ops.dither import Dither

        dither = Dither(load_system(options.words[0]), parse("length", options.rms))
    # rclpy's own handlers end the context under the call that Ctrl-C interrupts
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    operator = Operator(options.namespace, "ctl", patience=_PATIENCE)
    numbers: dict[str, object] = {}
    try:
        if options.action in TRANSITIONS:
            operator.transition(options.action)
        elif options.action in ("close", "open"):
            operator.close_loop(options.action == "close")
        elif options.action == "flat":
            operator.flatten()
        elif options.action == "set":
            operator.change_parameters(values)
        elif options.action == "start-sim":
            operator.start_sim()
        elif options.action == "publish":
            identity, sha256 = operator.publish(options.words[0])
            operator.wait_staged(identity)
            numbers = {"id": f"{identity:016x}", "sha256": sha256.hex()}
        elif options.action in ("commit", "roll-back"):
            numbers = {"first_frame": operator.commit(identity, sha256, roll_back=options.action == "roll-back")}
        elif options.action in _SENSORS:
            first_frame, message = operator.close_sensors(options.words, options.action == "close-sensor")
            numbers = {"first_frame": first_frame, "message": message}
        elif options.action == "sky":
            numbers = {"first_frame": operator.change_sky(changes, options.over, options.after)}
        elif options.action == "dither":
            numbers = {"sign_changes": dither.run(operator, options.over)}
        else:
            numbers = _status(operator)
    finally:
        operator.destroy_node()
        rclpy.shutdown()
    for name, value in numbers.items():
        print(f"{name:<22} {'' if value is None else value}")
    if not numbers:
        print("done")
    write_json(options.json, numbers)
    return 0


def _values(words: list[str]) -> dict[str, str]:
    for word in words or [""]:
        if "=" not in word:
            raise ValueError(f"set: expected NAME=VALUE, got {word or 'nothing'}")
    return {name: value for name, _, value in (word.partition("=") for word in words)}


def _changes(options: argparse.Namespace) -> dict[str, str]:
    """``--set`` as text, which the plant reads as an instrument file."""
    if bool(options.set) != (options.action == "sky"):
        raise ValueError("--set: expected with sky, and only there")
    values = assignments(options.set, "--set")
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}


def _identity(id_word: str, sha256_word: str) -> tuple[int, bytes]:
    try:
        identity, sha256 = int(id_word, 16), bytes.fromhex(sha256_word)
    except ValueError:
        identity, sha256 = 0, b""
    if len(sha256) != 32:
        raise ValueError(
            f"expected ID and SHA256 in hex, as 'srtomo ctl publish' prints them, got {id_word} {sha256_word}"
        )
    return identity, sha256


def _status(operator: Operator) -> dict[str, object]:
    from msgs_schema.msg import HrtcEvent

    end = time.monotonic() + _PATIENCE
    while (status := operator.hrtc) is None:
        if time.monotonic() > end:
            raise ValueError(f"no HRTC in namespace {operator.get_namespace()}")
        operator.spin(0.05)
    numbers = {name: getattr(status, name) for name in status.get_fields_and_field_types() if name != "header"}
    for name in ("reconstructor", "staged", "previous"):
        numbers[name] = f"{numbers[name]:016x}" if numbers[name] else "none"
    states = {HrtcEvent.OPEN: "open", HrtcEvent.CLOSED: "closed", HrtcEvent.FLAT: "flat"}
    numbers["loop_state"] = states[status.loop_state]
    numbers["silence"] = status.silence if math.isfinite(status.silence) else None
    return numbers
