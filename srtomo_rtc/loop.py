"""The control law, a frame at a time: no ROS, no allocation, no lock.

Pseudo-open-loop control. The mirror shows ``m = clip(u + o)``; the state is ``u = m - o``, so clipping acts on the
state and there is no wind-up. With ``m~[k]`` on the mirror during exposure k, ``u~[k] = m~[k] - o`` and ``Q = R G``::

    after command k-1 is out:      c = (1-leak) (1-g) u[k-1] + g (Q u~[k] - R y_ref)
    as each sensor's slopes come:  p_w = R_w y_w
    when the last one is in:       u[k] = c + g (p_1 + ... + p_W), then m[k] = clip(u[k] + o)

With ``polc`` off the same loop is a classical leaky integrator: ``c = (1-leak) u[k-1] - g R y_ref``.

The history holds m, indexed by exposure, and o is taken off when it is used: an offset and its slope reference
``y_ref = -G o`` then change together without a transient, whatever the delay.

Threads: one thread, the loop's, calls everything here but :meth:`Loop.post`, :meth:`Loop.request` and the constructors
of :class:`Slot` and :class:`Program`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.wire import MIRROR_UNKNOWN
from srtomo_rtc.vmm import all_finite, multiply

Floats = NDArray[np.float32]

HISTORY = 64
"""Commands remembered, in frames."""


class Verdict(enum.IntEnum):
    """How a frame was answered; the constants of msgs_schema/msg/DmCommand."""

    OK = 0
    OPEN = 1
    HOLD_NONFINITE = 2
    HOLD_INCOMPLETE = 3
    HOLD_MISSING = 4
    HOLD_BEHIND = 5
    HOLD_HISTORY = 6


@dataclass(frozen=True, eq=False)
class Settings:
    """What an operator sets. Immutable; arrays must not be written to.

    Attributes:
        id: travels in every command.
        polc: pseudo-open-loop control; otherwise a classical leaky integrator.
        leak: per frame, 0 <= leak < 1.
        relaxation: share of the state that an open loop drops each frame, 0 < relaxation <= 1.
        command_limit: m of wavefront, on top of each reconstructor's own limits.
        fault_budget: consecutive held frames after which the loop opens.
        offset: (n_commands,) m of wavefront.
        slope_reference: (n_slopes,) rad; ``-G offset`` for a wanted static shape, 0 for an aberration to be corrected.
    """

    id: int
    offset: Floats
    slope_reference: Floats
    polc: bool = True
    leak: float = 0.0
    relaxation: float = 0.1
    command_limit: float = math.inf
    fault_budget: int = 50

    def __post_init__(self) -> None:
        # as they travel in events: a replay must compute with the same numbers
        for name in ("leak", "relaxation", "command_limit"):
            object.__setattr__(self, name, float(np.float32(getattr(self, name))))


class Slot:
    """Memory for one reconstructor, by sensor and by columns. Made once, filled off the loop."""

    def __init__(self, layout: Layout) -> None:
        m = layout.n_commands
        self.R_columns = tuple(np.zeros((s.n_slopes, m), np.float32) for s in layout.sensors)
        self.Q_columns = np.zeros((m, m), np.float32)
        self.slope_reference = np.zeros(layout.n_slopes, np.float32)
        self.command_limit = np.zeros(m, np.float32)
        self.gain = 0.0
        self.id = 0
        self.sha256 = bytes(32)

    def fill(self, reconstructor: Reconstructor) -> None:
        """Copy a checked static reconstructor in. Not on the loop's thread, and never into a slot in use."""
        start = 0
        for columns in self.R_columns:
            np.copyto(columns, reconstructor.R[0, :, start : start + len(columns)].T)
            start += len(columns)
        np.copyto(self.Q_columns, reconstructor.Q[0].T)
        self.slope_reference[:] = reconstructor.slope_reference
        self.command_limit[:] = reconstructor.command_limit
        self.gain = reconstructor.gain
        self.sha256 = reconstructor.sha256
        self.id = reconstructor.id


class Program:
    """A slot under settings, ready to run: the one object that the loop reads once a frame.

    Immutable; made off the loop, so that nothing is computed or allocated when it is taken up.
    """

    def __init__(self, slot: Slot, settings: Settings) -> None:
        self.slot = slot
        self.settings = settings
        self.gain = np.float32(slot.gain)
        keep = 1.0 - settings.leak
        self.keep = np.float32(keep * (1.0 - slot.gain) if settings.polc else keep)
        self.relaxation = np.float32(settings.relaxation)
        self.limit = np.minimum(slot.command_limit, np.float32(settings.command_limit))
        reference = settings.slope_reference + slot.slope_reference
        self.reference = np.zeros_like(settings.offset)
        part = np.empty_like(self.reference)
        start = 0
        for columns in slot.R_columns:
            multiply(columns, reference[start : start + len(columns)], part)
            self.reference += part
            start += len(columns)

    def warm(self) -> None:
        """Touch every byte that a frame reads: the first product with a cold matrix takes 2-3 times as long."""
        out = np.empty_like(self.reference)
        for columns in self.slot.R_columns:
            multiply(columns, np.zeros(len(columns), np.float32), out)
        multiply(self.slot.Q_columns, np.zeros(len(out), np.float32), out)


_JIT: dict[str, Any] = {"nogil": True, "cache": True, "fastmath": False}


@numba.njit("void(f4[::1], f4[::1], f4, f4[::1], f4[::1])", **_JIT)
def _state_on_mirror(newest: Floats, before: Floats, fraction: float, offset: Floats, out: Floats) -> None:
    rest = np.float32(1.0) - fraction
    for i in range(len(out)):
        out[i] = (fraction * newest[i] + rest * before[i]) - offset[i]


@numba.njit("void(f4[::1], f4[::1], f4[::1], f4, f4, f4[::1])", **_JIT)
def _prepared(state: Floats, q: Floats, reference: Floats, keep: float, gain: float, out: Floats) -> None:
    for i in range(len(out)):
        out[i] = keep * state[i] + gain * (q[i] - reference[i])


@numba.njit("b1(f4[::1], f4, f4[:,::1], f4[::1])", **_JIT)
def _next_state(prepared: Floats, gain: float, parts: Floats, out: Floats) -> bool:
    finite = True
    for i in range(len(out)):
        total = parts[0, i]
        for w in range(1, len(parts)):
            total += parts[w, i]
        out[i] = prepared[i] + gain * total
        if not np.isfinite(out[i]):
            finite = False
    return finite


@numba.njit("i8(f4[::1], f4[::1], f4[::1], f4[::1])", **_JIT)
def _clip(state: Floats, offset: Floats, limit: Floats, command: Floats) -> int:
    """m = clip(u + o), u = m - o where that changed anything; how many were clipped."""
    clipped = 0
    for i in range(len(state)):
        m = state[i] + offset[i]
        if m > limit[i]:
            m = limit[i]
            state[i] = m - offset[i]
            clipped += 1
        elif m < -limit[i]:
            m = -limit[i]
            state[i] = m - offset[i]
            clipped += 1
        command[i] = m
    return clipped


@numba.njit("void(f4[::1], f4)", **_JIT)
def _relax(state: Floats, relaxation: float) -> None:
    keep = np.float32(1.0) - relaxation
    for i in range(len(state)):
        state[i] *= keep
        if abs(state[i]) < 1e-12:  # a picometre: do not decay into denormals
            state[i] = 0.0


class Loop:
    """State, history and control law of one instrument. See the module's head for the law and the threads.

    A frame is: :meth:`add` for each sensor, then :meth:`answer`; or :meth:`hold`. Then ``command``, ``verdict`` and the
    other public attributes describe the answer, and once it is out, :meth:`prepare` gets ready for the next.

    Attributes:
        frame: the next frame to answer; sensors: bit w set once sensor w was added to it.
        answered, used: the last frame answered, and the sensors that had come by then.
        command: (n_commands,) the last answer m, m of wavefront.
        state: (n_commands,) u after it.
        closed: whether the loop is closed for the next frame.
        program: what the next frame is made with; None before the first one.
        n_clipped, mirror_frame, mirror_frame_before, mirror_fraction: of the last answer, as in DmCommand.
    """

    def __init__(self, layout: Layout, delay: float) -> None:
        """Allocate everything. ``delay``: mid-exposure to mid-command, frames, at least 1."""
        if not 1 <= delay < HISTORY - 1:
            raise ValueError(f"delay: expected 1 to {HISTORY - 2} frames, got {delay}")
        self.delay = float(np.float32(delay))  # as it travels in events
        self._whole = math.floor(self.delay)
        self._fraction = 1.0 - (self.delay - self._whole)
        n_sensors, m = len(layout.sensors), layout.n_commands
        self.n_sensors = n_sensors
        self.all_sensors = (1 << n_sensors) - 1
        self._slopes = tuple(np.zeros(s.n_slopes, np.float32) for s in layout.sensors)
        self._parts = np.zeros((n_sensors, m), np.float32)
        self._part_of = tuple(self._parts[w] for w in range(n_sensors))
        self._history = np.zeros((HISTORY, m), np.float32)
        self._history_of = tuple(self._history[i] for i in range(HISTORY))
        self._flat = np.zeros(m, np.float32)
        self._on_mirror = np.zeros(m, np.float32)
        self._q = np.zeros(m, np.float32)
        self._prepared = np.zeros(m, np.float32)
        self._trial = np.zeros(m, np.float32)
        self.command = np.zeros(m, np.float32)
        self.state = np.zeros(m, np.float32)
        self.program: Program | None = None
        self._posted: Program | None = None
        self._requested_closed = False
        self.closed = False
        self.consecutive_holds = 0
        self.opened_by_faults = 0
        self.start(0)

    # -- from any thread --------------------------------------------------------------------------------------------

    def post(self, program: Program) -> None:
        """Use ``program`` from the next frame that :meth:`prepare` prepares. Any thread: one reference is stored."""
        self._posted = program

    def request(self, closed: bool) -> None:
        """Close or open the loop from the next frame that is prepared. Any thread: one flag is stored."""
        self._requested_closed = closed

    @property
    def pending(self) -> bool:
        """Whether something was posted or requested that the next :meth:`prepare` would take up. Any thread."""
        return self._posted is not None or (self._requested_closed and self.program is not None) != self.closed

    # -- from the loop's thread -------------------------------------------------------------------------------------

    def start(self, frame: int, closed: bool = False) -> None:
        """Begin a session at ``frame``: the mirror is taken to be flat until commands say otherwise.

        What was posted waits for the next :meth:`prepare`.
        """
        self.frame = frame
        self.first_frame = frame
        self.closed = self._requested_closed = closed
        self.consecutive_holds = 0
        self.sensors = 0
        self.used = 0
        self.answered = -1
        self.verdict = Verdict.OPEN
        self.n_clipped = 0
        self.state[:] = 0
        self._history[:] = 0
        self._expect_in_time()

    def resume(
        self, frame: int, first_frame: int, state: Floats, history: Floats, closed: bool, consecutive_holds: int
    ) -> None:
        """Continue after ``frame`` with a recorded state; ``history`` rows end with ``frame``. Not while running."""
        self.frame = frame + 1
        self.first_frame = first_frame
        self.closed = self._requested_closed = closed
        self.consecutive_holds = consecutive_holds
        self.state[:] = state
        for row, command in enumerate(history[-HISTORY:], start=frame + 1 - len(history[-HISTORY:])):
            self._history[row % HISTORY] = command
        self.prepare()

    def prepare(self) -> None:
        """Take up what was posted or requested, and form c for the next frame, supposing its command was in time.

        Sensors that were added to the frame already have to be added again.
        """
        self.sensors = 0
        if self._posted is not None:
            self.program, self._posted = self._posted, None
        self.closed = self._requested_closed and self.program is not None
        self._expect_in_time()

    def _expect_in_time(self) -> None:
        self._expect(self.frame - self._whole, self.frame - self._whole - 1, self._fraction)

    def _expect(self, newest: int, before: int, fraction: float) -> None:
        """Form c with ``fraction`` of the exposure under command ``newest`` and the rest under ``before``."""
        self.mirror_frame = newest
        self.mirror_frame_before = before
        self.mirror_fraction = fraction
        program = self.program
        if program is None:
            return
        if program.settings.polc:
            _state_on_mirror(
                self._shown(newest), self._shown(before), np.float32(fraction), program.settings.offset, self._on_mirror
            )
            multiply(program.slot.Q_columns, self._on_mirror, self._q)
        else:
            self._q[:] = 0
        _prepared(self.state, self._q, program.reference, program.keep, program.gain, self._prepared)

    def _shown(self, frame: int) -> Floats:
        return self._history_of[frame % HISTORY] if frame >= self.first_frame else self._flat

    def _known(self, frame: int) -> bool:
        return frame == -1 or max(self.first_frame, self.frame - HISTORY) <= frame < self.frame

    def add(self, sensor: int, slopes: Floats) -> None:
        """Take one sensor's slopes (n_slopes_w,) of the frame and form its product; they are copied."""
        own = self._slopes[sensor]
        own[:] = slopes
        if self.program is not None:
            multiply(self.program.slot.R_columns[sensor], own, self._part_of[sensor])
        self.sensors |= 1 << sensor

    def answer(self, mirror_frame: int, mirror_frame_before: int, mirror_fraction: float) -> Verdict:
        """Answer a frame whose sensors were all added; the arguments are SlopeFrame's."""
        assert self.sensors == self.all_sensors
        if not self.closed:
            return self._finish(Verdict.OPEN)
        assert self.program is not None
        for slopes in self._slopes:
            if not all_finite(slopes):
                return self.hold(Verdict.HOLD_NONFINITE)
        if self.program.settings.polc and mirror_frame != MIRROR_UNKNOWN:
            if not (
                self._known(mirror_frame)
                and (mirror_fraction == 1.0 or self._known(mirror_frame_before))
                and 0.0 <= mirror_fraction <= 1.0
            ):
                return self.hold(Verdict.HOLD_HISTORY)
            if (
                mirror_frame != self.mirror_frame
                or np.float32(mirror_fraction) != np.float32(self.mirror_fraction)
                or (mirror_fraction != 1.0 and mirror_frame_before != self.mirror_frame_before)
            ):
                self._expect(mirror_frame, mirror_frame_before, mirror_fraction)
        if not _next_state(self._prepared, self.program.gain, self._parts, self._trial):
            return self.hold(Verdict.HOLD_NONFINITE)
        self.state[:] = self._trial
        return self._finish(Verdict.OK)

    def hold(self, verdict: Verdict) -> Verdict:
        """Answer a frame without using its slopes: the state is kept (an open loop relaxes on)."""
        return self._finish(verdict)

    def _finish(self, verdict: Verdict) -> Verdict:
        program = self.program
        if verdict is Verdict.OK or verdict is Verdict.OPEN:
            self.consecutive_holds = 0
        else:
            self.consecutive_holds += 1
        if program is not None:
            if not self.closed:
                _relax(self.state, program.relaxation)
            self.n_clipped = _clip(self.state, program.settings.offset, program.limit, self.command)
            if self.closed and self.consecutive_holds > program.settings.fault_budget:
                self._requested_closed = False
                self.opened_by_faults += 1
        self._history_of[self.frame % HISTORY][:] = self.command
        self.verdict = verdict
        self.used = self.sensors
        self.answered = self.frame
        self.frame += 1
        self.sensors = 0
        return verdict

    def history(self, frames: int) -> Floats:
        """The last commands, (n, n_commands) with n <= ``frames``, oldest first. A copy: not for the hot path."""
        n = min(frames, HISTORY, self.frame - self.first_frame)
        rows: Sequence[int] = [(self.frame - n + i) % HISTORY for i in range(n)]
        return self._history[rows].copy()
