"""Threads that share products: the same bits whoever does what, no helper is waited for, and none stays behind."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from srtomo_rtc import realtime
from srtomo_rtc.crew import Crew, Timing, candidates, choose
from srtomo_rtc.vmm import accumulate, product_of, tiled

THREADS = (1, 2, 3, 5)


def helpers_alive() -> list[int]:
    names = {int(task.name): (task / "comm").read_text().strip() for task in Path("/proc/self/task").iterdir()}
    return sorted(thread for thread, name in names.items() if name == "srtomo-helper")


@pytest.mark.parametrize("kind", ["f4", "i2"])
@pytest.mark.parametrize("rows", [1, 33, 700])
def test_bits_do_not_depend_on_the_number_of_threads(kind, rows):
    """Fewer tiles than pieces, and more; again and again, since who is late changes."""
    rng = np.random.default_rng(rows)
    tiles = tiled((rng.standard_normal((rows, 90)) * 1000).astype(kind))
    vector = rng.standard_normal(90).astype("f4")
    expected = np.zeros(tiles.shape[0] * tiles.shape[2], "f4")
    accumulate(tiles, vector, expected, 7, 83)
    assert expected.any()
    for threads in THREADS:
        with Crew(threads, least_bytes=0) as crew:
            for _ in range(300):
                sums = np.zeros_like(expected)
                crew.multiply(product_of(tiles, vector, sums, 7, 83))
                assert sums.tobytes() == expected.tobytes()


def test_commands_do_not_depend_on_it_either(bench, mini):
    """The whole gate and law, packets in another order in each frame, helpers that sleep between frames or do not."""

    def commands(threads, spin_ns):
        made = bench()
        with Crew(threads, spin_ns, least_bytes=0) as crew:
            made.hrtc.loop.use(crew)
            made.close(mini.a)
            for k in range(40):
                order = np.random.default_rng([threads, k]).permutation(len(mini.layout.sensors))
                for message in np.array(made.messages(k), object)[order]:
                    made.hrtc.offer(message, made.now)
                made.hrtc.advance()
            made.hrtc.loop.use(None)
        return np.array([command.commands for command in made.commands])

    expected = commands(1, 0)
    assert len(expected) == 40 and expected.any()
    for threads in (2, 3):
        for spin_ns in (0, 1_000_000):
            assert commands(threads, spin_ns).tobytes() == expected.tobytes()


def test_a_helper_that_does_not_run_is_not_waited_for():
    """Under SCHED_IDLE, beside busy threads on its only core, a helper hardly ever comes to run."""
    core = min(os.sched_getaffinity(0))
    tiles, vector = tiled(np.ones((320, 64), "f4")), np.ones(64, "f4")
    with Crew(2, spin_ns=0, least_bytes=0) as crew:
        time.sleep(0.01)  # it sleeps now
        os.sched_setscheduler(crew.helpers[0], os.SCHED_IDLE, os.sched_param(0))
        with realtime.kept_on([core]):
            os.sched_setaffinity(crew.helpers[0], [core])
            for _ in range(1000):
                sums = np.zeros(320, "f4")
                crew.multiply(product_of(tiles, vector, sums))
                assert (sums == 64).all()


def test_helpers_end_with_their_crew():
    before = helpers_alive()
    crew = Crew(4)
    assert sorted(set(helpers_alive()) - set(before)) == sorted(crew.helpers) and len(crew.helpers) == 3
    crew.close()
    crew.close()
    assert helpers_alive() == before and crew.pointer is None


def test_helpers_are_pinned_or_the_reason_told():
    cores = sorted(os.sched_getaffinity(0))
    with Crew(3) as crew:
        wanted = [cores[0], cores[0], cores[-1]]
        assert str(realtime.pin_helpers(crew.helpers, wanted)) == (
            f"affinity of the helpers cores {cores[0]}, cores {cores[-1]}"
        )
        assert [os.sched_getaffinity(helper) for helper in crew.helpers] == [{cores[0]}, {cores[-1]}]
        assert not realtime.pin_helpers(crew.helpers, [0, 100_000, 0]).applied
        outcome = realtime.fifo_priority(3)
        policies = {os.sched_getscheduler(helper) for helper in crew.helpers}
        assert policies == {os.SCHED_FIFO if outcome.applied else os.SCHED_OTHER}
        for thread in map(int, os.listdir("/proc/self/task")):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


@pytest.mark.parametrize("threads", [0, 65])
def test_so_many_threads_are_refused(threads):
    with pytest.raises(ValueError, match=f"threads: expected 1 to 64, got {threads}"):
        Crew(threads)


def test_what_is_tried():
    assert [candidates(n) for n in (0, 1, 2, 3, 8, 100)] == [
        [1], [1], [1, 2], [1, 2, 3], [1, 2, 4, 8], [1, 2, 4, 8, 16, 32, 64]
    ]  # fmt: skip


def test_the_choice_is_the_fastest_that_is_worth_it(monkeypatch):
    """Of made-up times: 0.95 of the time is not worth a thread, 0.6 is."""
    times = {1: 1.0, 2: 0.95, 4: 0.6, 8: 0.58}
    monkeypatch.setattr(
        "srtomo_rtc.crew._seconds", lambda tiles, crew, period: times[crew.threads] * tiles[0].itemsize / 4
    )
    tiles = [np.ones((3, 5, 32), "f4")]
    choice = choose(tiles, list(times), 0.0)
    assert choice.threads == 4 and not tiles[0].any()
    assert choice.timings == [*(Timing("float32", n, t) for n, t in times.items()), Timing("int16", 4, 0.3)]
    assert choose(tiles, [2], 0.0, others=False) == (2, [Timing("float32", 2, 0.95)])


def test_a_measurement_is_short_and_leaves_nobody():
    tiles = [np.ones((23, 616, 32), "f4") for _ in range(4)]
    before = helpers_alive(), os.sched_getaffinity(0), threading.active_count()
    choice = choose(tiles, [1, 2], 0.001)
    assert [(timing.kernel, timing.threads) for timing in choice.timings[:2]] == [("float32", 1), ("float32", 2)]
    assert choice.timings[2].kernel == "int16" and all(timing.seconds > 0 for timing in choice.timings)
    assert before == (helpers_alive(), os.sched_getaffinity(0), threading.active_count())
