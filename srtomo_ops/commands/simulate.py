"""``srtomo simulate``."""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_ops.options import add_json, add_schedule, add_system, schedule_of, system_of, write_json
from srtomo_ops.progress import Progress
from srtomo_ops.simulate import SETTLING, Run, plain_settings, program_of, run
from srtomo_rtc.lowrank import factorise
from srtomo_rtc.vmm import KERNELS
from srtomo_sim.course import scheduled
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare, strehl
from srtomo_srtc.model import ground_prior
from srtomo_srtc.reconstructors import implicit

EXAMPLE = """examples:
  srtomo simulate gnao_ltao_sr --frames 1000 --seed 2 --set 'loop.rate=1 kHz'
  srtomo simulate mini --frames 2000 --at '4 s' 'atmosphere.r0=10 cm' 'over=2 s'"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    parser.add_argument("--frames", type=int, default=1000, help="exposures (default: 1000)")
    parser.add_argument("--seed", type=int, default=1, help="of sky, noise and jitter (default: 1)")
    parser.add_argument("--open", action="store_true", help="leave the loop open")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--reconstructor", metavar="FILE", type=Path, help="use this one instead of building one")
    source.add_argument("--prior", choices=("file", "ground"), default="file", help="to build one with (default: file)")
    parser.add_argument(
        "--kernel", choices=tuple(KERNELS), default="float32", help="that the loop multiplies with (default: float32)"
    )
    add_schedule(parser)
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    if options.frames <= SETTLING:
        raise ValueError(f"--frames: expected more than {SETTLING}, which are left out while the loop settles")
    changes = scheduled(schedule_of(options), system.loop.rate)
    start = time.perf_counter()
    if options.reconstructor:
        reconstructor = Reconstructor.load(options.reconstructor)
    else:
        believed = ground_prior(system) if options.prior == "ground" else system
        with Progress("reconstructor") as progress:
            reconstructor, _ = implicit(believed, label=options.prior, progress=progress.stage)
    if reconstructor.fingerprint != Layout(system).fingerprint:
        raise ValueError(f"{options.reconstructor}: made for another instrument than {system.name}")
    with Progress("sky") as progress:
        sky = prepare(system, options.frames, options.seed, changes=changes, progress=progress.share)
    parts = reconstructor.parts if options.kernel == "tlr" else []
    factors = [factorise(system, sky.layout, R) for R, _ in parts]
    settings = plain_settings(sky.layout, system.loop.leak, system.loop.tip_tilt)
    program = program_of(sky.layout, reconstructor, settings, options.kernel, factors)
    with Progress("loop") as progress:
        result = run(
            Plant(system, sky), {0: program}, closed=not options.open, each=lambda k: progress.share(k / options.frames)
        )
    after = result.frames >= SETTLING
    numbers = {
        "system": system.name,
        "reconstructor": f"{reconstructor.id:016x}",
        "kernel": program.slot.kernel_name,
        "rate_hz": system.loop.rate,
        "frames": options.frames,
        "seed": options.seed,
        "settling_frames": SETTLING,
        "changes": [{"frame": c.frame, "over": c.over, "set": dict(c.values)} for c in changes],
        "wfe_nm": result.wfe() * 1e9,
        "tip_tilt_nm": float(np.sqrt(np.mean(result.tip_tilt[after, 0] ** 2))) * 1e9,
        "fitting_nm": float(np.sqrt(np.mean(sky.fitting_error()[after] ** 2))) * 1e9,
        "strehl": float(np.mean(strehl(result.high_order[after, 0], system.science.wavelength))),
        "science_wavelength_m": system.science.wavelength,
        "seconds": time.perf_counter() - start,
    }
    print(
        f"{system.name}, {options.frames} frames at {system.loop.rate:g} Hz, seed {options.seed}, first science target"
    )
    print(f"  WFE           {numbers['wfe_nm']:8.1f} nm rms, piston and tip-tilt removed")
    print(f"  tip-tilt      {numbers['tip_tilt_nm']:8.1f} nm rms")
    print(f"  of it fitting {numbers['fitting_nm']:8.1f} nm rms")
    print(f"  Strehl        {numbers['strehl']:8.3f} at {system.science.wavelength * 1e9:g} nm (Marechal, no tip-tilt)")
    if changes:
        numbers["stretches"] = stretches = _stretches(result, [0, *(c.frame for c in changes), options.frames])
        print("  between the changes' beginnings")
        for stretch in stretches:
            print(f"    frames {stretch['first']:6d} to {stretch['last']:6d} {stretch['wfe_nm']:8.1f} nm rms")
    write_json(options.json, numbers)
    return 0


def _stretches(result: Run, edges: list[int]) -> list[dict[str, float]]:
    """WFE of the stretches between edges, those without a science frame that counts left out."""
    rows = []
    for first, stop in pairwise(edges):
        here = (result.frames >= max(first, SETTLING)) & (result.frames < stop)
        if here.any():
            wfe = float(np.sqrt(np.mean(result.high_order[here, 0] ** 2))) * 1e9
            rows.append({"first": max(first, SETTLING), "last": stop - 1, "wfe_nm": wfe})
    return rows
