"""Helper threads that share the loop's products, and how many of them pay. They run in ``native/crew.c``.

A product is cut into whole tiles of rows, so that every sum has the order it has on one thread: the number of threads
and who is late decide no bit. The loop's thread never waits for a helper that sleeps or has not begun: it takes over
whatever tiles are left.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_rtc import native
from srtomo_rtc.native import lib
from srtomo_rtc.vmm import Floats, product_of

LEAST_BYTES = 256 << 10
"""Of tiles in a product, some 10 us of one core's reading; with less the loop's thread works alone."""

SPIN_NS = 50_000
"""How long a helper looks for more work before it sleeps, where the loop's thread does not poll either."""

MAX_THREADS = 64

_WORTH = 0.9  # of the time with fewer threads, that more of them must not exceed
_MEASURING = 0.05  # s, for one number of threads and one kernel
_LEAST_RUNS = 3


class Crew:
    """The helpers beside one thread. That thread, or whoever calls while it does not run, uses it; any one thread makes
    and closes it.

    Args:
        threads: in all, the caller's included.
        spin_ns: how long a helper looks for more work before it sleeps.
        least_bytes: of tiles, below which the caller works alone.

    Attributes:
        threads: as given.
        helpers: the helpers' ids, for the scheduler's calls.

    Raises:
        ValueError: ``threads`` is not 1 to :data:`MAX_THREADS`.
        OSError: the system has no more threads.
    """

    def __init__(self, threads: int, spin_ns: int = SPIN_NS, least_bytes: int = LEAST_BYTES) -> None:
        if not 1 <= threads <= MAX_THREADS:
            raise ValueError(f"threads: expected 1 to {MAX_THREADS}, got {threads}")
        self.threads = threads
        self._pointer = lib.srt_crew_new(threads - 1, spin_ns, least_bytes)
        if not self._pointer:
            raise OSError(f"{threads - 1} helper threads could not be started")
        self.helpers = tuple(int(lib.srt_crew_thread(self._pointer, i)) for i in range(threads - 1))

    @property
    def pointer(self) -> int | None:
        """For the frame path; None once closed."""
        return self._pointer

    def multiply(self, product: native.Product) -> None:
        """Form a product (:func:`srtomo_rtc.vmm.product_of`) together."""
        lib.srt_crew_multiply(self._pointer, product)

    def close(self) -> None:
        """End the helpers, which nobody uses any more. Twice does no harm."""
        pointer, self._pointer = self._pointer, None
        lib.srt_crew_free(pointer)

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Timing(NamedTuple):
    """Median time of one frame's products R y, s, and its kernel and number of threads."""

    kernel: str
    threads: int
    seconds: float

    def __str__(self) -> str:
        return f"{self.kernel} with {self.threads} thread{'s' * (self.threads > 1)} {self.seconds * 1e6:.3g} us"


class Choice(NamedTuple):
    """What :func:`choose` found: the number of threads, and all that was measured."""

    threads: int
    timings: list[Timing]


def candidates(cores: int) -> list[int]:
    """Numbers of threads to try on so many cores: 1, 2, 4 .. and all of them."""
    most = min(max(cores, 1), MAX_THREADS)
    return [*(1 << i for i in range(most.bit_length()) if 1 << i < most), most]


def choose(tiles: Sequence[NDArray[Any]], threads: Sequence[int], period: float, others: bool = True) -> Choice:
    """Measure the products of one frame with each number of threads: for a fraction of a second, off the loop.

    More threads are chosen where they take at most 0.9 of the time of fewer. They give the same bits; another kernel
    does not, so it is measured for the report alone. The helpers inherit the calling thread's cores.

    Args:
        tiles: of each sensor, of the instrument's own size (:func:`srtomo_rtc.vmm.tiles_shape`), float32 or int16;
            overwritten with zeros, which fetches their pages.
        threads: to try, ascending.
        period: of the frames, s: between two products caches cool and helpers fall asleep as they do in the loop.
        others: measure int16 with the chosen number of threads, too, if the tiles are float32.
    """
    for one in tiles:
        one.fill(0)
    kernel = "int16" if tiles[0].dtype == np.int16 else "float32"
    chosen = Timing(kernel, threads[0], float("inf"))
    timings = []
    for n in threads:
        with Crew(n) as crew:
            timing = Timing(kernel, n, _seconds(tiles, crew, period))
            timings.append(timing)
            if timing.seconds <= _WORTH * chosen.seconds:
                chosen = timing
    if others and kernel == "float32":
        # half the tiles, of twice the rows: the same memory
        integers = [one.view(np.int16)[: -(-len(one) // 2)] for one in tiles]
        with Crew(chosen.threads) as crew:
            timings.append(Timing("int16", chosen.threads, _seconds(integers, crew, period)))
    return Choice(chosen.threads, timings)


def _seconds(tiles: Sequence[NDArray[Any]], crew: Crew, period: float) -> float:
    rows = max(one.shape[0] * one.shape[2] for one in tiles)
    sums: Floats = np.zeros(rows, np.float32)
    vector: Floats = np.zeros(max(one.shape[1] for one in tiles), np.float32)
    products = [product_of(one, vector, sums) for one in tiles]
    times: list[float] = []
    begun = time.perf_counter()
    end = begun + _MEASURING
    while len(times) < _LEAST_RUNS or begun < end:
        begun = time.perf_counter()
        for product in products:
            crew.multiply(product)
        times.append(time.perf_counter() - begun)
        time.sleep(max(period - times[-1], 0.0))
    return statistics.median(times[1:])  # the first one fetches the matrix
