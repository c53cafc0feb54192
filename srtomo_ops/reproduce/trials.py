"""Trials of an instrument in lockstep: what is measured, under skies that all trials of a seed share.

A sky costs far more than a run under it, and a reconstructor does not depend on the sky: both are made once, and a
trial costs one product a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from srtomo_core.layout import Array, Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_ops.simulate import SETTLING, program_of, run
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare, strehl
from srtomo_srtc.reconstructors.implicit import implicit

SCIENCE_EVERY = 5
"""Frames between two looks at the wavefront error: sub-apertures cross a layer's speckle in some tens."""

# seconds of each on one core, roughly: shares of the progress
_SKY, _BUILD, _RUN = 8.0, 2.0, 1.0


@dataclass(frozen=True)
class Trial:
    """One way to run an instrument.

    Attributes:
        plant: the instrument under the sky: photons and jitter may differ from the sky's own.
        noise_gain: of the reconstructor's noise prior; None scales it by g / (2-g) of the loop's gain g, 1 not at all.
        aligned: the reconstructor is built as if no sensor were shifted.
    """

    plant: System
    noise_gain: float | None = None
    aligned: bool = False

    def build(self) -> Reconstructor:
        """The trial's reconstructor."""
        layout = Layout(self.plant)
        if self.aligned:
            layout.sensors = tuple(replace(sensor, shift=(0.0, 0.0)) for sensor in layout.sensors)
        return implicit(self.plant, layout, noise_gain=self.noise_gain)[0]


class Outcome(NamedTuple):
    """Of a trial, by seed; frames before SETTLING are left out.

    Attributes:
        wfe: (n_seeds,) m rms, first science target, piston and tip-tilt removed.
        strehl: (n_seeds,) mean at the instrument's science wavelength (Marechal, no tip-tilt).
        fitting: (n_seeds,) m rms of what the mirrors cannot make.
    """

    wfe: Array
    strehl: Array
    fitting: Array

    @property
    def rms(self) -> float:
        """Mean of ``wfe`` over the seeds, m."""
        return float(np.mean(self.wfe))


def quadrature(worse: Outcome, better: Outcome) -> float:
    """Mean over paired seeds of ``sqrt(worse^2 - better^2)``, m; negative where ``better`` is worse."""
    squares = worse.wfe**2 - better.wfe**2
    return float(np.mean(np.sign(squares) * np.sqrt(np.abs(squares))))


def direct(worse: Outcome, better: Outcome) -> float:
    """Mean over paired seeds of ``worse - better``, m."""
    return float(np.mean(worse.wfe - better.wfe))


def with_electrons(system: System, electrons: float, subaperture: float = 0.4) -> System:
    """The system with so many electrons a frame on a laser's sub-aperture of ``subaperture`` m (by area on others)."""
    flux = electrons / subaperture**2 * system.loop.rate
    lasers = [i for i, sensor in enumerate(system.sensors) if system.star_of(sensor).kind == "laser"]
    return system.with_changes({f"sensors.{i}.photons": flux for i in lasers})


def measure(
    trials: dict[str, Trial],
    seeds: range,
    frames: int,
    progress: Callable[[str, float], None] = lambda stage, done: None,
) -> dict[str, Outcome]:
    """Run every trial under every seed's sky.

    Trials whose plants differ in photons, noise or jitter alone must stand together: they share a sky.

    Args:
        seeds: of sky, noise and jitter; the same for all trials, whose differences are then paired.
        progress: called with what is being done, and the share that is done, 0 to 1.
    """
    groups = list(_groups(trials))
    total = len(groups) * len(seeds) * _SKY + len(trials) * (_BUILD + len(seeds) * _RUN)
    spent = 0.0
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in trials}
    for group in groups:
        programs = {}
        for name in group:
            progress(f"reconstructor, {name}", spent / total)
            programs[name] = program_of(Layout(trials[name].plant), trials[name].build())
            spent += _BUILD
        system = trials[group[0]].plant
        for seed in seeds:

            def share(done: float, title: str = f"sky {seed}, {group[0]}", before: float = spent) -> None:
                progress(title, (before + _SKY * done) / total)

            sky = prepare(system, frames, seed, science_every=SCIENCE_EVERY, progress=share)
            spent += _SKY
            settled = np.arange(0, frames, SCIENCE_EVERY) >= SETTLING
            fitting = float(np.sqrt(np.mean(sky.targets[0].fitting_error()[settled] ** 2)))
            for name in group:
                progress(f"sky {seed}, {name}", spent / total)
                result = run(Plant(trials[name].plant, sky), {0: programs[name]})
                ratio = strehl(result.high_order[settled, 0], system.science.wavelength)
                found[name].append((result.wfe(), float(ratio.mean()), fitting))
                spent += _RUN
    return {name: Outcome(*np.array(rows).T) for name, rows in found.items()}


def _groups(trials: dict[str, Trial]) -> Iterator[list[str]]:
    """Neighbours that can share a sky."""
    group: list[str] = []
    for name, trial in trials.items():
        if group and _sky_of(trial.plant) != _sky_of(trials[group[0]].plant):
            yield group
            group = []
        group.append(name)
    if group:
        yield group


def _sky_of(system: System) -> System:
    """The system without what a sky does not depend on."""
    return system.with_changes({"sensors.*.photons": 1.0, "guide_stars.*.jitter": 0.0})
