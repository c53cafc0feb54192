"""Every fault of the slopes in random order, and clocks that jump: the frame gate and the loop, without ROS."""

import random
import struct
import time

import numpy as np
import pytest

from srtomo_rtc.loop import Verdict

FAULTS = 200  # frames with a fault each, or none
CLEAN = 60  # after them: a loop of gain 0.5 has forgotten what was before
STRAY = 10**6  # frames ahead: no jump of the count that the gate would believe


class Saboteur:
    """Does something else to every frame. What it injected is in ``injected``, by the counter that has to show it."""

    def __init__(self, bench, seed: int) -> None:
        self.bench = bench
        self.chance = random.Random(seed)
        self.injected: dict[str, int] = {}
        self.acts = (
            self.whole, self.whole, self.not_finite, self.not_finite, self.too_large, self.no_sensor, self.no_frame,
            self.twice, self.late, self.swapped, self.cut, self.of_another_instrument, self.of_another_session,
            self.stray, self.of_no_known_mirror, self.burst,
        )  # fmt: skip

    def disturb(self) -> None:
        """The next frames, in some way."""
        self.bench.now += 5_000_000
        self.chance.choice(self.acts)(self.bench.hrtc.loop.frame)

    def count(self, name: str, n: int = 1) -> None:
        self.injected[name] = self.injected.get(name, 0) + n

    def whole(self, k: int) -> None:
        self.bench.offer(*self.bench.messages(k))

    def not_finite(self, k: int) -> None:
        slopes = self.bench.sky.slopes(k)
        slopes[self.chance.randrange(len(slopes))] = self.chance.choice((np.nan, np.inf, -np.inf))
        self.bench.offer(*self.bench.messages(k, slopes))
        self.count("not finite")

    def too_large(self, k: int) -> None:
        """Finite, but no product with them is."""
        self.bench.offer(*self.bench.messages(k, np.full(self.bench.layout.n_slopes, 3e38, np.float32)))
        self.count("not finite")

    def no_sensor(self, k: int) -> None:
        parts = self.bench.messages(k)
        del parts[self.chance.randrange(len(parts))]
        self.bench.offer(*parts)
        self.bench.offer(*self.bench.messages(k + 1))
        self.count("held_incomplete")

    def no_frame(self, k: int) -> None:
        self.bench.offer(*self.bench.messages(k + 1))
        self.count("held_missing")

    def twice(self, k: int) -> None:
        parts = self.bench.messages(k)
        self.bench.offer(parts[0], *parts)
        self.bench.offer(*parts)
        self.count("dropped_duplicate", 1 + len(parts))

    def late(self, k: int) -> None:
        """The whole frame comes after its successor."""
        parts = self.bench.messages(k)
        self.bench.offer(*self.bench.messages(k + 1))
        self.bench.offer(*parts)
        self.count("held_missing")
        self.count("dropped_late", len(parts))

    def swapped(self, k: int) -> None:
        parts = self.bench.messages(k)
        self.chance.shuffle(parts)
        self.bench.offer(*parts)

    def cut(self, k: int) -> None:
        message = self.bench.messages(k)[0]
        self.bench.offer(message[: self.chance.randrange(len(message))], *self.bench.messages(k))
        self.count("dropped_malformed")

    def of_another_instrument(self, k: int) -> None:
        foreign = self.bench.messages(k, np.ones(self.bench.layout.n_slopes), fingerprint=bytes(32))
        self.bench.offer(*foreign, *self.bench.messages(k))
        self.count("dropped_fingerprint", len(foreign))

    def of_another_session(self, k: int) -> None:
        foreign = self.bench.messages(k, np.ones(self.bench.layout.n_slopes), session=77)
        self.bench.offer(*foreign, *self.bench.messages(k))
        self.count("dropped_session", len(foreign))

    def stray(self, k: int) -> None:
        foreign = self.bench.messages(k + STRAY, np.ones(self.bench.layout.n_slopes))
        self.bench.offer(*foreign, *self.bench.messages(k))
        self.count("dropped_session", len(foreign))

    def of_no_known_mirror(self, k: int) -> None:
        self.bench.offer(*self.bench.messages(k, timing=(k + 10, k, 1.0)))
        self.count("unknown mirror")

    def burst(self, k: int) -> None:
        """12 whole frames that wait, where 4 may."""
        timing = self.bench.sky.timing(k)
        self.bench.offer(*(message for i in range(12) for message in self.bench.messages(k + i, timing=timing)))
        self.count("held_behind", 7)


@pytest.mark.parametrize("seed", range(8))
def test_any_mixture_of_faults(bench, mini, seed):
    """One finite command a frame within the mirror's stroke; each fault in its counter; then as if nothing had been."""
    made = bench()
    made.close(mini.a)
    made.run(range(10))
    saboteur = Saboteur(made, seed)
    for _ in range(FAULTS):
        saboteur.disturb()
        assert made.hrtc.loop.closed  # none of them uses the fault budget up
    first_clean = made.hrtc.loop.frame
    made.run(range(first_clean, first_clean + CLEAN))

    assert [command.frame for command in made.commands] == list(range(first_clean + CLEAN))
    commands = np.array([command.commands for command in made.commands])
    assert np.isfinite(commands).all()
    assert (np.abs(commands) <= mini.a.command_limit).all()
    counters, injected = made.hrtc.counters, saboteur.injected
    for name in ("held_incomplete", "held_missing", "held_behind"):
        assert getattr(counters, name) == injected.get(name, 0), name
    for name in ("duplicate", "late", "session", "fingerprint", "malformed"):
        assert getattr(counters, f"dropped_{name}") == injected.get(f"dropped_{name}", 0), name
    assert counters.held_nonfinite == injected["not finite"]
    assert counters.held_history == injected["unknown mirror"]

    undisturbed = bench()
    undisturbed.close(mini.a)
    undisturbed.run(range(first_clean - CLEAN, first_clean + CLEAN))
    assert {command.verdict for command in made.commands[first_clean:]} == {Verdict.OK}
    wanted = undisturbed.commands[-1].commands
    assert made.commands[-1].commands == pytest.approx(wanted, abs=1e-5 * float(np.abs(wanted).max()))


@pytest.mark.parametrize("step", [-86400, -3600, -1, 1, 3600, 10**9])
def test_a_step_of_the_sensor_s_clock_is_carried_and_changes_nothing(bench, mini, step):
    """Stamps are the sensors' business: order and time-outs go by frame numbers and the monotonic clock."""
    plain, stepped = bench(), bench()
    for made in (plain, stepped):
        made.close(mini.a)
    plain.run(range(30))
    for k in range(30):
        stepped.now += 5_000_000
        seconds = stepped.now // 10**9 + (step if k >= 15 else 0)
        for message in stepped.messages(k):
            altered = bytearray(message)
            struct.pack_into("<i", altered, 4, seconds)
            stepped.offer(bytes(altered))
        assert stepped.commands[-1].stamp_sec == seconds
    assert [c.commands.tobytes() for c in stepped.commands] == [c.commands.tobytes() for c in plain.commands]
    assert {c.verdict for c in stepped.commands} == {Verdict.OK}
    assert vars(stepped.hrtc.counters) == vars(plain.hrtc.counters)


def test_the_host_s_wall_clock_is_not_asked(bench, mini, monkeypatch):
    made = bench()
    made.close(mini.a)

    def asked() -> int:
        raise AssertionError("the wall clock decides nothing in the loop")

    for name in ("time", "time_ns"):
        monkeypatch.setattr(time, name, asked)
    made.run(range(20))
    made.hrtc.flatten()
    assert len(made.commands) == 21
