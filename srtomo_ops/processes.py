"""The nodes as processes: started together, watched, and always ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

_OWN_GROUP: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"preexec_fn": os.setpgrp}


class NodeError(ValueError):
    """A node that ended before its time; one line with the last thing it said."""


class Processes:
    """``with Processes(folder) as nodes: nodes.start("hrtc", [...])``; leaving ends whatever still runs.

    SIGINT and SIGTERM leave it too, as a KeyboardInterrupt. To be entered by the main thread.

    Args:
        folder: where each node's output goes, as NAME.log.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._handlers: dict[signal.Signals, Any] = {}

    def start(self, name: str, words: list[str], module: str = "srtomo_ops.cli") -> None:
        """Start ``srtomo WORDS...`` under a name, or another module with these words."""
        with open(self.log(name), "wb") as log:
            # a group of its own: Ctrl-C goes to the supervisor, which ends the nodes in order. No session of its own:
            # Linux shares cores among sessions first, and the SRTC's SCHED_IDLE would count among its threads alone
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", module, *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                **_OWN_GROUP,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )

    def resident_bytes(self, name: str) -> int:
        """Memory that a node holds now: its own and what it shares."""
        pages = Path(f"/proc/{self._running[name].pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def log(self, name: str) -> Path:
        """A node's output."""
        return self._folder / f"{name}.log"

    def last_line(self, name: str) -> str:
        """The last line that a node wrote, or an empty one."""
        lines = self.log(name).read_text(errors="replace").split("\n")
        return next((line for line in reversed(lines) if line.strip()), "")

    def check(self) -> None:
        """Raise if a node has ended.

        Raises:
            NodeError: names it, with its last line.
        """
        for name, process in self._running.items():
            code = process.poll()
            if code is not None:
                raise NodeError(f"{name} ended with exit code {code}: {self.last_line(name)} (see {self.log(name)})")

    def prioritise(self, name: str, priority: int) -> bool:
        """SCHED_FIFO for every thread of a node; False where the system refuses."""
        try:
            for thread in os.listdir(f"/proc/{self._running[name].pid}/task"):
                os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))
        except OSError:
            return False
        return True

    def stop(self, name: str, patience: float = 30.0) -> int:
        """End a node with SIGINT, and wait; SIGKILL when its patience is over. Its exit code."""
        process = self._running.pop(name)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            return process.wait(patience)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()

    def __enter__(self) -> Processes:
        # whoever ends this process politely, and a shell that has it ignore Ctrl-C in the background, end the nodes too
        for number in (signal.SIGINT, signal.SIGTERM):
            self._handlers[number] = signal.signal(number, signal.default_int_handler)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        end = time.monotonic() + 10
        for name in list(self._running):
            self.stop(name, max(0.1, end - time.monotonic()))
        for number, handler in self._handlers.items():
            if handler is not None:  # one that is not Python's cannot be put back
                signal.signal(number, handler)
