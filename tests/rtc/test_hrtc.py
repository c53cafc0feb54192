"""The frame gate: whatever comes, every frame is answered once and in order, and what is dropped changes nothing."""

import itertools
import random
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from srtomo_core import wire
from srtomo_core.wire import MIRROR_UNKNOWN
from srtomo_rtc.loop import HISTORY, Verdict

OTHER = 77  # another session
SECOND = 1_000_000_000


def counted(bench) -> dict[str, int]:
    """Counters that are not zero, without the answers'."""
    counters = asdict(bench.hrtc.counters)
    del counters["commands"], counters["clipped"]
    return {name: count for name, count in counters.items() if count}


def answers(bench) -> list[tuple[int, Verdict]]:
    return [(command.frame, Verdict(command.verdict)) for command in bench.commands]


def assert_answered_once(bench, first: int, last: int) -> None:
    assert [command.frame for command in bench.commands] == list(range(first, last + 1))


@pytest.fixture
def running(bench, mini):
    """A closed loop after frames 0 to 9."""
    made = bench()
    made.close(mini.a)
    made.run(range(10))
    assert counted(made) == {} and len(made.commands) == 10
    return made


@pytest.fixture
def undisturbed(bench, mini):
    """Bits of the commands 0 to 29 of the same loop when nothing happens."""
    made = bench()
    made.close(mini.a)
    made.run(range(30))
    return [command.commands.tobytes() for command in made.commands]


def assert_undisturbed(running, undisturbed) -> None:
    """The loop runs on to frame 29 as if nothing had happened since frame 10."""
    running.run(range(running.hrtc.loop.frame, 30))
    assert_answered_once(running, 0, 29)
    assert [command.commands.tobytes() for command in running.commands] == undisturbed


# -- what is dropped -------------------------------------------------------------------------------------------------


def test_duplicates(running, undisturbed):
    first, second, *rest = running.messages(10)
    running.offer(first)
    running.offer(first)  # of a frame in assembly
    running.offer(second, *rest)
    running.offer(*running.messages(10))  # of a frame that is answered
    running.offer(running.packet(10, 0, 3, 5))
    assert counted(running) == {"dropped_duplicate": 6}
    assert_undisturbed(running, undisturbed)


def test_late(running):
    """What comes first after its frame was held is late; what had come before is a duplicate."""
    old = running.messages(10)
    running.offer(*old[1:])
    running.offer(*running.messages(11))
    assert answers(running)[10:] == [(10, Verdict.HOLD_INCOMPLETE), (11, Verdict.OK)]
    running.offer(old[0])
    assert counted(running) == {"held_incomplete": 1, "dropped_late": 1}
    running.offer(old[1])
    assert counted(running) == {"held_incomplete": 1, "dropped_late": 1, "dropped_duplicate": 1}
    running.run(range(12, 20))
    assert_answered_once(running, 0, 19)


def test_late_from_before_the_session(bench, mini):
    made = bench()
    made.close(mini.a)
    made.run(range(1000, 1010))
    made.offer(*made.messages(990))
    made.offer(*made.messages(0))
    assert counted(made) == {"dropped_late": 8}
    assert_answered_once(made, 1000, 1009)


@pytest.mark.parametrize("changed", [{"session": OTHER}, {"session": 1}])
def test_another_session_or_publisher(running, undisturbed, changed):
    for k in range(10, 20):
        running.offer(*running.messages(k, np.ones(running.layout.n_slopes), **changed))
        running.frame(k)
    assert counted(running) == {"dropped_session": 40}
    assert_undisturbed(running, undisturbed)


def test_another_instrument(running, undisturbed):
    running.offer(*running.messages(10, fingerprint=bytes(32)))
    assert counted(running) == {"dropped_fingerprint": 4}
    assert_undisturbed(running, undisturbed)


@pytest.mark.parametrize("frame", [10**6, 5000, 200, 30, 2**62 - 1])
def test_a_stray_frame_number_does_not_move_the_loop(running, undisturbed, frame):
    """Not even when all sensors agree on it: only a second exposure makes it a jump of the count."""
    running.offer(*running.messages(frame, np.ones(running.layout.n_slopes)))
    assert counted(running) == {"dropped_session": 4}
    running.frame(10)
    running.offer(*running.messages(frame, np.ones(running.layout.n_slopes)))
    running.offer(running.messages(frame + 100 if frame < 2**61 else frame - 100)[0])
    assert_undisturbed(running, undisturbed)


@pytest.mark.parametrize("frame", [2**62, 2**63, 2**64 - 1])
def test_an_impossible_frame_number(running, undisturbed, frame):
    """It would not fit into a command; also as the first message of all."""
    message = running.messages(frame, np.ones(running.layout.n_slopes), timing=(-1, -1, 1.0))[0]
    running.offer(message)
    running.now += 5 * SECOND
    running.offer(message)
    assert counted(running) == {"dropped_malformed": 2}
    assert_undisturbed(running, undisturbed)


def test_a_session_of_number_zero_is_none(running, bench):
    fresh = bench()
    fresh.offer(*fresh.messages(0, session=0))
    running.offer(*running.messages(10, session=0))
    assert counted(fresh) == counted(running) == {"dropped_malformed": 4}
    assert not fresh.commands


def test_messages_that_do_not_fit_the_sensors(running, undisturbed):
    n = [sensor.n_valid for sensor in running.layout.sensors]
    slopes = np.zeros(2 * sum(n) + 2)
    whole = running.messages(10)[1]
    running.offer(
        running.packet(10, 0, n[0] - 1, 2, slopes=slopes),  # over the end: has 2 slopes less than announced
        running.packet(10, 0, 0, 0),
        whole[:-8],
        whole[:40],
        b"",
    )
    fields = wire.read_slope_frame(whole)
    for sensor, n_sensors in [(4, 1), (3, 2), (0, 0), (65535, 1), (0, 2), (1, 3)]:
        writer = wire.SlopeFrameWriter(
            "x", fields.session, fields.fingerprint, sensor, n_sensors, fields.n_subapertures
        )
        running.offer(writer.write(0, 10, 8, 7, 1.0))
    assert counted(running) == {"dropped_malformed": 11}
    assert_undisturbed(running, undisturbed)


_MINI_MESSAGE = st.integers(0, 3)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_fuzzed_messages_never_raise_and_never_corrupt(running, data):
    """Garbage, cut-off and altered messages: counted, and no command becomes wrong or is made twice."""
    message = bytearray(running.messages(running.hrtc.loop.frame)[data.draw(_MINI_MESSAGE)])
    how = data.draw(st.sampled_from(["garbage", "cut", "longer", "header"]))
    if how == "garbage":
        message = bytearray(data.draw(st.binary(max_size=300)))
    elif how == "cut":
        message = message[: data.draw(st.integers(0, len(message) - 1))]
    elif how == "longer":
        message += data.draw(st.binary(min_size=4, max_size=20))
    else:  # anything but frame, session and slopes, in which any value is as good as another
        places = st.one_of(st.integers(0, 3), st.integers(12, 15), st.integers(40, 79), st.integers(100, 107))
        for _ in range(data.draw(st.integers(1, 4))):
            message[data.draw(places)] ^= data.draw(st.integers(1, 255))
    before = len(running.commands), sum(counted(running).values())
    running.offer(bytes(message))
    dropped = sum(counted(running).values()) - before[1]
    assert len(running.commands) == before[0]  # one message alone never answers a frame of mini
    assert dropped == 1 or how == "header"
    running.frame(running.hrtc.loop.frame)
    assert_answered_once(running, 0, running.hrtc.loop.frame - 1)
    assert all(np.isfinite(command.commands).all() for command in running.commands[-2:])


def test_every_cut_of_a_message_is_refused(running):
    message = running.messages(10)[0]
    for end in range(len(message)):
        running.hrtc.offer(message[:end], running.now)
    assert counted(running) == {"dropped_malformed": len(message)}


# -- order and packets -----------------------------------------------------------------------------------------------


def test_any_order_of_sensors_and_packets_gives_the_same_bits(running, undisturbed):
    shuffle = random.Random(3)
    n = [sensor.n_valid for sensor in running.layout.sensors]
    for k in range(10, 20):
        parts = [running.packet(k, 3, 0, 1)]
        for w in range(3):
            cuts = [0, *sorted(shuffle.sample(range(1, n[w]), 4)), n[w]]
            parts += [running.packet(k, w, a, b - a) for a, b in itertools.pairwise(cuts)]
        shuffle.shuffle(parts)
        for part in parts:
            running.offer(part)
    assert counted(running) == {}
    assert_undisturbed(running, undisturbed)


@pytest.mark.parametrize("groups", [[(0, 4)], [(0, 2), (2, 2)], [(3, 1), (0, 3)]])
def test_several_sensors_in_one_message(running, undisturbed, groups):
    for k in range(10, 20):
        for first, n_sensors in groups:
            running.offer(running.packet(k, first, 0, 0, n_sensors) if n_sensors > 1 else running.messages(k)[first])
    assert counted(running) == {}
    assert_undisturbed(running, undisturbed)


def test_what_the_mirror_showed_does_not_depend_on_the_order_of_arrival(bench, mini):
    """Should packets of a frame disagree on it, the first sub-aperture of the first sensor is right."""
    bits = []
    for order in itertools.permutations(range(4)):
        made = bench()
        made.close(mini.a)
        made.run(range(6))
        slopes = made.sky.slopes(6)
        parts = [made.messages(6, slopes, timing=(4 - w, 3, 1.0))[w] for w in range(4)]
        made.offer(*(parts[w] for w in order))
        assert made.commands[6].mirror_frame == 4
        bits.append(made.commands[6].commands.tobytes())
    assert len(set(bits)) == 1


def test_two_frames_interleaved(running):
    """Messages of two frames alternate; each is answered when its last one is in, in order."""
    slopes = {k: running.sky.slopes(k) for k in (10, 11)}
    timing = {10: (8, 7, 1.0), 11: (9, 8, 1.0)}
    parts = {k: running.messages(k, slopes[k], timing=timing[k]) for k in (10, 11)}
    for first, second in zip(parts[10][:3], parts[11][:3], strict=True):
        running.offer(first)
        running.offer(second)
    assert len(running.commands) == 10
    running.offer(parts[10][3])
    assert answers(running)[10:] == [(10, Verdict.OK)]
    running.offer(parts[11][3])
    assert answers(running)[10:] == [(10, Verdict.OK), (11, Verdict.OK)]
    assert counted(running) == {}


def test_out_of_order_frames(running):
    """A frame that is whole before its predecessor ends the wait for it; what then comes is late."""
    parts = {k: running.messages(k, np.zeros(running.layout.n_slopes), timing=(8, 7, 1.0)) for k in (10, 11)}
    running.offer(*parts[11][:3])
    assert len(running.commands) == 10
    running.offer(parts[11][3])
    assert answers(running)[10:] == [(10, Verdict.HOLD_MISSING), (11, Verdict.OK)]
    running.offer(*parts[10])
    assert counted(running) == {"held_missing": 1, "dropped_late": 4}
    running.run(range(12, 20))
    assert_answered_once(running, 0, 19)


# -- what is held ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", range(4))
def test_missing_sensor(running, lost):
    state = running.hrtc.loop.state.copy()
    parts = running.messages(10)
    running.offer(*(part for w, part in enumerate(parts) if w != lost))
    assert len(running.commands) == 10  # the next frame has not begun
    running.frame(11)
    assert answers(running)[10:] == [(10, Verdict.HOLD_INCOMPLETE), (11, Verdict.OK)]
    held = running.commands[10]
    assert held.commands.tobytes() == running.commands[9].commands.tobytes()
    assert held.sensors == 0b1111 & ~(1 << lost)
    assert not np.array_equal(running.hrtc.loop.state, state)  # frame 11 moved on
    assert counted(running) == {"held_incomplete": 1}


def test_missing_packet(running):
    running.offer(*running.messages(10)[1:], running.packet(10, 0, 0, 20))
    running.frame(11)
    assert answers(running)[10:] == [(10, Verdict.HOLD_INCOMPLETE), (11, Verdict.OK)]
    assert running.commands[10].sensors == 0b1110


def test_two_later_frames_begun_end_the_wait(running):
    """A sensor that has died: its frames are held one by one as others begin."""
    for k in range(10, 14):
        running.offer(*running.messages(k)[:3])
    assert answers(running)[10:] == [(10, Verdict.HOLD_INCOMPLETE), (11, Verdict.HOLD_INCOMPLETE)]


@pytest.mark.parametrize("gap", [1, 2, 8])
def test_whole_frames_missing(running, gap):
    running.frame(10 + gap)
    expected = [(k, Verdict.HOLD_MISSING) for k in range(10, 10 + gap)] + [(10 + gap, Verdict.OK)]
    assert answers(running)[10:] == expected
    assert counted(running) == {"held_missing": gap}
    for held in running.commands[10:-1]:
        assert held.commands.tobytes() == running.commands[9].commands.tobytes()
        assert (held.sensors, held.stamp_sec) == (0, 0)


@pytest.mark.parametrize("gap", [9, 20, 300, 3000])
def test_a_long_gap_is_believed_when_a_second_exposure_agrees(running, gap):
    """A stall of the HRTC beyond the depth of its queue: every frame is answered all the same."""
    running.run(range(10 + gap, 20 + gap))
    assert_answered_once(running, 0, 19 + gap)
    assert counted(running) == {"held_missing": gap + 1, "dropped_session": 4}
    assert running.commands[-1].verdict == (Verdict.OK if gap < 50 else Verdict.OPEN)  # the fault budget


def test_more_than_max_behind_frames_waiting(bench, mini):
    made = bench(max_behind=2)
    made.close(mini.a)
    made.run(range(10))
    waiting = [message for k in range(10, 16) for message in made.messages(k, timing=(8, 7, 1.0))]
    made.offer(*waiting)
    assert answers(made)[10:] == [(k, Verdict.HOLD_BEHIND) for k in (10, 11, 12)] + [
        (k, Verdict.OK) for k in (13, 14, 15)
    ]
    assert counted(made) == {"held_behind": 3}


def test_frames_beyond_the_assembly_memory_are_behind_not_missing(running):
    """Nothing was missing of them: 20 whole frames waited."""
    waiting = [message for k in range(10, 30) for message in running.messages(k, timing=(8, 7, 1.0))]
    running.offer(*waiting)
    assert_answered_once(running, 0, 29)
    assert counted(running) == {"held_behind": 15}
    assert all(c.sensors == 0b1111 for c in running.commands)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 100, -1])
def test_slopes_that_are_not_finite(running, bad, place):
    slopes = running.sky.slopes(10)
    slopes[place] = bad
    running.frame(10, slopes)
    assert answers(running)[10:] == [(10, Verdict.HOLD_NONFINITE)]
    assert running.commands[10].commands.tobytes() == running.commands[9].commands.tobytes()
    running.run(range(11, 20))
    assert counted(running) == {"held_nonfinite": 1}
    assert all(command.verdict == Verdict.OK for command in running.commands[11:])


@pytest.mark.parametrize(
    "timing",
    [
        (10, 9, 1.0),  # its own command
        (2**62, 0, 1.0),
        (-(2**62), 0, 1.0),
        (-2, 0, 1.0),
        (8, 7, float("nan")),
        (8, 7, 1.5),
        (8, 7, -0.5),
        (8, 10**6, 0.5),
    ],
)
def test_a_mirror_state_that_is_not_in_the_history(running, timing):
    running.offer(*running.messages(10, timing=timing))
    assert answers(running)[10:] == [(10, Verdict.HOLD_HISTORY)]
    running.run(range(11, 20))
    assert counted(running) == {"held_history": 1}


def test_a_sensor_that_does_not_know_the_mirror(bench, mini, undisturbed):
    made = bench()
    made.close(mini.a)
    for k in range(30):
        made.offer(*made.messages(k, timing=(MIRROR_UNKNOWN, MIRROR_UNKNOWN, 0.0)))
    assert [command.commands.tobytes() for command in made.commands] == undisturbed


# -- sessions --------------------------------------------------------------------------------------------------------


def test_restart_of_the_sensors(running):
    """A new session is adopted after a second of silence: history and state start at zero, the loop is open."""
    old = running.session
    running.session = OTHER
    running.frame(0)
    assert counted(running) == {"dropped_session": 4}
    running.now += SECOND
    running.sky.shown.clear()
    running.run(range(5, 10))
    assert [(c.session, c.frame, c.verdict) for c in running.commands[10:]] == [
        (OTHER, k, Verdict.OPEN) for k in range(5, 10)
    ]
    assert not running.commands[10].commands.any()
    assert running.hrtc.loop.first_frame == 5
    running.offer(*running.messages(11, session=old))
    assert counted(running) == {"dropped_session": 8}


def test_a_session_goes_on_after_a_silence(running, undisturbed):
    running.now += 100 * SECOND
    assert_undisturbed(running, undisturbed)


def test_a_session_that_goes_on_far_ahead_after_a_silence_begins_anew(running):
    running.now += 2 * SECOND
    running.sky.shown.clear()
    running.run(range(5000, 5003))
    assert answers(running)[10:] == [(k, Verdict.OPEN) for k in (5000, 5001, 5002)]
    assert counted(running) == {}


def test_the_count_of_a_session_never_goes_back(running):
    """Every frame number of a session has one answer; a sensor whose count restarts has to draw a new session."""
    running.now += 100 * SECOND
    running.run(range(5))
    assert len(running.commands) == 10
    assert counted(running) == {"dropped_duplicate": 20}
    running.session = OTHER
    running.frame(0)
    assert len(running.commands) == 11


def test_a_loop_closed_before_the_first_slopes_is_closed_in_the_first_frame(bench, mini):
    for idle_first in (False, True):
        made = bench()
        made.close(mini.a)
        if idle_first:
            made.hrtc.idle(made.now)
        made.run(range(7, 9))
        assert answers(made) == [(7, Verdict.OK), (8, Verdict.OK)]


# -- changes between frames ------------------------------------------------------------------------------------------


def test_a_frame_that_stays_incomplete_does_not_keep_a_change_waiting(running, mini):
    """The sensors died within a frame: the swap is taken up, and the frame, should it go on, is made by one alone."""
    running.publish(mini.b)
    parts = running.messages(10)
    running.offer(parts[0], parts[1])
    running.commit(mini.b)
    running.hrtc.idle(running.now)
    assert running.hrtc.loop.program.slot.id == mini.a.id  # the frame may go on any moment
    running.hrtc.idle(running.now + SECOND)
    assert running.hrtc.loop.program.slot.id == mini.b.id
    running.offer(parts[2], parts[3])
    state, slopes = running.commands[9].commands.astype(float), running.sky.slopes(10)
    u = running.sky.shown[8]
    expected = 0.5 * state + 0.5 * (mini.b.Q[0].astype(float) @ u + mini.b.R[0].astype(float) @ slopes)
    assert running.commands[10].reconstructor == mini.b.id
    assert running.commands[10].commands == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_flat_is_published_when_the_hrtc_stops(running):
    running.hrtc.flatten()
    flat = running.commands[10]
    assert (flat.frame, flat.verdict, flat.loop_state, flat.sensors) == (10, Verdict.OPEN, 0, 0)
    assert not flat.commands.any()
    running.offer(*running.messages(10))
    assert counted(running) == {"dropped_late": 4}
    running.hrtc.start()
    running.run(range(11, 14))
    assert_answered_once(running, 0, 13)
    assert (running.hrtc.loop.first_frame, running.hrtc.loop.closed) == (11, False)


def test_frames_that_pass_while_the_hrtc_is_not_active_are_not_answered(running):
    """Activated again, soon or late, it begins with the first slopes that come; it may be closed before these."""
    running.hrtc.flatten()
    running.offer(*running.messages(9), *running.messages(10))
    running.hrtc.start()
    running.hrtc.loop.request(closed=True)
    running.hrtc.idle(running.now)
    running.sky.shown.clear()
    running.run(range(40, 45))
    assert [frame for frame, _ in answers(running)] == [*range(11), *range(40, 45)]
    assert answers(running)[11:] == [(k, Verdict.OK) for k in range(40, 45)]
    assert running.hrtc.loop.first_frame == 40


def test_flat_has_no_latency(running):
    """It answers no slopes: the silence before it is no deadline missed."""
    running.now += 100 * SECOND
    running.hrtc.flatten()
    assert running.commands[-1].latency < 0.1


def test_the_stamp_travels_from_slopes_to_command(running):
    running.now += 7 * SECOND + 123
    sent = running.now
    running.offer(*running.messages(10))
    assert running.commands[10].stamp_sec * SECOND + running.commands[10].stamp_nanosec == sent


def test_a_snapshot_holds_all_that_the_loop_remembers(running):
    running.run(range(10, 100))
    running.hrtc.want_snapshot()
    running.offer(*running.messages(100))
    snapshot = running.hrtc.snapshots.get_nowait()
    assert (snapshot.frame, snapshot.first_frame, len(snapshot.history)) == (100, 0, HISTORY)
    shown = np.array([command.commands for command in running.commands[-HISTORY:]])
    assert np.array_equal(snapshot.history, shown)


def test_what_waits_does_not_grow(running):
    """Changes and snapshots are the only queues, and both are made by request."""
    while not running.hrtc.changes.empty():
        running.hrtc.changes.get()
    for k in range(10, 40):
        running.offer(*running.messages(k))
    assert running.hrtc.changes.empty() and running.hrtc.snapshots.empty()
