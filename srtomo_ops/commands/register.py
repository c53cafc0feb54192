"""``srtomo register``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srtomo_core import wire
from srtomo_core.bag import BagError, BagReader
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import load_interaction_matrix
from srtomo_core.system import System, load_system
from srtomo_ops.options import add_json, assignments, write_json
from srtomo_ops.progress import Progress
from srtomo_srtc.matching import Matched, Matcher
from srtomo_srtc.register import (
    MIN_STRETCHES,
    TOLERANCE,
    Registration,
    Stretches,
    from_interaction_matrix,
    from_telemetry,
)
from srtomo_srtc.registration import registration_content

EXAMPLE = """examples:
  srtomo register night1                                        from closed-loop telemetry, 15 s or more of it
  srtomo register measured.npz --system gnao_ltao_sr            from a measured interaction matrix
  srtomo register night1 --json places.json                     and then make reconstructors that know:
  srtomo reconstruct gnao_ltao_sr --registration places.json -o registered.npz
a dither that an operator put on the mirrors through hrtc/static_shape is found in the bag and used
exit code: 0 all sensors within tolerance, 1 some are not, 2 cannot be told"""

_STRETCH = 1.5  # s
_TOGGLES = 2 * MIN_STRETCHES  # changes of the offset that make a dither

Floats = NDArray[np.float32]


def configure(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("source", metavar="SOURCE", type=Path, help="bag, or .npz with an interaction matrix")
    parser.add_argument("--system", metavar="SYSTEM", help="of an interaction matrix: name or path of a .yaml file")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="with --system: change it")
    parser.add_argument(
        "--tolerance",
        metavar="SUBAPERTURES",
        type=float,
        default=TOLERANCE,
        help=f"displacement, rms over a sensor, that is reported (default: {TOLERANCE:g})",
    )
    add_json(parser)


def main(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.source.suffix == ".npz":
        if options.system is None:
            raise ValueError(f"{options.source}: an interaction matrix needs --system")
        system = load_system(options.system, assignments(options.set, "--set"))
        layout = Layout(system)
        found = from_interaction_matrix(system, load_interaction_matrix(options.source, layout.fingerprint), layout)
        how = "measured interaction matrix"
    else:
        system, found, how = _from_bag(options.source)
        layout = Layout(system)
    content = registration_content(system, layout, found, how)
    _print(content)
    notes = found.notes(options.tolerance)
    for note in notes:
        print(note)
    write_json(options.json, content)
    return 1 if notes else 0


def _from_bag(path: Path) -> tuple[System, Registration, str]:
    with BagReader(path) as reader:
        text = reader.metadata.get("system")
        if text is None:
            raise BagError(f"{path}: does not say which instrument it is of: not recorded by 'srtomo record'?")
        system = System.model_validate_json(text)
        layout = Layout(system)
        offsets = _Offsets(reader, layout, system.loop.delay)
        stretches = Stretches(system, layout, half_period=offsets.half_period)
        length = round(_STRETCH * system.loop.rate)
        with Progress("telemetry") as progress:
            for stretch in _runs(reader, layout, length, progress):
                _add(stretches, stretch, offsets)
    if len(stretches) < MIN_STRETCHES:
        raise ValueError(
            f"{path}: expected {MIN_STRETCHES * _STRETCH:g} s without gaps or more, got {len(stretches) * _STRETCH:g} s"
        )
    with Progress("registration"):
        found = from_telemetry(stretches)
    how = "dither" if offsets.half_period else "no dither"
    return system, found, f"{stretches.n_frames / system.loop.rate:.1f} s of telemetry, {how}"


class _Offsets:
    """The loop's offset frame by frame, as the bag's events tell it.

    Attributes:
        half_period: frames from one change to the next, at the median; None where there are too few for a dither.
    """

    def __init__(self, reader: BagReader, layout: Layout, delay: float) -> None:
        self._whole = math.floor(delay)
        self._share = np.float32(delay - self._whole)
        changes: dict[tuple[int, int], Floats] = {}
        for message in reader.messages(reader.topic(wire.EVENT.name)):
            event = reader.decode(message)
            if len(event.offset) == layout.n_commands:
                changes[event.session, event.first_frame] = np.array(event.offset, np.float32)
        keys = sorted(changes)
        self._keys = keys
        self._values = [changes[key] for key in keys]
        turns = [
            after
            for before, after in zip(range(len(keys)), range(1, len(keys)), strict=False)
            if keys[before][0] == keys[after][0] and not np.array_equal(self._values[before], self._values[after])
        ]
        self.half_period: int | None = None
        if len(turns) >= _TOGGLES:
            self.half_period = max(1, int(np.median(np.diff([keys[turn][1] for turn in turns]))))

    def on_mirror(self, session: int, frames: range) -> Floats:
        """(n_frames, n_commands) the offset's share of what was on the mirrors."""
        rows = np.zeros((len(frames) + 1, len(self._values[0])), np.float32)
        of_session = [
            (first, value) for (s, first), value in zip(self._keys, self._values, strict=True) if s == session
        ]
        for i, frame in enumerate(range(frames.start - self._whole - 1, frames.stop - self._whole)):
            known = [value for first, value in of_session if first <= frame]
            if known:
                rows[i] = known[-1]
        return (1 - self._share) * rows[1:] + self._share * rows[:-1]


def _runs(reader: BagReader, layout: Layout, length: int, progress: Progress) -> Iterator[list[Matched]]:
    """Every ``length`` exposures that follow each other without a gap."""
    matcher = Matcher(layout)
    run: list[Matched] = []
    slopes, commands = reader.topic(wire.SLOPES.name), reader.topic(wire.COMMAND.name)
    total = reader.counts[slopes] + reader.counts[commands]
    for done, message in enumerate(reader.messages(slopes, commands)):
        (matcher.add_slopes if message.topic == slopes else matcher.add_command)(message.data)
        if done % 256 and done + 1 < total:
            continue
        progress.share(done / total)
        for exposure in matcher.take(final=done + 1 == total):
            if run and (exposure.session, exposure.frame) != (run[-1].session, run[-1].frame + 1):
                run = []  # what is before the gap is too short
            run.append(exposure)
            if len(run) == length:
                yield run
                run = []


def _add(stretches: Stretches, run: list[Matched], offsets: _Offsets) -> None:
    slopes, mirror = np.array([e.slopes for e in run]), np.array([e.mirror for e in run])
    frames = range(run[0].frame, run[-1].frame + 1)
    dither = None if offsets.half_period is None else offsets.on_mirror(run[0].session, frames)
    stretches.add(slopes, mirror, dither)


def _print(content: dict[str, Any]) -> None:
    print(f"{content['system']}, {content['from']}: sensors against where the instrument file has them, 1-sigma errors")
    print(f"{'sensor':>12} {'shift x, y [sub-aperture]':>37} {'rotation [deg]':>17} {'magnified [%]':>17} {'gain':>17}")
    for row in content["sensors"]:
        shifts = " ".join(
            f"{row[f'shift_{axis}_subaperture']:+8.4f} ± {row[f'shift_{axis}_subaperture_sigma']:.4f}" for axis in "xy"
        )
        print(
            f"{row['sensor']:>12} {shifts:>37} {row['rotation_deg']:+8.3f} ± {row['rotation_deg_sigma']:.3f}  "
            f"{100 * row['magnification']:+8.3f} ± {100 * row['magnification_sigma']:.3f}  "
            f"{row['gain']:7.4f} ± {row['gain_sigma']:.4f}"
        )
