"""The kernels beside each other on one reconstructor: bytes, rank, error and time, of one thread and of several.

Each runs the loop's own path, a frame at a time: every sensor's slopes in, then the command, paced at the instrument's
rate; c, with Q, is formed in between as in operation, and not timed. Kernels take turns of a few frames. Before a
figure is given, commands of several threads are held bit for bit against those of one, products against float64 of the
matrix that the kernel states to apply, and the stated error against slopes drawn from the covariance that it is
reckoned from.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_ops.simulate import plain_settings
from srtomo_rtc import realtime
from srtomo_rtc.compression import LIMIT, SlopeStatistics, error_to_noise, int16_to_noise
from srtomo_rtc.crew import Crew
from srtomo_rtc.loop import Loop, Program, Slot, Verdict
from srtomo_rtc.lowrank import factorise

TOLERANCES = (0.3, 0.09, 0.03, 0.01)
"""Of low rank: error aimed at, over what photon noise leaves in the commands."""

_TURN = 10  # frames
_DRAWN = 24  # slope vectors that the stated error is held against
_ALIKE = 0.5  # of the stated error: so few vectors tell no better
_UNKNOWN = -(2**63)  # of SlopeFrame: as if the last command was in time


@dataclass
class Row:
    """One kernel with one number of threads.

    Attributes:
        kernel: float32, int16, or tlr with its tolerance.
        nbytes: of matrix, read for a product R y.
        rank, whole: mean rank of the factors, and share of the blocks that are none; 0 and 1 but for tlr.
        error: rms error of R y over the rms that photon noise leaves in it, as stated when it is staged.
        drawn: the same, of slopes drawn at random.
        seconds: of each frame, first slopes to command.
    """

    kernel: str
    threads: int
    nbytes: int
    rank: float
    whole: float
    error: float
    drawn: float
    seconds: list[float]

    @property
    def median(self) -> float:
        """Of ``seconds``."""
        return float(np.median(self.seconds))


class _Runner:
    """One kernel's loop."""

    def __init__(self, system: System, layout: Layout, slot: Slot, crew: Crew, row: Row) -> None:
        self.row = row
        self.command: NDArray[np.float32] = np.zeros(0, np.float32)
        self._layout = layout
        self._loop = Loop(layout, system.loop.delay)
        self._loop.use(crew)
        program = Program(slot, plain_settings(layout, system.loop.leak))
        program.warm()
        self._loop.post(program)
        self._loop.request(closed=True)
        self._loop.prepare()

    def run(self, slopes: Sequence[NDArray[np.float32]], period: float, timed: bool = True) -> None:
        """A turn; ``command`` is then the last one."""
        loop, layout = self._loop, self._layout
        for y in slopes:
            own = [np.ascontiguousarray(y[layout.slopes_of(w)]) for w in range(loop.n_sensors)]
            begun = time.perf_counter()
            for w, values in enumerate(own):
                loop.add(w, values)
            verdict = loop.answer(_UNKNOWN, _UNKNOWN, 1.0)
            ended = time.perf_counter()
            if verdict != Verdict.OK:
                raise ValueError(f"a frame was answered with verdict {verdict.name}")
            if timed:
                self.row.seconds.append(ended - begun)
            loop.prepare()
            time.sleep(max(period - (time.perf_counter() - begun), 0.0))
        self.command = loop.command.copy()


def measure(
    system: System,
    reconstructor: Reconstructor,
    threads: Sequence[int],
    frames: int,
    tolerances: Sequence[float] = TOLERANCES,
    fifo_priority: int = 0,
    progress: Callable[[str, float], None] = lambda stage, done: None,
) -> list[Row]:
    """Every kernel with every number of threads (1 first), ``frames`` frames each; under SCHED_FIFO, if asked for, from
    when the factors are found.

    Raises:
        ValueError: the reconstructor is of another instrument or predictive, or a kernel does not do what it states.
    """
    layout = Layout(system)
    if reconstructor.fingerprint != layout.fingerprint or reconstructor.n_epochs != 1:
        raise ValueError(f"reconstructor {reconstructor.label!r}: expected a static one of {system.name}")
    runners: dict[str, list[_Runner]] = {}
    crews = [Crew(n) for n in threads]
    try:
        for slot, row in _slots(system, layout, reconstructor, tolerances, progress):
            rows = [Row(**{**vars(row), "threads": crew.threads, "seconds": []}) for crew in crews]
            runners[row.kernel] = [
                _Runner(system, layout, slot, crew, one) for crew, one in zip(crews, rows, strict=True)
            ]
        if not (outcome := realtime.fifo_priority(fifo_priority)).applied:
            raise ValueError(str(outcome))
        slopes = list(1e-7 * np.random.default_rng(0).standard_normal((_TURN, layout.n_slopes)).astype(np.float32))
        done = -_TURN  # the first turn is for the caches
        while done < frames:
            for kernel, together in runners.items():
                for runner in together:
                    runner.run(slopes[: min(_TURN, frames - max(done, 0))], 1 / system.loop.rate, timed=done >= 0)
                if any(runner.command.tobytes() != together[0].command.tobytes() for runner in together):
                    raise ValueError(f"{kernel}: commands depend on the number of threads")
            done += _TURN
            progress("frames", min(max(done, 0) / frames, 1.0))
    finally:
        for crew in crews:
            crew.close()
    return [runner.row for together in runners.values() for runner in together]


def table(rows: Sequence[Row]) -> list[str]:
    """What was measured, for people; the first row is float32 with one thread."""
    dense = rows[0]
    lines = [
        f"R of {dense.nbytes / 2**20:.3g} MiB in float32; checked: threads decide no bit, products are as stated",
        f"{'kernel':<12}{'threads':>8}{'bytes':>8}{'rank':>7}{'whole':>7}"
        f"{'error':>10}{'drawn':>10}{'us':>10}{'time':>7}",
    ]
    for row in rows:
        ranks = f"{row.rank:>7.1f}{row.whole:>7.2f}" if row.kernel.startswith("tlr") else f"{'':14}"
        lines.append(
            f"{row.kernel:<12}{row.threads:>8}{row.nbytes / dense.nbytes:>8.3f}{ranks}{row.error:>10.1e}"
            f"{row.drawn:>10.1e}{row.median * 1e6:>10.4g}{row.median / dense.median:>7.2f}"
        )
    return [
        *lines,
        "bytes, time: of float32 with one thread; rank: mean of the factors', whole: share of blocks that are none",
        f"error, drawn: of what photon noise leaves in the commands, as stated (limit {LIMIT:g}), and of slopes drawn",
        "us: median, first slopes in to command ready",
    ]


def _slots(
    system: System,
    layout: Layout,
    reconstructor: Reconstructor,
    tolerances: Sequence[float],
    progress: Callable[[str, float], None],
) -> Iterator[tuple[Slot, Row]]:
    R = reconstructor.R[0]
    drawn = _draw(system, layout)
    noise = _noise(system, layout, R)

    def row(kernel: str, slot: Slot, error: float, nbytes: int, rank: float = 0.0, whole: float = 1.0) -> Row:
        matrices = slot.epochs[0]
        products = np.stack([matrices.times(y)[: layout.n_commands] for y in drawn]).astype(np.float64)
        stated = drawn.astype(np.float64) @ matrices.R.T.astype(np.float64)
        if not np.allclose(products, stated, rtol=0, atol=1e-5 * np.abs(stated).max()):
            raise ValueError(f"{kernel}: a product is not that of the matrix that is stated")
        wrong = products - drawn.astype(np.float64) @ R.T.astype(np.float64)
        rms = math.sqrt(float(np.sum(wrong**2)) / len(drawn)) / noise
        if not abs(rms - error) <= _ALIKE * error + 1e-4:
            raise ValueError(f"{kernel}: slopes drawn at random leave {rms:.2g} where {error:.2g} is stated")
        return Row(kernel, 1, nbytes, rank, whole, error, rms, [])

    for kernel, error, nbytes in (
        ("float32", 0.0, R.nbytes),
        ("int16", int16_to_noise(system, layout, R), R.nbytes // 2),
    ):
        slot = Slot(layout, kernel=kernel)
        slot.fill(reconstructor)
        yield slot, row(kernel, slot, error, nbytes)
    for number, tolerance in enumerate(tolerances):
        progress("factors", number / len(tolerances))
        factors = factorise(system, layout, R, tolerance)
        slot = Slot(layout, kernel="tlr")
        slot.fill(reconstructor, [factors])
        error = error_to_noise(system, layout, R, factors.applied())
        yield slot, row(f"tlr {tolerance:g}", slot, error, factors.nbytes, factors.mean_rank, factors.whole)


def _draw(system: System, layout: Layout) -> NDArray[np.float32]:
    """Slopes (n, n_slopes) of turbulence without a mirror, sensor by sensor independent, with photon noise."""
    statistics, rng = SlopeStatistics(system, layout), np.random.default_rng(1)
    found = []
    for w, sensor in enumerate(layout.sensors):
        half = np.linalg.cholesky(statistics.covariance(w, np.arange(sensor.n_valid)))
        drawn = rng.standard_normal((_DRAWN, len(half))) @ half.T
        found.append(drawn.reshape(_DRAWN, -1, 2).transpose(0, 2, 1).reshape(_DRAWN, -1))
    return np.concatenate(found, axis=1).astype(np.float32)


def _noise(system: System, layout: Layout, R: NDArray[np.float32]) -> float:
    statistics = SlopeStatistics(system, layout)
    variances = np.concatenate([np.tile(statistics.photons(w), 2) for w in range(len(layout.sensors))])
    return math.sqrt(float(np.sum(R.astype(np.float64) ** 2 @ variances)))
