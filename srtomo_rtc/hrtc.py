"""From messages to commands: the frame gate around the loop. No ROS.

Every frame number of a session gets exactly one answer. Messages are put in place by frame and sensor; a frame whose
sensors are all in is answered at once. A frame that cannot be completed any more (a later one is complete, or two later
ones have begun) is held, and so are whole frames when more than ``max_behind`` wait. Duplicates, late ones, other
sessions, other instruments and damaged messages are counted and dropped. One stray frame number does not move the
loop: a jump of the count is believed when a second exposure agrees, and the count of a session never goes back.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core.exposure import Exposure, fits, subaperture_starts
from srtomo_core.layout import Layout
from srtomo_core.wire import DmCommandWriter, SlopeFrame, WireError, read_slope_frame
from srtomo_rtc.latency import LatencyHistogram
from srtomo_rtc.loop import HISTORY, Loop, Program, Verdict

Floats = NDArray[np.float32]

_AHEAD = 8  # frames that may be in assembly at once
_RECENT = 64  # answered frames whose sensors are remembered, to tell a duplicate from a late message
_MAX_JUMP = (
    4096  # frames that a session may skip within the silence below; more is another count, as of another session
)
_SILENCE = 1_000_000_000  # ns without a usable message after which another count may take over
_SHORT_JUMP = 64  # frames that a session may skip and still be the same count after a silence
_STALLED = 100_000_000  # ns without a usable message after which a frame that has begun does not delay what was posted

_HELD = {
    Verdict.HOLD_NONFINITE: "held_nonfinite",
    Verdict.HOLD_INCOMPLETE: "held_incomplete",
    Verdict.HOLD_MISSING: "held_missing",
    Verdict.HOLD_BEHIND: "held_behind",
    Verdict.HOLD_HISTORY: "held_history",
}


@dataclass
class Counters:
    """What happened since activation; names as in msgs_schema/msg/HrtcStatus."""

    commands: int = 0
    held_nonfinite: int = 0
    held_incomplete: int = 0
    held_missing: int = 0
    held_behind: int = 0
    held_history: int = 0
    dropped_duplicate: int = 0
    dropped_late: int = 0
    dropped_session: int = 0
    dropped_fingerprint: int = 0
    dropped_malformed: int = 0
    clipped: int = 0


class Change(NamedTuple):
    """Something that the loop took up, for the events: ``what`` is SESSION, PROGRAM or LOOP."""

    what: str
    session: int
    frame: int
    closed: bool
    program: Program | None
    reason: str


class Snapshot(NamedTuple):
    """The loop after a frame; fields as in msgs_schema/msg/HrtcState."""

    stamp_sec: int
    stamp_nanosec: int
    session: int
    frame: int
    closed: bool
    program: Program | None
    consecutive_holds: int
    first_frame: int
    state: Floats
    history: Floats


class Hrtc:
    """The frame gate, the loop and the command's buffer.

    One thread, the loop's, calls :meth:`start` first, then :meth:`offer`, :meth:`advance` and :meth:`idle`, and
    :meth:`flatten` last. Counters, histogram and the loop's
    public attributes may be read from any thread, which may also call :meth:`want_snapshot` and take from ``changes``
    and ``snapshots``.

    Args:
        layout: of the instrument.
        delay: mid-exposure to mid-command, frames.
        publish: called with each serialised DmCommand, on the loop's thread.
        deadline_ns: latency above which a frame counts as a miss.
        max_behind: complete frames that may wait before whole frames are skipped.
        max_epochs: exposures that a reconstructor may use.
    """

    def __init__(
        self,
        layout: Layout,
        delay: float,
        publish: Callable[[bytes], None],
        *,
        deadline_ns: int = 1_000_000_000,
        max_behind: int = 4,
        max_epochs: int = 1,
    ) -> None:
        if not 1 <= max_behind < _AHEAD:
            raise ValueError(f"max_behind: expected 1 to {_AHEAD - 1} frames, got {max_behind}")
        self.loop = Loop(layout, delay, max_epochs)
        self.counters = Counters()
        self.latency = LatencyHistogram(deadline_ns)
        self.changes: queue.SimpleQueue[Change] = queue.SimpleQueue()
        self.snapshots: queue.SimpleQueue[Snapshot] = queue.SimpleQueue()
        self._snapshot_wanted = False
        self.session = 0
        self.last_slopes_ns = 0
        self._fresh = True
        self._publish = publish
        self._max_behind = max_behind
        self._fingerprint = layout.fingerprint
        self._n_sensors = len(layout.sensors)
        self._starts = subaperture_starts(layout)
        self._writer = DmCommandWriter("dm", layout.n_commands)
        self._exposures = [Exposure(self._starts) for _ in range(_AHEAD)]
        self._complete_ns = [0] * _AHEAD
        self._used = [0] * _RECENT
        self._newest = -1
        self._jump = -1
        self._decided_ns = 0

    def start(self) -> None:
        """Begin to run, or to run again: the next slopes begin a session anew; its frames up to here are the past."""
        self._fresh = True
        self._take_up()

    def offer(self, buffer: bytes, now_ns: int) -> None:
        """Put one serialised SlopeFrame in its place; ``now_ns`` (monotonic) is when it was taken.

        Its product is formed at once if it belongs to the next frame. Nothing is answered before :meth:`advance`,
        unless frames ahead of the assembly memory force it.
        """
        counters = self.counters
        try:
            message = read_slope_frame(buffer)
        except WireError:
            counters.dropped_malformed += 1
            return
        if message.fingerprint != self._fingerprint:
            counters.dropped_fingerprint += 1
            return
        if not fits(message, self._starts):
            counters.dropped_malformed += 1
            return
        same = message.session == self.session
        ahead = message.frame - self.loop.frame
        if same and ahead < 0:
            self._too_late(message)
            return
        silent = now_ns - self.last_slopes_ns >= _SILENCE
        if self._fresh or (silent and not (same and ahead <= _SHORT_JUMP)):
            self._begin(message.session, message.frame)
        elif not same or ahead > _MAX_JUMP or not self._follows(message.frame):
            counters.dropped_session += 1
            return
        self.last_slopes_ns = self._decided_ns = now_ns
        while message.frame >= self.loop.frame + _AHEAD:
            self._skip_next()
        self._place(message, now_ns)

    def _follows(self, frame: int) -> bool:
        """Whether ``frame`` follows on the newest, or on an earlier exposure that jumped to just before it."""
        if frame <= max(self._newest, self.loop.frame) + _AHEAD:
            return True
        agreed = 0 < frame - self._jump <= _AHEAD
        self._jump = -1 if agreed else frame
        return agreed

    def _begin(self, session: int, frame: int) -> None:
        for exposure in self._exposures:
            exposure.clear()
        for place in range(_RECENT):
            self._used[place] = 0
        self._jump = -1
        same = session == self.session
        reason = f"frames go on at {frame} instead of {self.loop.frame}" if same else "slopes of a new session"
        # a loop that was closed before any slopes came stays closed; a session after another starts with an open one
        if self._fresh:
            self._prepare()
        closed = self.loop.closed and self._fresh
        self._fresh = False
        self.session = session
        self._newest = frame
        self.loop.start(frame, closed)
        self.changes.put(Change("SESSION", session, frame, closed, self.loop.program, reason))
        self._prepare()

    def _too_late(self, message: SlopeFrame) -> None:
        recent = self.loop.frame - message.frame <= _RECENT and message.frame >= self.loop.first_frame
        if recent and self._used[message.frame % _RECENT] >> message.sensor & 1:
            self.counters.dropped_duplicate += 1
        else:
            self.counters.dropped_late += 1

    def _place(self, message: SlopeFrame, now_ns: int) -> None:
        place = message.frame % _AHEAD
        exposure = self._exposures[place]
        before = exposure.arrived
        if not exposure.put(message):
            self.counters.dropped_duplicate += 1
            return
        if message.frame > self._newest:
            self._newest = message.frame
        new = exposure.arrived & ~before
        if new:
            self._complete_ns[place] = now_ns
            if message.frame == self.loop.frame:
                self._add(exposure, new)

    def _add(self, exposure: Exposure, sensors: int) -> None:
        for sensor in range(self._n_sensors):
            if sensors >> sensor & 1:
                self.loop.add(sensor, exposure.slopes[sensor])

    def advance(self) -> None:
        """Answer every frame that is complete, and hold every frame that cannot be completed any more."""
        loop = self.loop
        while True:
            frame = loop.frame
            if self._newest < frame:
                return
            if self._newest - frame > self._max_behind:
                self._skip_next()
            elif loop.sensors == loop.all_sensors:
                self._answer_next(Verdict.OK)
            elif self._newest >= frame + 2 or self._exposures[(frame + 1) % _AHEAD].arrived == loop.all_sensors:
                self._answer_next(Verdict.HOLD_MISSING)
            else:
                return

    def _skip_next(self) -> None:
        complete = self.loop.sensors == self.loop.all_sensors
        self._answer_next(Verdict.HOLD_BEHIND if complete else Verdict.HOLD_MISSING)

    def want_snapshot(self) -> None:
        """Ask for a Snapshot after the next answer, in ``snapshots``. Any thread."""
        self._snapshot_wanted = True

    def _snapshot(self, sec: int, nanosec: int) -> Snapshot:
        # once a second, after the command is out: the one place of the loop's thread that allocates
        loop = self.loop
        return Snapshot(sec, nanosec, self.session, loop.answered, loop.closed, loop.program, loop.consecutive_holds,
                        loop.first_frame, loop.state.copy(), loop.history(HISTORY))  # fmt: skip

    def idle(self, now_ns: int) -> None:
        """No slopes are waiting: take up what was posted or requested, unless a frame is just coming in."""
        loop = self.loop
        if loop.pending and (loop.sensors == 0 or now_ns - self.last_slopes_ns > _STALLED):
            self._take_up()

    def _take_up(self) -> None:
        """Take up what was posted or requested, and form the products of what is here of the next frame anew."""
        self._prepare()
        exposure = self._exposures[self.loop.frame % _AHEAD]
        if exposure.arrived:
            self._add(exposure, exposure.arrived)

    def flatten(self) -> None:
        """Open the loop and answer the next frame with the offset alone, whether or not its slopes came."""
        self._decided_ns = time.monotonic_ns()
        self.loop.request(closed=False)
        self.loop.state[:] = 0
        self._prepare()
        self._answer_next(Verdict.OPEN)

    def _answer_next(self, verdict: Verdict) -> None:
        loop, counters = self.loop, self.counters
        frame, place = loop.frame, loop.frame % _AHEAD
        exposure = self._exposures[place]
        since_ns = self._complete_ns[place] if exposure.arrived == loop.all_sensors else self._decided_ns
        program = loop.program
        if verdict is Verdict.OK:
            verdict = loop.answer(*exposure.mirror)
        elif verdict is Verdict.OPEN:
            loop.hold(verdict)
        else:
            if verdict is Verdict.HOLD_MISSING and exposure.begun:
                verdict = Verdict.HOLD_INCOMPLETE
            loop.hold(verdict)
        ready = time.monotonic_ns()
        settings = program.settings.id if program else 0
        reconstructor = program.slot.id if program else 0
        gain = program.slot.gain if program else 0.0
        sec, nanosec = exposure.stamp
        self._writer.values[:] = loop.command
        # the names are msgs_schema/msg/DmCommand's, in its order
        self._publish(
            self._writer.write(
                sec, nanosec, self.session, frame, reconstructor, settings, loop.used, verdict, loop.closed,
                min(loop.n_clipped, 65535), gain, loop.mirror_frame, loop.mirror_frame_before, loop.mirror_fraction,
                (ready - since_ns) * 1e-9,
            )
        )  # fmt: skip
        self.latency.add(time.monotonic_ns() - since_ns)
        counters.commands += 1
        counters.clipped += loop.n_clipped
        held = _HELD.get(verdict)
        if held is not None:
            setattr(counters, held, getattr(counters, held) + 1)
        self._used[frame % _RECENT] = loop.used
        exposure.clear()
        if self._snapshot_wanted:
            self._snapshot_wanted = False
            self.snapshots.put(self._snapshot(sec, nanosec))
        self._take_up()

    def _prepare(self) -> None:
        loop = self.loop
        program, closed = loop.program, loop.closed
        loop.prepare()
        if loop.program is not program:
            self.changes.put(Change("PROGRAM", self.session, loop.frame, loop.closed, loop.program, ""))
        if loop.closed is not closed:
            by_faults = closed and program is not None and loop.consecutive_holds > program.settings.fault_budget
            reason = f"{loop.consecutive_holds} frames held in a row" if by_faults else "asked for"
            self.changes.put(Change("LOOP", self.session, loop.frame, loop.closed, loop.program, reason))
