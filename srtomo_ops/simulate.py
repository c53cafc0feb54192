"""The loop in lockstep without ROS: the HRTC's own control law against the simulated plant, the same every run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import TipTiltLoop
from srtomo_rtc.loop import Loop, Program, Settings, Slot, Verdict
from srtomo_rtc.lowrank import Factors
from srtomo_sim.plant import Plant

SETTLING = 50
"""Frames left out of the statistics by default: the loop starts from a flat mirror."""


class Run(NamedTuple):
    """Residuals of a run, one row a science frame.

    Attributes:
        frames: (n,) exposure numbers.
        high_order: (n, n_targets) m rms, piston and tip-tilt removed.
        tip_tilt: (n, n_targets) m rms of tip and tilt.
    """

    frames: NDArray[np.int64]
    high_order: NDArray[np.float64]
    tip_tilt: NDArray[np.float64]

    def wfe(self, settling: int = SETTLING) -> float:
        """Rms over time of the first target's high-order residual after ``settling`` frames, m."""
        return float(np.sqrt(np.mean(self.high_order[self.frames >= settling, 0] ** 2)))


def program_of(
    layout: Layout,
    reconstructor: Reconstructor,
    settings: Settings | None = None,
    kernel: str = "float32",
    factors: Sequence[Factors] = (),
) -> Program:
    """A program that runs a reconstructor under plain settings; for kernel tlr its parts' ``factors`` are needed."""
    slot = Slot(layout, reconstructor.n_epochs, kernel)
    slot.fill(reconstructor, factors)
    return Program(slot, settings or plain_settings(layout))


def plain_settings(layout: Layout, leak: float = 0.0, tip_tilt: TipTiltLoop | None = None) -> Settings:
    """Pseudo-open-loop control, no offset, no limit but the mirrors' stroke; ``tip_tilt`` in a loop of its own."""
    return Settings(
        id=1,
        offset=np.zeros(layout.n_commands, np.float32),
        slope_reference=np.zeros(layout.n_slopes, np.float32),
        leak=leak,
        tip_tilt_gain=tip_tilt.gain if tip_tilt is not None else 0.0,
        tip_tilt_leak=tip_tilt.leak if tip_tilt is not None else 0.0,
    )


def run(
    plant: Plant,
    programs: dict[int, Program],
    *,
    frames: int | None = None,
    closed: bool = True,
    each: Callable[[int], None] = lambda frame: None,
) -> Run:
    """Close the loop over a plant that has not run yet.

    Args:
        programs: what the loop runs, by the first frame it is to make; the first is for frame 0.
        frames: how many; by default all that the sky was prepared for.
        closed: False leaves the mirrors flat.
        each: called with every frame's number after it.
    """
    sky = plant.sky
    epochs = max(program.slot.n_epochs for program in programs.values())
    loop = Loop(sky.layout, sky.system.loop.delay, epochs)
    loop.post(programs[0])
    loop.prepare()
    loop.request(closed)
    own_sensors = sum(1 << w for w in sky.layout.tip_tilt_sensors)
    rows = []
    for k in range(sky.n_frames if frames is None else frames):
        if k in programs:
            loop.post(programs[k])
        loop.prepare()
        slopes = plant.measure(k)
        on = plant.on_mirror(k)
        if k % sky.science_every == 0:
            error = plant.wfe(k)
            rows.append((k, error.high_order, error.tip_tilt))
        if (stars := plant.tip_tilt(k)) is not None:
            loop.give_tip_tilt(stars[0], own_sensors, stars[1])
        for w in range(loop.n_sensors):
            if loop.all_sensors >> w & 1:
                loop.add(w, slopes[sky.layout.slopes_of(w)])
        verdict = loop.answer(on.frame, on.before, on.fraction)
        assert verdict in (Verdict.OK, Verdict.OPEN)
        plant.command(k, loop.command)
        each(k)
    numbers, high_order, tip_tilt = zip(*rows, strict=True)
    return Run(np.array(numbers), np.array(high_order), np.array(tip_tilt))
