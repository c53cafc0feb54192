"""Independent pieces of work on a given number of threads; interrupted between two pieces."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed

Progress = Callable[[float], None]
"""Called, on the caller's own thread, with the share of the work that is done, 0 to 1."""


def silent(done: float) -> None:
    """A :data:`Progress` for whoever does not want to know."""


def run(tasks: Iterable[Callable[[], None]], threads: int = 1, progress: Progress = silent) -> None:
    """Do all tasks, in any order.

    Args:
        tasks: to gain from threads, they spend their time in matrix products or compiled loops.
        threads: with 1, in turn on the caller's own.

    Raises:
        The first error of a task, or KeyboardInterrupt; tasks that have not begun are then left.
    """
    work = list(tasks)
    if threads == 1:
        for i, task in enumerate(work):
            task()
            progress((i + 1) / len(work))
        return
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(task) for task in work]
        try:
            for i, future in enumerate(as_completed(futures)):
                future.result()
                progress((i + 1) / len(work))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
