"""Fixtures of the node tests: a ROS domain of their own, and real processes that are always ended."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# One thread each, as the nodes have: two files run at a time, and other threads give BLAS's results other last bits.
# Before numpy loads.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import pytest

from srtomo_ops.cli import LOCAL

NEEDS_ROS = "needs rclpy: install srtomo with its extra, pip install '.[ros]', or source ROS 2 Jazzy"


class NodeProcess:
    """A Python process that was started by a test; what it prints goes to a file."""

    def __init__(self, arguments: tuple[str, ...], log: Path) -> None:
        self._log = log
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                cwd=log.parent,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )

    @property
    def pid(self) -> int:
        """The process's id: the wheels of rclpy start Python twice, but in one process."""
        return self._process.pid

    @property
    def output(self) -> str:
        """What it printed so far, errors included."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, text: str, timeout: float = 30.0) -> None:
        """Wait until it has printed a text."""
        deadline = time.monotonic() + timeout
        while text not in self.output:
            ended = self._process.poll()
            assert ended is None, f"ended with {ended} before it printed {text!r}:\n{self.output}"
            assert time.monotonic() < deadline, f"no {text!r} within {timeout} s:\n{self.output}"
            time.sleep(0.02)

    def wait(self, timeout: float = 30.0) -> int:
        """Wait until it ends; returns its exit status."""
        return self._process.wait(timeout)

    def interrupt(self, timeout: float = 30.0) -> int:
        """As Ctrl-C does; returns its exit status."""
        self._process.send_signal(signal.SIGINT)
        return self.wait(timeout)

    def terminate(self, timeout: float = 30.0) -> int:
        """SIGTERM; returns its exit status."""
        self._process.send_signal(signal.SIGTERM)
        return self.wait(timeout)

    def kill(self) -> None:
        """kill -9."""
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """End it, politely first."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if self._process.poll() is not None:
                return
            self._process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5.0)


StartProcess = Callable[..., NodeProcess]


@pytest.fixture(scope="session")
def _clean_shared_memory() -> Iterator[None]:
    """What killed processes left in /dev/shm; segments in use stay."""
    yield
    if tool := shutil.which("fastdds", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"):
        subprocess.run([tool, "shm", "clean"], capture_output=True, timeout=30, check=False)


@contextmanager
def _own_domain() -> Iterator[int]:
    pytest.importorskip("rclpy", reason=NEEDS_ROS)
    from domain_coordinator import domain_id

    with domain_id() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        for variable, value in LOCAL.items():
            patch.setenv(variable, value)
        yield number


@contextmanager
def _processes(folder: Path) -> Iterator[StartProcess]:
    processes: list[NodeProcess] = []

    def start(*arguments: str | Path) -> NodeProcess:
        log = folder / f"process_{len(processes)}.log"
        processes.append(NodeProcess(tuple(map(str, arguments)), log))
        return processes[-1]

    try:
        yield start
    finally:
        for process in reversed(processes):
            process.end()


@pytest.fixture
def ros_domain(_clean_shared_memory: None) -> Iterator[int]:
    """A free ROS domain on this host alone, in the environment of this process and those that it starts."""
    with _own_domain() as number:
        yield number


@pytest.fixture
def start_process(ros_domain: int, tmp_path: Path) -> Iterator[StartProcess]:
    """Starts ``python ARGUMENTS...`` in the test's domain and folder, e.g. ``start_process("-m", "package.node")``."""
    with _processes(tmp_path) as start:
        yield start


@pytest.fixture(scope="module")
def start_shared_process(
    _clean_shared_memory: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[StartProcess]:
    """As ``start_process``, in a domain and a folder for all tests of a module."""
    with _own_domain(), _processes(tmp_path_factory.mktemp("processes")) as start:
        yield start
