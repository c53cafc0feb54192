"""Real-time settings in processes of their own: applied, or reported with the reason."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from srtomo_rtc import realtime


def run(code: str, **environment: str) -> str:
    """Standard output of a new Python; its variables for BLAS threads are those given alone."""
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**kept, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stdout.strip()


PIN = "from srtomo_rtc import realtime; print(realtime.pin_blas())"


def test_blas_threads_are_pinned_before_numpy():
    assert run(PIN) == "blas threads 1"
    assert run(f"{PIN}; import os; print(os.environ['OPENBLAS_NUM_THREADS'])").splitlines()[1] == "1"
    assert run(f"import numpy; {PIN}") == "blas threads refused: numpy was loaded first (unset threads)"
    assert run(f"import numpy; {PIN}", OPENBLAS_NUM_THREADS="4").endswith("(4 threads)")
    assert run(f"import numpy; {PIN}", OPENBLAS_NUM_THREADS="1") == "blas threads 1"


def test_blas_is_asked_how_many_threads_it_has():
    read = "from srtomo_rtc import realtime; asked = realtime.pin_blas()"
    assert run(f"{read}; import scipy.linalg; print(realtime.read_blas(asked))") == "blas threads 1"
    assert run(f"{read}; print(realtime.read_blas(asked))").endswith("set and not read back: no OpenBLAS")
    late = run(f"import numpy; {read}; print(realtime.read_blas(asked))", OPENBLAS_NUM_THREADS="2")
    if len(os.sched_getaffinity(0)) > 1:
        assert late == "blas threads refused: OpenBLAS uses 2, numpy was loaded first (2 threads)"


def test_the_module_itself_does_not_load_numpy():
    assert run("import sys; from srtomo_rtc import realtime; print('numpy' in sys.modules)") == "False"


def test_memory_is_locked_or_the_reason_told():
    code = (
        "from srtomo_rtc import realtime; print(realtime.lock_memory());"
        "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmLck')))"
    )
    outcome, locked = run(code).splitlines()
    if int(locked) == 0:
        assert outcome.startswith("memory lock refused: ")
    else:
        assert outcome == f"memory lock {int(locked) >> 10} MiB"


@pytest.mark.skipif(os.geteuid() == 0, reason="the limit does not bind root")
def test_memory_is_not_locked_under_a_limit():
    """Locking future pages under a limit would turn a later allocation into a crash."""
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft == resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (1 << 20, hard))
    try:
        assert not realtime.lock_memory().applied
    finally:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (soft, hard))


def test_priority():
    code = (
        "import os; from srtomo_rtc import realtime; print(realtime.fifo_priority({})); print(os.sched_getscheduler(0))"
    )
    assert run(code.format(0)).splitlines() == ["SCHED_FIFO not asked for", str(os.SCHED_OTHER)]
    outcome, policy = run(code.format(5)).splitlines()
    if outcome == "SCHED_FIFO 5":
        assert policy == str(os.SCHED_FIFO)
    else:
        assert outcome.startswith("SCHED_FIFO refused: ") and "RLIMIT_RTPRIO" in outcome
        assert policy == str(os.SCHED_OTHER)
    assert run(code.format(1000)).startswith("SCHED_FIFO refused: ")


def test_affinity():
    own = min(os.sched_getaffinity(0))
    code = "from srtomo_rtc import realtime; import os; print(realtime.pin_thread({})); print(os.sched_getaffinity(0))"
    assert run(code.format([own])).splitlines() == [f"affinity of the loop cores {own}", str({own})]
    assert run(code.format([])).splitlines()[1] == str(os.sched_getaffinity(0))
    assert run(code.format([100_000])).startswith("affinity of the loop refused: ")


def test_huge_pages_are_counted_or_the_reason_told():
    code = (
        "from srtomo_rtc import realtime; from srtomo_rtc.vmm import huge_zeros;"
        # others' pages, which are huge where the system makes them so, are none of the matrices'
        "import numpy; numpy.ones(1 << 23);"
        "kept = huge_zeros((16, 1024, 1024), 'f4'); kept[:] = 1; unused = huge_zeros((8, 1024, 1024), 'f4');"
        "print(realtime.huge_pages((one.ctypes.data, one.nbytes) for one in (kept, unused)))"
    )
    outcome = run(code)
    if "[never]" in Path("/sys/kernel/mm/transparent_hugepage/enabled").read_text():
        assert outcome.startswith("huge pages refused: ")
    else:
        assert outcome == "huge pages 64 MiB of 64 MiB of matrices"
    small = run("from srtomo_rtc import realtime; print(realtime.huge_pages([(0, 1 << 20)]))")
    assert small == "huge pages not needed: no matrix fills one (1.0 MiB at most)"


def test_the_interpreter_is_quiet():
    code = (
        "import gc, sys; from srtomo_rtc import realtime; print(realtime.quiet_interpreter());"
        "print(gc.get_freeze_count() > 1000, sys.getswitchinterval())"
    )
    assert run(code).splitlines() == ["garbage collection frozen", "True 0.0005"]


def test_a_worker_stands_back():
    """A thread that is started under SCHED_FIFO, on all cores, gets off both."""
    allowed = sorted(os.sched_getaffinity(0))
    code = (
        "import os, threading; from srtomo_rtc import realtime; fifo = realtime.fifo_priority(5).applied;"
        "worker = lambda: print(os.sched_getscheduler(0), realtime.stand_back({}), os.sched_getscheduler(0),"
        " os.sched_getaffinity(0), sep='; '); started = threading.Thread(target=worker); started.start();"
        "started.join(); print(fifo, os.sched_getscheduler(0), os.sched_getaffinity(0), sep='; ')"
    )
    for taken in (allowed[:1], allowed, []):
        worker, rest = run(code.format(taken)).splitlines()
        left = [core for core in allowed if core not in taken] or allowed
        fifo = rest.startswith("True")
        policy = os.SCHED_FIFO if fifo else os.SCHED_OTHER
        cores = ",".join(map(str, left))
        assert worker == f"{policy}; staging normal scheduling, cores {cores}; {os.SCHED_OTHER}; {set(left)}"
        assert rest == f"{fifo}; {policy}; {set(allowed)}"
    if not fifo:
        pytest.skip("the system refuses SCHED_FIFO (RLIMIT_RTPRIO): nothing to be taken off")
