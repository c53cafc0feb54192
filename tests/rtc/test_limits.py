"""What operators set to limit the loop: slew, clip, rms, the gain's ramp, flat, the watchdog; bags replay all of it."""

import math
import time
from dataclasses import asdict

import numpy as np
import pytest

from srtomo_core.bag import BagReader
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import Direction, load_system
from srtomo_rtc.loop import Loop, LoopState, Program, Slot, Verdict
from srtomo_rtc.offload import Offload, tilt_of_commands
from srtomo_rtc.replay import Replay
from srtomo_sim.mirror import interaction_matrix, mirror_phase

SECOND = 10**9
LAYOUT = Layout(load_system("mini"))
N, M = LAYOUT.n_slopes, LAYOUT.n_commands
RNG = np.random.default_rng(8)
G = RNG.standard_normal((N, M)) * 3.0
R = np.linalg.pinv(G) + RNG.standard_normal((M, N)) * 2e-4
SKY = RNG.standard_normal((80, N)) * 1e-6
OFFSET = (RNG.standard_normal(M) * 5e-8).astype("f4")
GAIN = 0.5


@pytest.fixture(scope="module")
def program(helpers):
    made = Reconstructor.from_matrices(R, G, fingerprint=LAYOUT.fingerprint, gain=GAIN, command_limit=LAYOUT.stroke)
    slot = Slot(LAYOUT)
    slot.fill(made)
    return lambda **settings: Program(slot, helpers.plain_settings(LAYOUT, **settings))


def feed(loop, y):
    for w in range(loop.n_sensors):
        loop.add(w, y[LAYOUT.slopes_of(w)].astype("f4"))


def frames(loop, count=80):
    """Run a loop behind its mirror, with a delay of one frame; yields after each answer."""
    shown = np.zeros(M)
    for k in range(count):
        feed(loop, SKY[k] - G @ shown)
        assert loop.answer(k - 1, k - 2, 1.0) is (Verdict.OK if loop.closed else Verdict.OPEN)
        shown = loop.command.astype(float)
        yield k
        loop.prepare()


# -- limits of the command ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("slew",), ("rms",), ("clip",), ("slew", "rms", "clip")])
def test_the_state_follows_what_limits_put_on_the_mirror(program, names):
    """Against the law in float64: u[k] = (1-g) u[k-1] + g R s[k], limited in m = u + o; counts too."""
    limits = {name: value for name, value in (("slew", 1.5e-8), ("rms", 4e-8), ("clip", 7e-8)) if name in names}
    settings = {"offset": OFFSET, "slope_reference": (-G @ OFFSET).astype("f4")}
    named = {"slew": "slew_limit", "rms": "rms_limit", "clip": "command_limit"}
    loop = Loop(LAYOUT, 1)
    loop.post(program(**settings, **{named[name]: value for name, value in limits.items()}))
    loop.request(closed=True)
    loop.prepare()
    slew, rms, limit = (limits.get(name, math.inf) for name in ("slew", "rms", "clip"))
    u, last = np.zeros(M), np.zeros(M)
    counts = np.zeros(3, int)
    for k in frames(loop):
        u = (1 - GAIN) * u + GAIN * R @ SKY[k]
        wanted = u + OFFSET
        m = np.clip(wanted, -limit, limit)
        scaled = np.sqrt(np.mean(m**2)) > rms * (1 + 1e-6)
        within = m * rms / np.sqrt(np.mean(m**2)) if scaled else m
        counts += (loop.n_clipped, loop.scaled, loop.n_slewed)
        assert loop.n_clipped == pytest.approx((m != wanted).sum(), abs=1)
        m = np.clip(within, last - slew, last + slew)
        assert loop.scaled == scaled and loop.n_slewed == pytest.approx((m != within).sum(), abs=3)
        assert loop.command == pytest.approx(m, abs=3e-5 * np.abs(u).max())
        assert np.abs(loop.command - last).max() < slew * (1 + 1e-5)
        u, last = m - OFFSET, loop.command.astype(float)
    assert [count > 20 for count in counts] == [name in names for name in ("clip", "rms", "slew")]


def test_a_scaled_command_keeps_its_shape_and_a_held_one_its_bits(program):
    loop = Loop(LAYOUT, 1)
    loop.post(program(rms_limit=1e-8))
    loop.request(closed=True)
    loop.prepare()
    feed(loop, SKY[0])
    loop.answer(-1, -1, 1.0)
    wanted = GAIN * R @ SKY[0]
    assert loop.command @ wanted == pytest.approx(np.linalg.norm(loop.command) * np.linalg.norm(wanted), rel=1e-6)
    assert np.sqrt(np.mean(loop.command.astype(float) ** 2)) == pytest.approx(1e-8, rel=1e-6)
    before = loop.command.tobytes()
    for _ in range(5):
        loop.prepare()
        loop.hold(Verdict.HOLD_MISSING)
        assert loop.command.tobytes() == before


def test_an_offset_goes_on_no_faster_than_the_slew_limit(program):
    """In an open loop, from the flat that a session begins with."""
    loop = Loop(LAYOUT, 1)
    loop.post(program(offset=OFFSET, slew_limit=2e-8, relaxation=1.0))
    loop.prepare()
    needed = math.ceil(np.abs(OFFSET).max() / 2e-8)
    for k in frames(loop, needed + 1):
        assert loop.command == pytest.approx(np.clip(OFFSET, -(k + 1) * 2e-8, (k + 1) * 2e-8), abs=1e-13)
        assert (loop.n_slewed > 0) == (k + 1 < needed)


# -- the gain's ramp ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("polc", [True, False])
def test_the_gain_rises_in_a_ramp_from_each_closing(program, polc):
    """g[j] = g min(j / N, 1) in the j-th frame, a held one counted: in the gain, and in what is kept of the state."""
    ramp, leak = 8, 0.01
    loop = Loop(LAYOUT, 1)
    loop.post(program(gain_ramp=ramp, polc=polc, leak=leak))
    loop.request(closed=True)
    loop.prepare()
    u, j = np.zeros(M), 0
    for k in range(50):
        if k in (3, 30):  # opened and closed again between two frames; opened for some
            loop.request(closed=False)
            loop.prepare()
        if k in (3, 34):
            loop.request(closed=True)
            loop.prepare()
            j = 0
        shown = u.copy()
        feed(loop, SKY[k] - polc * G @ shown)
        if k == 5:
            assert loop.hold(Verdict.HOLD_MISSING) is Verdict.HOLD_MISSING
            j += 1
        elif loop.answer(k - 1, k - 2, 1.0) is Verdict.OK:
            j += 1
            g = GAIN * min(j / ramp, 1)
            assert loop.gain == pytest.approx(g, rel=1e-6)
            u = (1 - leak) * (1 - g if polc else 1) * u + g * R @ SKY[k]
        else:
            assert 30 <= k < 34
            u = 0.9 * u
        assert loop.command == pytest.approx(u, abs=3e-5 * max(np.abs(u).max(), 1e-9)), k
        assert loop.frames_closed == (0 if 30 <= k < 34 else j) or not loop.closed
        loop.prepare()


# -- flat and watchdog -------------------------------------------------------------------------------------------------


@pytest.fixture
def closed(bench, mini):
    """A closed loop with an offset, after 20 frames; its changes were told."""
    made = bench()
    made.swap.change_settings(offset=OFFSET, watchdog=2.0)
    made.close(mini.a)
    made.run(range(20))
    made.tell = lambda: None
    return made


def request(bench, state: LoopState) -> None:
    bench.hrtc.loop.request_state(state)
    bench.hrtc.idle(bench.now)


def told(bench) -> list[tuple[int, LoopState, str]]:
    changes = []
    while not bench.hrtc.changes.empty():
        changes.append(bench.hrtc.changes.get())
    return [(change.frame, change.loop_state, change.reason) for change in changes if change.what == "LOOP"]


def test_flat_puts_the_static_shape_on_with_the_next_frame(closed):
    request(closed, LoopState.FLAT)
    closed.run(range(20, 23))
    assert told(closed) == [(20, LoopState.FLAT, "asked for")]
    for command in closed.commands[20:]:
        assert (command.verdict, command.loop_state) == (Verdict.OPEN, LoopState.FLAT)
        assert command.commands.tobytes() == OFFSET.tobytes()
    request(closed, LoopState.CLOSED)
    closed.run(range(23, 25))
    assert [command.verdict for command in closed.commands[23:]] == [Verdict.OK] * 2


def test_flat_goes_no_faster_than_the_slew_limit(closed):
    closed.swap.change_settings(slew_limit=1e-9)
    request(closed, LoopState.FLAT)
    start = closed.commands[-1].commands
    closed.run(range(20, 30))
    way = np.clip(OFFSET.astype(float) - start, -10e-9, 10e-9)
    assert closed.commands[-1].commands == pytest.approx(start + way, abs=1e-12)
    assert closed.hrtc.counters.slewed > 0 == closed.hrtc.counters.clipped


def test_flat_does_not_wait_for_sensors_that_are_silent(closed):
    closed.swap.change_settings(slew_limit=1e-9)  # no later command would go on from it
    closed.offer(*closed.messages(20)[:2])
    closed.hrtc.loop.request_state(LoopState.FLAT)
    closed.hrtc.idle(closed.now)
    assert len(closed.commands) == 20
    for _ in range(3):
        closed.now += SECOND // 2
        closed.hrtc.idle(closed.now)
    (flat,) = closed.commands[20:]
    assert (flat.frame, flat.verdict, flat.loop_state, flat.sensors) == (20, Verdict.OPEN, LoopState.FLAT, 0)
    assert flat.commands.tobytes() == OFFSET.tobytes()
    closed.offer(*closed.messages(20)[2:])
    assert closed.hrtc.counters.dropped_late == 2
    closed.run(range(21, 24))
    assert {command.loop_state for command in closed.commands[21:]} == {LoopState.FLAT}


def test_a_silence_opens_a_closed_loop_and_leaves_the_static_shape(closed):
    closed.now += 2 * SECOND
    closed.hrtc.idle(closed.now)
    assert len(closed.commands) == 20 and told(closed) == []
    closed.now += SECOND // 2
    closed.hrtc.idle(closed.now)
    closed.now += 100 * SECOND
    closed.hrtc.idle(closed.now)
    (flat,) = closed.commands[20:]
    assert (flat.frame, flat.verdict, flat.loop_state, flat.sensors) == (20, Verdict.OPEN, LoopState.OPEN, 0)
    assert flat.commands.tobytes() == OFFSET.tobytes()
    assert told(closed) == [(20, LoopState.OPEN, "no slopes for 2.5 s")]
    loop = closed.hrtc.loop
    assert (loop.opened_by_silence, loop.opened_by_faults) == (1, 0)
    closed.run(range(21, 24))
    assert [command.verdict for command in closed.commands[21:]] == [Verdict.OPEN] * 3
    closed.now += 100 * SECOND  # closed while they are silent, it waits for them anew
    request(closed, LoopState.CLOSED)
    closed.now += SECOND
    closed.hrtc.idle(closed.now)
    assert loop.closed
    closed.run(range(24, 26))
    assert [command.verdict for command in closed.commands[24:]] == [Verdict.OK] * 2


@pytest.mark.parametrize("how", ["off", "open", "closed before the first slopes"])
def test_a_silence_that_opens_nothing(bench, mini, how):
    made = bench()
    made.swap.change_settings(watchdog=0.0 if how == "off" else 2.0)
    made.close(mini.a)
    if how != "closed before the first slopes":
        made.run(range(5))
    if how == "open":
        made.hrtc.loop.request(closed=False)
    for _ in range(3):
        made.now += 10 * SECOND
        made.hrtc.idle(made.now)
    assert made.hrtc.loop.opened_by_silence == 0
    assert made.hrtc.loop.closed == (how != "open")


# -- replay ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def limited(bench, mini, tmp_path_factory):
    """100 frames in which every limit acts, with states in the middle of a ramp and of a slew."""
    path = tmp_path_factory.mktemp("limits") / "bag"
    made = bench(bag=path, delay=1.6)
    loop = made.hrtc.loop
    made.swap.change_settings(gain_ramp=20, watchdog=2.0)
    made.close(mini.a)
    made.run(range(8))
    made.hrtc.want_snapshot()
    made.run(range(8, 15))
    loop.request(closed=False)
    made.hrtc.idle(made.now)
    loop.request(closed=True)
    made.hrtc.idle(made.now)
    made.run(range(15, 30))
    made.swap.change_settings(slew_limit=2e-8, rms_limit=3e-7, command_limit=6e-7)
    made.run(range(30, 45))
    made.hrtc.want_snapshot()
    made.run(range(45, 50))
    made.swap.change_settings(offset=OFFSET)
    loop.request_state(LoopState.FLAT)
    made.run(range(50, 53))
    made.hrtc.want_snapshot()
    made.run(range(53, 60))
    loop.request(closed=True)
    made.run(range(60, 70))
    made.offer(*made.messages(70)[:2])  # the sensors stall in the middle of a frame
    made.now += 3 * SECOND
    made.hrtc.idle(made.now)
    made.tell()
    made.run(range(71, 80))
    loop.request(closed=True)
    made.run(range(80, 100))
    made.finish()
    counters = made.hrtc.counters
    assert min(counters.slewed, counters.scaled, counters.clipped, loop.opened_by_silence) > 0
    assert len(made.commands) == 100
    return path


@pytest.mark.parametrize("start", [0, 10, 16, 47, 55, 90])
def test_every_limit_replays_bit_for_bit(limited, start):
    with BagReader(limited) as reader:
        outcome = Replay(reader).run(start)
    assert (outcome.compared, outcome.differing, outcome.gaps) == (100 - start, 0, []), asdict(outcome)


# -- what is told ------------------------------------------------------------------------------------------------------


def test_the_latency_of_a_frame_begins_with_its_first_slopes(closed):
    first, last = closed.messages(20)[0], closed.messages(20)[1:]
    before = int(closed.hrtc.frame_latency.counts.sum())
    now = time.monotonic_ns()
    closed.hrtc.offer(first, now - 10**15)
    for message in last:
        closed.hrtc.offer(message, now)
    closed.hrtc.advance()
    assert int(closed.hrtc.frame_latency.counts.sum()) == before + 1
    assert closed.hrtc.frame_latency.max_ns > 10**15 > closed.hrtc.latency.max_ns


def test_the_tilt_of_commands_is_that_of_the_wavefront():
    """Against the mean gradient over the pupil of the plant's influence functions; some sensors are rotated."""
    system = load_system("mini")
    tilt = tilt_of_commands(LAYOUT, interaction_matrix(system, LAYOUT))
    assert abs(np.mean([sensor.rotation for sensor in LAYOUT.sensors])) > 0.03
    radius, step = system.telescope.diameter / 2, 1e-3
    grid = np.linspace(-radius, radius, 60)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    inside = np.hypot(x, y) < radius
    x, y = x[inside], y[inside]
    axis = Direction(x=0.0, y=0.0)
    flat = mirror_phase(LAYOUT, x, y, axis)
    expected = [
        ((mirror_phase(LAYOUT, x + dx, y + dy, axis) - flat) / step).mean(axis=0) for dx, dy in ((step, 0), (0, step))
    ]
    plane = LAYOUT.mirrors[0].actuators @ np.array([[1e-6, 0], [0, 1e-6], [3e-7, -8e-7]]).T
    assert tilt @ plane == pytest.approx(expected @ plane, abs=0.02 * np.abs(expected @ plane).max())


def test_the_offload_is_the_mean_of_the_last_second(program):
    now = [0.0]
    tilt = RNG.standard_normal((2, M))
    offload = Offload(tilt, lambda: now[0])
    loop = Loop(LAYOUT, 1)
    assert offload.look(loop, 1) == (0.0, 0.0)
    loop.post(program())
    loop.request(closed=True)
    loop.prepare()
    commands = []
    for k in frames(loop, 60):
        commands.append(loop.command.astype(float))
        if k % 5 == 4:
            now[0] += 0.125
            expected = tilt @ np.mean(commands[-40:], axis=0)
            assert offload.look(loop, 1) == pytest.approx(tuple(expected), rel=1e-5)
    now[0] += 30
    assert offload.look(loop, 1) == pytest.approx(tuple(expected), rel=1e-5)  # no frames: the mirror stays
    loop.start(0)
    assert offload.look(loop, 2) == (0.0, 0.0)
