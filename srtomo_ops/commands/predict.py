"""``srtomo predict``."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_core.units import ARCSEC
from srtomo_ops.commands.reconstruct import add_keywords, keywords_of
from srtomo_ops.options import add_json, add_system, assignments, changes_of, system_of, write_json
from srtomo_ops.progress import Progress
from srtomo_srtc.model import ground_prior
from srtomo_srtc.predict import Budget, Prediction, drifted, limit, mean_wfe, misplaced
from srtomo_srtc.reconstructors import METHODS

EXAMPLE = """examples:
  srtomo predict gnao_ltao_sr --set 'loop.rate=1 kHz'
  srtomo predict gnao_ltao_sr --reconstructor sr.npz --stability
  srtomo predict gnao_ltao_sr --method predictive --with epochs=3
  srtomo predict mini --becomes 'atmosphere.layers.2.altitude=14 km' --becomes 'atmosphere.r0=12 cm' --over 30"""

_TERMS = ("fitting", "tomography", "noise", "lag", "total", "tip_tilt")
_SHIFTS = (0.1, 0.2, 0.3, 0.4)  # sub-apertures of the first sensor
_ROTATIONS = (0.5, 1.0, 2.0)  # degrees
_GAINS = (0.5, 0.7, 1.3, 1.6)
_CLOSE = 0.005  # sub-apertures: how well a limit of shift is found


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--reconstructor", metavar="FILE", type=Path, help="predict this one instead of building one")
    source.add_argument("--prior", choices=("file", "ground"), default="file", help="to build one with (default: file)")
    parser.add_argument(
        "--method", choices=sorted(METHODS), default="implicit", help="to build with (default: implicit)"
    )
    add_keywords(parser, "srtomo reconstruct --help lists them")
    parser.add_argument("--stability", action="store_true", help="also the loop's margin against misplaced mirrors")
    parser.add_argument(
        "--becomes",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="the sky drifts towards this change of atmosphere: WFE against the matrix's age",
    )
    parser.add_argument("--over", metavar="MINUTES", type=float, default=30.0, help="how long that takes (default: 30)")
    parser.add_argument("--ages", type=int, default=7, help="how many ages, from 0 to --over (default: 7)")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    end = _end_of_drift(options)
    start = time.perf_counter()
    reconstructor = _reconstructor(options, system)
    # the gain belongs to the reconstructor, which runs with its own
    system = system.with_changes({"loop.gain": reconstructor.gain})
    with Progress("prediction") as progress:
        prediction = Prediction(system, epochs=reconstructor.n_epochs, progress=progress.stage)
    budgets = prediction.budgets(reconstructor.R)
    content: dict[str, Any] = {
        "system": system.name,
        "reconstructor": f"{reconstructor.id:016x}",
        "rate_hz": system.loop.rate,
        "delay_frames": system.loop.delay,
        "gain": system.loop.gain,
        "epochs": reconstructor.n_epochs,
        "targets": [_in_nm(budget) for budget in budgets],
        "wfe_nm": 1e9 * mean_wfe(budgets),
    }
    _print_budgets(system, content)
    if system.tip_tilt_sensors:
        print("  tip-tilt as if its own loop's stars were read out in every frame; srtomo simulate has its true rate")
    if options.stability:
        content["stability"] = _stability(system, reconstructor)
    if end is not None:
        content["age"] = _age(options, system, end, reconstructor)
    content["seconds"] = time.perf_counter() - start
    write_json(options.json, content)
    return 0


def _reconstructor(options: argparse.Namespace, system: System) -> Reconstructor:
    if options.reconstructor:
        reconstructor = Reconstructor.load(options.reconstructor)
        if reconstructor.fingerprint != Layout(system).fingerprint:
            raise ValueError(f"{options.reconstructor}: made for another instrument than {system.name}")
        return reconstructor
    return _build(options, ground_prior(system) if options.prior == "ground" else system)


def _build(options: argparse.Namespace, believed: System) -> Reconstructor:
    with Progress("reconstructor") as progress:
        reconstructor, _ = METHODS[options.method](
            believed, label=options.prior, progress=progress.stage, **keywords_of(options)
        )
    return reconstructor


def _end_of_drift(options: argparse.Namespace) -> System | None:
    if not options.becomes:
        return None
    if options.ages < 2 or options.over <= 0:
        raise ValueError("--ages, --over: expected at least 2 ages and a time above 0")
    becomes = assignments(options.becomes, "--becomes")
    for key in becomes:
        if not key.startswith("atmosphere."):
            raise ValueError(f"--becomes {key}: expected a key of atmosphere")
    return load_system(options.system, {**changes_of(options), **becomes})


def _nm(variance: float) -> float:
    """Root of a variance, with its sign, nm."""
    return math.copysign(1e9 * math.sqrt(abs(variance)), variance)


def _in_nm(budget: Budget) -> dict[str, float]:
    return {
        "x_arcsec": budget.direction.x / ARCSEC,
        "y_arcsec": budget.direction.y / ARCSEC,
        "weight": budget.weight,
        **{f"{term}_nm": _nm(getattr(budget, term)) for term in _TERMS},
    }


def _print_budgets(system: System, content: dict[str, Any]) -> None:
    loop = system.loop
    print(
        f"{system.name} at {loop.rate:g} Hz, delay {loop.delay:g} frames, gain {loop.gain:g}; reconstructor "
        f"{content['reconstructor']}\nnm rms, piston and tip-tilt removed (last column: tip-tilt alone)"
    )
    print(f"{'direction [arcsec]':>18} " + " ".join(f"{term:>10}" for term in _TERMS))
    for row in content["targets"]:
        place = f"{row['x_arcsec']:+.1f} {row['y_arcsec']:+.1f}"
        print(f"{place:>18} " + " ".join(f"{row[f'{term}_nm']:10.1f}" for term in _TERMS))
    print(f"WFE {content['wfe_nm']:.1f} nm rms over the directions with their weights; terms add in quadrature")


def _stability(system: System, reconstructor: Reconstructor) -> dict[str, Any]:
    size = Layout(system).sensors[0].size
    cases: list[tuple[str, float, dict[str, Any]]] = [("none", 0.0, {})]
    cases += [("shift_subaperture", s, {"shift": (s * size, 0.0)}) for s in _SHIFTS]
    cases += [("rotation_deg", r, {"rotation": math.radians(r)}) for r in _ROTATIONS]
    cases += [("gain", g, {"gain_error": g}) for g in _GAINS]
    rows = []
    with Progress("stability") as progress:
        for n, (kind, amount, error) in enumerate(cases):
            progress.share(n / (len(cases) + 2))
            found = misplaced(system, reconstructor, **error)
            rows.append({"error": kind, "amount": amount, "radius": found.radius, "growth": found.growth})
        limits = {}
        for n, name in enumerate(("radius", "growth")):
            progress.share((len(cases) + n) / (len(cases) + 2))

            def value(shift: float, name: str = name) -> float:
                return float(getattr(misplaced(system, reconstructor, shift=(shift * size, 0.0)), name))

            limits[name] = limit(value, 0.0, 1.0, _CLOSE)
    print("\nmirrors misplaced: rho(Q - R G), below 1 stable at any delay; growth a frame at this delay and gain")
    for row in rows:
        label = "in place" if row["error"] == "none" else f"{row['error']} {row['amount']:g}"
        print(f"{label:>22} {row['radius']:8.3f} {row['growth']:8.3f}")
    print(
        f"limit of shift along x: {limits['growth']:.3f} sub-aperture in this loop, {limits['radius']:.3f} at any delay"
    )
    return {"errors": rows, "shift_limit_subaperture": limits["growth"], "shift_limit_any_delay": limits["radius"]}


def _age(options: argparse.Namespace, system: System, end: System, old: Reconstructor) -> list[dict[str, float]]:
    print(f"\n{'age [min]':>10} {'this matrix':>12} {'a new one':>12}   WFE, nm rms")
    rows = []
    for share in np.linspace(0, 1, options.ages):
        sky = drifted(system, end, float(share))
        with Progress(f"age {share * options.over:.0f} min") as progress:
            prediction = Prediction(sky, epochs=old.n_epochs, progress=progress.stage)
        new = old if share == 0 and options.prior == "file" and not options.reconstructor else _build(options, sky)
        row = {
            "age_min": float(share) * options.over,
            "old_nm": 1e9 * mean_wfe(prediction.budgets(old.R)),
            "new_nm": 1e9 * mean_wfe(prediction.budgets(new.R)),
        }
        print(f"{row['age_min']:10.1f} {row['old_nm']:12.1f} {row['new_nm']:12.1f}", flush=True)
        rows.append(row)
    return rows
