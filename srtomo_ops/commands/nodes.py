"""``srtomo hrtc``, ``srtomo srtc`` and ``srtomo sim``: each runs a node until SIGINT or SIGTERM."""

from __future__ import annotations

import argparse
import importlib
import json
from typing import Any

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
        words += ["-p", parameter]
    return words


def quoted(parameter: str, defaults: dict[str, Any]) -> str:
    """``NAME:=VALUE`` as ROS reads it: YAML, which would take a text with brackets for a list.

    Raises:
        ValueError: the node has no such parameter; ROS takes those without a word.
    """
    name, _, value = parameter.partition(":=")
    if name not in defaults:
        raise ValueError(f"-p {parameter}: no such parameter (expected one of {', '.join(defaults)})")
    if isinstance(defaults[name], str) and not value.startswith(("'", '"')):
        value = "'" + value.replace("'", "''") + "'"
        return f"{name}:={value}"
    if isinstance(defaults[name], float) and value.lstrip("+-").isdecimal():
        return f"{parameter}.0"  # a whole number is no floating-point one to ROS
    return parameter


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system_of(options)  # a wrong instrument is refused here, in one line
    for parameter in options.p:
        if ":=" not in parameter:
            raise ValueError(f"-p {parameter}: expected NAME:=VALUE")
    module = importlib.import_module(_MODULES[options.command])
    if options.parameters:
        for name, default, description in module.parameters():
            print(f"{name:<20} {default!r:<10} {description}")
        return 0
    defaults = {name: default for name, default, _ in module.parameters()}
    parameters = [quoted(parameter, defaults) for parameter in options.p]
    arguments = ros_arguments(options.system, changes_of(options), options.namespace, parameters)
    from rclpy.exceptions import ParameterException

    try:
        return int(module.main(arguments))
    except ParameterException as error:  # of a wrong type, or out of its range; names it
        raise ValueError(f"-p: {error}") from None
