"""``srtomo estimate``."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srtomo_core.bag import BagError, BagReader
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import load_interaction_matrix
from srtomo_core.system import System
from srtomo_ops.options import add_registration, writable_file, write_json
from srtomo_srtc.learn import LIMIT, Learned
from srtomo_srtc.learn_wind import LayerWind
from srtomo_srtc.learned_sky import lags_of, learned_sky
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.registration import registered_layout
from srtomo_srtc.sampling import FEWEST, Sampling
from srtomo_srtc.telemetry import COUNTED_RATE, Statistics, Telemetry

EXAMPLE = """examples:
  srtomo estimate night1 --plot night1.png
  srtomo estimate night1 --altitudes 0,4000,8000,16000 -o sky.json
  srtomo estimate night1 --winds"""

BETWEEN = "errors allow for turbulence anywhere between these altitudes"
ONLY_AT = "errors suppose that all turbulence is at these altitudes"


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("bag", metavar="BAG", type=Path, help="directory or .mcap file")
    parser.add_argument(
        "--altitudes",
        metavar="M,M,...",
        type=_altitudes,
        help="of the layers, m above the telescope, ascending; errors suppose that all turbulence is there "
        "(default: a grid as fine as the stars can tell, with turbulence in between allowed for in the errors)",
    )
    parser.add_argument("--winds", action="store_true", help="learn the wind of each layer too")
    parser.add_argument(
        "--interaction-matrix",
        metavar="FILE",
        type=Path,
        help="the one that the loop ran with, made by 'srtomo calibrate' (default: computed)",
    )
    add_registration(parser)
    parser.add_argument(
        "--slopes",
        metavar="N",
        type=int,
        default=LIMIT,
        help=f"to work with, at most about (default: {LIMIT}; {FEWEST} a sensor are always enough)",
    )
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, help="write what was learned to FILE as JSON")
    parser.add_argument("--plot", metavar="FILE", type=Path, help="draw profile and covariances to FILE")


def _altitudes(text: str) -> list[float]:
    return [float(value) for value in text.split(",")]


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    for path in (options.output, options.plot):
        if path is not None:
            writable_file(path)
    with BagReader(options.bag) as reader:
        if reader.cut:
            print(reader.cut)
        text = reader.metadata.get("system")
        if text is None:
            raise BagError(f"{options.bag}: does not say which instrument it is of: not recorded by 'srtomo record'?")
        system = System.model_validate_json(text)
        layout, _ = registered_layout(options.registration, system)
        Sampling.of(system, layout, options.slopes)  # before any work
        statistics = _statistics(reader, system, layout, options.interaction_matrix, options.winds)
    start = time.perf_counter()
    sky = learned_sky(
        system, statistics, winds=options.winds, layout=layout, altitudes=options.altitudes, limit=options.slopes
    )
    learned, winds = sky.learned, sky.winds
    seconds = time.perf_counter() - start
    supposed = BETWEEN if options.altitudes is None else ONLY_AT
    _print(system, statistics, learned, winds, supposed)
    if options.plot is not None:
        from srtomo_ops.report import sky_figure

        sky_figure(options.plot, system, learned)
    write_json(options.output, {**_numbers(system, statistics, learned, winds), "errors": supposed, "seconds": seconds})
    return 0


def _statistics(reader: BagReader, system: System, layout: Layout, matrix: Path | None, winds: bool) -> Statistics:
    G: NDArray[np.floating] = (
        interaction_matrix(system, layout) if matrix is None else load_interaction_matrix(matrix, layout.fingerprint)
    )
    first, last = reader.time_range
    lags = lags_of(system, max(1, round(system.loop.rate / COUNTED_RATE))) if winds else ()
    # one block, longer than the bag: nothing is forgotten or held out
    telemetry = Telemetry(system, G, layout=layout, window=(last - first) * 1e-9 + 1, blocks=1, held_out=0, lags=lags)
    telemetry.feed(reader)
    statistics = telemetry.statistics()
    if telemetry.tally.sessions > 1:
        print(
            f"{telemetry.tally.sessions} sessions in the bag: of the last one alone, frames {statistics.first_frame} "
            f"to {statistics.last_frame}"
        )
    return statistics


def _print(system: System, statistics: Statistics, learned: Learned, winds: Sequence[LayerWind], supposed: str) -> None:
    low, high = learned.outer_scale_range
    seen = f"{low:.0f} to {high:.0f} m" if math.isfinite(high) else f"above {low:.0f} m"
    print(
        f"{system.name}: {learned.n_frames} frames over {statistics.duration:.1f} s, worth {learned.n_effective:.0f} "
        f"independent ones\n"
        f"  r0           {100 * learned.r0:.2f} +- {100 * learned.r0_sigma:.2f} cm at 500 nm and zenith\n"
        f"  outer scale  {learned.outer_scale:.0f} m ({seen})\n"
        f"  {'altitude [m]':<18} {'share of Cn2':>14}"
    )
    for group in reversed(learned.groups):
        ends = [f"{learned.altitudes[i]:.0f}" for i in (group.layers[0], group.layers[-1])]
        where = ends[0] if len(group.layers) == 1 else f"{ends[0]} to {ends[1]}"
        why = f"   {len(group.layers)} layers told as one: {group.reason}" if group.reason else ""
        print(f"  {where:<18} {group.fraction:6.3f} +- {group.sigma:.3f}{why}")
    print(f"  {supposed}")
    if winds:
        print(f"  {'altitude [m]':<18} {'wind [m/s]':>14} {'going to [deg from +x]':>26}")
    for wind in reversed(winds):
        turn = f"{math.degrees(wind.direction):4.0f} +- {math.degrees(wind.sigma / max(wind.speed, wind.sigma)):.0f}"
        told = wind.reason or f"{wind.speed:6.1f} +- {wind.sigma:.1f} {turn:>26}"
        print(f"  {wind.altitude:<18.0f} {told}")
    print("  noise variance over that of the instrument file")
    for level in learned.noise:
        print(f"  {system.sensors[level.sensor].name:<18} {level.factor:6.3f} +- {level.sigma:.3f}")


def _numbers(system: System, statistics: Statistics, learned: Learned, winds: Sequence[LayerWind]) -> dict[str, Any]:
    low, high = learned.outer_scale_range
    return {
        "system": system.name,
        "frames": learned.n_frames,
        "duration_s": statistics.duration,
        "independent_frames": learned.n_effective,
        "r0_m": learned.r0,
        "r0_sigma_m": learned.r0_sigma,
        "outer_scale_m": learned.outer_scale,
        "outer_scale_low_m": low,
        "outer_scale_high_m": high if math.isfinite(high) else None,
        "altitudes_m": learned.altitudes.tolist(),
        "fractions": learned.fractions.tolist(),
        "groups": [
            {
                "altitudes_m": [float(learned.altitudes[i]) for i in group.layers],
                "altitude_m": group.altitude,
                "fraction": group.fraction,
                "sigma": group.sigma,
                "reason": group.reason,
            }
            for group in learned.groups
        ],
        "winds": [{"altitude_m": wind.altitude, "fraction": wind.fraction, **_wind(wind)} for wind in winds],
        "noise": [
            {"sensor": system.sensors[level.sensor].name, "variance_factor": level.factor, "sigma": level.sigma}
            for level in learned.noise
        ],
    }


def _wind(wind: LayerWind) -> dict[str, Any]:
    if wind.reason:
        return {"reason": wind.reason}
    return {
        "speed_mps": wind.speed,
        "direction_deg": math.degrees(wind.direction),
        "sigma_mps": wind.sigma,
    }
