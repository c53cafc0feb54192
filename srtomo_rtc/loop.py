"""The control law, a frame at a time: no ROS, no allocation, no lock.

Pseudo-open-loop control. The mirror shows ``m = clip(u + o)``; the state is ``u = m - o``, so clipping acts on the
state and there is no wind-up. With ``m~[k]`` on the mirror during exposure k, ``u~[k] = m~[k] - o`` and ``Q = R G``::

    after command k-1 is out:      c = (1-leak) (1-g) u[k-1] + g (Q u~[k] - R y_ref)
    as each sensor's slopes come:  p_w = R_w y_w
    when the last one is in:       u[k] = c + g (p_1 + ... + p_W), then m[k] = clip(u[k] + o)

With ``polc`` off the same loop is a classical leaky integrator: ``c = (1-leak) u[k-1] - g R y_ref``.

A reconstructor of several epochs adds ``g sum_j>=1 (R_j (y[k-j] - y_ref) + Q_j u~[k-j])`` to c, so that the command
waits for nothing more than with one. It needs the N-1 exposures before, all of them answered OK in a closed loop: with
one of them held, missing, from an open loop or from before the session, the fallback makes the command, a whole
reconstructor for one exposure (R_0 alone would have the wrong gain). What is remembered are slopes and what was on the
mirror, not products: a commit costs no fallback.

The history holds m, indexed by exposure, and o is taken off when it is used: an offset and its slope reference
``y_ref = -G o`` then change together without a transient, whatever the delay.

Threads: one thread, the loop's, calls everything here but :meth:`Loop.post`, :meth:`Loop.request` and the constructors
of :class:`Slot` and :class:`Program`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
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

MAX_EPOCHS = 8
"""Exposures that a loop can be made for."""

_NEVER = -(2**62)  # no frame has this number, nor the one before the first


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


class Columns:
    """R and Q for one exposure, by columns: R sensor by sensor.

    Attributes:
        R: of each sensor, (n_slopes_w, n_commands).
        Q: (n_commands, n_commands).
    """

    def __init__(self, layout: Layout) -> None:
        m = layout.n_commands
        self.R = tuple(np.zeros((s.n_slopes, m), np.float32) for s in layout.sensors)
        self.Q = np.zeros((m, m), np.float32)

    def fill(self, R: Floats, Q: Floats) -> None:
        """Copy R (n_commands, n_slopes) and Q in."""
        start = 0
        for columns in self.R:
            np.copyto(columns, R[:, start : start + len(columns)].T)
            start += len(columns)
        np.copyto(self.Q, Q.T)

    def times(self, slopes: Floats) -> Floats:
        """``R slopes`` (n_commands,), sensor by sensor; a new array."""
        out, part, start = np.zeros(len(self.Q), np.float32), np.empty(len(self.Q), np.float32), 0
        for columns in self.R:
            multiply(columns, slopes[start : start + len(columns)], part)
            out += part
            start += len(columns)
        return out

    def warm(self) -> None:
        """Touch every byte."""
        self.times(np.zeros(sum(map(len, self.R)), np.float32))
        multiply(self.Q, np.zeros(len(self.Q), np.float32), np.empty(len(self.Q), np.float32))


class Slot:
    """Memory for one reconstructor. Made once, filled off the loop.

    Attributes:
        n_epochs: of the reconstructor in it.
        epochs: matrices of each epoch that there is room for, the newest exposure first.
        fallback: for the newest exposure alone; the first epoch's where there is room for no more.
    """

    def __init__(self, layout: Layout, max_epochs: int = 1) -> None:
        m = layout.n_commands
        self.n_epochs = 1
        self.epochs = tuple(Columns(layout) for _ in range(max_epochs))
        self.fallback = Columns(layout) if max_epochs > 1 else self.epochs[0]
        self.slope_reference = np.zeros(layout.n_slopes, np.float32)
        self.command_limit = np.zeros(m, np.float32)
        self.gain = 0.0
        self.id = 0
        self.sha256 = bytes(32)

    def fill(self, reconstructor: Reconstructor) -> None:
        """Copy a checked reconstructor in. Not on the loop's thread, and never into a slot in use.

        Raises:
            ValueError: it has more epochs than there is room for.
        """
        if reconstructor.n_epochs > len(self.epochs):
            raise ValueError(f"uses {reconstructor.n_epochs} exposures; there is room for {len(self.epochs)}")
        self.n_epochs = reconstructor.n_epochs
        for columns, (R, Q) in zip((*self.epochs[: self.n_epochs], self.fallback), reconstructor.parts, strict=False):
            columns.fill(R, Q)
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
        self.several = slot.n_epochs > 1
        self.alone = slot.fallback if self.several else slot.epochs[0]
        self.alone_reference = self.alone.times(reference)
        self.reference = np.zeros_like(self.alone_reference)
        for columns in slot.epochs[: slot.n_epochs]:
            self.reference += columns.times(reference)

    def warm(self) -> None:
        """Touch every byte that a frame reads: the first product with a cold matrix takes 2-3 times as long."""
        for columns in {*self.slot.epochs[: self.slot.n_epochs], self.alone}:
            columns.warm()


_JIT: dict[str, Any] = {"nogil": True, "cache": True, "fastmath": False}


@numba.njit("void(f4[::1], f4[::1], f4, f4[::1], f4[::1])", **_JIT)
def _state_on_mirror(newest: Floats, before: Floats, fraction: float, offset: Floats, out: Floats) -> None:
    rest = np.float32(1.0) - fraction
    for i in range(len(out)):
        out[i] = (fraction * newest[i] + rest * before[i]) - offset[i]


@numba.njit("void(f4[::1], f4[::1])", **_JIT)
def _add(part: Floats, out: Floats) -> None:
    for i in range(len(out)):
        out[i] += part[i]


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
        max_epochs: exposures that a reconstructor may use.
        program: what the next frame is made with; None before the first one.
        n_clipped, mirror_frame, mirror_frame_before, mirror_fraction: of the last answer, as in DmCommand.
    """

    def __init__(self, layout: Layout, delay: float, max_epochs: int = 1) -> None:
        """Allocate everything.

        Args:
            delay: mid-exposure to mid-command, frames, at least 1.
            max_epochs: exposures that a reconstructor may use, 1 to :data:`MAX_EPOCHS`.
        """
        if not 1 <= delay < HISTORY - 1 - MAX_EPOCHS:
            raise ValueError(f"delay: expected 1 to {HISTORY - 2 - MAX_EPOCHS} frames, got {delay}")
        if not 1 <= max_epochs <= MAX_EPOCHS:
            raise ValueError(f"max_epochs: expected 1 to {MAX_EPOCHS}, got {max_epochs}")
        self.max_epochs = max_epochs
        self.delay = float(np.float32(delay))  # as it travels in events
        self._whole = math.floor(self.delay)
        self._fraction = 1.0 - (self.delay - self._whole)
        n_sensors, m = len(layout.sensors), layout.n_commands
        self.n_sensors = n_sensors
        self.all_sensors = (1 << n_sensors) - 1
        # by exposure: frame k is in row k % max_epochs
        self._slopes = np.zeros((max_epochs, layout.n_slopes), np.float32)
        self._slopes_of = tuple(tuple(row[layout.slopes_of(w)] for w in range(n_sensors)) for row in self._slopes)
        self._kept = np.full(max_epochs, _NEVER, np.int64)  # the frame, if it was answered OK
        # what was on the mirror, as in DmCommand
        self._mirror_frames = np.full((max_epochs, 2), -1, np.int64)
        self._mirror_fraction = np.ones(max_epochs, np.float32)
        self._parts = np.zeros((n_sensors, m), np.float32)
        self._part_of = tuple(self._parts[w] for w in range(n_sensors))
        self._history = np.zeros((HISTORY, m), np.float32)
        self._history_of = tuple(self._history[i] for i in range(HISTORY))
        self._flat = np.zeros(m, np.float32)
        self._on_mirror = np.zeros(m, np.float32)
        self._q = np.zeros(m, np.float32)
        self._product = np.zeros(m, np.float32)
        self._older = np.zeros(m, np.float32)
        self._several = False
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
        """Use ``program`` from the next frame that :meth:`prepare` prepares. Any thread: one reference is stored.

        Raises:
            ValueError: it uses more exposures than the loop remembers.
        """
        if program.slot.n_epochs > self.max_epochs:
            raise ValueError(f"uses {program.slot.n_epochs} exposures; this loop takes {self.max_epochs}")
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
        self._kept[:] = _NEVER
        self._several = False
        self._expect_in_time()

    def resume(
        self,
        frame: int,
        first_frame: int,
        state: Floats,
        history: Floats,
        closed: bool,
        consecutive_holds: int,
        exposures: Mapping[int, tuple[Sequence[Floats], tuple[int, int, float]]] | None = None,
    ) -> None:
        """Continue after ``frame`` with a recorded state. Not while running.

        Args:
            history: the commands up to that of ``frame``, the last row.
            exposures: of earlier frames that were answered OK, by frame: the slopes of each sensor, and what was on the
                mirror, as in DmCommand. Of more than ``max_epochs - 1`` only the newest matter.
        """
        self.frame = frame + 1
        self.first_frame = first_frame
        self.closed = self._requested_closed = closed
        self.consecutive_holds = consecutive_holds
        self.state[:] = state
        for row, command in enumerate(history[-HISTORY:], start=frame + 1 - len(history[-HISTORY:])):
            self._history[row % HISTORY] = command
        self._kept[:] = _NEVER
        for earlier, (slopes, mirror) in (exposures or {}).items():
            if frame - self.max_epochs < earlier <= frame:
                row = earlier % self.max_epochs
                for own, values in zip(self._slopes_of[row], slopes, strict=True):
                    own[:] = values
                self._keep(row, earlier, *mirror)
        self.prepare()

    def prepare(self) -> None:
        """Take up what was posted or requested, and form c for the next frame, supposing its command was in time.

        Sensors that were added to the frame already have to be added again.
        """
        self.sensors = 0
        if self._posted is not None:
            self.program, self._posted = self._posted, None
        self.closed = self._requested_closed and self.program is not None
        self._form_older()
        self._expect_in_time()

    def _form_older(self) -> None:
        """Form the part of c that earlier exposures make, if the program uses them and all are here."""
        program = self.program
        self._several = program is not None and program.several and self._kept_back(program.slot.n_epochs - 1)
        if program is None or not self._several:
            return
        self._older[:] = 0
        for j in range(1, program.slot.n_epochs):
            row = (self.frame - j) % self.max_epochs
            columns = program.slot.epochs[j]
            for w in range(self.n_sensors):
                multiply(columns.R[w], self._slopes_of[row][w], self._product)
                _add(self._product, self._older)
            if program.settings.polc:
                newest, before = self._mirror_frames[row]
                self._product_with_mirror(columns.Q, newest, before, self._mirror_fraction[row], self._product)
                _add(self._product, self._older)

    def _kept_back(self, n: int) -> bool:
        """Whether the ``n`` exposures before this one are kept."""
        for frame in range(self.frame - n, self.frame):
            if self._kept[frame % self.max_epochs] != frame:
                return False
        return True

    def _keep(self, row: int, frame: int, newest: int, before: int, fraction: float) -> None:
        self._kept[row] = frame
        self._mirror_frames[row, 0] = newest
        self._mirror_frames[row, 1] = before
        self._mirror_fraction[row] = fraction

    def _product_with_mirror(self, Q: Floats, newest: int, before: int, fraction: float, out: Floats) -> None:
        """``Q u~`` with ``fraction`` of the exposure under command ``newest`` and the rest under ``before``."""
        assert self.program is not None
        _state_on_mirror(
            self._shown(newest),
            self._shown(before),
            np.float32(fraction),
            self.program.settings.offset,
            self._on_mirror,
        )
        multiply(Q, self._on_mirror, out)

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
        columns = program.slot.epochs[0] if self._several else program.alone
        if program.settings.polc:
            self._product_with_mirror(columns.Q, newest, before, fraction, self._q)
        else:
            self._q[:] = 0
        reference = program.alone_reference
        if self._several:
            _add(self._older, self._q)
            reference = program.reference
        _prepared(self.state, self._q, reference, program.keep, program.gain, self._prepared)

    def _shown(self, frame: int) -> Floats:
        return self._history_of[frame % HISTORY] if frame >= self.first_frame else self._flat

    def _known(self, frame: int) -> bool:
        # it still has to be known when this exposure is the oldest that is used, however many the loop takes
        oldest = self.frame - HISTORY + MAX_EPOCHS
        return frame == -1 or max(self.first_frame, oldest) <= frame < self.frame

    def add(self, sensor: int, slopes: Floats) -> None:
        """Take one sensor's slopes (n_slopes_w,) of the frame and form its product; they are copied."""
        own = self._slopes_of[self.frame % self.max_epochs][sensor]
        own[:] = slopes
        program = self.program
        if program is not None:
            columns = program.slot.epochs[0] if self._several else program.alone
            multiply(columns.R[sensor], own, self._part_of[sensor])
        self.sensors |= 1 << sensor

    def answer(self, mirror_frame: int, mirror_frame_before: int, mirror_fraction: float) -> Verdict:
        """Answer a frame whose sensors were all added; the arguments are SlopeFrame's."""
        assert self.sensors == self.all_sensors
        if not self.closed:
            return self._finish(Verdict.OPEN)
        assert self.program is not None
        if not all_finite(self._slopes[self.frame % self.max_epochs]):
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
        self._keep(
            self.frame % self.max_epochs,
            self.frame if verdict is Verdict.OK else _NEVER,
            self.mirror_frame,
            self.mirror_frame_before,
            self.mirror_fraction,
        )
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
