"""``srtomo simulate``."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_ops.options import add_json, add_system, system_of, write_json
from srtomo_ops.progress import Progress
from srtomo_ops.simulate import SETTLING, plain_settings, program_of, run
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare, strehl
from srtomo_srtc.model import ground_prior
from srtomo_srtc.reconstructors import implicit

EXAMPLE = "example:\n  srtomo simulate gnao_ltao_sr --frames 1000 --seed 2 --set 'loop.rate=1 kHz'"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_system(parser)
    parser.add_argument("--frames", type=int, default=1000, help="exposures (default: 1000)")
    parser.add_argument("--seed", type=int, default=1, help="of sky, noise and jitter (default: 1)")
    parser.add_argument("--open", action="store_true", help="leave the loop open")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--reconstructor", metavar="FILE", type=Path, help="use this one instead of building one")
    source.add_argument("--prior", choices=("file", "ground"), default="file", help="to build one with (default: file)")
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    system = system_of(options)
    if options.frames <= SETTLING:
        raise ValueError(f"--frames: expected more than {SETTLING}, which are left out while the loop settles")
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
        sky = prepare(system, options.frames, options.seed, progress=progress.share)
    program = program_of(sky.layout, reconstructor, plain_settings(sky.layout, system.loop.leak))
    with Progress("loop") as progress:
        result = run(
            Plant(system, sky), {0: program}, closed=not options.open, each=lambda k: progress.share(k / options.frames)
        )
    after = result.frames >= SETTLING
    numbers = {
        "system": system.name,
        "reconstructor": f"{reconstructor.id:016x}",
        "rate_hz": system.loop.rate,
        "frames": options.frames,
        "seed": options.seed,
        "settling_frames": SETTLING,
        "wfe_nm": result.wfe() * 1e9,
        "tip_tilt_nm": float(np.sqrt(np.mean(result.tip_tilt[after, 0] ** 2))) * 1e9,
        "fitting_nm": float(np.sqrt(np.mean(sky.targets[0].fitting_error()[after] ** 2))) * 1e9,
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
    write_json(options.json, numbers)
    return 0
