"""The command ``srtomo``: sub-commands in groups, each a module of :mod:`srtomo_ops.commands`."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple, NoReturn


class Command(NamedTuple):
    """A sub-command: its name, one line of help, and its module's name when that differs."""

    name: str
    help: str
    module: str = ""


GROUPS: dict[str, tuple[Command, ...]] = {
    "See it run": (
        Command("demo", "the whole loop over ROS 2: plant, HRTC, SRTC and recorder, a swap half way"),
        Command("simulate", "the loop in lockstep without ROS: wavefront error of an instrument"),
    ),
    "Instruments and reconstructors": (
        Command("systems", "list the instruments, or print one in full with derived quantities"),
        Command("reconstruct", "build a tomographic reconstructor and write R, Q, G"),
        Command("predict", "residual wavefront error and stability margins from covariances alone"),
        Command("design", "sensor shifts, clockings, asterism or mirror pitch that leave the least error"),
        Command("calibrate", "measure the interaction matrix of the simulated instrument"),
        Command("bench", "how fast this machine is, once what it computes is checked"),
        Command("reproduce", "measure published figures again and say which hold"),
    ),
    "Nodes": (
        Command("hrtc", "run the hard-real-time node: slopes in, commands out", "nodes"),
        Command("srtc", "run the soft-real-time node: reconstructors", "nodes"),
        Command("sim", "run the simulated plant", "nodes"),
        Command("record", "record every exchange to an MCAP bag"),
        Command("ctl", "configure, activate, close, commit, roll back a running HRTC"),
    ),
    "Bags": (
        Command("replay", "put a bag through the loop again and compare commands bit for bit"),
        Command("estimate", "learn the sky from a bag: r0, profile, noise, with their errors"),
        Command("register", "where each sensor sits against the mirrors, from a bag or an interaction matrix"),
        Command("bag", "say what a bag holds, or repair a cut-off one"),
    ),
}

# Nodes talk over shared memory alone unless the user says otherwise: ROS 2's discovery has no authentication, and even
# its range LOCALHOST binds sockets to every interface.
LOCAL = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "FASTDDS_BUILTIN_TRANSPORTS": "SHM",
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).with_name("fastdds.xml")),
}

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong, as every command does."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see '{self.prog} --help')\n")


def _overview() -> str:
    lines = ["usage: srtomo COMMAND ...", "", "Real-time computer of a tomographic adaptive-optics system.", ""]
    for group, commands in GROUPS.items():
        lines.append(f"{group}:")
        lines += [f"  {command.name:<12} {command.help}" for command in commands]
        lines.append("")
    lines += [
        "'srtomo COMMAND --help' shows a command's options with units, defaults and an example.",
        "options: --help, --version",
    ]
    return "\n".join(lines)


def _version() -> str:
    try:
        return version("srtomo")
    except PackageNotFoundError:
        return "(not installed)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command. Exit codes: 0 done, 1 done but a check failed, 2 bad input (one line on standard error)."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "help"):
        print(_overview())
        return 0 if words else 2
    if words[0] == "--version":
        print(f"srtomo {_version()}")
        return 0
    commands = {command.name: command for group in GROUPS.values() for command in group}
    command = commands.get(words[0])
    if command is None:
        print(f"srtomo: no command {words[0]!r}: expected one of {', '.join(commands)}", file=sys.stderr)
        return 2
    # one BLAS thread beats two on busy cores, and has to be asked for before numpy loads
    for variable in _THREADS:
        os.environ.setdefault(variable, "1")
    if not any(variable in os.environ for variable in LOCAL):
        os.environ.update(LOCAL)
    try:
        module = importlib.import_module(f"srtomo_ops.commands.{command.module or command.name}")
        from srtomo_ops.options import writable_file

        parser = _Parser(
            prog=f"srtomo {command.name}",
            description=command.help[0].upper() + command.help[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            epilog=module.EXAMPLE.replace("COMMAND", command.name),
        )
        module.configure(parser)
        options = parser.parse_args(words[1:])
        options.command = command.name
        if getattr(options, "json", None) is not None:
            writable_file(options.json)  # before any work
        return int(module.main(options))
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        return 0
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("rclpy", "msgs_schema"):
            raise
        print(
            f"srtomo {command.name}: needs ROS 2 ({error.name} is missing): pip install 'srtomo[ros]'", file=sys.stderr
        )
        return 2
    except ImportError as error:
        if error.name != "srtomo_rtc.native":
            raise
        print(f"srtomo {command.name}: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.filename is None or os.environ.get("SRTOMO_TRACEBACK"):
            raise
        print(f"srtomo {command.name}: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    except (ValueError, MemoryError) as error:
        # every error of bad input in srtomo is a ValueError of one line
        if "\n" in str(error) or os.environ.get("SRTOMO_TRACEBACK"):
            raise
        print(f"srtomo {command.name}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    raise SystemExit(main())
