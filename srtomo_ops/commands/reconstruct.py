"""``srtomo reconstruct``."""

from __future__ import annotations

import argparse
import inspect
import json
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from srtomo_ops.options import (
    add_json,
    add_registration,
    add_system,
    assignments,
    system_of,
    writable_file,
    write_json,
)
from srtomo_ops.progress import Progress
from srtomo_srtc.measured import read_measured
from srtomo_srtc.model import ground_prior
from srtomo_srtc.reconstructors import METHODS
from srtomo_srtc.registration import registered_layout, with_places

_SHARED = ("system", "layout", "label", "progress")  # parameters that have options of their own, or none


def own_keywords(method: str) -> dict[str, str]:
    """A method's parameters that a command line can give, each as ``name=default|other|choices``.

    In brackets where the method finds a value itself if none is given.
    """
    hints = get_type_hints(METHODS[method])
    out = {}
    for name, parameter in inspect.signature(METHODS[method]).parameters.items():
        if name in _SHARED or not _can_be_typed(hints[name]):
            continue
        default = parameter.default
        shown = [] if default is None else [f"{default:g}" if isinstance(default, float) else str(default).lower()]
        values = "|".join(dict.fromkeys([*shown, *_choices(hints[name])]))
        text = f"{name}={values}" if values else name
        out[name] = f"[{text}]" if default is None else text
    return out


def _can_be_typed(hint: Any) -> bool:
    if get_origin(hint) in (Union, UnionType):
        return all(_can_be_typed(part) for part in get_args(hint))
    return hint in (str, int, float, bool, type(None), Sequence[float]) or get_origin(hint) is Literal


def _choices(hint: Any) -> list[str]:
    if get_origin(hint) is Literal:
        return list(get_args(hint))
    return [choice for part in get_args(hint) for choice in _choices(part)]


def _list_of_methods() -> str:
    lines = []
    for method in sorted(METHODS):
        lines.append(
            textwrap.fill(
                " ".join(own_keywords(method).values()),
                100,
                initial_indent=f"  {method:<14}",
                subsequent_indent=16 * " ",
                break_long_words=False,
                break_on_hyphens=False,
            )
        )
    return "\n".join(lines)


EXAMPLE = f"""methods, and what --with can set of each, with defaults (SI units; in brackets: found by itself):
{_list_of_methods()}

examples:
  srtomo reconstruct gnao_ltao_sr -o sr.npz
  srtomo reconstruct gnao_ltao_sr --method explicit --with prior=laplacian --with solver=cg -o sparse.npz
  srtomo reconstruct mini --method predictive --with epochs=3 --with wind_uncertainty=2 -o mini.npz
  srtomo reconstruct mini --prior ground --with kappa=1e-3 -o mini.npz
  srtomo reconstruct mini --method learn_apply --measured covariances.npz -o mini.npz

covariances for --measured: an .npz with 'slopes' (all slopes with each other, noise included, rad^2; radians of tilt,
sensor by sensor, all x then all y) and, of a truth sensor, 'truth' (its slopes on each science target with all others)
and 'truth_subapertures' (across the pupil); with the system's 'fingerprint' in it, another system's is refused."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="the .npz to write")
    parser.add_argument(
        "--prior",
        choices=("file", "ground"),
        default="file",
        help="turbulence profile supposed: the instrument file's, or all of it at the ground (default: file)",
    )
    parser.add_argument(
        "--method", choices=sorted(METHODS), default="implicit", help="how (default: implicit); all are listed below"
    )
    add_keywords(parser)
    add_registration(parser)
    parser.add_argument(
        "--measured",
        metavar="FILE",
        type=Path,
        help="measured covariances for learn_apply to use as they are; the .npz is described below",
    )
    parser.add_argument("--label", default="", help="a name for people (default: the prior)")
    add_json(parser)


def add_keywords(parser: argparse.ArgumentParser, where: str = "all are listed below") -> None:
    """``--with``: see :func:`keywords_of`."""
    parser.add_argument(
        "--with",
        dest="keywords",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help=f"a parameter of the method; {where}",
    )


def keywords_of(options: argparse.Namespace) -> dict[str, Any]:
    """The method's own parameters from ``--with``.

    Raises:
        ValueError: the method has no such parameter, or not of that type.
    """
    own = own_keywords(options.method)
    keywords = assignments(options.keywords, "--with")
    hints = get_type_hints(METHODS[options.method])
    for key, value in keywords.items():
        if key not in own:
            raise ValueError(f"--with {key}: method {options.method} takes {', '.join(own)}")
        if not _fits(value, hints[key]):
            raise ValueError(f"--with {key}: expected a value such as in {own[key]}, got {json.dumps(value)}")
    return keywords


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value read from JSON is one of a type that can be typed."""
    if get_origin(hint) in (Union, UnionType):
        return any(_fits(value, part) for part in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if hint == Sequence[float]:
        return isinstance(value, list) and all(_fits(item, float) for item in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is hint


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    writable_file(options.output)
    keywords = keywords_of(options)
    if options.measured is not None:
        if options.method != "learn_apply":
            raise ValueError(f"--measured: expected with --method learn_apply, not {options.method}")
        keywords |= read_measured(str(options.measured), system)
    layout, registration = registered_layout(options.registration, system)
    believed = ground_prior(system) if options.prior == "ground" else system
    start = time.perf_counter()
    with Progress("reconstructor") as progress:
        reconstructor, G = METHODS[options.method](
            believed, layout, label=options.label or options.prior, progress=progress.stage, **keywords
        )
    seconds = time.perf_counter() - start
    reconstructor = with_places(reconstructor, registration)
    reconstructor.save(options.output, G)
    exposures = f" of {reconstructor.n_epochs} exposures" if reconstructor.n_epochs > 1 else ""
    print(
        f"{options.output}: {reconstructor.id:016x}, {reconstructor.n_commands} commands x "
        f"{reconstructor.n_slopes} slopes{exposures}, gain {reconstructor.gain:g}, {seconds:.1f} s"
    )
    write_json(
        options.json,
        {
            "system": system.name,
            "id": f"{reconstructor.id:016x}",
            "sha256": reconstructor.sha256.hex(),
            "commands": reconstructor.n_commands,
            "slopes": reconstructor.n_slopes,
            "epochs": reconstructor.n_epochs,
            "seconds": seconds,
            "output": str(options.output),
            "provenance": dict(reconstructor.provenance),
        },
    )
    return 0
