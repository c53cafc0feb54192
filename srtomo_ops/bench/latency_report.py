"""What ``srtomo bench latency`` says: a table with its targets, and the same as numbers for a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from srtomo_ops.bench.latency import PATH_TARGETS, TARGETS, Compute, Problem, Summary

if TYPE_CHECKING:
    from srtomo_ops.bench.path import Paths

_MEANING = {
    "sgemv": "(a) one float32 product R y, numpy, one core",
    "staggered": "loop, last packet due to command ready",
    "burst": "loop, message due to command ready",
    "burst_int16": "loop with kernel int16, message due to command ready",
    "float32": "float32 kernel alone",
    "int16": "int16 kernel alone",
}
"""Of Compute.latencies."""


def report(problem: Problem, compute: Compute, paths: Paths | None) -> tuple[list[str], bool]:
    """Lines for people, and whether every target is met. Without ``paths`` there is only the compute."""
    layout, sgemv = problem.layout, compute.latencies["sgemv"].median
    error = max(compute.error, paths.error if paths else 0.0)
    lines = [
        f"{problem.system.name}: {layout.n_commands} commands x {layout.n_slopes} slopes at "
        f"{problem.system.loop.rate:g} Hz, {len(problem.sensors('staggered').due_ns)} packets a frame when staggered",
        f"checked: every frame has one command, in order, within {error:.0e} of float64",
        f"{'us':<62}{'median':>8}{'p90':>8}{'p99':>8}{'max':>9}{'/ (a)':>7}",
        "compute, in this process",
    ]
    lines += [_row(meaning, compute.latencies[name], sgemv) for name, meaning in _MEANING.items()]
    lines.append(f"  16 bits err by {compute.int16_to_noise:.1e} of what sensor noise leaves in the commands")
    if paths is not None:
        lines.append(f"whole path, over ROS ({paths.realtime})")
        for arrival, found in paths.arrivals.items():
            lines += [
                _row(f"{arrival}: {name}, last slopes published to command back", found.path[node], sgemv)
                for node, name in (("echo", "(b) echo"), ("hrtc", "HRTC"))
            ]
            lines += [
                _row(f"{arrival}: {name}, last slopes received to command sent", found.inside[node], sgemv)
                for node, name in (("echo", "echo"), ("hrtc", "HRTC"))
            ]
            lines.append(_row(f"{arrival}: HRTC, last slopes received to command ready", found.loop, sgemv))
    targets = [_target(f"compute, {name}, median", compute.ratio(name), most) for name, most in TARGETS.items()]
    if paths is not None:
        for arrival, most in PATH_TARGETS.items():
            for name in ("median", "p90"):
                mean, half = (value / sgemv for value in getattr(paths.arrivals[arrival], name))
                targets.append(_target(f"path, {arrival}, {name}, HRTC less echo", mean, most, half))
    lines.append("targets, set for gnao_ltao_sr, in units of (a)")
    lines += [line for line, _ in targets]
    if held := compute.held + (paths.held if paths else 0):
        lines.append(f"{held} frames were held because the loop was behind; they are left out of the figures")
    if paths is not None:
        lines += [f"{name}: its queue lost slopes of {n} frames" for name, n in paths.lost.items() if n]
    return lines, all(met for _, met in targets)


def numbers(problem: Problem, compute: Compute, paths: Paths | None) -> dict[str, Any]:
    """For ``--json``; s unless the name says otherwise."""
    found: dict[str, Any] = {
        "system": problem.system.name,
        "commands": problem.layout.n_commands,
        "slopes": problem.layout.n_slopes,
        "rate_hz": problem.system.loop.rate,
        "packets": len(problem.sensors("staggered").due_ns),
        "compute": {
            "seconds": _plain(compute.latencies),
            "to_sgemv": {name: compute.ratio(name) for name in TARGETS},
            "targets": TARGETS,
            "largest_error": compute.error,
            "held": compute.held,
            "int16_to_noise": compute.int16_to_noise,
        },
    }
    if paths is not None:
        found["path"] = {
            "seconds": {
                arrival: {
                    "published_to_returned": _plain(latency.path),
                    "received_to_sent": _plain(latency.inside),
                    "received_to_ready": latency.loop._asdict(),
                    "hrtc_less_echo": {"median": latency.median._asdict(), "p90": latency.p90._asdict()},
                }
                for arrival, latency in paths.arrivals.items()
            },
            "targets_to_sgemv": PATH_TARGETS,
            "largest_error": paths.error,
            "held": paths.held,
            "frames_with_lost_slopes": paths.lost,
            "realtime": paths.realtime,
        }
    return found


def _row(meaning: str, summary: Summary, sgemv: float) -> str:
    quantiles = "".join(f"{value * 1e6:8.0f}" for value in summary[:3])
    return f"  {meaning:<60}{quantiles}{summary.max * 1e6:9.0f}{summary.median / sgemv:7.2f}"


def _target(name: str, ratio: float, most: float, half_width: float = 0.0) -> tuple[str, bool]:
    """A line, and whether the target is met: with the whole of the interval, where there is one."""
    met = ratio + half_width <= most
    interval = f" (95 %: {ratio - half_width:.2f} to {ratio + half_width:.2f})" if half_width else ""
    return f"  {'met' if met else 'MISSED':<7}{name}: {ratio:.3f}{interval}, at most {most:g}", met


def _plain(summaries: Mapping[str, Summary]) -> dict[str, dict[str, float]]:
    return {name: summary._asdict() for name, summary in summaries.items()}
