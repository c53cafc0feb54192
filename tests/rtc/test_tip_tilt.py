"""Tip-tilt's own loop in the HRTC: three stars that count their own frames, their faults, and the replay of it all."""

import math
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import load_system
from srtomo_core.wire import SlopeFrameWriter
from srtomo_rtc.loop import Verdict
from srtomo_rtc.replay import Replay
from srtomo_rtc.swap import Refused, Swap
from srtomo_sim.mirror import interaction_matrix
from srtomo_srtc.reconstructors import implicit

GAIN = 0.4
STARS = (1, 4, 5)
ALL = sum(1 << w for w in STARS)


@pytest.fixture(scope="module")
def instrument():
    """``mini_tip_tilt`` as the fixture ``mini`` has mini."""
    system = load_system("mini_tip_tilt")
    layout = Layout(system)
    made = implicit(system, label="a")[0]
    return SimpleNamespace(
        system=system,
        layout=layout,
        G=interaction_matrix(system, layout).astype(np.float32),
        a=made,
        b=implicit(system, label="b", noise_gain=1.0)[0],
    )


class Sky:
    """A bench (conftest.py) whose stars have their own frames, and what the integrator should make of these."""

    def __init__(self, bench, instrument, **options) -> None:
        self.made = type(bench())(instrument, **options)
        self.instrument, self.layout = instrument, instrument.layout
        self.made.close(instrument.a)
        self.made.swap.change_settings(tip_tilt_gain=GAIN, tip_tilt_leak=0.05)
        self.expected = np.zeros(self.layout.n_commands)  # t in float64
        self.given: dict[int, np.ndarray] = {}
        for k in range(8):
            self.frame(k)
        self.made.commands.clear()

    @property
    def loop(self):
        return self.made.hrtc.loop

    @property
    def counts(self) -> dict[str, int]:
        return {name: count for name, count in self.loop.tip_tilt_counts.items() if count}

    @property
    def dropped(self) -> dict[str, int]:
        return {k: v for k, v in asdict(self.made.hrtc.counters).items() if v and k not in ("commands", "clipped")}

    def frame(self, k: int) -> wire.DmCommand:
        """A frame of the high orders, and the answer."""
        self.made.now += 5_000_000
        slopes = self.made.sky.slopes(k)
        self.made.offer(*(m for w, m in enumerate(self.made.messages(k, slopes)) if w not in STARS))
        self.made.tell()
        return self.made.commands[-1]

    def slopes(self, j: int) -> np.ndarray:
        return (np.random.default_rng([9, j]).standard_normal(self.layout.n_slopes) * 1e-7).astype(np.float32)

    def star(self, j: int, w: int, slopes=None, n_sensors: int = 1, session: int | None = None) -> None:
        """A message of a star; that of two sensors holds the next one too."""
        own = slice(int(self.layout.slope_start[w]), int(self.layout.slope_start[w + n_sensors]))
        sensors = self.layout.sensors[w : w + n_sensors]
        writer = SlopeFrameWriter(
            sensors[0].name, session or self.made.session, self.layout.fingerprint, w, n_sensors,
            sum(s.n_valid for s in sensors),
        )  # fmt: skip
        writer.values[:] = (self.slopes(j) if slopes is None else slopes)[own]
        self.made.offer(writer.write(self.made.now, j, wire.MIRROR_UNKNOWN, wire.MIRROR_UNKNOWN, 1.0))

    def stars(self, j: int, stars=STARS, slopes=None) -> None:
        for w in stars:
            self.star(j, w, slopes)

    def take(self, j: int, stars=STARS) -> None:
        """The integrator's step, in float64: the mean over the stars that came, each with its weight."""
        R, y = self.instrument.a.R[0].astype(float), self.slopes(j).astype(float)
        whole = [self.response(w) for w in STARS]
        share = sum(self.response(w) for w in stars) / sum(whole)
        step = sum(R[:, self.layout.slopes_of(w)] @ y[self.layout.slopes_of(w)] for w in stars) / share
        self.expected = 0.95 * self.expected + GAIN * step

    def response(self, w: int) -> float:
        """What R makes of a tip that star w alone sees."""
        place, own = self.layout.sensors[w], self.layout.slopes_of(w)
        tip = np.repeat([math.cos(place.rotation), -math.sin(place.rotation)], place.n_valid)
        return float(np.linalg.norm(self.instrument.a.R[0][:, own].astype(float) @ tip))

    def check(self, command: wire.DmCommand, frame: int, stars: int) -> None:
        """t is what it should be, the command is u + t, and says which frame of which stars has come into it."""
        np.testing.assert_allclose(self.loop.tip_tilt, self.expected, atol=1e-5 * np.abs(self.expected).max())
        np.testing.assert_array_equal(command.commands, self.loop.state + self.loop.tip_tilt)
        assert (command.tip_tilt_frame, command.sensors & ALL) == (frame, stars)
        assert np.isfinite(command.commands).all()


@pytest.fixture
def sky(bench, instrument):
    return Sky(bench, instrument)


def test_a_star_s_frame_is_in_the_next_command(sky):
    sky.stars(3)
    sky.take(3)
    sky.check(sky.frame(8), 3, ALL)
    sky.check(sky.frame(9), 3, 0)
    sky.star(4, 4, n_sensors=2)  # stars beside each other may share a message
    sky.star(4, 1)
    sky.take(4)
    sky.check(sky.frame(10), 4, ALL)
    assert sky.counts == {"frames": 2}
    assert sky.dropped == {}


def test_held_high_orders_are_no_reason_to_hold_tip_tilt(sky):
    sky.stars(0)
    sky.take(0)
    slopes = sky.made.sky.slopes(8)
    slopes[sky.layout.slopes_of(0)] = np.nan
    sky.made.offer(*(m for w, m in enumerate(sky.made.messages(8, slopes)) if w not in STARS))
    command = sky.made.commands[-1]
    assert command.verdict == Verdict.HOLD_NONFINITE
    sky.check(command, 0, ALL)


def test_the_lost_star(sky):
    """It is waited for once; the others then go on, until it is back."""
    k = 8
    for j in range(10):
        there = STARS if not 3 <= j < 7 else (1, 5)
        sky.stars(j, there)
        if j == 3:
            sky.check(sky.frame(k), 2, 0)  # waits for the star
            continue
        if j == 4:  # a newer frame came: 3 is given up, and of the two that wait 4 is used
            sky.take(4, there)
            sky.check(sky.frame(k + 1), 4, sum(1 << w for w in there))
            k += 2
            continue
        if j == 7:  # its first frame comes when nobody waits for it
            sky.take(7, (1, 4, 5))
        else:
            sky.take(j, there)
        sky.check(sky.frame(k), j, sum(1 << w for w in there))
        k += 1
    assert sky.counts == {"frames": 9, "partial": 3, "skipped": 1}
    assert sky.dropped == {}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_star_that_is_not_finite_is_a_lost_one(sky, value):
    slopes = sky.slopes(0)
    slopes[sky.layout.slopes_of(4).start + 1] = value
    sky.stars(0, slopes=slopes)
    sky.take(0, (1, 5))
    sky.check(sky.frame(8), 0, 1 << 1 | 1 << 5)
    sky.stars(1, slopes=np.full_like(slopes, value))
    sky.check(sky.frame(9), 0, 0)  # the last star lost: held
    sky.stars(2)
    sky.take(2)
    sky.check(sky.frame(10), 2, ALL)
    assert sky.counts == {"frames": 2, "partial": 1, "held": 1}


def test_what_is_dropped(sky):
    sky.stars(5)
    sky.stars(5)
    sky.star(4, 1)
    sky.star(6, 1, session=99)
    sky.star(10**6, 1)  # a stray number
    sky.take(5)
    sky.check(sky.frame(8), 5, ALL)
    assert sky.dropped == {"dropped_duplicate": 3, "dropped_late": 1, "dropped_session": 2}
    sky.star(6, 0, n_sensors=2)  # a laser's sensor with a star's
    writer = SlopeFrameWriter("ngs2", sky.made.session, sky.layout.fingerprint, 4, 1, 2)
    sky.made.offer(writer.write(0, 6, -1, -1, 1.0))  # half a star
    assert sky.dropped["dropped_malformed"] == 2
    sky.stars(40)  # a jump that a second frame agrees with
    sky.stars(41)
    sky.take(41)
    sky.check(sky.frame(9), 41, ALL)


def test_a_mirror_at_its_limit_holds_tip_tilt(sky):
    """What would take an actuator out of its range is not taken in, so that there is no wind-up; back is allowed."""
    sky.made.swap.change_settings(command_limit=3e-7, tip_tilt_leak=0.0)
    sky.frame(8)
    own = np.zeros(sky.layout.n_slopes, np.float32)
    for w in STARS:
        place = sky.layout.sensors[w]
        own[sky.layout.slopes_of(w)] = np.repeat([math.cos(place.rotation), -math.sin(place.rotation)], place.n_valid)
    for j in range(40):
        sky.stars(j, slopes=own * np.float32(1e-7))
        sky.frame(9 + j)
    held = sky.counts["held"]
    assert 3e-8 < np.abs(sky.loop.tip_tilt).max() <= 3e-7
    assert held > 20
    before = sky.loop.tip_tilt.copy()
    sky.stars(40, slopes=own * np.float32(-1e-7))
    sky.frame(49)
    assert np.abs(sky.loop.tip_tilt).max() < 0.9 * np.abs(before).max()
    assert sky.counts["held"] == held


def test_an_open_loop_relaxes_it_and_flat_is_flat(sky):
    sky.stars(0)
    sky.frame(8)
    before = sky.loop.tip_tilt.copy()
    sky.loop.request(closed=False)
    sky.made.hrtc.idle(sky.made.now)
    sky.stars(1)
    assert sky.frame(9).tip_tilt_frame == 0
    np.testing.assert_allclose(sky.loop.tip_tilt, 0.9 * before, rtol=1e-6)
    sky.made.hrtc.flatten()
    assert not sky.made.commands[-1].commands.any()


def test_replay(bench, instrument, tmp_path):
    """Lost stars, held frames, settings, a swap and the middle of the bag: bit for bit; an altered star shows."""
    path = tmp_path / "bag"
    sky = Sky(bench, instrument, bag=path)
    made = sky.made
    made.publish(instrument.b)
    slopes = sky.slopes(3)
    slopes[sky.layout.slopes_of(1)] = np.nan
    for k in range(8, 80):
        if k % 5 == 2:
            there = (1, 5) if 30 <= k < 45 else STARS
            sky.stars(k // 5, there, slopes if k == 17 else None)
        if k == 33:
            made.hrtc.want_snapshot()
        if k == 40:
            made.commit(instrument.b)
        if k == 50:
            made.swap.change_settings(tip_tilt_gain=0.2)
        if k == 60:
            made.offer(*made.messages(60)[2:4])
            continue
        if k in (65, 68):
            made.hrtc.loop.request(closed=k == 68)
        sky.frame(k)
    made.hrtc.flatten()
    made.finish()
    for start in (0, 35):
        with BagReader(path) as reader:
            outcome = Replay(reader).run(start)
        assert (outcome.differing, outcome.skipped, outcome.unanswered, outcome.gaps) == (0, 0, 0, [])
        assert outcome.compared == 81 - start
    with BagReader(path) as reader:
        replay = Replay(reader)
        put = replay.stars.put
        replay.stars.put = lambda m: put(m._replace(slopes=m.slopes * (1 if m.frame != 12 else 1.001)))
        assert replay.run().differing > 10


def test_what_a_swap_refuses(instrument, helpers):
    settings = helpers.plain_settings(instrument.layout)
    swap = Swap(instrument.system, instrument.layout, instrument.G, settings, lambda program: None)
    swap.stage_whole(instrument.a)
    own = instrument.layout.slopes_of(4)
    for change, reason in (
        (lambda R: R[:, own] * -1, "of the tip-tilt that ngs2 sees"),
        (lambda R: R[:, own] * 3, "of the tip-tilt that"),
        (lambda R: np.roll(R[:, own], 4, axis=1), "of the tip-tilt that ngs2 sees"),
    ):
        R = instrument.a.R.copy()
        R[0][:, own] = change(R[0])
        with pytest.raises(Refused, match=reason):
            swap.stage_whole(replace(instrument.a, R=R))
    # the joint estimate counts the stars' slopes in Q
    joint = Reconstructor.from_matrices(
        instrument.a.R[0], instrument.G, fingerprint=instrument.a.fingerprint, gain=0.5,
        command_limit=instrument.layout.stroke,
    )  # fmt: skip
    with pytest.raises(Refused, match="not stable enough"):
        swap.stage_whole(joint)
