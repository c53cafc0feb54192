"""Bags: rosbag2-style directories of MCAP files, written, read, and mended when they were cut off; no ROS needed.

A bag is ``metadata.yaml`` and ``<name>_0.mcap``, ``<name>_1.mcap`` ...: profile ``ros2``, ``ros2msg`` schemas, ``cdr``
messages in zstd chunks with an index. What a replay has to know beside the messages is in the files' metadata record
``srtomo``. Every file but the first begins with what a late reader would be sent on transient local topics, so that a
replay can start in it when the files before it are gone.
"""

from __future__ import annotations

import heapq
import os
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import yaml
from mcap.writer import CompressionType, Writer

from srtomo_core.mcap_reader import METADATA_RECORD, REPEATED, BagError, BagMessage, McapReader
from srtomo_core.messages import decode_recorded, definition, type_hash

__all__ = ["METADATA_RECORD", "BagError", "BagMessage", "BagReader", "BagWriter", "repair"]

CHUNK_SIZE = 1 << 20
"""Bytes gathered before they are compressed and written; what a killed recorder can lose."""


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


@dataclass
class _WrittenTopic:
    """What was declared of a topic; ``latched``: what a late reader would be sent, where files are split."""

    type_name: str
    text: str
    details: dict[str, str]
    latched: deque[BagMessage]
    messages: int = 0


class _FileWriter:
    """One MCAP file. Every method may raise OSError."""

    def __init__(self, path: Path, metadata: Mapping[str, str]) -> None:
        self.path = path
        self.counts: Counter[str] = Counter()
        self.first_time = _EMPTY_START
        self.last_time = 0
        self._final_bytes: int | None = None
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._file: IO[bytes] = open(path, "xb")
        self._writer = Writer(self._file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="srtomo")
        self._writer.add_metadata(METADATA_RECORD, dict(metadata))
        self._file.flush()

    @property
    def closed(self) -> bool:
        return self._file.closed

    @property
    def bytes(self) -> int:
        # a finished file may be moved away or deleted while the recording goes on
        return os.path.getsize(self.path) if self._final_bytes is None else self._final_bytes

    def declare(self, topic: str, written: _WrittenTopic) -> None:
        name = written.type_name
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "ros2msg", written.text.encode())
        self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[name], written.details)

    def write(self, message: BagMessage) -> None:
        channel = self._channels[message.topic]
        self._writer.add_message(
            channel, message.log_time, message.data, message.publish_time, message.sequence & 0xFFFFFFFF
        )
        self.counts[message.topic] += 1
        self.first_time = min(self.first_time, message.log_time)
        self.last_time = max(self.last_time, message.log_time)

    def flush(self) -> None:
        self._writer.flush()

    def finish(self) -> None:
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._final_bytes = os.path.getsize(self.path)
        # it holds an index of the whole file, and a recording without an end has files without end
        del self._writer

    def abort(self) -> None:
        # closing writes what is buffered, and so fails again on a full disk
        with suppress(OSError):
            self._file.close()


class BagWriter:
    """Writes a new bag. Not thread-safe: one thread at a time.

    ``metadata.yaml`` and the metadata record are on disk from the start, so that a bag whose writer was killed can be
    read, and mended, up to its last whole chunk.

    Args:
        path: the directory to make; it must not exist.
        metadata: what goes into the metadata record.
        split_bytes: size of a file from which on the next one is begun; None: all in one.
        limit_bytes: size of all files from which on the oldest are removed, for recordings without an end; None: keep
            them all. Needs ``split_bytes``.

    Attributes:
        removed_files, removed_bytes: what the limit has cost so far.

    Raises:
        BagError: it exists already, or cannot be written. Every method that writes raises it too, e.g. on a full disk;
            the bag is then cut off, and :func:`repair` mends it.
        ValueError: a limit that is not at least twice the size of a file.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, str],
        *,
        split_bytes: int | None = None,
        limit_bytes: int | None = None,
    ) -> None:
        if split_bytes is not None and split_bytes <= 0:
            raise ValueError(f"split: expected a size above 0, got {split_bytes} bytes")
        if limit_bytes is not None and (split_bytes is None or limit_bytes < 2 * split_bytes):
            files = "files to be split" if split_bytes is None else f"at least two files of {split_bytes} bytes"
            raise ValueError(f"limit of {limit_bytes} bytes: expected {files}")
        self.path = Path(path)
        self.removed_files = 0
        self.removed_bytes = 0
        self._name = self.path.resolve().name
        self._metadata = dict(metadata)
        self._split_bytes = split_bytes
        self._limit_bytes = limit_bytes
        self._topics: dict[str, _WrittenTopic] = {}
        self._files: list[_FileWriter] = []
        try:
            self.path.mkdir(parents=True)
            self._file = self._begin_file(self._metadata)
        except FileExistsError:
            raise BagError(f"{self.path}: exists already, and is not overwritten") from None
        except OSError as error:
            raise BagError(f"{self.path}: cannot be written ({error.strerror})") from None

    def _begin_file(self, metadata: Mapping[str, str]) -> _FileWriter:
        number = self.removed_files + len(self._files)
        self._files.append(_FileWriter(self.path / f"{self._name}_{number}.mcap", metadata))
        self._write_yaml()
        return self._files[-1]

    @property
    def bytes_written(self) -> int:
        """Bytes of the MCAP files so far, removed ones too. Any thread."""
        return self.removed_bytes + sum(file.bytes for file in [*self._files])

    def declare(self, topic: str, type_name: str, *, depth: int = 0, transient_local: bool = False) -> None:
        """Announce a topic before its first message, with what its writers offer beside being reliable.

        Raises:
            BagError: no such type.
        """
        details = {
            "offered_qos_profiles": _offered_qos(depth, transient_local),
            "topic_type_hash": type_hash(type_name),
        }
        kept = depth if transient_local and self._split_bytes is not None else 0
        self._declare(topic, type_name, definition(type_name), details, kept)

    def keep(self, topic: str, count: int) -> None:
        """Repeat no more than the last ``count`` messages of a declared transient local topic in later files."""
        written = self._topics.get(topic)
        if written is not None and written.latched.maxlen:
            written.latched = deque(written.latched, count)

    def _declare(self, topic: str, type_name: str, text: str, details: dict[str, str], kept: int = 0) -> None:
        written = _WrittenTopic(type_name, text, details, deque(maxlen=kept))
        try:
            self._file.declare(topic, written)
        except OSError as error:
            raise self._failed(error) from None
        self._topics[topic] = written

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
        if topic not in self._topics:
            self.declare(topic, type_name)
        written = self._topics[topic]
        if written.type_name != type_name:
            raise BagError(f"{topic}: holds {written.type_name}, got {type_name}")
        message = BagMessage(topic, type_name, data, log_time, publish_time, sequence)
        try:
            self._file.write(message)
        except OSError as error:
            raise self._failed(error) from None
        written.messages += 1
        written.latched.append(message)

    def declare_as(self, reader: BagReader) -> None:
        """Announce the topics of another bag, with the definitions and qualities of service that it recorded.

        Its messages may be older than ours, and can then be written as they are.
        """
        for file in reader.files:
            for channel in file.channels.values():
                if channel.topic not in self._topics:
                    schema = file.schemas[channel.schema_id]
                    self._declare(channel.topic, schema.name, schema.data.decode(), channel.metadata)

    def flush(self) -> None:
        """End the chunk in progress, hand everything to the operating system, and begin a new file if it is time."""
        try:
            self._file.flush()
            if self._split_bytes is not None and self._file.bytes >= self._split_bytes:
                self._split()
        except OSError as error:
            raise self._failed(error) from None

    def _split(self) -> None:
        self._file.finish()
        repeated = [message for written in self._topics.values() for message in written.latched]
        repeated.sort(key=attrgetter("log_time"))
        self._file = self._begin_file({**self._metadata, REPEATED: str(len(repeated))})
        for topic, written in self._topics.items():
            self._file.declare(topic, written)
        for message in repeated:
            self._file.write(message)
        self._file.flush()
        self._remove_oldest()

    def _remove_oldest(self) -> None:
        while self._limit_bytes is not None and len(self._files) > 1:
            sizes = [file.bytes for file in self._files]
            # room for the file just begun to become as large as any
            if sum(sizes) + max(sizes) <= self._limit_bytes:
                return
            oldest = self._files.pop(0)
            self.removed_files += 1
            self.removed_bytes += oldest.bytes
            # a reader that goes by metadata.yaml must never look for a file that is gone
            self._write_yaml()
            oldest.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Write the index and the final ``metadata.yaml``. A second call does nothing."""
        if self._file.closed:
            return
        try:
            self._file.finish()
            self._write_yaml()
        except OSError as error:
            raise self._failed(error) from None

    def abort(self) -> None:
        """Leave the bag as a kill would: whole up to the last chunk on disk, and without an index."""
        self._file.abort()

    def _failed(self, error: OSError) -> BagError:
        self.abort()
        return BagError(f"{self.path}: cannot be written ({error.strerror or error})")

    def _write_yaml(self) -> None:
        first = min((file.first_time for file in self._files), default=_EMPTY_START)
        last = max((file.last_time for file in self._files), default=0)
        counts = sum((file.counts for file in self._files), Counter[str]())
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": max(0, last - first)},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": counts.total(),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": written.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": yaml.safe_load(written.details.get("offered_qos_profiles", "")) or [],
                        "type_description_hash": written.details.get("topic_type_hash", ""),
                    },
                    "message_count": counts[topic],
                }
                for topic, written in self._topics.items()
            ],
            # MCAP compresses its chunks itself: to rosbag2 the file is not compressed
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.path.name for file in self._files],
            "files": [
                {
                    "path": file.path.name,
                    "starting_time": {"nanoseconds_since_epoch": file.first_time},
                    "duration": {"nanoseconds": max(0, file.last_time - file.first_time)},
                    "message_count": file.counts.total(),
                }
                for file in self._files
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


# --- Reading ----------------------------------------------------------------------------------------------------------


class BagReader:
    """Reads a bag in the order of its log times, cut off or whole; one pass over the records' headers on opening.

    Args:
        path: a bag's directory, or an ``.mcap`` file.

    Attributes:
        files: the readers of its files, in order.
        cut: None, or the sentence that says how much of a cut-off bag is there.
        metadata: of the record ``srtomo``; empty when another recorder wrote the bag.
        topics: full name to type, in order of appearance.
        counts: messages by topic.

    Raises:
        BagError: no bag there, or not MCAP files of ROS 2 messages. Iterating raises it at a damaged chunk.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.files: list[McapReader] = []
        try:
            for source in _mcap_files(self.path):
                self.files.append(McapReader(source))
        except BaseException:
            self.close()
            raise
        for file in self.files[1:]:
            file.without_repeated()
        self.metadata = {key: value for key, value in self.files[0].metadata.items() if key != REPEATED}
        self.topics: dict[str, str] = {}
        self._definitions: dict[str, bytes] = {}
        counts: Counter[str] = Counter()
        for file in self.files:
            schemas = {channel.topic: file.schemas[channel.schema_id] for channel in file.channels.values()}
            self.topics |= {topic: schema.name for topic, schema in schemas.items()}
            self._definitions |= {schema.name: schema.data for schema in schemas.values()}
            counts.update(file.counts)
        self.counts = {topic: counts[topic] for topic in self.topics}
        self.cut = "; ".join(f"{file.path.name} {file.cut}" for file in self.files if file.cut) or None

    @property
    def message_count(self) -> int:
        """Messages in the bag."""
        return sum(self.counts.values())

    @property
    def time_range(self) -> tuple[int, int]:
        """First and last log time, ns since the epoch; (0, 0) of an empty bag."""
        ranges = [file.time_range for file in self.files if sum(file.counts.values())]
        return min((first for first, _ in ranges), default=0), max((last for _, last in ranges), default=0)

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
        return heapq.merge(*(file.messages(*topics) for file in self.files), key=attrgetter("log_time"))

    def __iter__(self) -> Iterator[BagMessage]:
        return self.messages()

    def decode(self, message: BagMessage) -> Any:
        """A message of this bag as an object, by the definition in the bag (:func:`decode_recorded`).

        Raises:
            MessageError: no message of that definition.
        """
        text = self._definitions[message.type].decode(errors="replace")
        return decode_recorded(message.type, message.data, text)

    def close(self) -> None:
        """Close the files."""
        for file in self.files:
            file.close()

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _mcap_files(path: Path) -> list[Path]:
    """The files of a bag, by the numbers at the end of their names."""
    if not path.is_dir():
        return [path]
    files = [*path.glob("*.mcap")]
    if not files:
        raise BagError(f"{path}: expected a directory with .mcap files, got none")
    numbers = {file: file.stem.rpartition("_")[2] for file in files}
    return sorted(files, key=lambda file: (int(numbers[file]) if numbers[file].isdigit() else 0, file.name))


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
            writer.declare_as(reader)
            for message in reader:
                writer.write(*message)
        return reader.message_count
