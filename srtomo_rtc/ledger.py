"""What a recording should hold, told from the frame numbers in what it does hold. No ROS.

Within a session the sensors count exposures, and the HRTC answers every one: each number between the first and the last
seen must be there from every sensor, and be answered.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from srtomo_core.wire import WireError, read_dm_command, read_slope_frame

_GAPS_REPORTED = 20
_OPEN = 1  # DmCommand.OPEN
_QUIET = 0.5  # s without slopes or commands after which nothing can be under way any more


class FrameSet:
    """A set of frame numbers, kept as runs: a gap costs memory, a frame does not."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []  # one past the last

    def add(self, frame: int) -> bool:
        """Put a number in; False if it is there already."""
        starts, ends = self._starts, self._ends
        if ends and ends[-1] == frame:
            ends[-1] += 1
            return True
        i = bisect_right(starts, frame)  # runs before i start at or below it
        if i and frame < ends[i - 1]:
            return False
        joins_before = i > 0 and ends[i - 1] == frame
        joins_after = i < len(starts) and starts[i] == frame + 1
        if joins_before and joins_after:
            ends[i - 1] = ends.pop(i)
            starts.pop(i)
        elif joins_before:
            ends[i - 1] += 1
        elif joins_after:
            starts[i] = frame
        else:
            starts.insert(i, frame)
            ends.insert(i, frame + 1)
        return True

    def __len__(self) -> int:
        return sum(self._ends) - sum(self._starts)

    @classmethod
    def of(cls, first: int, last: int) -> FrameSet:
        """The numbers from ``first`` to ``last``."""
        run = cls()
        if first <= last:
            run._starts, run._ends = [first], [last + 1]
        return run

    @property
    def first(self) -> int:
        """The lowest number. The set must not be empty."""
        return self._starts[0]

    @property
    def last(self) -> int:
        """The highest number. The set must not be empty."""
        return self._ends[-1] - 1

    def gaps(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """Runs that are missing from ``first`` to ``last``, each as its own first and last."""
        for start, end in zip(self._starts, self._ends):
            if start > last:
                break
            if start > first:
                yield first, start - 1
            first = max(first, end)
        if first <= last:
            yield first, last

    def __or__(self, other: FrameSet) -> FrameSet:
        either = FrameSet()
        for start, end in sorted(zip(self._starts + other._starts, self._ends + other._ends)):
            if either._ends and start <= either._ends[-1]:
                either._ends[-1] = max(either._ends[-1], end)
            else:
                either._starts.append(start)
                either._ends.append(end)
        return either

    def __and__(self, other: FrameSet) -> FrameSet:
        common = FrameSet()
        i = j = 0
        while i < len(self._starts) and j < len(other._starts):
            start = max(self._starts[i], other._starts[j])
            end = min(self._ends[i], other._ends[j])
            if start < end:
                common._starts.append(start)
                common._ends.append(end)
            if self._ends[i] <= other._ends[j]:
                i += 1
            else:
                j += 1
        return common


class _Stream(NamedTuple):
    """What carries one message of every frame: a sensor, several adjacent ones, or a packet of one."""

    sensor: int
    first_subaperture: int
    n_subapertures: int


@dataclass
class _Session:
    slopes: dict[_Stream, FrameSet] = field(default_factory=dict)
    stars: dict[_Stream, FrameSet] = field(default_factory=dict)  # of tip-tilt's own loop, by their own count
    commands: FrameSet = field(default_factory=FrameSet)
    last_answer: int = -1  # highest number of a command that answers slopes, or their absence
    adopted: list[int] = field(default_factory=list)  # first frames that the HRTC said it would answer
    closed: list[tuple[int, int]] = field(default_factory=list)  # first frame, and the bits of sensors closed from then
    last_arrival: float = 0.0

    def complete(self, n_subapertures: int) -> FrameSet:
        """Frames that hold every sub-aperture of the sensors that share a count, and a command."""
        if sum(stream.n_subapertures for stream in self.slopes) != n_subapertures:
            return FrameSet()
        frames = self.commands
        for stream, have in self.slopes.items():
            frames = frames & (have | self.excused(stream, frames.last if len(frames) else -1))
        return frames

    def excused(self, stream: _Stream, last: int) -> FrameSet:
        """Frames up to ``last`` in which the stream's sensor was closed, and need not have sent anything."""
        frames = FrameSet()
        events = sorted(self.closed)
        for (first, sensors), (after, _) in zip(events, [*events[1:], (last + 1, 0)]):
            if sensors >> stream.sensor & 1:
                frames = frames | FrameSet.of(first, min(after - 1, last))
        return frames

    def gaps(self, in_flight: int, quiet: bool) -> tuple[dict[_Stream, list[tuple[int, int]]], list[tuple[int, int]]]:
        """Missing runs of every stream, and of the commands.

        Up to ``in_flight`` frames that only some streams hold, at either end, are those that a recording started or
        stopped in the middle of; a frame 0 is no such start, and a session that has fallen quiet has no such end.
        """
        if not self.slopes:
            return {}, []
        firsts = [have.first for have in self.slopes.values()]
        newest = max(have.last for have in self.slopes.values())
        there = {stream: have | self.excused(stream, newest) for stream, have in self.slopes.items()}
        lasts = [have.last for have in there.values()]
        if self.last_answer >= 0:
            lasts.append(self.last_answer)
        partial_start = 0 < min(firsts) and max(firsts) - min(firsts) <= in_flight
        first = max(firsts) if partial_start else min(firsts)
        partial_end = not quiet and max(lasts) - min(lasts) <= in_flight
        last = min(lasts) if partial_end else max(lasts)
        return {s: list(have.gaps(first, last)) for s, have in there.items()}, self._unanswered(first, last)

    def _unanswered(self, first: int, last: int) -> list[tuple[int, int]]:
        adopted = sorted(self.adopted)
        if adopted:
            first = max(first, adopted[0])
        elif len(self.commands):
            first = max(first, self.commands.first)
        else:
            return []
        unanswered = []
        for start, end in self.commands.gaps(first, last):
            # an HRTC that came back answers from the frame that it adopted, and not those before
            back = max((frame for frame in adopted[1:] if start < frame <= end + 1), default=start)
            if back <= end:
                unanswered.append((back, end))
        return unanswered


class Ledger:
    """Books what was recorded of ``wfs/slopes``, ``hrtc/command`` and the sessions of ``hrtc/event``.

    Args:
        n_subapertures: valid sub-apertures of each sensor.
        fingerprint: of the layout; slopes of another instrument are counted apart.
        in_flight: frames that may be under way between sensor and recorder when it starts or stops.
        tip_tilt_sensors: those that count their own frames, each from the first that came to the last.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        n_subapertures: Sequence[int],
        fingerprint: bytes,
        in_flight: int,
        clock: Callable[[], float] = time.monotonic,
        tip_tilt_sensors: Collection[int] = (),
    ) -> None:
        self._n_subapertures = sum(n for w, n in enumerate(n_subapertures) if w not in tip_tilt_sensors)
        self._tip_tilt_sensors = tip_tilt_sensors
        self._fingerprint = fingerprint
        self._in_flight = in_flight
        self._clock = clock
        self._sessions: dict[int, _Session] = {}
        self.duplicate_slopes = 0
        self.duplicate_commands = 0
        self.malformed = 0
        self.foreign = 0

    def _session(self, session: int) -> _Session:
        entry = self._sessions.get(session)
        if entry is None:
            entry = self._sessions[session] = _Session()
        return entry

    def add_slopes(self, buffer: bytes) -> None:
        """Book a serialised SlopeFrame."""
        try:
            message = read_slope_frame(buffer)
        except WireError:
            self.malformed += 1
            return
        if message.fingerprint != self._fingerprint:
            self.foreign += 1
            return
        session = self._session(message.session)
        session.last_arrival = self._clock()
        stream = _Stream(message.sensor, message.first_subaperture, message.n_subapertures)
        streams = session.stars if message.sensor in self._tip_tilt_sensors else session.slopes
        have = streams.get(stream)
        if have is None:
            have = streams[stream] = FrameSet()
        self.duplicate_slopes += not have.add(message.frame)

    def add_command(self, buffer: bytes) -> None:
        """Book a serialised DmCommand."""
        try:
            message = read_dm_command(buffer)
        except WireError:
            self.malformed += 1
            return
        session = self._session(message.session)
        session.last_arrival = self._clock()
        self.duplicate_commands += not session.commands.add(message.frame)
        # the flat that a stopping HRTC leaves behind does not need slopes
        if message.sensors or message.verdict != _OPEN:
            session.last_answer = max(session.last_answer, message.frame)

    def add_adoption(self, session: int, first_frame: int) -> None:
        """Book that the HRTC adopted a session, and the first frame that it answers."""
        self._session(session).adopted.append(first_frame)

    def add_closed(self, session: int, first_frame: int, sensors: int) -> None:
        """Book that from a frame on these sensors (bits) are closed, and no others."""
        closed = self._session(session).closed
        if (closed[-1][1] if closed else 0) != sensors:
            closed.append((first_frame, sensors))

    def _gaps(self, session: _Session) -> tuple[dict[_Stream, list[tuple[int, int]]], list[tuple[int, int]]]:
        by_stream, unanswered = session.gaps(self._in_flight, self._clock() - session.last_arrival > _QUIET)
        stars = {stream: list(have.gaps(have.first, have.last)) for stream, have in session.stars.items()}
        return by_stream | stars, unanswered

    @property
    def frames(self) -> int:
        """Frame numbers that have every sensor's slopes and a command."""
        return sum(len(session.complete(self._n_subapertures)) for session in self._sessions.values())

    @property
    def lost(self) -> tuple[int, int]:
        """Messages that should be here and are not: slopes, commands."""
        slopes = commands = 0
        for session in self._sessions.values():
            by_stream, unanswered = self._gaps(session)
            slopes += sum(_total(gaps) for gaps in by_stream.values())
            commands += _total(unanswered)
        return slopes, commands

    def report(self) -> list[dict[str, Any]]:
        """Each session: its number, frames, and the first gaps of every stream, as [first, last] frame."""
        sessions = []
        for number, session in self._sessions.items():
            complete = session.complete(self._n_subapertures)
            by_stream, unanswered = self._gaps(session)
            slopes = [
                {
                    "sensor": stream.sensor,
                    "first_subaperture": stream.first_subaperture,
                    "recorded": len((session.slopes | session.stars)[stream]),
                    "lost": _total(gaps),
                    "gaps": gaps[:_GAPS_REPORTED],
                }
                for stream, gaps in sorted(by_stream.items())
            ]
            sessions.append(
                {
                    "session": number,
                    "frames": len(complete),
                    "first_frame": complete.first if len(complete) else None,
                    "last_frame": complete.last if len(complete) else None,
                    "slopes": slopes,
                    "commands": {
                        "recorded": len(session.commands),
                        "lost": _total(unanswered),
                        "gaps": unanswered[:_GAPS_REPORTED],
                    },
                }
            )
        return sessions


def _total(gaps: list[tuple[int, int]]) -> int:
    return sum(last - first + 1 for first, last in gaps)
