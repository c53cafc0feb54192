"""``Processes``: no node outlives the process that started it, however that one is ended."""

from __future__ import annotations

import os
import time
from typing import Any

import pytest

SUPERVISOR = """
import sys, time
from pathlib import Path
from srtomo_ops.processes import Processes
with Processes(Path.cwd()) as nodes:
    nodes.start("node", ["0", "--bind", "127.0.0.1"], "http.server")
    print(nodes._running["node"].pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("how", ["interrupt", "terminate"])
def test_nodes_end_with_the_process_that_started_them(start_process: Any, how: str) -> None:
    process = start_process("-c", SUPERVISOR)
    while not (told := process.output.split()):
        time.sleep(0.02)
    node = int(told[0])
    # where Ctrl-C does not go, and among whose tasks SCHED_IDLE counts
    assert os.getpgid(node) == node
    assert os.getsid(node) == os.getsid(process.pid)
    assert getattr(process, how)() != 0
    with pytest.raises(ProcessLookupError):
        os.kill(node, 0)
