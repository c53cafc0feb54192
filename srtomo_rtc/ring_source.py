"""The ring of an HRTC as the recorder sees it: it comes, goes, and may be left behind by a killed one. No ROS."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from srtomo_core.ring import RingError, RingReader

_LOOK_PERIOD = 0.1  # s between looks for a ring, and whether the writer of one is alive


class RingMessage(NamedTuple):
    """One message of a ring; ``arrived`` in ns of the monotonic clock."""

    channel: int
    arrived: int
    data: bytes


class RingSource:
    """Reads the ring of a name while there is one with a living writer. One thread.

    Args:
        path: of the ring's file.
        since: messages of before are none of ours, ns of the monotonic clock.
        clock: seconds, monotonic.

    Attributes:
        messages: how many were read.
    """

    def __init__(self, path: Path, since: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._since, self._clock = path, since, clock
        self._reader: RingReader | None = None
        self._look_at = -float("inf")
        self._overruns = 0
        self.messages = 0

    @property
    def attached(self) -> bool:
        """Whether there is a ring to read."""
        return self._reader is not None

    @property
    def overruns(self) -> int:
        """Messages that were overwritten before they were read."""
        return self._overruns + (self._reader.lost if self._reader is not None else 0)

    def read(self, wanted: bool = True) -> list[RingMessage]:
        """What has come. A ring whose writer is gone, or which is not ``wanted``, is read to its end and left."""
        looking = self._clock() >= self._look_at
        if looking:
            self._look_at = self._clock() + _LOOK_PERIOD
        reader = self._reader
        if reader is None:
            reader = self._reader = self._find() if wanted and looking else None
        if reader is None:
            return []
        # asked first, read then: nothing comes in between
        over = not wanted or reader.ended or (looking and not reader.writer_lives)
        found = [RingMessage(record.channel, record.time_ns - reader.ahead, record.data) for record in reader.read()]
        found = [message for message in found if message.arrived >= self._since]
        self.messages += len(found)
        if over:
            self.close()
        return found

    def _find(self) -> RingReader | None:
        try:
            reader = RingReader(self._path)
        except RingError:
            return None
        if reader.writer_lives:
            return reader
        reader.close()  # of a killed HRTC: the next one clears it
        return None

    def close(self) -> None:
        """Leave the ring, if there is one."""
        if self._reader is not None:
            self._overruns = self.overruns
            self._reader.close()
            self._reader = None


class Recent:
    """The last messages of a topic that come by two ways, told by their bytes: whichever copy comes first is news.

    However late the other one is. A message that was sent twice comes twice by each way, and is news twice.

    Args:
        count: how many different ones are remembered.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._seen: OrderedDict[int, tuple[int, int]] = OrderedDict()

    def add(self, data: bytes, way: int) -> bool:
        """Put in a message that came by way 0 or 1; False if it has come by the other already."""
        key = hash(data)
        first, second = self._seen.get(key, (0, 0))
        mine, other = (first, second) if way == 0 else (second, first)
        mine += 1
        self._seen[key] = (mine, other) if way == 0 else (other, mine)
        self._seen.move_to_end(key)
        if len(self._seen) > self._count:
            self._seen.popitem(last=False)
        return mine > other
