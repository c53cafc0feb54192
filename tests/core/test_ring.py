import multiprocessing
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from srtomo_core.ring import RingError, RingReader, RingWriter, ring_path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "test.ring"


def test_every_record_is_read_once_in_order(path: Path) -> None:
    with RingWriter(path, 1 << 16) as writer:
        reader = RingReader(path)
        sent, got = [], []
        for i in range(5000):  # many times round, with sizes that never fit the end exactly
            data = bytes([i % 251]) * (i * 37 % 1009)
            writer.write(i % 3, 1000 + i, data)
            sent.append((i % 3, i, 1000 + i, data))
            if i % 7 == 0:
                got += list(reader.read())
        got += list(reader.read())
        assert [tuple(record) for record in got] == sent
        assert reader.lost == 0


def test_a_reader_that_falls_behind_counts_what_it_lost(path: Path) -> None:
    with RingWriter(path, 1 << 14) as writer:
        reader = RingReader(path)
        for _ in range(100):
            writer.write(0, 0, b"x" * 1000)
        assert list(reader.read()) == []
        for _ in range(3):
            writer.write(0, 0, b"y")
        assert [record.number for record in reader.read()] == [100, 101, 102]
        assert reader.lost == 100


def test_a_late_reader_gets_what_is_still_there_and_calls_nothing_lost(path: Path) -> None:
    with RingWriter(path, 1 << 14) as writer:
        writer.write(0, 0, b"first")
        assert [record.data for record in RingReader(path).read()] == [b"first"]
        for _ in range(100):
            writer.write(0, 0, b"x" * 1000)
        late = RingReader(path)
        writer.write(0, 0, b"new")
        assert [record.data for record in late.read()] == [b"new"]
        assert late.lost == 0


def test_a_closed_ring_is_gone_but_can_be_read_to_its_end(path: Path) -> None:
    writer = RingWriter(path, 1 << 14)
    reader = RingReader(path)
    writer.write(4, 5, b"last")
    assert not reader.ended
    writer.close()
    assert reader.ended
    assert not path.exists()
    assert [record.data for record in reader.read()] == [b"last"]
    with pytest.raises(RingError, match=r"test\.ring: no ring to read"):
        RingReader(path)


def _write_for_ever(path: Path) -> None:
    writer = RingWriter(path, 1 << 20)
    i = 0
    while True:
        writer.write(0, i, i.to_bytes(8, "little") * (1 + i % 97))
        i += 1


def test_another_process_writes_while_this_one_reads(path: Path) -> None:
    process = multiprocessing.get_context("spawn").Process(target=_write_for_ever, args=(path,))
    process.start()
    try:
        reader = _reader_of_another_process(path)
        assert reader.writer_lives
        with pytest.raises(RingError, match="in use by another process"):
            RingWriter(path, 1 << 14)
        got = 0
        before = -1
        deadline = time.monotonic() + 1.0
        while time.monotonic() < deadline:
            for record in reader.read():
                assert record.data == record.number.to_bytes(8, "little") * (1 + record.number % 97)
                assert record.number > before
                before = record.number
                got += 1
        assert got + reader.lost <= before + 1
        assert got > 100
    finally:
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    assert not reader.writer_lives
    assert not reader.ended
    # what the killed one left behind is no obstacle, and no litter
    with RingWriter(path, 1 << 14):
        assert reader.ended
        assert path.stat().st_size < 1 << 15
    assert not path.exists()


def _reader_of_another_process(path: Path) -> RingReader:
    deadline = time.monotonic() + 30
    while True:
        try:
            return RingReader(path)
        except RingError:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_what_killed_writers_left_goes_with_the_next_start_of_any_other(tmp_path: Path) -> None:
    """Rings of this user that nobody holds, and nothing else."""
    mine = f"srtomo-{os.getuid()}-"
    left, alive = (tmp_path / f"{mine}{name}-hrtc.ring" for name in ("3-gnao", "4"))
    others = [tmp_path / name for name in (f"srtomo-{os.getuid()}1-3-hrtc.ring", f"{mine}3.other", "3-hrtc.ring")]
    with RingWriter(left, 1 << 14) as killed:
        killed.write(0, 0, b"not read yet")
        reader, content = RingReader(left), left.read_bytes()
    left.write_bytes(content)
    for other in others:
        other.write_bytes(content)
    os.mkfifo(tmp_path / f"{mine}pipe.ring")  # does not hold the cleaner up
    (tmp_path / f"{mine}link.ring").symlink_to(others[0])
    with RingWriter(alive, 1 << 14), RingWriter(tmp_path / f"{mine}5-hrtc.ring", 1 << 14):
        assert not left.exists()
        assert alive.exists() and all(other.exists() for other in others)
    assert [record.data for record in reader.read()] == [b"not read yet"]


def test_writers_that_start_at_once_remove_nobody_s_ring(tmp_path: Path) -> None:
    def make_and_close(domain: int) -> None:
        path = tmp_path / f"srtomo-{os.getuid()}-{domain}-hrtc.ring"
        for _ in range(200):
            with RingWriter(path, 1 << 12) as writer:
                assert path.exists()
                writer.write(0, 0, b"x")

    with ThreadPoolExecutor(4) as pool:  # locks are of open files, not of processes
        list(pool.map(make_and_close, range(4)))
    assert list(tmp_path.iterdir()) == []


def test_no_room_is_said_in_one_line(path: Path) -> None:
    with pytest.raises(RingError, match=r"no room for \d+ MiB"):
        RingWriter(path, 1 << 60)
    assert not path.exists()


def test_a_message_must_fit(path: Path) -> None:
    with RingWriter(path, 1 << 10) as writer, pytest.raises(ValueError, match="does not fit"):
        writer.write(0, 0, bytes(600))


def test_rings_of_two_instruments_have_two_names() -> None:
    assert ring_path(3, "/a/b").name == f"srtomo-{os.getuid()}-3-a-b-hrtc.ring"
    assert ring_path(3, "").name == f"srtomo-{os.getuid()}-3-hrtc.ring"
