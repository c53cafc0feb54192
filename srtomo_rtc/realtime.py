"""Real-time settings: each one applied, read back, and reported with the reason where the system refused.

Import this module first: :func:`pin_blas` must run before numpy loads, and :func:`read_blas` after it.
:func:`pin_thread` and :func:`kept_on` may act on the thread that calls them; everything else is of the whole process or
of threads named, and for one thread to call before frames come.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

_BLAS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_BLAS_COUNTS = tuple(
    f"{prefix}openblas_get_num_threads{suffix}" for prefix in ("", "scipy_") for suffix in ("", "64_", "_64_")
)  # as the wheels of numpy and scipy, and distributions, name it
_REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR)
_MCL_CURRENT, _MCL_FUTURE = 1, 2

HUGE_PAGE = 2 << 20
"""Bytes."""


class Outcome(NamedTuple):
    """Whether a setting was applied, and why not."""

    name: str
    applied: bool
    detail: str

    def __str__(self) -> str:
        return f"{self.name} {self.detail}" if self.applied else f"{self.name} refused: {self.detail}"


def pin_blas(threads: int = 1) -> Outcome:
    """Ask for a number of BLAS threads; refused when numpy is loaded already and another number was in force.

    Whether BLAS heeds it, :func:`read_blas` tells.
    """
    name = "blas threads"
    in_force = os.environ.get(_BLAS[0])
    if "numpy" in sys.modules and in_force != str(threads):
        return Outcome(name, False, f"numpy was loaded first ({in_force or 'unset'} threads)")
    for variable in _BLAS:
        os.environ[variable] = str(threads)
    return Outcome(name, True, str(threads))


def read_blas(asked: Outcome, threads: int = 1) -> Outcome:
    """The number of threads that every OpenBLAS of the process says it uses, once numpy is loaded.

    Args:
        asked: what :func:`pin_blas` gave, which stands where no OpenBLAS is found to be asked.
        threads: that it was given.
    """
    found = set()
    # numpy and scipy bring one each
    for library in {line.split(maxsplit=5)[-1].strip() for line in _memory_map() if "openblas" in line}:
        with suppress(OSError):
            loaded = ctypes.CDLL(library)
            found |= {int(getattr(loaded, name)()) for name in _BLAS_COUNTS if hasattr(loaded, name)}
    if not found:
        return asked._replace(detail=f"{asked.detail}, set and not read back: no OpenBLAS") if asked.applied else asked
    if found == {threads}:
        return Outcome(asked.name, True, str(threads))
    reason = f", {asked.detail}" if not asked.applied else ""
    return Outcome(asked.name, False, f"OpenBLAS uses {', '.join(map(str, sorted(found)))}{reason}")


def _memory_map() -> list[str]:
    return Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()


def lock_memory() -> Outcome:
    """mlockall: no page of the process is swapped out."""
    name = "memory lock"
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        # locking future pages under a limit would turn a later allocation into a crash
        return Outcome(name, False, f"RLIMIT_MEMLOCK is {soft} bytes, needs unlimited")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        return Outcome(name, False, os.strerror(ctypes.get_errno()))
    locked = _kibibytes("status", "VmLck")
    return Outcome(name, locked > 0, f"{locked >> 10} MiB" if locked else "the system has locked nothing")


def _kibibytes(file: str, field: str) -> int:
    for line in Path("/proc/self", file).read_text(encoding="ascii").splitlines():
        if line.startswith(f"{field}:"):
            return int(line.split()[1])
    return 0


def huge_pages(matrices: Iterable[tuple[int, int]]) -> Outcome:
    """What of the matrices is on huge pages: they ask for them when they are made, if they fill one.

    Args:
        matrices: address and bytes of each. What was not touched yet is not there, and not counted.
    """
    matrices = list(matrices)
    large = [(start, start + size) for start, size in matrices if size >= HUGE_PAGE]
    if not large:
        largest = max((size for _, size in matrices), default=0)
        return Outcome("huge pages", True, f"not needed: no matrix fills one ({largest / 2**20:.1f} MiB at most)")
    huge, there = _pages_of(large)
    if huge:
        return Outcome("huge pages", True, f"{huge >> 10} MiB of {there >> 10} MiB of matrices")
    setting = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    try:
        reason = f"{setting} says {setting.read_text(encoding='ascii').strip()}"
    except OSError:
        reason = "this system has none"
    return Outcome("huge pages", False, reason)


def _pages_of(ranges: Collection[tuple[int, int]]) -> tuple[int, int]:
    """KiB on huge pages, and in memory at all, of the mappings that hold these ranges of addresses."""
    huge = there = 0
    counted = False
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8", errors="replace").splitlines():
        word, *rest = line.split()
        if not word.endswith(":"):
            start, end = (int(address, 16) for address in word.split("-"))
            counted = any(start < last and first < end for first, last in ranges)
        elif counted and word == "AnonHugePages:":
            huge += int(rest[0])
        elif counted and word == "Rss:":
            there += int(rest[0])
    return huge, there


def pin_thread(cores: Collection[int], thread: int = 0, name: str = "affinity of the loop") -> Outcome:
    """Keep a thread, 0 for the calling one, on some cores; none: leave it as it is."""
    try:
        if cores:
            os.sched_setaffinity(thread, cores)
        return Outcome(name, True, "cores " + ",".join(map(str, sorted(os.sched_getaffinity(thread)))))
    except (OSError, ValueError) as error:
        return Outcome(name, False, str(error))


def pin_helpers(helpers: Sequence[int], cores: Sequence[int]) -> Outcome:
    """Keep each helper thread on the core after the one before; the loop's own is the first. None: leave them."""
    name = "affinity of the helpers"
    each = [pin_thread(cores[i : i + 1], helper, name) for i, helper in enumerate(helpers, start=1)]
    refused = [outcome for outcome in each if not outcome.applied]
    return refused[0] if refused else Outcome(name, True, ", ".join(outcome.detail for outcome in each))


@contextmanager
def kept_on(cores: Collection[int]) -> Iterator[None]:
    """Keep the calling thread, and those that it starts meanwhile, on some cores, if that can be; none: as they are."""
    before = os.sched_getaffinity(0)
    with suppress(OSError, ValueError):
        os.sched_setaffinity(0, cores or before)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def fifo_priority(priority: int) -> Outcome:
    """SCHED_FIFO for every thread of the process: the middleware's carry the slopes, and the loop's waits for them."""
    name = "SCHED_FIFO"
    if priority <= 0:
        return Outcome(name, True, "not asked for")
    threads = [int(thread) for thread in os.listdir("/proc/self/task")]
    try:
        for thread in threads:
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        found = {(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in threads}
    except (OSError, ValueError) as error:
        return Outcome(name, False, f"{error} (RLIMIT_RTPRIO)")
    return Outcome(name, found == {(os.SCHED_FIFO, priority)}, str(priority))


def stand_back(cores: Collection[int]) -> Outcome:
    """Normal scheduling for the calling thread, and none of ``cores`` if others remain to the process.

    For work of seconds, which the loop could not preempt at its own priority. No less than normal: whoever has the
    interpreter's lock must get on.
    """
    name = "staging"
    try:
        if os.sched_getscheduler(0) in _REAL_TIME:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except OSError as error:
        return Outcome(name, False, str(error))
    if os.sched_getscheduler(0) in _REAL_TIME:
        return Outcome(name, False, "it has kept the loop's scheduling")
    allowed = os.sched_getaffinity(os.getpid())
    pinned = pin_thread(allowed.difference(cores) or allowed, name=name)
    return pinned._replace(detail=f"normal scheduling, {pinned.detail}") if pinned.applied else pinned


def quiet_interpreter() -> Outcome:
    """Freeze all that lives now out of garbage collection, and let threads switch 10 times as readily."""
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(0.0005)
    return Outcome("garbage collection", gc.get_freeze_count() > 0, "frozen")
