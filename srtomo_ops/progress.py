"""A progress line on standard error for anything that takes over two seconds; silent when it is not a terminal."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress


class Progress:
    """``with Progress("sky") as progress: work(progress.share)``."""

    def __init__(self, title: str) -> None:
        self._bar = RichProgress(
            TextColumn("{task.description:<30}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            transient=True,
            disable=not sys.stderr.isatty(),
        )
        self._title = title
        self._task = self._bar.add_task(title, total=1.0)

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def share(self, done: float) -> None:
        """The share of the work that is done, 0 to 1."""
        self._bar.update(self._task, completed=done)

    def stage(self, name: str, done: float) -> None:
        """The same, with the name of the stage that begins."""
        self._bar.update(self._task, completed=done, description=f"{self._title}: {name}")
