"""The same matrices given to pyRTC's pseudo-open-loop integrators and to our loop: latency in turns (``make rival``).

2528 slopes and 732 commands: ``gnao_ltao_sr`` without its central obscuration and its natural star. Both are paced at
the instrument's rate, compute on one core with one BLAS thread, and are held against float64 in every frame. The clock
starts when the slopes, or the last message of them, are due. Theirs ends when the command is in its shared memory, and
leaves out what writing the slopes there takes; ours ends when the command is serialised, and holds the reading of the
messages, the gate and its checks. Of their integrators the faster one counts, of medians and of tails.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srtomo_core.system import load_system
from srtomo_ops.bench.latency import ARRIVALS, LoopHere, Problem, Summary

INTEGRATORS = ("standard_integrator_pol", "pid_integrator_pol")
FASTER = {"staggered": 4.0, "burst": 2.5}
TURNS, FRAMES = 80, 50
"""Of each in turns: 4000 frames."""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def problem() -> Problem:
    system = load_system("gnao_ltao_sr", {"telescope.obscuration": 0})
    lasers = {"guide_stars": system.guide_stars[:4], "sensors": system.sensors[:4]}
    made = Problem.of(system.model_copy(update=lasers))
    assert made.layout.n_slopes == 2528
    return made


class Rival:
    """pyRTC's process."""

    def __init__(self, python: str, problem: Problem, folder: Path) -> None:
        self._problem, self._folder = problem, folder
        reconstructor = problem.reconstructor
        np.savez(
            folder / "problem.npz",
            R=reconstructor.R[0],
            G=problem.G,
            slopes=problem.slopes,
            gain=reconstructor.gain,
            rate=problem.system.loop.rate,
        )
        threads = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}
        words = [python, str(Path(__file__).with_name("rival_pyrtc.py")), str(folder / "problem.npz")]
        # nothing of this environment
        self._process = subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(folder / "rival.log").open("wb"),
            env={"HOME": str(folder), "PATH": os.defpath, **threads},
            text=True,
        )
        self._expect("ready")

    def _expect(self, word: str) -> None:
        """It may log to standard output too."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.strip() == word:
                return
        raise AssertionError((self._folder / "rival.log").read_text())

    def run(self, integrator: str, frames: int) -> list[int]:
        """Latencies of its next frames, ns, once they are checked."""
        assert self._process.stdin is not None
        out = self._folder / "out.npz"
        print(integrator, frames, out, file=self._process.stdin, flush=True)
        self._expect("done")
        with np.load(out) as file:
            self._check(file)
            return [int(ns) for ns in file["taken"]]

    def _check(self, file: Any) -> None:
        """``c[n] = (1-g) c[n-1] + g R (s + G c[n-1])``, from its own c[n-1]."""
        reconstructor, commands = self._problem.reconstructor, file["commands"].astype(float)
        before = np.concatenate([[file["first"]], commands[:-1]]).astype(float)
        slopes = self._problem.slopes[(int(file["frame"]) + np.arange(len(commands))) % len(self._problem.slopes)]
        opened = slopes.astype(float) + before @ self._problem.G.T
        gain = reconstructor.gain
        wanted = (1 - gain) * before + gain * opened @ reconstructor.R[0].astype(float).T
        off = np.abs(commands - wanted).max(axis=1) / np.abs(wanted).max(axis=1)
        assert off.max() < 1e-4

    def end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(30)


@pytest.fixture
def rival(problem: Problem, tmp_path: Path) -> Iterator[Rival]:
    python = os.environ.get("SRTOMO_PYRTC_PYTHON", "")
    if not python:
        pytest.skip("SRTOMO_PYRTC_PYTHON is not set: 'make rival' makes an environment with pyRTC and sets it")
    if subprocess.run([python, "-c", "import pyrtc"], capture_output=True, env={}, check=False).returncode:
        pytest.skip(f"{python} cannot import pyrtc")
    made = Rival(python, problem, tmp_path)
    yield made
    made.end()


def test_we_are_faster(rival: Rival, problem: Problem, capsys: pytest.CaptureFixture[str]) -> None:
    assert os.environ.get("OPENBLAS_NUM_THREADS") == "1"
    ours = LoopHere(problem, round(1e9 / problem.system.loop.rate))
    taken: dict[str, list[int]] = {name: [] for name in (*ARRIVALS, *INTEGRATORS)}
    for turn in range(TURNS + 1):
        for name, latencies in taken.items():
            new = ours.run(name, FRAMES) if name in ARRIVALS else rival.run(name, FRAMES)
            latencies += new if turn else []  # the first warms up
    found = {name: Summary.of(latencies) for name, latencies in taken.items()}
    tail = {name: float(np.quantile(latencies, 0.999)) * 1e-9 for name, latencies in taken.items()}
    best = min(INTEGRATORS, key=lambda name: found[name].median)
    best_tail = min(tail[name] for name in INTEGRATORS)
    assert ours.reference.held == 0
    with capsys.disabled():
        print(f"\n{'us':<28}{'median':>8}{'p90':>8}{'p99':>8}{'p99.9':>8}{'max':>9}")
        for name, s in found.items():
            values = (*s[:3], tail[name], s.max)
            print(f"{name:<28}" + "".join(f"{value * 1e6:8.0f}" for value in values))
        for arrival in ARRIVALS:
            ratio = found[best].median / found[arrival].median
            print(f"{arrival}: {ratio:.1f} times as fast as {best} in the median, wanted {FASTER[arrival]:g}")
    for arrival in ARRIVALS:
        assert found[arrival].median * FASTER[arrival] <= found[best].median
        assert tail[arrival] < best_tail
