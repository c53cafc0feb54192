"""The recorder: every exchange to a bag, and the word on what is missing in it.

Messages are taken in batches from a node that no executor spins, as serialised bytes, and written by a thread of their
own: the readers' queues, of a second's messages, bridge a pause of the one, a bounded queue those of the other.

Slopes and commands come from the HRTC's ring in shared memory while there is one. Their subscriptions then stand by:
nobody takes from their queues, which keep the last second for the moment when the ring is gone, falls silent, or has
been overrun.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import math
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from msgs_schema.msg import HrtcEvent, RecorderStatus
from msgs_schema.msg import Reconstructor as ReconstructorMsg
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from srtomo_core.bag import BagError, BagWriter
from srtomo_core.clock import ArrivalClock
from srtomo_core.layout import Layout
from srtomo_core.ring import ring_path
from srtomo_core.system import InstrumentError, System, load_system
from srtomo_core.wire import (
    COMMAND,
    EVENT,
    RECONSTRUCTOR,
    RECONSTRUCTOR_BLOCK,
    RECORDER_STATUS,
    SLOPES,
    TOPICS,
    Topic,
)
from srtomo_rtc.ledger import Ledger
from srtomo_rtc.ring_source import Recent, RingSource

_HOT_PERIOD = 0.01  # s between visits to the topics of every frame
_SLOW_PERIOD = 0.1  # s between visits to the others, however long those take
_LEAST_DEPTH = 16  # messages, of the slow topics' readers
_STATUS_PERIOD = 0.5  # s
_FLUSH_PERIOD = 1.0  # s: what a killed recorder loses at the most, when messages are rare
_UNMATCHED_STATUSES = 4  # in a row: after 2 s a publisher in the graph is not merely being discovered
_IN_FLIGHT = 0.1  # s from a sensor to here that is no loss when a recording starts or stops in between
_LAST_MESSAGES = 0.3  # s that messages already sent get to arrive after the order to stop
_WAITING_BYTES = 256 << 20  # for the disk; beyond it messages wait in the readers' queues
_OVERLAP = 1.0  # s after a change between ring and subscriptions for which both are taken from
_GRACE = 100_000_000  # ns that a message from a subscription waits for its copy in the ring, which has the better time
_REMEMBERED = 10  # queues' worth of messages, which may come by both
_QUIET = 0.25  # s without a message in the ring after which the subscriptions are looked at too
_RING_CHANNELS = (SLOPES, COMMAND)
_RING, _SUBSCRIPTION = 0, 1  # ways by which these come
_SAYS_WHAT_IS_CLOSED = (HrtcEvent.SESSION, HrtcEvent.SETTINGS, HrtcEvent.COMMIT, HrtcEvent.ROLLBACK)


_UNRECORDED = "a publisher offers less than reliable (or transient local) delivery, and is not recorded"


class _Record(NamedTuple):
    """A message on its way to the bag; times in ns since the epoch, ``received`` by a clock that nobody sets."""

    received: int
    tap: _Tap
    data: bytes
    sent: int
    sequence: int


@dataclass
class _Tap:
    """One topic as it is recorded."""

    topic: Topic
    name: str
    message_type: type
    subscription: Any
    clock: ArrivalClock
    recent: Recent
    recorded: int = 0
    last_sequence: int = 0
    skipped: int = 0
    several_publishers: bool = False
    unmatched_statuses: int = 0

    def take(self) -> Iterator[_Record]:
        """What the reader's queue holds now. To be called with the subscription's handle held."""
        take_message = self.subscription.handle.take_message
        for _ in range(self.subscription.qos_profile.depth):
            taken = take_message(self.message_type, True)
            if taken is None:
                return
            data, info = taken
            sequence = info["publication_sequence_number"]
            # a lower number is that of another publisher
            if self.last_sequence and sequence > self.last_sequence + 1:
                self.skipped += sequence - self.last_sequence - 1
            self.last_sequence = sequence
            received = self.clock.start + self.clock.monotonic(info["received_timestamp"])
            yield _Record(received, self, data, info["source_timestamp"], sequence)


class _Scribe(threading.Thread):
    """Writes batches to the bag, so that compression and disk never keep the readers' queues waiting."""

    def __init__(self, bag: BagWriter) -> None:
        super().__init__(name="scribe")
        self._bag = bag
        self._batches: queue.SimpleQueue[list[_Record] | None] = queue.SimpleQueue()
        self._given = 0
        self._written = 0
        self.error: Exception | None = None

    @property
    def waiting_bytes(self) -> int:
        """Bytes given and not written yet. Any thread."""
        return self._given - self._written

    def give(self, batch: list[_Record]) -> None:
        """Hand over messages. Recording thread."""
        self._given += sum(len(record.data) for record in batch)
        self._batches.put(batch)

    def finish(self) -> None:
        """Write what was given, close the bag and end the thread. Recording thread."""
        self._batches.put(None)
        self.join()

    def run(self) -> None:
        """The thread's body."""
        try:
            self._write()
            self._bag.close()
        # raised again by the recording thread: nothing may end this one unseen
        except Exception as error:
            self.error = error

    def _write(self) -> None:
        flush_at = time.monotonic() + _FLUSH_PERIOD
        while True:
            try:
                batch = self._batches.get(timeout=_FLUSH_PERIOD)
            except queue.Empty:
                batch = []
            if batch is None:
                return
            for record in batch:
                tap = record.tap
                if tap.topic is RECONSTRUCTOR:
                    self._keep_two(record)
                self._bag.write(tap.name, tap.topic.type, record.data, record.received, record.sent, record.sequence)
                self._written += len(record.data)
            if time.monotonic() >= flush_at:
                self._bag.flush()
                flush_at = time.monotonic() + _FLUSH_PERIOD

    def _keep_two(self, manifest: _Record) -> None:
        """Have later files repeat the blocks of two reconstructors, as their writer keeps them: they are large."""
        blocks = manifest.tap.name.removesuffix(RECONSTRUCTOR.name) + RECONSTRUCTOR_BLOCK.name
        n_blocks = deserialize_message(manifest.data, ReconstructorMsg).n_blocks
        self._bag.keep(blocks, min(2 * n_blocks, RECONSTRUCTOR_BLOCK.depth))


class Recorder:
    """Subscribes to the topics of an instrument, books and records what comes. One thread calls all its methods.

    While an HRTC of this domain and namespace has a ring in shared memory, slopes and commands come from there.

    Args:
        bag: to write to; the recorder closes it.
        layout: of the instrument: the sub-apertures that make a frame.
        rate: frames per second.
        namespace: where its topics are.
        topics: of ``wire.TOPICS``; all by default.
    """

    def __init__(
        self, bag: BagWriter, layout: Layout, rate: float, namespace: str, topics: Sequence[Topic] = TOPICS
    ) -> None:
        self._bag = bag
        self.ledger = Ledger(
            [sensor.n_valid for sensor in layout.sensors],
            layout.fingerprint,
            math.ceil(_IN_FLIGHT * rate),
            tip_tilt_sensors=layout.tip_tilt_sensors,
        )
        self._clock = ArrivalClock()
        self._node = Node("recorder", namespace=namespace or None, enable_rosout=False, start_parameter_services=False)
        status_qos = QoSProfile(**RECORDER_STATUS.qos())
        self._status = self._node.create_publisher(RecorderStatus, RECORDER_STATUS.name, status_qos)
        per_second = {SLOPES: rate * len(layout.sensors), COMMAND: rate}
        # several may come between two visits, also where a writer keeps but the last for late readers
        self._taps = [
            self._tap(topic, max(_LEAST_DEPTH, topic.depth_at(per_second.get(topic, 0.0)))) for topic in topics
        ]
        self._hot = [tap for tap in self._taps if tap.topic in (SLOPES, COMMAND)]
        self._by_channel = {_RING_CHANNELS.index(tap.topic): tap for tap in self._hot}
        path = ring_path(self._node.context.get_domain_id(), self._node.get_namespace())
        self._ring = RingSource(path, time.monotonic_ns())
        self._ring_wanted = bool(self._hot)
        self._heard = -math.inf  # when something last came from the ring
        self._changed = -math.inf  # when ring and subscriptions last took over from each other
        self._waiting: list[_Record] = []  # from subscriptions, until the ring was read after their grace
        self._unrecorded: list[str] = []
        self._scribe = _Scribe(bag)
        self._scribe.start()
        self._started = time.monotonic()

    def _tap(self, topic: Topic, depth: int) -> _Tap:
        package, kind, name = topic.type.split("/")
        message_type = getattr(importlib.import_module(f"{package}.{kind}"), name)
        subscription = self._node.create_subscription(
            message_type, topic.name, _never_called, QoSProfile(**topic.qos(depth)), raw=True
        )
        full_name = subscription.topic_name
        self._bag.declare(full_name, topic.type, depth=depth, transient_local=topic.transient_local)
        return _Tap(topic, full_name, message_type, subscription, self._clock, Recent(_REMEMBERED * depth))

    def record(self, stop: threading.Event) -> None:
        """Record until ``stop`` is set and what was sent by then is in the bag, then close the bag.

        Raises:
            BagError: the bag cannot be written any more.
        """
        # what is here stays: the collector need not look at it again and again
        gc.collect()
        gc.freeze()
        try:
            self._record(stop)
        finally:
            self._scribe.finish()
        if self._scribe.error is not None:
            raise self._scribe.error

    def _record(self, stop: threading.Event) -> None:
        slow_at = status_at = time.monotonic()
        while not stop.is_set() and self._scribe.error is None:
            if self._scribe.waiting_bytes < _WAITING_BYTES:
                slow = time.monotonic() >= slow_at
                if slow:
                    slow_at = time.monotonic() + _SLOW_PERIOD
                self._drain(self._taps if slow else self._hot)
            if time.monotonic() >= status_at:
                self._publish_status()
                status_at = time.monotonic() + _STATUS_PERIOD
            time.sleep(_HOT_PERIOD)
        # not until nothing comes any more: the loop may run on
        deadline = time.monotonic() + _LAST_MESSAGES
        while self._scribe.error is None and time.monotonic() < deadline:
            time.sleep(_HOT_PERIOD)
            self._drain(self._taps)

    def _drain(self, taps: Sequence[_Tap]) -> bool:
        graceful = self._clock.start + time.monotonic_ns() - _GRACE  # before the ring is read
        batch = self._take_ring()
        since_change = time.monotonic() - self._changed
        for tap in taps:
            if tap.topic in _RING_CHANNELS and self._ring.attached and since_change > _OVERLAP:
                continue  # stands by
            with tap.subscription.handle:
                taken = list(tap.take())
            if tap.topic in _RING_CHANNELS:
                self._waiting += taken
            else:
                batch += taken
        due = [record for record in self._waiting if record.received < graceful or not self._ring.attached]
        self._waiting = [record for record in self._waiting if record.received >= graceful and self._ring.attached]
        batch += [record for record in due if record.tap.recent.add(record.data, _SUBSCRIPTION)]
        batch.sort(key=itemgetter(0))
        if not batch:
            return False
        for record in batch:
            self._book(record)
        self._scribe.give(batch)
        return True

    def _take_ring(self) -> list[_Record]:
        before = self._ring.attached, self._ring.overruns
        # before it is read: a process that stood still in between would take the ring for quiet, and messages that are
        # in it from their subscriptions, with later times
        now = time.monotonic()
        messages = self._ring.read(self._ring_wanted)
        if messages:
            self._heard = now
        if before != (self._ring.attached, self._ring.overruns) or (self._ring.attached and now - self._heard > _QUIET):
            self._changed = now
        batch = []
        for channel, arrived, data in messages:
            tap = self._by_channel.get(channel)
            if tap is not None:
                received = self._clock.start + arrived
                batch.append(_Record(received, tap, data, received, 0))
        return [record for record in batch if record.tap.recent.add(record.data, _RING)]

    def _book(self, record: _Record) -> None:
        record.tap.recorded += 1
        topic = record.tap.topic
        if topic is SLOPES:
            self.ledger.add_slopes(record.data)
        elif topic is COMMAND:
            self.ledger.add_command(record.data)
        elif topic is EVENT:
            event = deserialize_message(record.data, HrtcEvent)
            if event.kind == HrtcEvent.SESSION:
                self.ledger.add_adoption(event.session, event.first_frame)
            if event.session and event.kind in _SAYS_WHAT_IS_CLOSED:
                self.ledger.add_closed(event.session, event.first_frame, event.closed_sensors)

    def _publish_status(self) -> None:
        publishers = {}
        for tap in self._taps:
            matched = publishers[tap.topic] = tap.subscription.get_publisher_count()
            tap.several_publishers |= matched > 1
            # a publisher that offers less than the table asks for is in the graph, and silent
            unmatched = self._node.count_publishers(tap.name) > matched
            tap.unmatched_statuses = tap.unmatched_statuses + 1 if unmatched else 0
            if tap.unmatched_statuses == _UNMATCHED_STATUSES:
                self._unrecorded.append(tap.name)
                print(f"recorder: {tap.name}: {_UNRECORDED}", file=sys.stderr, flush=True)
        # the ring holds the commands of one HRTC alone
        self._ring_wanted = bool(self._hot) and publishers.get(COMMAND, 0) <= 1
        status = RecorderStatus()
        status.header.stamp = self._node.get_clock().now().to_msg()
        status.bag = str(self._bag.path)
        status.slope_publishers = publishers.get(SLOPES, 0)
        status.command_publishers = publishers.get(COMMAND, 0)
        status.frames = self.ledger.frames
        status.messages = sum(tap.recorded for tap in self._taps)
        status.lost = sum(lost or 0 for lost in self._lost().values())
        status.bytes = self._bag.bytes_written
        self._status.publish(status)

    def _lost(self) -> dict[Topic, int | None]:
        """By frame numbers where there are some, otherwise by the publisher's own count; None with several of them."""
        lost = {tap.topic: None if tap.several_publishers else tap.skipped for tap in self._taps}
        by_frames = dict(zip((SLOPES, COMMAND), self.ledger.lost))
        return {topic: by_frames.get(topic, skipped) for topic, skipped in lost.items()}

    def report(self) -> dict[str, Any]:
        """What was recorded and what is missing, by topic and session; None where no number tells."""
        lost = self._lost()
        duplicates = {SLOPES: self.ledger.duplicate_slopes, COMMAND: self.ledger.duplicate_commands}
        topics = {
            tap.name: {"recorded": tap.recorded, "lost": lost[tap.topic], "duplicates": duplicates.get(tap.topic)}
            for tap in self._taps
        }
        return {
            "bag": str(self._bag.path),
            "seconds": time.monotonic() - self._started,
            "cpu_seconds": time.process_time(),
            "bytes": self._bag.bytes_written,
            "removed_files": self._bag.removed_files,
            "removed_bytes": self._bag.removed_bytes,
            "messages": sum(tap.recorded for tap in self._taps),
            "frames": self.ledger.frames,
            "lost": sum(count or 0 for count in lost.values()),
            "from_ring": self._ring.messages,
            "overrun": self._ring.overruns,
            "malformed": self.ledger.malformed,
            "of_another_instrument": self.ledger.foreign,
            "unrecorded": self._unrecorded,
            "topics": topics,
            "sessions": self.ledger.report(),
        }

    def close(self) -> None:
        """Leave the network and the ring."""
        self._ring.close()
        self._node.destroy_node()


def _never_called(_: object) -> None:
    """A subscription must have a callback; without an executor nobody calls it."""


def table(report: dict[str, Any]) -> str:
    """The report for people."""
    rows = [("topic", "recorded", "lost", "duplicates")]
    for name, entry in report["topics"].items():
        rows.append((name, *("-" if entry[key] is None else str(entry[key]) for key in rows[0][1:])))
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))])
        for row in rows
    ]
    lines.append(
        f"{report['frames']} whole frames, {report['lost']} messages lost, {report['bytes'] / 1e6:.1f} MB "
        f"in {report['seconds']:.1f} s: {report['bag']}"
    )
    if report["removed_files"]:
        removed = f"the oldest {report['removed_files']} files, {report['removed_bytes'] / 1e6:.1f} MB"
        lines.append(f"{removed}, were removed to stay within the limit")
    if report["from_ring"]:
        overrun = f", {report['overrun']} were overwritten there first" if report["overrun"] else ""
        lines.append(f"{report['from_ring']} slopes and commands came from the HRTC's memory{overrun}")
    if report["malformed"]:
        lines.append(f"{report['malformed']} malformed messages were recorded as they came")
    if report["of_another_instrument"]:
        lines.append(f"{report['of_another_instrument']} slope messages are of another instrument than the one given")
    lines += [f"{name}: {_UNRECORDED}" for name in report["unrecorded"]]
    return "\n".join(lines)


def choose_topics(names: Sequence[str] | None) -> tuple[Topic, ...]:
    """Topics by their names in the table of the wire; all of them for None.

    Raises:
        BagError: a name is not in the table.
    """
    if names is None:
        return TOPICS
    by_name = {topic.name: topic for topic in TOPICS}
    for name in names:
        if name not in by_name:
            raise BagError(f"topic {name}: expected some of {', '.join(by_name)}")
    return tuple(by_name[name] for name in names)


def run(
    output: str | Path,
    system: System,
    namespace: str = "",
    topics: Sequence[str] | None = None,
    ros_args: Sequence[str] = (),
    split_bytes: int | None = None,
    limit_bytes: int | None = None,
) -> dict[str, Any]:
    """Record until SIGINT or SIGTERM. Main thread only.

    Args:
        output: the bag's directory; it must not exist.
        system: the instrument.
        namespace: of its topics.
        topics: their names as in ``wire.TOPICS``; all by default.
        ros_args: for rclpy, from ``--ros-args`` on.
        split_bytes, limit_bytes: of the bag, as in :class:`~srtomo_core.bag.BagWriter`.

    Returns:
        :meth:`Recorder.report`.

    Raises:
        BagError: the bag cannot be written.
    """
    chosen = choose_topics(topics)
    layout = Layout(system)
    metadata = {
        "system": system.model_dump_json(),
        "fingerprint": layout.fingerprint.hex(),
        "n_slopes": str(layout.n_slopes),
        "n_commands": str(layout.n_commands),
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    with (
        _stop_signals() as stop,
        BagWriter(output, metadata, split_bytes=split_bytes, limit_bytes=limit_bytes) as bag,
    ):
        rclpy.init(args=list(ros_args), signal_handler_options=SignalHandlerOptions.NO)
        try:
            recorder = Recorder(bag, layout, system.loop.rate, namespace, chosen)
            print(f"recording {len(chosen)} topics to {bag.path}", flush=True)
            try:
                recorder.record(stop)
                return recorder.report()
            finally:
                recorder.close()
        finally:
            rclpy.shutdown()


@contextmanager
def _stop_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, a second one included: the bag is finished in any case."""
    stop = threading.Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def main(arguments: Sequence[str] | None = None) -> int:
    """The recorder as a program; the return value is the exit status."""
    everything = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(prog="recorder_node", description="Record every exchange of an instrument.")
    parser.add_argument("output", help="directory of the bag to write; must not exist")
    parser.add_argument("--system", required=True, help="instrument: a name or the path of a .yaml file")
    parser.add_argument("--namespace", default="", help="of the instrument's topics (default: none)")
    parser.add_argument("--topics", nargs="+", metavar="NAME", help="record only these, e.g. wfs/slopes")
    parser.add_argument("--json", metavar="FILE", help="write the report there")
    options = parser.parse_args(remove_ros_args(["", *everything])[1:])
    ros_args = everything[everything.index("--ros-args") :] if "--ros-args" in everything else []
    try:
        report = run(options.output, load_system(options.system), options.namespace, options.topics, ros_args)
    except (BagError, InstrumentError) as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1
    print(table(report))
    if options.json:
        try:
            Path(options.json).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            print(f"recorder: {options.json}: cannot be written ({error.strerror})", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
