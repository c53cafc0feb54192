"""A ring of serialised messages in shared memory: one process writes, any number read, nobody waits. No ROS.

The HRTC puts every message that it takes and every command that it publishes into one; the recorder drains it, so that
"everything is recorded" does not rest on the middleware's queues. A reader that falls behind by more than the ring's
capacity goes on with the newest record, and is told how many it lost.

Layout, little-endian, all numbers unsigned but one; a writer in another language follows it too:

========  ====  ==========================================================================================
offset    size  what
========  ====  ==========================================================================================
0         8     ``srtring1``
8         8     capacity C: bytes of the data, a multiple of 64
16        8     process id of the writer
24        8     1 once the writer has closed the ring, otherwise 0
32        8     ahead (signed): the records' times less the monotonic clock, ns; never changed
64        8     claimed: bytes that were or are being written since the start
128       8     written: bytes that are whole since the start; never above claimed
4096      C     data: records end to end, position p at ``4096 + p mod C``
========  ====  ==========================================================================================

A record is its size in bytes with this head and padding (4, a multiple of 16), its channel (4), its number from 0
(8), the time in ns since the epoch (8), the length of the message (8), then the message. No record crosses the end of
the data: one of channel 0xFFFFFFFF fills the rest where the next does not fit, and has no number.

The writer stores claimed, then the record, then written; a reader copies a record and believes the copy if claimed
has not come round to it meanwhile. That needs stores and loads in program order, as x86-64 keeps them.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import stat
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np

_MAGIC = b"srtring1"
_HEAD = struct.Struct("<8sQQQq")
_CLOSED, _CLAIMED, _WRITTEN = 24 // 8, 64 // 8, 128 // 8
_DATA = 4096
_RECORD = struct.Struct("<IIQQQ")
_FILLER = 0xFFFFFFFF
_TRIES = 20  # for the lock, 1 ms apart: a reader holds it for a moment when it looks whether the writer lives


class RingError(OSError):
    """A ring that cannot be made or read; one line that says why."""


class Record(NamedTuple):
    """One message; ``time_ns`` since the epoch, ``number`` counted by the writer from 0."""

    channel: int
    number: int
    time_ns: int
    data: bytes


def ring_path(domain: int, namespace: str, name: str = "hrtc") -> Path:
    """Where the ring of a ROS domain and namespace is."""
    place = "-".join(part for part in namespace.split("/") if part)
    return Path("/dev/shm") / (_own() + "-".join(filter(None, (str(domain), place, f"{name}.ring"))))


def _own() -> str:
    """What the names of this user's rings begin with."""
    return f"srtomo-{os.getuid()}-"


class RingWriter:
    """Makes a ring and writes to it. One thread.

    The file is locked as long as the writer lives, whatever ends it: what killed ones left, the next removes, whichever
    domain and namespace it is for. Readers keep what they have mapped.

    Args:
        path: of the file to make, in shared memory.
        capacity: bytes of records to keep.

    Attributes:
        ahead: what a record's time is to be more than the monotonic clock, ns: the system's clock when the ring was
            made. Whoever sets that clock afterwards does not move the records.

    Raises:
        RingError: the ring of that name has a living writer, or there is no room for it.
    """

    def __init__(self, path: Path, capacity: int) -> None:
        self.path = path
        self.capacity = -(-capacity // 64) * 64
        self._number = 0
        _remove_left_behind(path.parent)
        self._fd = _lock_new(path)
        try:
            os.posix_fallocate(self._fd, 0, _DATA + self.capacity)  # or a full /dev/shm would end the process later
            # every page is there before the first record
            flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
            self._map = mmap.mmap(self._fd, _DATA + self.capacity, flags=flags)
        except OSError as error:
            path.unlink(missing_ok=True)
            os.close(self._fd)
            raise RingError(f"{path}: no room for {self.capacity >> 20} MiB ({error.strerror})") from None
        self._heads = np.frombuffer(self._map, "<u8", _DATA // 8)
        self._position = 0
        self.ahead = time.time_ns() - time.monotonic_ns()
        # the magic comes last: before it nobody reads
        _HEAD.pack_into(self._map, 0, bytes(8), self.capacity, os.getpid(), 0, self.ahead)
        self._map[:8] = _MAGIC

    @property
    def address(self) -> int:
        """Of the file's beginning in this process, until :meth:`close`: for a writer in another language, which then
        is the only one."""
        return int(self._heads.ctypes.data)

    def write(self, channel: int, time_ns: int, data: bytes) -> None:
        """Add a message.

        Raises:
            ValueError: it is larger than half the ring; readers count it as lost.
        """
        size = -(-(_RECORD.size + len(data)) // 16) * 16
        if size > self.capacity // 2:
            self._number += 1
            raise ValueError(f"a message of {len(data)} bytes does not fit a ring of {self.capacity}")
        place = self._position % self.capacity
        rest = self.capacity - place
        if rest < size:
            self._heads[_CLAIMED] = self._position + rest
            if rest >= 8:
                struct.pack_into("<II", self._map, _DATA + place, rest, _FILLER)
            self._position += rest
            place = 0
        self._heads[_CLAIMED] = self._position + size
        start = _DATA + place
        _RECORD.pack_into(self._map, start, size, channel, self._number, time_ns, len(data))
        self._map[start + _RECORD.size : start + _RECORD.size + len(data)] = data
        self._number += 1
        self._position += size
        self._heads[_WRITTEN] = self._position

    def close(self) -> None:
        """Say that nothing more comes, and remove the ring's name; readers keep what they have not read yet."""
        if self._fd < 0:
            return
        self._heads[_CLOSED] = 1
        self.path.unlink(missing_ok=True)
        del self._heads
        self._map.close()
        os.close(self._fd)
        self._fd = -1

    def __enter__(self) -> RingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _lock_new(path: Path) -> int:
    """An empty locked file of that name; one without a living writer is removed first."""
    tries = _TRIES
    while True:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(fd)
            tries -= 1
            if not tries:
                raise RingError(f"{path}: in use by another process") from None
            time.sleep(0.001)
            continue
        found = os.fstat(fd)
        if found.st_size == 0 and found.st_nlink:
            return fd
        # readers of the old one keep their mapping of it: it is not written over, but given up
        if found.st_nlink:  # otherwise it was removed meanwhile, and what has the name now is another's
            path.unlink(missing_ok=True)
        os.close(fd)


def _remove_left_behind(folder: Path) -> None:
    """Remove this user's rings that no writer holds. Who makes one just now, and finds it removed, makes it again."""
    for path in folder.glob(f"{_own()}*.ring"):
        with suppress(OSError):  # in use, or gone
            fd = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                found = os.fstat(fd)
                # with the lock nobody else removes or replaces it; without the look it might be the name's next holder
                if stat.S_ISREG(found.st_mode) and found.st_uid == os.getuid() and os.path.samestat(found, path.stat()):
                    path.unlink()
            finally:
                os.close(fd)


class RingReader:
    """Reads a ring from its oldest record on. One thread; the writer never notices.

    Args:
        path: of the ring's file.

    Attributes:
        lost: records that were overwritten before they were read.
        ahead: what the records' times are more than the monotonic clock, ns.

    Raises:
        RingError: there is no ring of that name, or it is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open(path, "rb") as file:
                self._inode = os.fstat(file.fileno()).st_ino
                self._map = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
        except (OSError, ValueError) as error:
            raise RingError(f"{path}: no ring to read ({getattr(error, 'strerror', error)})") from None
        magic, self.capacity, self.writer, _, self.ahead = _HEAD.unpack_from(self._map, 0)
        if magic != _MAGIC or len(self._map) != _DATA + self.capacity:
            raise RingError(f"{path}: no ring to read (not whole, or another file)")
        self._heads = np.frombuffer(self._map, "<u8", _DATA // 8)
        self._position = 0
        self._next_number = 0
        self.lost = 0
        if self._claimed() > self.capacity:
            self._resynchronise()
            self._next_number = -1  # what went before this reader came is not its loss

    def _claimed(self) -> int:
        return int(self._heads[_CLAIMED])

    @property
    def ended(self) -> bool:
        """Whether the writer closed the ring, or another ring has its name now; what is in it can still be read."""
        try:
            return bool(self._heads[_CLOSED]) or os.stat(self.path).st_ino != self._inode
        except OSError:
            return True

    @property
    def writer_lives(self) -> bool:
        """Whether some process still holds the ring's lock."""
        try:
            with open(self.path, "rb") as file:
                if os.fstat(file.fileno()).st_ino != self._inode:
                    return False
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            pass
        return False

    def _resynchronise(self) -> None:
        # records have no marks to start from in the middle of the ring: go on with what comes next
        self._position = int(self._heads[_WRITTEN])

    def read(self) -> Iterator[Record]:
        """The records written since the last call, in order."""
        written = int(self._heads[_WRITTEN])
        while self._position < written:
            place = self._position % self.capacity
            start = _DATA + place
            if self.capacity - place < _RECORD.size:  # too short for any record
                self._position += self.capacity - place
                continue
            size, channel, number, time_ns, length = _RECORD.unpack_from(self._map, start)
            data = b"" if channel == _FILLER else self._map[start + _RECORD.size : start + _RECORD.size + length]
            if self._claimed() - self._position > self.capacity:
                self._resynchronise()
                written = int(self._heads[_WRITTEN])
                continue
            self._position += size
            if channel == _FILLER:
                continue
            if self._next_number >= 0:
                self.lost += number - self._next_number
            self._next_number = number + 1
            yield Record(channel, number, time_ns, data)

    def close(self) -> None:
        """Leave the ring."""
        del self._heads
        self._map.close()
