"""One MCAP file of ROS 2 messages, read whole or as far as it goes; no ROS needed."""

from __future__ import annotations

import math
import os
import struct
import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import accumulate
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

METADATA_RECORD = "srtomo"
"""Name of the MCAP metadata record that holds a bag's own metadata."""

REPEATED = "repeated"
"""Entry of the metadata record: how many messages at the head of a file are those that an earlier one holds too."""


class BagError(ValueError):
    """A bag that cannot be written, read or mended; one line that says why."""


_EMPTY_START = 2**63 - 1

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK_TIMES = struct.Struct("<QQ")
_INDEX = struct.Struct("<HI")
_INDEX_ENTRY_BYTES = 16
_COUNT = struct.Struct("<Q")
_LOOSE_BYTES = 1 << 20  # messages outside of chunks are read in runs of about this size
_LOOSE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


# what broken bytes lead the unpackers to: lengths beyond the end, no text, nothing to decompress
_BROKEN = (struct.error, ValueError, McapError, zstandard.ZstdError, RuntimeError, MemoryError)


class BagMessage(NamedTuple):
    """One message of a bag: ``data`` as serialised; times of receiving and sending in ns since the epoch; the
    publisher's own count, 0 when it has none."""

    topic: str
    type: str
    data: bytes
    log_time: int
    publish_time: int
    sequence: int


class _Message(NamedTuple):
    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


@dataclass
class _Segment:
    """A chunk, or a run of records outside of any: what is read, and sorted, at once."""

    offset: int
    end: int
    chunk: bool
    first_time: int = _EMPTY_START
    last_time: int = 0
    counts: Counter[int] = field(default_factory=Counter)  # messages by channel


class McapReader:
    """Reads one file in the order of its log times; one pass over the records' headers on opening.

    Attributes:
        cut: None, or the sentence that says how much of a cut-off file is there.
        metadata: of the record ``srtomo``; empty when another recorder wrote the file.
        channels: its channels by their numbers in the file.
        schemas: its schemas by theirs.
        counts: messages by topic.

    Raises:
        BagError: not an MCAP file of ROS 2 messages. Iterating raises it at a damaged chunk.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut: str | None = None
        self.metadata: dict[str, str] = {}
        self._segments: list[_Segment] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._profile: str | None = None
        self._indexed_to = -1  # where the newest chunk, with its index so far, ends
        self._stated_count: int | None = None  # messages, by the file's own statistics
        try:
            self._file: IO[bytes] = open(path, "rb")
        except OSError as error:
            raise BagError(f"{path}: cannot be read ({error.strerror})") from None
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        size = os.fstat(self._file.fileno()).st_size
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise BagError(f"{self.path}: not an MCAP file")
        good, whole = self._scan(size)
        if not whole:
            good = self._drop_broken_tail(good)
        if self._profile not in (None, "ros2"):
            raise BagError(f"{self.path}: expected MCAP profile ros2, got {self._profile!r}")
        self._complete_index()
        self._count_topics()
        if self._stated_count not in (None, self.message_count):
            raise BagError(f"{self.path}: damaged: {self._stated_count} messages announced, {self.message_count} found")
        if not whole:
            self.cut = f"cut off: {good} of {size} bytes are whole records, which hold {self.message_count} messages"

    def _count_topics(self) -> None:
        self.counts = {channel.topic: 0 for channel in self.channels.values()}
        for segment in self._segments:
            for channel, count in segment.counts.items():
                self.counts[self.channels[channel].topic] += count

    def _scan(self, size: int) -> tuple[int, bool]:
        """Walk the records; returns the end of the last whole one, and whether the file ends as it should."""
        position = len(MCAP0_MAGIC)
        while len(header := self._file.read(_RECORD.size)) == _RECORD.size:
            opcode, length = _RECORD.unpack(header)
            end = position + _RECORD.size + length
            if end > size or opcode == 0:  # zeros are what a power cut leaves
                break
            if opcode == Opcode.FOOTER:
                self._file.seek(end)
                return end, self._file.read() == MCAP0_MAGIC
            try:
                self._note(opcode, position, end)
            except _BROKEN as error:
                raise self._damaged(position, error) from None
            position = end
            self._file.seek(position)
        return position, False

    def _note(self, opcode: int, start: int, end: int) -> None:
        """Keep what a record's place in the file tells. The file stands at the record's content."""
        if opcode == Opcode.CHUNK:
            first, last = _CHUNK_TIMES.unpack(self._file.read(_CHUNK_TIMES.size))
            self._segments.append(_Segment(start, end, True, first, last))
            self._indexed_to = end
        elif opcode == Opcode.MESSAGE_INDEX and start == self._indexed_to:
            # of the chunk right before: that of a chunk which is none any more must not count for another
            self._indexed_to = end
            channel, length = _INDEX.unpack(self._file.read(_INDEX.size))
            self._segments[-1].counts[channel] += length // _INDEX_ENTRY_BYTES
        elif opcode in _LOOSE:
            last_run = self._segments[-1] if self._segments else None
            if last_run and not last_run.chunk and last_run.end == start and end - last_run.offset < _LOOSE_BYTES:
                last_run.end = end
            else:
                self._segments.append(_Segment(start, end, False))
        elif opcode == Opcode.HEADER:
            self._profile = ReadDataStream(self._file).read_prefixed_string()
        elif opcode == Opcode.METADATA:
            record = Metadata.read(ReadDataStream(self._file))
            if record.name == METADATA_RECORD:
                self.metadata = record.metadata
        elif opcode == Opcode.STATISTICS:
            (self._stated_count,) = _COUNT.unpack(self._file.read(_COUNT.size))

    def _drop_broken_tail(self, good: int) -> int:
        """A power cut can leave a last chunk of full length with nothing in it; returns where the good part ends."""
        while self._segments:
            last = self._segments[-1]
            try:
                self._count(last)
                break
            except BagError:
                self._segments.pop()
                good = last.offset
        return good

    def _count(self, segment: _Segment) -> None:
        """Take from the messages themselves what an index would have told, and the channels on the way."""
        segment.counts.clear()
        for message in self._messages(segment):
            segment.counts[message.channel] += 1
            segment.first_time = min(segment.first_time, message.log_time)
            segment.last_time = max(segment.last_time, message.log_time)

    def _complete_index(self) -> None:
        for segment in self._segments:
            if not segment.counts:
                self._count(segment)
        # without a full summary, schemas and channels are announced in some segment before their first message
        for segment in self._segments:
            if not self._unannounced():
                break
            self._count(segment)
        if missing := self._unannounced():
            raise BagError(f"{self.path}: damaged: messages of channel {min(missing)}, which is never announced")
        for channel in self.channels.values():
            encoding = f"{channel.message_encoding} with {self.schemas[channel.schema_id].encoding}"
            if encoding != "cdr with ros2msg":
                raise BagError(f"{self.path}: {channel.topic}: expected cdr with ros2msg, got {encoding}")

    def _unannounced(self) -> set[int]:
        announced = {channel.id for channel in self.channels.values() if channel.schema_id in self.schemas}
        used = {*self.channels, *(channel for segment in self._segments for channel in segment.counts)}
        return used - announced

    @property
    def message_count(self) -> int:
        """Messages in the bag."""
        return sum(self.counts.values())

    @property
    def time_range(self) -> tuple[int, int]:
        """First and last log time, ns since the epoch; (0, 0) of an empty bag."""
        filled = [segment for segment in self._segments if segment.counts]
        return (min((s.first_time for s in filled), default=0), max((s.last_time for s in filled), default=0))

    def without_repeated(self) -> None:
        """Leave out what an earlier file of the same bag holds too."""
        stated = self.metadata.get(REPEATED, "0")
        if not stated.isdecimal():
            raise BagError(f"{self.path}: damaged: {REPEATED} of its metadata is {stated!r}")
        left = int(stated)
        # the writer ends a chunk after them
        while left > 0 and self._segments:
            left -= self._segments.pop(0).counts.total()
        self._count_topics()

    def messages(self, *topics: str) -> Iterator[BagMessage]:
        """Messages in the order of their log times: of the topics named in full, or of all.

        Raises:
            BagError: a chunk is damaged.
        """
        wanted = {i: c for i, c in self.channels.items() if not topics or c.topic in topics}
        names = {i: (c.topic, self.schemas[c.schema_id].name) for i, c in wanted.items()}
        for message in self._in_log_order(names.keys()):
            topic, type_name = names[message.channel]
            yield BagMessage(topic, type_name, message.data, message.log_time, message.publish_time, message.sequence)

    def _in_log_order(self, channels: Iterable[int]) -> Iterator[_Message]:
        wanted = set(channels)
        segments = [s for s in self._segments if not wanted.isdisjoint(s.counts)]
        # segments overlap in time a little: a message waits until none that is still to be read can be earlier
        later = [*accumulate((s.first_time for s in reversed(segments[1:])), min, initial=math.inf)][::-1]
        waiting: list[_Message] = []
        for segment, earliest_later in zip(segments, later):
            waiting += [message for message in self._messages(segment) if message.channel in wanted]
            waiting.sort(key=attrgetter("log_time"))
            ready = bisect_left(waiting, earliest_later, key=attrgetter("log_time"))
            yield from waiting[:ready]
            del waiting[:ready]

    def _messages(self, segment: _Segment) -> Iterator[_Message]:
        """Messages of a segment in file order; channels and schemas in it are learned on the way."""
        data = self._content(segment)
        position = 0
        try:
            while position < len(data):
                opcode, length = _RECORD.unpack_from(data, position)
                start = position + _RECORD.size
                position = start + length
                if position > len(data):
                    raise self._damaged(segment.offset, "a record ends outside its chunk")
                if opcode == Opcode.MESSAGE:
                    channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
                    content = data[start + _MESSAGE.size : position]
                    yield _Message(channel_id, sequence, log_time, publish_time, content)
                elif opcode == Opcode.SCHEMA:
                    schema = Schema.read(ReadDataStream(BytesIO(data[start:position])))
                    self.schemas[schema.id] = schema
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(ReadDataStream(BytesIO(data[start:position])))
                    self.channels[channel.id] = channel
        except _BROKEN as error:
            raise self._damaged(segment.offset, error) from None

    def _content(self, segment: _Segment) -> bytes:
        self._file.seek(segment.offset)
        record = self._file.read(segment.end - segment.offset)
        if not segment.chunk:
            return record
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(record[_RECORD.size :])))
            stream, length = get_chunk_data_stream(chunk)
            data: bytes = stream.read(length)
        except _BROKEN as error:
            raise self._damaged(segment.offset, error) from None
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise self._damaged(segment.offset, "wrong checksum")
        return data

    def _damaged(self, offset: int, reason: object) -> BagError:
        return BagError(f"{self.path}: damaged at byte {offset}: {reason}")

    def close(self) -> None:
        """Close the file."""
        self._file.close()
