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
from srtomo_srtc.learn import Learned


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
    left.set(xscale="log", yscale="log", xlabel="last slopes received to command ready [us]", ylabel="frames",
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


def sky_figure(path: Path, system: System, learned: Learned) -> None:
    """The profile against altitude, and measured against fitted covariance of slopes."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4))
    kilometres = learned.altitudes / 1e3
    left.barh(kilometres, learned.fractions, height=0.3, color="lightgrey", label="best fit, layer by layer")
    for i, group in enumerate(learned.groups):
        ends = kilometres[[group.layers[0], group.layers[-1]]]
        ends += np.array([-0.3, 0.3])
        label = "told apart, 1 sigma" if i == 0 else None
        interval = group.fraction - group.sigma, group.fraction + group.sigma
        left.fill_betweenx(ends, *interval, color="tab:blue", alpha=0.4, lw=0, label=label)
        left.plot([group.fraction] * 2, ends, color="tab:blue")
    left.set(xlabel="share of Cn2", ylabel="altitude [km above the telescope]", xlim=(0, None),
             title=f"{system.name}: r0 {100 * learned.r0:.1f} +- {100 * learned.r0_sigma:.1f} cm")  # fmt: skip
    left.legend(fontsize=8)
    for name, colour, (length, measured, fitted) in zip(
        ("one sensor", "two sensors"), ("tab:red", "tab:green"), _by_baseline(learned), strict=True
    ):
        right.plot(length, measured, "o", ms=4, color=colour, label=f"{name}, measured")
        right.plot(length, fitted, color=colour, lw=1, label=f"{name}, fitted")
    right.set(xlabel="baseline in the pupil [m]", ylabel="covariance of slopes, x or y [rad$^2$]",
              title="mean over directions; noise at 0")  # fmt: skip
    right.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _by_baseline(learned: Learned) -> list[tuple[Any, Any, Any]]:
    """Within a sensor, and between sensors: baselines (n,) m, measured and fitted covariance at them, rad^2."""
    parts = learned.sampling.parts
    starts = np.cumsum([0] + [part.place.n_slopes for part in parts])
    size = min(part.place.size for part in parts)
    sums = np.zeros((2, 3, 1 + 2 * max(len(part.place.mask) for part in parts)))
    for i, a in enumerate(parts):
        for j, b in enumerate(parts):
            if a.place.size != size or b.place.size != size:
                continue
            (ax, ay), (bx, by) = (part.place.to_pupil(*part.place.local.T) for part in (a, b))
            bins = np.rint(np.hypot(ax[:, None] - bx, ay[:, None] - by) / size).astype(int).ravel()
            kind = sums[int(a.sensor != b.sensor)]
            for axis in range(2):
                rows = slice(starts[i] + axis * a.place.n_valid, starts[i] + (axis + 1) * a.place.n_valid)
                columns = slice(starts[j] + axis * b.place.n_valid, starts[j] + (axis + 1) * b.place.n_valid)
                for row, values in enumerate((learned.measured, learned.fitted)):
                    kind[row] += np.bincount(bins, values[rows, columns].ravel(), len(kind[row]))
                kind[2] += np.bincount(bins, minlength=len(kind[2]))
    out = []
    for measured, fitted, count in sums:
        seen = count > 0
        out.append((size * np.flatnonzero(seen), measured[seen] / count[seen], fitted[seen] / count[seen]))
    return out
