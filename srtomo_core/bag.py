"""Bags: rosbag2-style directories with one MCAP file, written, read, and mended when they were cut off; no ROS needed.

A bag is ``metadata.yaml`` and ``<name>_0.mcap``: profile ``ros2``, ``ros2msg`` schemas, ``cdr`` messages in zstd chunks
with an index. What a replay has to know beside the messages is in the file's metadata record ``srtomo``.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from itertools import accumulate
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple

import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from srtomo_core.messages import definition, type_hash

METADATA_RECORD = "srtomo"
"""Name of the MCAP metadata record that holds a bag's own metadata."""

CHUNK_SIZE = 1 << 20
"""Bytes gathered before they are compressed and written; what a killed recorder can lose."""


class BagError(ValueError):
    """A bag that cannot be written, read or mended; one line that says why."""


# --- Writing ----------------------------------------------------------------------------------------------------------

_NO_TIME = {"sec": 9223372036, "nsec": 854775807}  # rosbag2's infinite duration
_EMPTY_START = 2**63 - 1  # rosbag2's starting time of a bag without messages


def _offered_qos(depth: int, transient_local: bool) -> str:
    """The quality of service of a topic's writers as rosbag2 (version 9) keeps it: YAML in a string."""
    profile = {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable",
        "durability": "transient_local" if transient_local else "volatile",
        "deadline": _NO_TIME.copy(),
        "lifespan": _NO_TIME.copy(),
        "liveliness": "automatic",
        "liveliness_lease_duration": _NO_TIME.copy(),
        "avoid_ros_namespace_conventions": False,
    }
    return yaml.safe_dump([profile], sort_keys=False)


class BagWriter:
    """Writes a new bag. Not thread-safe: one thread at a time.

    ``metadata.yaml`` and the metadata record are on disk from the start, so that a bag whose writer was killed can be
    read, and mended, up to its last whole chunk.

    Args:
        path: the directory to make; it must not exist.
        metadata: what goes into the metadata record.

    Raises:
        BagError: it exists already, or cannot be written. Every method that writes raises it too, e.g. on a full disk;
            the bag is then cut off, and :func:`repair` mends it.
    """

    def __init__(self, path: str | Path, metadata: Mapping[str, str]) -> None:
        self.path = Path(path)
        self._file_name = f"{self.path.resolve().name}_0.mcap"
        self._channels: dict[str, _WrittenChannel] = {}
        self._schemas: dict[str, int] = {}
        self._first_time = _EMPTY_START
        self._last_time = 0
        try:
            self.path.mkdir(parents=True)
            self._file: IO[bytes] = open(self.path / self._file_name, "xb")
        except FileExistsError:
            raise BagError(f"{self.path}: exists already, and is not overwritten") from None
        except OSError as error:
            raise BagError(f"{self.path}: cannot be written ({error.strerror})") from None
        self._writer = Writer(self._file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
        try:
            self._writer.start(profile="ros2", library="srtomo")
            self._writer.add_metadata(METADATA_RECORD, dict(metadata))
            self._file.flush()
            self._write_yaml()
        except OSError as error:
            raise self._failed(error) from None

    @property
    def bytes_written(self) -> int:
        """Bytes of the MCAP file so far. Any thread."""
        return os.path.getsize(self.path / self._file_name)

    def declare(self, topic: str, type_name: str, *, depth: int = 0, transient_local: bool = False) -> None:
        """Announce a topic before its first message, with what its writers offer beside being reliable.

        Raises:
            BagError: no such type.
        """
        self._declare(
            topic,
            type_name,
            definition(type_name),
            {
                "offered_qos_profiles": _offered_qos(depth, transient_local),
                "topic_type_hash": type_hash(type_name),
            },
        )

    def _declare(self, topic: str, type_name: str, text: str, details: dict[str, str]) -> None:
        try:
            if type_name not in self._schemas:
                self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text.encode())
            channel_id = self._writer.register_channel(topic, "cdr", self._schemas[type_name], details)
        except OSError as error:
            raise self._failed(error) from None
        self._channels[topic] = _WrittenChannel(channel_id, type_name, details)

    def write(
        self, topic: str, type_name: str, data: bytes, log_time: int, publish_time: int, sequence: int = 0
    ) -> None:
        """Add a serialised message.

        Args:
            topic: full name.
            type_name: e.g. ``msgs_schema/msg/SlopeFrame``.
            data: little-endian CDR, encapsulation included.
            log_time: when it was received, ns since the epoch.
            publish_time: when it was sent, ns since the epoch.
            sequence: the publisher's own count; 0 when it has none.
        """
        if topic not in self._channels:
            self.declare(topic, type_name)
        channel = self._channels[topic]
        if channel.type_name != type_name:
            raise BagError(f"{topic}: holds {channel.type_name}, got {type_name}")
        try:
            self._writer.add_message(channel.id, log_time, data, publish_time, sequence & 0xFFFFFFFF)
        except OSError as error:
            raise self._failed(error) from None
        channel.messages += 1
        self._first_time = min(self._first_time, log_time)
        self._last_time = max(self._last_time, log_time)

    def _copy(self, reader: BagReader) -> None:
        """All messages of another bag, with the definitions and qualities of service that it recorded."""
        topics = {}
        for channel in reader._channels.values():
            schema = reader._schemas[channel.schema_id]
            topics[channel.id] = (channel.topic, schema.name)
            self._declare(channel.topic, schema.name, schema.data.decode(), channel.metadata)
        for message in reader._in_log_order(topics):
            self.write(*topics[message.channel], message.data, message.log_time, message.publish_time, message.sequence)

    def flush(self) -> None:
        """End the chunk in progress and hand everything to the operating system."""
        try:
            self._writer.flush()
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Write the index and the final ``metadata.yaml``. A second call does nothing."""
        if self._file.closed:
            return
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._write_yaml()
        except OSError as error:
            raise self._failed(error) from None

    def abort(self) -> None:
        """Leave the bag as a kill would: whole up to the last chunk on disk, and without an index."""
        # closing writes what is buffered, and so fails again on a full disk
        with suppress(OSError):
            self._file.close()

    def _failed(self, error: OSError) -> BagError:
        self.abort()
        return BagError(f"{self.path}: cannot be written ({error.strerror or error})")

    def _write_yaml(self) -> None:
        messages = sum(channel.messages for channel in self._channels.values())
        start = {"nanoseconds_since_epoch": self._first_time}
        duration = {"nanoseconds": max(0, self._last_time - self._first_time)}
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": messages,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": channel.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": yaml.safe_load(channel.details.get("offered_qos_profiles", "")) or [],
                        "type_description_hash": channel.details.get("topic_type_hash", ""),
                    },
                    "message_count": channel.messages,
                }
                for topic, channel in self._channels.items()
            ],
            # MCAP compresses its chunks itself: to rosbag2 the file is not compressed
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file_name],
            "files": [
                {
                    "path": self._file_name,
                    "starting_time": start.copy(),
                    "duration": duration.copy(),
                    "message_count": messages,
                }
            ],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
        unfinished = self.path / "metadata.yaml.part"
        unfinished.write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False))
        unfinished.replace(self.path / "metadata.yaml")

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            # what was recorded until then is good; the error that is under way is the news
            with suppress(BagError):
                self.close()


@dataclass
class _WrittenChannel:
    id: int
    type_name: str
    details: dict[str, str]
    messages: int = 0


# --- Reading ----------------------------------------------------------------------------------------------------------

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
    """One message of a bag: ``data`` as serialised, ``log_time`` in ns since the epoch."""

    topic: str
    type: str
    data: bytes
    log_time: int


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


class BagReader:
    """Reads a bag in the order of its log times, cut off or whole; one pass over the records' headers on opening.

    Args:
        path: a bag's directory, or an ``.mcap`` file.

    Attributes:
        cut: None, or the sentence that says how much of a cut-off bag is there.
        metadata: of the record ``srtomo``; empty when another recorder wrote the bag.
        topics: full name to type, in order of appearance.
        counts: messages by topic.

    Raises:
        BagError: no bag there, or not an MCAP file of ROS 2 messages. Iterating raises it at a damaged chunk.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.cut: str | None = None
        self.metadata: dict[str, str] = {}
        self._segments: list[_Segment] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._profile: str | None = None
        self._stated_count: int | None = None  # messages, by the file's own statistics
        source = _mcap_file(self.path)
        try:
            self._file: IO[bytes] = open(source, "rb")
        except OSError as error:
            raise BagError(f"{source}: cannot be read ({error.strerror})") from None
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
        totals = sum((segment.counts for segment in self._segments), Counter[int]())
        self.topics = {c.topic: self._schemas[c.schema_id].name for c in self._channels.values()}
        self.counts = dict.fromkeys(self.topics, 0)
        for channel, count in totals.items():
            self.counts[self._channels[channel].topic] += count
        if self._stated_count not in (None, self.message_count):
            raise BagError(f"{self.path}: damaged: {self._stated_count} messages announced, {self.message_count} found")
        if not whole:
            self.cut = f"cut off: {good} of {size} bytes are whole records, which hold {self.message_count} messages"

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
        elif opcode == Opcode.MESSAGE_INDEX and self._segments:
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
        for channel in self._channels.values():
            encoding = f"{channel.message_encoding} with {self._schemas[channel.schema_id].encoding}"
            if encoding != "cdr with ros2msg":
                raise BagError(f"{self.path}: {channel.topic}: expected cdr with ros2msg, got {encoding}")

    def _unannounced(self) -> set[int]:
        announced = {channel.id for channel in self._channels.values() if channel.schema_id in self._schemas}
        used = {*self._channels, *(channel for segment in self._segments for channel in segment.counts)}
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

    def topic(self, name: str) -> str:
        """The full name of a topic, e.g. ``hrtc/command`` recorded as ``/gnao/hrtc/command``.

        Raises:
            BagError: the bag holds no such topic, or one in each of several namespaces.
        """
        found = [full for full in self.topics if full == name or full.endswith("/" + name.removeprefix("/"))]
        if name.startswith("/"):
            found = [full for full in found if full == name]
        if not found:
            raise BagError(f"{self.path}: no topic {name} (it holds {', '.join(self.topics) or 'none'})")
        if len(found) > 1:
            raise BagError(f"{self.path}: topic {name} is in several namespaces: {', '.join(found)}")
        return found[0]

    def messages(self, *topics: str) -> Iterator[BagMessage]:
        """Messages in the order of their log times: of the topics named in full, or of all.

        Raises:
            BagError: a chunk is damaged.
        """
        wanted = {i: c for i, c in self._channels.items() if not topics or c.topic in topics}
        names = {i: (c.topic, self._schemas[c.schema_id].name) for i, c in wanted.items()}
        for message in self._in_log_order(names.keys()):
            topic, type_name = names[message.channel]
            yield BagMessage(topic, type_name, message.data, message.log_time)

    def __iter__(self) -> Iterator[BagMessage]:
        return self.messages()

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
                    self._schemas[schema.id] = schema
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(ReadDataStream(BytesIO(data[start:position])))
                    self._channels[channel.id] = channel
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

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _mcap_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    files = sorted(path.glob("*.mcap"))
    if len(files) != 1:
        raise BagError(f"{path}: expected a directory with one .mcap file, got {len(files)}")
    return files[0]


# --- Mending ----------------------------------------------------------------------------------------------------------


def repair(path: str | Path, out: str | Path) -> int:
    """Write what a cut-off bag holds as a new bag that every reader opens.

    Args:
        path: the bag that was cut off: its directory or its ``.mcap`` file. It is left as it is.
        out: the directory to make.

    Returns:
        The number of messages recovered.

    Raises:
        BagError: the bag is whole, nothing can be recovered from it, or ``out`` cannot be written.
    """
    with BagReader(path) as reader:
        if reader.cut is None:
            raise BagError(f"{path}: whole, with {reader.message_count} messages: nothing to repair")
        if not reader.message_count:
            raise BagError(f"{path}: {reader.cut}: nothing to recover")
        with BagWriter(out, reader.metadata) as writer:
            writer._copy(reader)
        return reader.message_count
