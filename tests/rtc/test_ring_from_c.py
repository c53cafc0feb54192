"""The ring that the frame path writes in C, against the reader, and against the writer, in Python."""

from __future__ import annotations

import ctypes
import time

import pytest

from srtomo_core.ring import RingReader, RingWriter
from srtomo_rtc import native
from srtomo_rtc.native import lib
from srtomo_rtc.ring_source import Recent, RingSource


@pytest.fixture
def write():
    """Writes a message in C; the ring's state is the caller's."""
    function = ctypes.CFUNCTYPE(
        None, ctypes.POINTER(native.Ring), ctypes.c_uint32, ctypes.c_int64, ctypes.c_char_p, ctypes.c_size_t
    )(("srt_ring_write", lib))
    return lambda ring, channel, now, data: function(ring, channel, now, data, len(data))


def opened(writer: RingWriter) -> native.Ring:
    return native.Ring(writer.address, writer.capacity, writer.ahead)


def sizes(count: int):
    """Of messages: small and large ones, and none that fits the end exactly each time."""
    return (i * 37 % 1009 for i in range(count))


def test_every_record_is_read_once_in_order(write, tmp_path):
    with RingWriter(tmp_path / "c.ring", 1 << 16) as writer:
        ring, reader = opened(writer), RingReader(tmp_path / "c.ring")
        sent, got = [], []
        for i, size in enumerate(sizes(5000)):
            data = bytes([i % 251]) * size
            write(ring, i % 2, 1000 + i, data)
            sent.append((i % 2, i, 1000 + i + writer.ahead, data))
            if i % 7 == 0:
                got += reader.read()
        got += reader.read()
    assert [tuple(record) for record in got] == sent
    assert reader.lost == 0


def test_both_writers_leave_the_same_memory(write, tmp_path):
    """Byte for byte; more than once round, with fillers."""
    with RingWriter(tmp_path / "c.ring", 1 << 12) as c, RingWriter(tmp_path / "python.ring", 1 << 12) as python:
        ring = opened(c)
        for i, size in enumerate(sizes(100)):
            data = bytes([i]) * size
            write(ring, i % 2, i - c.ahead, data)
            python.write(i % 2, i, data)
            memories = [(tmp_path / name).read_bytes()[64:] for name in ("c.ring", "python.ring")]
            assert memories[0] == memories[1], i


def test_overruns_and_messages_that_do_not_fit_are_counted_as_lost(write, tmp_path):
    with RingWriter(tmp_path / "c.ring", 1 << 14) as writer:
        ring = opened(writer)
        source = RingSource(tmp_path / "c.ring", 0)
        assert source.read() == [] and source.attached
        for _ in range(100):
            write(ring, 0, 0, b"x" * 1000)
        write(ring, 0, 0, b"x" * (1 << 13))
        assert source.read() == []
        write(ring, 1, 5, b"y")
        assert source.read() == [(1, 5, b"y")]
        assert source.overruns == 101
    assert source.read() == [] and not source.attached
    assert source.overruns == 101


def test_the_gate_puts_what_it_takes_and_what_goes_out_into_the_ring(bench, mini, tmp_path):
    """Whatever becomes of it: damaged, twice, too late."""
    made = bench()
    with RingWriter(tmp_path / "hrtc.ring", 1 << 20) as writer:
        made.hrtc.record_to(writer)
        reader = RingReader(tmp_path / "hrtc.ring")
        begun = time.monotonic_ns()
        offered = []
        made.close(mini.a)
        for k in range(50):
            messages = [*made.messages(k), b"damaged"]
            messages += messages[:1]
            offered += messages
            made.offer(*messages)
        records = list(reader.read())
        assert [record.data for record in records if record.channel == 0] == offered
        commands = [record for record in records if record.channel == 1]
        assert [record.data for record in commands] == made.sent and len(commands) == 50
        assert all(begun <= record.time_ns - reader.ahead <= time.monotonic_ns() for record in commands)
        made.hrtc.record_to(None)
        made.frame(50)
        assert list(reader.read()) == []


def test_a_source_comes_and_goes_with_its_ring(tmp_path):
    path, now = tmp_path / "hrtc.ring", [0.0]
    source = RingSource(path, since=100, clock=lambda: now[0])
    assert source.read() == []
    with RingWriter(path, 1 << 12) as writer:
        writer.write(0, 99 + writer.ahead, b"of before the recording")
        writer.write(0, 100 + writer.ahead, b"first")
        assert source.read() == []  # looked for a moment ago
        now[0] += 1.0
        assert source.read() == [(0, 100, b"first")]
        writer.write(1, 101 + writer.ahead, b"last")
    assert source.attached
    assert source.read() == [(1, 101, b"last")] and not source.attached
    with RingWriter(path, 1 << 12) as writer:
        now[0] += 1.0
        assert source.read() == [] and source.attached
        writer.write(0, 200 + writer.ahead, b"read to the end")
        assert source.read(wanted=False) == [(0, 200, b"read to the end")] and not source.attached
    assert source.messages == 3


def test_a_message_that_comes_by_two_ways_is_news_once_and_one_sent_twice_twice():
    recent = Recent(2)
    came = [(b"a", 0), (b"a", 1), (b"b", 1), (b"b", 0), (b"b", 0), (b"b", 1), (b"b", 1)]
    assert [recent.add(*one) for one in came] == [True, False, True, False, True, False, True]
    assert [recent.add(*one) for one in ((b"c", 0), (b"b", 0), (b"a", 1))] == [True, False, True]  # a is forgotten
