import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from srtomo_core.wire import DmCommandWriter, SlopeFrameWriter
from srtomo_rtc.ledger import FrameSet, Ledger

FINGERPRINT = bytes(range(32))
SESSION = 2**64 - 5


@given(st.lists(st.integers(0, 40), max_size=60))
def test_frame_set_against_a_plain_set(frames):
    ours, plain = FrameSet(), set()
    for frame in frames:
        assert ours.add(frame) == (frame not in plain)
        plain.add(frame)
    assert len(ours) == len(plain)
    missing = {frame for first, last in ours.gaps(5, 30) for frame in range(first, last + 1)}
    assert missing == set(range(5, 31)) - plain
    if plain:
        assert (ours.first, ours.last) == (min(plain), max(plain))


@given(st.sets(st.integers(0, 40)), st.sets(st.integers(0, 40)))
def test_frames_in_common(a, b):
    left, right = FrameSet(), FrameSet()
    for frame in a:
        left.add(frame)
    for frame in b:
        right.add(frame)
    common = left & right
    held = set(range(41)) - {frame for first, last in common.gaps(0, 40) for frame in range(first, last + 1)}
    assert held == a & b and len(common) == len(a & b)


class Instrument:
    """Books the messages of an instrument of two sensors, of 3 and 2 sub-apertures."""

    def __init__(self, in_flight: int = 5) -> None:
        self.now = 0.0
        self.ledger = Ledger([3, 2], FINGERPRINT, in_flight, clock=lambda: self.now)
        self.writers = [self.writer(0, 3), self.writer(1, 2)]
        self.command_writer = DmCommandWriter("hrtc", 4)

    @staticmethod
    def writer(sensor: int, n_subapertures: int, fingerprint: bytes = FINGERPRINT) -> SlopeFrameWriter:
        return SlopeFrameWriter("s", SESSION, fingerprint, sensor, 1, n_subapertures)

    def slopes(self, sensor: int, *frames: int) -> None:
        for frame in frames:
            self.ledger.add_slopes(self.writers[sensor].write(0, frame, -1, -1, 1.0))

    def commands(self, *frames: int) -> None:
        for frame in frames:
            fields = (SESSION, frame, 0, 0, 3, 0, 1, 0, 0.5, -1, -1, -1, 1.0, 1e-4)
            self.ledger.add_command(self.command_writer.write(0, 0, *fields))

    def all(self, *frames: int) -> None:
        self.slopes(0, *frames)
        self.slopes(1, *frames)
        self.commands(*frames)

    def quiet(self) -> None:
        self.now += 10


def test_nothing_is_lost_when_all_is_there():
    instrument = Instrument()
    frames = list(range(100))
    random.Random(0).shuffle(frames)
    instrument.all(*frames)
    instrument.quiet()
    assert instrument.ledger.frames == 100
    assert instrument.ledger.lost == (0, 0)
    (session,) = instrument.ledger.report()
    assert (session["session"], session["first_frame"], session["last_frame"]) == (SESSION, 0, 99)


def test_gaps_are_counted_where_they_are():
    instrument = Instrument()
    instrument.slopes(0, *range(0, 20))
    instrument.slopes(1, *range(0, 7), *range(9, 20))
    instrument.commands(*range(0, 15), *range(16, 20))
    instrument.quiet()
    assert instrument.ledger.lost == (2, 1)
    assert instrument.ledger.frames == 17
    (session,) = instrument.ledger.report()
    assert [stream["gaps"] for stream in session["slopes"]] == [[], [(7, 8)]]
    assert session["commands"]["gaps"] == [(15, 15)]


def test_a_frame_that_nobody_has_is_lost_by_all():
    instrument = Instrument()
    instrument.all(*range(0, 10), *range(11, 20))
    assert instrument.ledger.lost == (2, 1)


def test_the_first_frame_of_a_session_is_demanded_of_every_sensor():
    instrument = Instrument()
    instrument.slopes(0, *range(0, 20))
    instrument.slopes(1, *range(1, 20))
    instrument.commands(*range(0, 20))
    assert instrument.ledger.lost == (1, 0)


def test_a_recording_may_begin_in_the_middle():
    instrument = Instrument()
    instrument.slopes(0, *range(501, 520))
    instrument.slopes(1, *range(500, 520))
    instrument.commands(*range(503, 520))
    instrument.quiet()
    assert instrument.ledger.lost == (0, 0)
    assert instrument.ledger.frames == 17


def test_a_recording_may_end_in_the_middle_but_not_when_all_has_been_quiet():
    instrument = Instrument()
    instrument.slopes(0, *range(0, 21))
    instrument.slopes(1, *range(0, 20))
    instrument.commands(*range(0, 18))
    assert instrument.ledger.lost == (0, 0)
    instrument.quiet()
    assert instrument.ledger.lost == (1, 3)


def test_more_than_what_can_be_in_flight_is_lost():
    instrument = Instrument(in_flight=5)
    instrument.slopes(0, *range(0, 30))
    instrument.slopes(1, *range(0, 24))
    instrument.commands(*range(0, 30))
    assert instrument.ledger.lost == (6, 0)


def test_commands_count_from_the_frame_that_the_hrtc_adopted():
    instrument = Instrument()
    instrument.slopes(0, *range(0, 40))
    instrument.slopes(1, *range(0, 40))
    instrument.commands(*range(12, 40))
    assert instrument.ledger.lost == (0, 0)  # for all that is known, the HRTC came up at frame 12
    instrument.ledger.add_adoption(SESSION, 10)
    assert instrument.ledger.lost == (0, 2)


def test_frames_between_two_adoptions_are_not_owed():
    instrument = Instrument()
    instrument.slopes(0, *range(0, 40))
    instrument.slopes(1, *range(0, 40))
    instrument.ledger.add_adoption(SESSION, 0)
    instrument.commands(*range(0, 10))
    instrument.ledger.add_adoption(SESSION, 25)
    instrument.commands(*range(26, 40))
    assert instrument.ledger.lost == (0, 1)


def test_no_hrtc_owes_no_commands():
    instrument = Instrument()
    instrument.slopes(0, *range(0, 10))
    instrument.slopes(1, *range(0, 10))
    assert (instrument.ledger.lost, instrument.ledger.frames) == ((0, 0), 0)


def test_duplicates_malformed_and_foreign_messages_are_counted_apart():
    instrument = Instrument()
    instrument.all(*range(0, 10))
    instrument.slopes(1, 4, 9)
    instrument.commands(0)
    instrument.ledger.add_slopes(b"\x00\x01\x00\x00 too short")
    instrument.ledger.add_command(struct.pack("<I", 0))
    instrument.ledger.add_slopes(Instrument.writer(0, 3, bytes(32)).write(0, 99, -1, -1, 1.0))
    ledger = instrument.ledger
    assert (ledger.duplicate_slopes, ledger.duplicate_commands, ledger.malformed, ledger.foreign) == (2, 1, 2, 1)
    assert (ledger.frames, ledger.lost) == (10, (0, 0))


@pytest.mark.parametrize("silent", [0, 1])
def test_a_frame_without_a_sensor_is_not_whole(silent):
    instrument = Instrument()
    instrument.slopes(1 - silent, *range(10))
    instrument.commands(*range(10))
    assert instrument.ledger.frames == 0


def test_sessions_are_books_of_their_own():
    instrument = Instrument()
    instrument.all(*range(0, 10))
    instrument.quiet()
    other = SlopeFrameWriter("both", 7, FINGERPRINT, 0, 2, 5)  # one message for both sensors
    for frame in (100, 101, 103):
        instrument.ledger.add_slopes(other.write(0, frame, -1, -1, 1.0))
    assert instrument.ledger.lost == (1, 0)
    assert [session["session"] for session in instrument.ledger.report()] == [SESSION, 7]


def test_the_flat_that_a_stopping_hrtc_leaves_is_no_loss():
    """It answers no slopes: the sensors may have stopped before, or go on."""
    instrument = Instrument()
    for frame in range(10):
        instrument.slopes(0, frame)
        instrument.slopes(1, frame)
        instrument.commands(frame)
    fields = (SESSION, 10, 0, 0, 0, 1, 0, 0, 0.5, -1, -1, -1, 1.0, 1e-4)
    instrument.ledger.add_command(instrument.command_writer.write(0, 0, *fields))
    instrument.now += 1
    assert instrument.ledger.lost == (0, 0)
    instrument.slopes(0, 10)
    instrument.slopes(1, 10)
    instrument.now += 1
    assert (instrument.ledger.lost, instrument.ledger.frames) == ((0, 0), 11)


@given(st.sets(st.integers(0, 40)), st.sets(st.integers(0, 40)))
def test_frames_of_either(a, b):
    left, right = FrameSet(), FrameSet()
    for frame in a:
        left.add(frame)
    for frame in b:
        right.add(frame)
    either = left | right
    missing = {frame for first, last in either.gaps(0, 40) for frame in range(first, last + 1)}
    assert missing == set(range(41)) - (a | b) and len(either) == len(a | b)


def test_a_closed_sensor_owes_nothing():
    """What it did not send before it was closed, and after it was opened, is lost all the same."""
    instrument = Instrument()
    instrument.slopes(0, *range(40))
    instrument.slopes(1, *range(0, 8), 15, *range(31, 40))
    instrument.commands(*range(40))
    assert (instrument.ledger.lost, instrument.ledger.frames) == ((22, 0), 18)
    instrument.ledger.add_closed(SESSION, 0, 0)
    instrument.ledger.add_closed(SESSION, 10, 0b10)
    instrument.ledger.add_closed(SESSION, 20, 0b10)  # told again with a swap
    instrument.ledger.add_closed(SESSION, 30, 0b01)
    assert (instrument.ledger.lost, instrument.ledger.frames) == ((3, 0), 37)
    (session,) = instrument.ledger.report()
    assert [stream["gaps"] for stream in session["slopes"]] == [[], [(8, 9), (30, 30)]]


def test_a_sensor_that_stays_closed_is_not_waited_for_at_the_end():
    instrument = Instrument(in_flight=5)
    instrument.slopes(0, *range(21))
    instrument.slopes(1, *range(10))
    instrument.commands(*range(19))
    instrument.ledger.add_closed(SESSION, 10, 0b10)
    assert (instrument.ledger.lost, instrument.ledger.frames) == ((0, 0), 19)
