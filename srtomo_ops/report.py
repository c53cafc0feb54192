"""Figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.design import Cut, Design


def demo_figure(
    path: Path, system: System, frame: Any, wfe: Any, swap_frame: int, bag: Path, labels: tuple[str, str]
) -> None:
    """WFE against time with the swap marked, latency histogram, and the mirrors at the end.

    Args:
        frame, wfe: (n,) exposure numbers and wavefront errors, m rms.
        labels: what was active before and after the swap.
    """
    with BagReader(bag) as reader:
        latencies = []
        last = None
        for message in reader.messages(reader.topic(wire.COMMAND.name)):
            last = wire.read_dm_command(message.data)
            latencies.append(last.latency)
    layout = Layout(system)
    figure, (top, left, right) = plt.subplots(1, 3, figsize=(15, 4.2), width_ratios=(2, 1.2, 1))
    seconds = np.asarray(frame) / system.loop.rate
    swap = swap_frame / system.loop.rate
    for part, label, colour in ((seconds < swap, labels[0], "tab:red"), (seconds >= swap, labels[1], "tab:blue")):
        top.plot(seconds[part], np.asarray(wfe)[part] * 1e9, lw=0.7, color=colour, label=label)
    top.axvline(swap, color="black", ls="--", lw=1)
    top.annotate(f"swap at frame {swap_frame}", (swap, 0.97), xycoords=("data", "axes fraction"), xytext=(4, 0),
                 textcoords="offset points", va="top", fontsize=8)  # fmt: skip
    settled = np.asarray(wfe)[seconds > 0.2]
    top.set(xlabel="time [s]", ylabel="WFE [nm rms], tip-tilt removed", title=system.name,
            ylim=(0, 1.3e9 * float(np.max(settled))))  # fmt: skip
    top.legend(fontsize=8, loc="lower left")
    microseconds = np.asarray(latencies) * 1e6
    left.hist(microseconds, bins=np.geomspace(max(microseconds.min(), 1), max(microseconds.max(), 2), 60).tolist())
    left.set(xscale="log", yscale="log", xlabel="last slopes taken to command ready [us]", ylabel="frames",
             title="latency")  # fmt: skip
    mirror = layout.mirrors[0]
    shape = np.full(mirror.mask.shape, np.nan)
    if last is not None:
        shape[mirror.mask] = last.commands[layout.commands_of(0)] * 1e9
    image = right.imshow(shape, origin="lower", cmap="RdBu_r")
    right.set(title=f"{mirror.name} at the end [nm of wavefront]", xticks=[], yticks=[])
    figure.colorbar(image, ax=right, shrink=0.8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def design_figure(path: Path, title: str, found: Design, lines: Sequence[Cut], amounts: Any, cost: Any) -> None:
    """How flat a design's optimum is along each variable, and what unknown shifts of its sensors cost.

    Args:
        amounts, cost: (n,) sub-apertures, and m rms.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2))
    for cut, value in zip(lines, found.values, strict=True):
        span = cut.variable.high - cut.variable.low
        left.plot((cut.values - value) / span, cut.wfe * 1e9, marker=".", lw=1, label=cut.variable.name)
    left.axhline(found.start_wfe * 1e9, color="black", ls="--", lw=1, label="as it was")
    left.set(xlabel="distance from the optimum [share of the range]", ylabel="WFE [nm rms], tip-tilt removed",
             title=title)  # fmt: skip
    left.legend(fontsize=7)
    right.plot(amounts, np.asarray(cost) * 1e9, marker="o")
    right.set(xlabel="sensors off by, unknown [sub-aperture]", ylabel="WFE [nm rms], tip-tilt removed",
              title="misalignment")  # fmt: skip
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
