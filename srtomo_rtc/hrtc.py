"""From messages to commands: the frame gate around the loop. No ROS. It runs in ``native/gate.c``, wrapped here.

Every frame number of a session gets exactly one answer. Messages are put in place by frame and sensor, and multiplied
as they come; a frame whose sensors are all in is answered at once. A frame that cannot be completed any more (a later
one is complete, or two later ones have begun) is held, and so are whole frames when more than ``max_behind`` wait.
Duplicates, late ones, other sessions, other instruments and damaged messages are counted and dropped. One stray frame
number does not move the loop: a jump of the count is believed when a second exposure agrees, and the count of a session
never goes back.

Stars of tip-tilt's own loop count their own frames. Such a frame is taken in with the next answer once every star has
come that came in the frame before, or once a later one begins; of several that wait for an answer the newest is.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.ring import RingWriter
from srtomo_rtc import native
from srtomo_rtc.latency import LatencyHistogram
from srtomo_rtc.loop import HISTORY, Loop, LoopState, Owner, Program, check_size
from srtomo_rtc.native import lib

Floats = NDArray[np.float32]

_AHEAD = 8  # frames that may be in assembly at once


@dataclass
class Counters:
    """What happened since activation; names as in msgs_schema/msg/HrtcStatus."""

    commands: int = 0
    held_nonfinite: int = 0
    held_incomplete: int = 0
    held_missing: int = 0
    held_behind: int = 0
    held_history: int = 0
    held_closed: int = 0
    dropped_duplicate: int = 0
    dropped_late: int = 0
    dropped_session: int = 0
    dropped_fingerprint: int = 0
    dropped_malformed: int = 0
    clipped: int = 0
    slewed: int = 0
    scaled: int = 0
    fallback: int = 0
    changes_lost: int = 0


class Change(NamedTuple):
    """Something that the loop took up, for the events: ``what`` is SESSION, PROGRAM or LOOP."""

    what: str
    session: int
    frame: int
    loop_state: LoopState
    program: Program | None
    reason: str
    by_itself: bool = False


class Snapshot(NamedTuple):
    """The loop after a frame; fields as in msgs_schema/msg/HrtcState."""

    stamp_sec: int
    stamp_nanosec: int
    session: int
    frame: int
    loop_state: LoopState
    program: Program | None
    consecutive_holds: int
    frames_closed: int
    first_frame: int
    state: Floats
    history: Floats
    tip_tilt_frame: int
    tip_tilt: Floats


_T = TypeVar("_T")


class _Told(Generic[_T]):
    """What the loop has put into a ring; one thread takes it out."""

    def __init__(self, take: Callable[[], _T | None]) -> None:
        self._take = take
        self._next: _T | None = None

    def empty(self) -> bool:
        """Whether nothing waits."""
        if self._next is None:
            self._next = self._take()
        return self._next is None

    def get(self) -> _T:
        """The oldest that waits.

        Raises:
            LookupError: nothing does.
        """
        if self.empty():
            raise LookupError("nothing waits")
        told, self._next = self._next, None
        assert told is not None
        return told

    get_nowait = get


class Hrtc:
    """The frame gate, the loop and the command's buffer.

    One thread, the loop's, calls :meth:`start` first, then :meth:`offer`, :meth:`advance` and :meth:`idle`, and
    :meth:`flatten` last; or ``srt_run`` of ``native/ros.c``, which does the same without the interpreter. Counters,
    histogram and the loop's public attributes may be read from any thread. One other thread may call
    :meth:`want_snapshot` and take from ``changes`` and ``snapshots``.

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
        size = check_size(layout, delay, max_epochs)
        made = Owner(lib.srt_gate_new(*size, layout.fingerprint, deadline_ns, max_behind), lib.srt_gate_free, "gate")
        self.loop = Loop(layout, delay, max_epochs, made)
        self._owner = made
        self.gate = made.pointer
        self._c: native.Gate = made.pointer.contents
        self._error: BaseException | None = None
        self._c.publish = self._callback = native.PUBLISH(self._publisher(publish))
        self.latency = LatencyHistogram(shared=self._c.latency)
        self.frame_latency = LatencyHistogram(shared=self._c.frame_latency)
        self._offered = b""
        self.changes: _Told[Change] = _Told(self._next_change)
        self.snapshots: _Told[Snapshot] = _Told(self._next_snapshot)

    # -- for any thread to look at ----------------------------------------------------------------------------------

    @property
    def session(self) -> int:
        """Of the slopes; 0: none have come."""
        return int(self._c.session)

    @property
    def last_slopes_ns(self) -> int:
        """When the last usable message came (monotonic)."""
        return int(self._c.last_slopes_ns)

    @property
    def last_tip_tilt_ns(self) -> int:
        """When the last usable message of tip-tilt's own stars came (monotonic); 0: none has."""
        return int(self._c.last_tip_tilt_ns)

    @property
    def counters(self) -> Counters:
        """As they are now."""
        counters = self._c.counters
        return Counters(*(getattr(counters, name) for name in native.COUNTERS))

    @property
    def stopping(self) -> bool:
        """Whether the loop's thread is to end; may be set by any thread."""
        return bool(self._c.stop)

    @stopping.setter
    def stopping(self, value: bool) -> None:
        """Set before the loop's thread starts, and to end it."""
        self._c.stop = value

    @property
    def not_flat(self) -> bool:
        """Whether anything is on the mirror that a stopping loop has to take off."""
        return bool(lib.srt_gate_not_flat(self.gate))

    def record_to(self, ring: RingWriter | None) -> None:
        """From now on put every message offered (channel 0) and every command that went out (channel 1) into a ring,
        which must stay open until this was called again; None: into none. While the loop's thread does not run."""
        self._c.ring = native.Ring() if ring is None else native.Ring(ring.address, ring.capacity, ring.ahead)

    # -- from the loop's thread -------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to run, or to run again: the next slopes begin a session anew; its frames up to here are the past."""
        lib.srt_gate_start(self.gate)

    def offer(self, buffer: bytes, now_ns: int) -> None:
        """Put one serialised SlopeFrame in its place; ``now_ns`` (monotonic) is when it was received.

        Its product is formed at once if it belongs to the next frame. Nothing is answered before :meth:`advance`,
        unless frames ahead of the assembly memory force it.
        """
        lib.srt_gate_offer(self.gate, buffer, len(buffer), now_ns)
        self._offered = buffer  # the library looks at it once more
        self._raise()

    def advance(self) -> None:
        """Answer every frame that is complete, and hold every frame that cannot be completed any more."""
        lib.srt_gate_advance(self.gate)
        self._raise()

    def idle(self, now_ns: int) -> None:
        """No slopes are waiting: take up what was posted or requested, unless a frame is just coming in.

        While no slopes come at all, this is also where a closed loop opens after the watchdog's time, and where FLAT is
        published: either answers the next frame with the offset.
        """
        lib.srt_gate_idle(self.gate, now_ns)
        self._raise()

    def flatten(self) -> None:
        """Open the loop and answer the next frame with the offset alone, whether or not its slopes came."""
        lib.srt_gate_flatten(self.gate)
        self._raise()

    def _publisher(self, publish: Callable[[bytes], None]) -> Callable[[Any, int, int], int]:
        def call(context: Any, message: int, size: int) -> int:
            try:
                publish(ctypes.string_at(message, size))
            except BaseException as error:
                self._error = error  # nothing can be raised through the library
                return 1
            return 0

        return call

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    # -- from one other thread --------------------------------------------------------------------------------------

    def want_snapshot(self) -> None:
        """Ask for a Snapshot after the next answer, in ``snapshots``."""
        lib.srt_gate_want_snapshot(self.gate)

    def _next_change(self) -> Change | None:
        c = native.Change()
        if not lib.srt_gate_next_change(self.gate, c):
            return None
        what, reason = ("SESSION", "PROGRAM", "LOOP")[c.what], ""
        by_itself = what == "LOOP" and c.reason in (native.FAULTS, native.SILENCE)
        if what == "SESSION":
            goes_on = f"frames go on at {c.frame} instead of {c.number}"
            reason = goes_on if c.reason == native.GOES_ON else "slopes of a new session"
        elif what == "LOOP":
            reason = "asked for"
            if c.reason == native.FAULTS:
                reason = f"{c.number} frames held in a row"
            elif c.reason == native.SILENCE:
                reason = f"no slopes for {c.number * 1e-9:.1f} s"
        program = self.loop.program_named(c.token)
        return Change(what, c.session, c.frame, LoopState(c.state), program, reason, by_itself)

    def _next_snapshot(self) -> Snapshot | None:
        pointer = lib.srt_gate_next_snapshot(self.gate)
        if not pointer:
            return None
        c, loop = pointer.contents, self.loop
        m, n_rows = len(loop.command), int(self._c.loop.contents.n_rows)
        state = native.view(self._owner, c.state, (n_rows,))[:m].copy()
        history = native.view(self._owner, c.history, (HISTORY, n_rows))[:, :m]
        n = min(HISTORY, c.frame + 1 - c.first_frame)
        rows = [(c.frame + 1 - n + i) % HISTORY for i in range(n)]
        made = Snapshot(c.stamp_sec, c.stamp_nanosec, c.session, c.frame, LoopState(c.loop_state),
                        loop.program_named(c.token), c.consecutive_holds, c.frames_closed, c.first_frame, state,
                        history[rows].copy(), c.tip_tilt_frame,
                        native.view(self._owner, c.tip_tilt, (n_rows,))[:m].copy())  # fmt: skip
        lib.srt_gate_snapshot_done(self.gate)
        return made
