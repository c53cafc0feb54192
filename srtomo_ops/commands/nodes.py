"""``srtomo hrtc``, ``srtomo srtc`` and ``srtomo sim``: each runs a node until SIGINT or SIGTERM."""

from __future__ import annotations

import argparse
import importlib
import json

from srtomo_ops.options import add_system, changes_of, system_of

_MODULES = {"hrtc": "srtomo_rtc.node", "srtc": "srtomo_srtc.node", "sim": "srtomo_sim.node"}

EXAMPLE = """example:
  srtomo COMMAND gnao_ltao_sr --namespace gnao -p NAME:=VALUE
every parameter of the node can be given with -p; 'srtomo COMMAND SYSTEM --parameters' lists them with defaults
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the commands."""
    add_system(parser)
    parser.add_argument("--namespace", default="", help="of topics and services (default: none)")
    parser.add_argument("-p", metavar="NAME:=VALUE", action="append", default=[], help="a parameter of the node")
    parser.add_argument("--parameters", action="store_true", help="list the node's parameters and end")


def ros_arguments(system: str, changes: dict[str, object], namespace: str, parameters: list[str]) -> list[str]:
    """The ROS arguments that hand an instrument, its changes and parameters (``NAME:=VALUE``) to a node."""
    words = ["--ros-args", "-p", f"system:={system}"]
    if changes:
        # the outer quotes keep YAML from reading the JSON as a mapping
        words += ["-p", f"changes:='{json.dumps(changes)}'"]
    if namespace:
        words += ["-r", f"__ns:=/{namespace.strip('/')}"]
    for parameter in parameters:
        if ":=" not in parameter:
            raise ValueError(f"-p {parameter}: expected NAME:=VALUE")
        words += ["-p", parameter]
    return words


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system_of(options)  # a wrong instrument is refused here, in one line
    arguments = ros_arguments(options.system, changes_of(options), options.namespace, options.p)
    module = importlib.import_module(_MODULES[options.command])
    if options.parameters:
        for name, default, description in module.parameters():
            print(f"{name:<20} {default!r:<10} {description}")
        return 0
    known = [name for name, _, _ in module.parameters()]
    for parameter in options.p:
        # ROS takes parameters that no node declares, without a word
        if (name := parameter.partition(":=")[0]) not in known:
            raise ValueError(f"-p {parameter}: no such parameter (expected one of {', '.join(known)})")
    return int(module.main(arguments))
