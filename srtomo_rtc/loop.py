"""The control law, a frame at a time: no ROS, no allocation, no lock. It runs in ``native/law.c``, wrapped here.

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

What limits a command acts in this order, and the state follows what was put on the mirror: each actuator's clip; a
command whose rms over all actuators is too large is scaled down, its shape kept; the slew limit. After closing the gain
may rise in a ramp: in frame j of N (from 1) ``j g / N`` stands for every g above.

Sensors that are closed are not waited for, and whatever they send is ignored. The command is then made by the
reconstructor's :class:`~srtomo_core.reconstructor.Closure` for just these; or, if there is none, the natural stars'
:class:`~srtomo_core.reconstructor.LowOrder` acts as an integrator and leaves the high orders as they are; or the
command is held. The state and the history of what was on the mirror go on, so that no change among these shows a step.

Tip-tilt may have a loop of its own, on stars that count their own frames j (:class:`srtomo_core.system.TipTiltLoop`)::

    t[j] = keep t[j-1] + g_t R_t (y_t[j] - y_ref),        m[k] = clip(u[k] + o + t)

with the newest t of the stars' frames that have come, one at most an answer, and held high orders are no reason to hold
t. R_t is the reconstructor's columns for those stars; each star's is the whole of tip-tilt in its weight
(:attr:`Slot.star_weights`), so that the rest goes on with ``R_t / (sum of their weights)`` when one is lost: no slopes
of it, or none that are finite. With the last one t is held; so it is where it would leave the range of an actuator.
An open loop relaxes it like u.

t is no part of the state u, or the filter of the high orders would integrate it a second time. But u~ has it, being all
that is on the mirror but o: ``y + G (u~ + t~)`` are the open-loop slopes, of which R for blind stars takes no tip-tilt
(:mod:`srtomo_srtc.tip_tilt`). Without t~, what those stars do see of t, the mirror's ripple on a tilt, would come back
as u.

The history holds m, indexed by exposure, and o is taken off when it is used: an offset and its slope reference
``y_ref = -G o`` then change together without a transient, whatever the delay.

Threads: one thread, the loop's, calls everything here but :meth:`Loop.post`, :meth:`Loop.request` and the constructors
of :class:`Slot` and :class:`Program`.
"""

from __future__ import annotations

import ctypes
import enum
import itertools
import math
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, n_parts
from srtomo_rtc import native
from srtomo_rtc.crew import Crew
from srtomo_rtc.lowrank import Factors
from srtomo_rtc.native import lib
from srtomo_rtc.vmm import KERNELS, huge_zeros, multiply, quantise, rows_of, tiled, tiles_shape, untiled

Floats = NDArray[np.float32]

HISTORY = 64
"""Commands remembered, in frames."""

MAX_EPOCHS = 8
"""Exposures that a loop can be made for."""


class Verdict(enum.IntEnum):
    """How a frame was answered; the constants of msgs_schema/msg/DmCommand."""

    OK = 0
    OPEN = 1
    HOLD_NONFINITE = 2
    HOLD_INCOMPLETE = 3
    HOLD_MISSING = 4
    HOLD_BEHIND = 5
    HOLD_HISTORY = 6
    HOLD_CLOSED = 7


class LoopState(enum.IntEnum):
    """The constants of msgs_schema/msg/HrtcEvent."""

    OPEN = 0
    CLOSED = 1
    FLAT = 2


@dataclass(frozen=True, eq=False)
class Settings:
    """What an operator sets. Immutable; arrays must not be written to.

    Attributes:
        id: travels in every command.
        polc: pseudo-open-loop control; otherwise a classical leaky integrator.
        leak: per frame, 0 <= leak < 1.
        relaxation: share of the state that an open loop drops each frame, 0 < relaxation <= 1.
        command_limit: m of wavefront, on top of each reconstructor's own limits.
        slew_limit: m that a command may change in a frame; 0: any.
        rms_limit: m, of all commands of a frame: a larger command is scaled down to it, its shape kept; 0: any.
        gain_ramp: frames in which the gain rises to its value once the loop is closed; 0: at once.
        fault_budget: consecutive held frames after which the loop opens.
        watchdog: s without slopes after which a closed loop opens, at least 0.1; 0: never.
        offset: (n_commands,) m of wavefront.
        tip_tilt_gain, tip_tilt_leak: of tip-tilt's own loop, per frame of its own, where there is one.
        slope_reference: (n_slopes,) rad; ``-G offset`` for a wanted static shape, 0 for an aberration to be corrected.
        closed_sensors: bit w set: sensor w is closed.
    """

    id: int
    offset: Floats
    slope_reference: Floats
    polc: bool = True
    leak: float = 0.0
    relaxation: float = 0.1
    command_limit: float = math.inf
    slew_limit: float = 0.0
    rms_limit: float = 0.0
    gain_ramp: int = 0
    fault_budget: int = 50
    watchdog: float = 0.0
    tip_tilt_gain: float = 0.0
    tip_tilt_leak: float = 0.0
    closed_sensors: int = 0

    def __post_init__(self) -> None:
        # as they travel in events: a replay must compute with the same numbers
        for name in (
            "leak", "relaxation", "command_limit", "slew_limit", "rms_limit", "watchdog", "tip_tilt_gain",
            "tip_tilt_leak",
        ):  # fmt: skip
            object.__setattr__(self, name, float(np.float32(getattr(self, name))))


class Matrices:
    """R and Q for one exposure, in tiles (:func:`srtomo_rtc.vmm.tiled`).

    Attributes:
        sensors: bit w set: sensor w is used; of the others there are no columns in the tiles.
        R_tiles: of each sensor, its columns sub-aperture by sub-aperture: x, then y; 16-bit integers for kernel int16;
            none for kernel tlr.
        R_scales: of each sensor, (n_rows of the tiles,) what its integers are in m/rad; None but for kernel int16.
        factors: R for kernel tlr.
        Q_tiles: its columns command by command.
    """

    def __init__(self, layout: Layout, kernel: str = "float32", sensors: int = -1) -> None:
        n_rows = rows_of(layout.n_commands)
        kind: type = np.int16 if kernel == "int16" else np.float32
        self._n_commands = layout.n_commands
        self._counts = tuple(sensor.n_slopes for sensor in layout.sensors)
        self.sensors = sensors & (1 << len(self._counts)) - 1
        in_tiles = self.sensors if kernel != "tlr" else 0
        self.R_tiles = tuple(
            huge_zeros(tiles_shape(layout.n_commands, n if in_tiles >> w & 1 else 0, kind), kind)
            for w, n in enumerate(self._counts)
        )
        self.factors: Factors | None = None
        self.R_scales = tuple(np.ones(n_rows, np.float32) for _ in layout.sensors) if kernel == "int16" else None
        self.Q_tiles = huge_zeros(tiles_shape(layout.n_commands, layout.n_commands, np.float32), np.float32)

    def fill(self, R: Floats, Q: Floats, factors: Factors | None = None) -> None:
        """Copy R (n_commands, n_slopes) and Q in; for kernel tlr keep R's factors instead of R.

        Raises:
            ValueError: R cannot be held in 16 bits.
        """
        self.factors = factors
        for w, columns in self._used() if factors is None else ():
            n, tiles = self._counts[w], self.R_tiles[w]
            own: NDArray[Any] = R[:, columns].reshape(len(R), 2, -1).transpose(0, 2, 1).reshape(len(R), n)
            if self.R_scales is not None:
                own, self.R_scales[w][: len(R)] = quantise(own)
            tiled(own, tiles)
        tiled(Q, self.Q_tiles)

    def _used(self) -> Iterator[tuple[int, slice]]:
        """The sensors that are used, each with its columns of R."""
        start = 0
        for w, n in enumerate(self._counts):
            if self.sensors >> w & 1:
                yield w, slice(start, start + n)
            start += n

    @property
    def R(self) -> Floats:
        """(n_commands, n_slopes) as it is applied, a copy."""
        if self.factors is not None:
            return self.factors.applied()
        m = self._n_commands
        R = np.zeros((m, sum(self._counts)), np.float32)
        for w, columns in self._used():
            matrix = untiled(self.R_tiles[w], m) * (1 if self.R_scales is None else self.R_scales[w][:m, None])
            R[:, columns] = matrix.reshape(m, -1, 2).transpose(0, 2, 1).reshape(m, -1)
        return R

    @property
    def Q(self) -> Floats:
        """(n_commands, n_commands), a copy."""
        return untiled(self.Q_tiles, self._n_commands)

    def times(self, slopes: Floats) -> Floats:
        """``R slopes``, sensor by sensor; a new array with the tiles' rows."""
        if self.factors is not None:
            return self.factors.times(slopes)
        out = np.zeros(rows_of(self._n_commands), np.float32)
        part = np.empty_like(out)
        for w, columns in self._used():
            own = slopes[columns]
            multiply(self.R_tiles[w], np.ascontiguousarray(own.reshape(2, -1).T).ravel(), part)
            out += part if self.R_scales is None else part * self.R_scales[w]
        return out

    @property
    def memory(self) -> tuple[NDArray[Any], ...]:
        """All that a product reads."""
        factors = self.factors.sensors if self.factors is not None else ()
        return *self.R_tiles, self.Q_tiles, *(array for sensor in factors for array in sensor.memory)

    def warm(self) -> None:
        """Touch every byte."""
        self.times(np.zeros(sum(self._counts), np.float32))
        multiply(self.Q_tiles, np.zeros(self._n_commands, np.float32), np.empty(rows_of(self._n_commands), np.float32))

    def native(self) -> native.Matrices:
        """For the frame path; valid as long as this object."""
        made = native.Matrices(Q=self.Q_tiles.ctypes.data)
        if self.factors is not None:
            made.low_rank, made.rows = self.factors.native, self.factors.rows.ctypes.data
            for w, one in enumerate(self.factors.sensors):
                made.R_scales[w] = one.scales.ctypes.data
        for w, tiles in enumerate(self.R_tiles):
            made.R[w] = tiles.ctypes.data
            if self.R_scales is not None:
                made.R_scales[w] = self.R_scales[w].ctypes.data
        return made


def star_weights(layout: Layout, R: Floats) -> Floats:
    """(n_sensors,) of each of tip-tilt's own stars in the mean of them that R_t takes; 0 for other sensors.

    A star's columns are its weight times a rotation of what all have in common, for the mean of its sub-apertures:
    their length tells the weight. Exactly rounded sums give the same bits on every machine.
    """
    lengths = np.zeros(len(layout.sensors))
    for w in layout.tip_tilt_sensors:
        squares = R[:, layout.slopes_of(w)].astype(np.float64) ** 2
        lengths[w] = math.sqrt(layout.sensors[w].n_valid * math.fsum(squares.flat))
    total = math.fsum(lengths)
    return (lengths / total if total else lengths).astype(np.float32)


def used_by(R: Floats, layout: Layout) -> int:
    """Bit w set: R (n_commands, n_slopes) uses sensor w."""
    return sum(1 << w for w in range(len(layout.sensors)) if R[:, layout.slopes_of(w)].any())


class Slot:
    """Memory for one reconstructor. Made once, filled off the loop.

    Attributes:
        kernel: float32, int16 or tlr.
        kernel_name: as in events; for tlr once it is filled.
        n_epochs: of the reconstructor in it.
        epochs: matrices of each epoch that there is room for, the newest exposure first.
        fallback: for the newest exposure alone; the first epoch's where there is room for no more.
        closures: for the newest exposure alone, by the sensors that are closed. Their room is made when it is needed
            first, and kept.
        low_order: of natural stars, or None.
        star_weights: (n_sensors,) :func:`star_weights` of it.
    """

    def __init__(self, layout: Layout, max_epochs: int = 1, kernel: str = "float32") -> None:
        m = layout.n_commands
        self.kernel = kernel
        self.kernel_name = KERNELS[kernel]
        self.n_epochs = 1
        self.epochs = tuple(Matrices(layout, kernel) for _ in range(max_epochs))
        self.fallback = Matrices(layout, kernel) if max_epochs > 1 else self.epochs[0]
        self.closures: dict[int, Matrices] = {}
        self.low_order: Matrices | None = None
        self.slope_reference = np.zeros(layout.n_slopes, np.float32)
        self.command_limit = np.zeros(m, np.float32)
        self.star_weights = np.zeros(len(layout.sensors), np.float32)
        self._layout = layout
        self.gain = 0.0
        self.id = 0
        self.sha256 = bytes(32)

    def fill(self, reconstructor: Reconstructor, factors: Sequence[Factors] = ()) -> None:
        """Copy a checked reconstructor in. Not on the loop's thread, and never into a slot in use.

        Args:
            factors: of each of its epochs and of its fallback, for kernel tlr.

        Raises:
            ValueError: it has more epochs than there is room for, or cannot be held in 16 bits.
        """
        if reconstructor.n_epochs > len(self.epochs):
            raise ValueError(f"uses {reconstructor.n_epochs} exposures; there is room for {len(self.epochs)}")
        self.n_epochs = reconstructor.n_epochs
        parts = reconstructor.parts[: n_parts(self.n_epochs)]
        targets = (*self.epochs[: self.n_epochs], self.fallback)[: len(parts)]
        each: Sequence[Factors | None] = factors or [None] * len(parts)
        for matrices, (R, Q), own in zip(targets, parts, each, strict=True):
            matrices.fill(R, Q, own)
        self.kernel_name = "-".join([KERNELS[self.kernel], *(own.digest().hex()[:16] for own in factors)])
        self._fill_closures(reconstructor)
        self.slope_reference[:] = reconstructor.slope_reference
        self.command_limit[:] = reconstructor.command_limit
        self.star_weights[:] = star_weights(self._layout, parts[-1][0])
        self.gain = reconstructor.gain
        self.sha256 = reconstructor.sha256
        self.id = reconstructor.id

    def divided(self, slope_reference: Floats) -> tuple[Floats, Floats]:
        """A slope reference (n_slopes,) for the high orders, and that for tip-tilt's own stars, x0 y0 x1 y1 ...."""
        high, stars = slope_reference.copy(), np.zeros_like(slope_reference)
        for own in map(self._layout.slopes_of, self._layout.tip_tilt_sensors):
            stars[own] = slope_reference[own].reshape(2, -1).T.ravel()
            high[own] = 0
        return high, stars

    def _fill_closures(self, reconstructor: Reconstructor) -> None:
        kernel = "float32" if self.kernel == "tlr" else self.kernel
        room, self.closures = self.closures, {}
        for closure in reconstructor.closures:
            matrices = room.get(closure.sensors) or Matrices(self._layout, kernel, ~closure.sensors)
            matrices.fill(closure.R, closure.Q)
            self.closures[closure.sensors] = matrices
        self.low_order = None
        if reconstructor.low_order is not None:
            R = reconstructor.low_order.R
            self.low_order = Matrices(self._layout, kernel, used_by(R, self._layout))
            self.low_order.fill(R, np.zeros_like(reconstructor.Q[0]))


_tokens = itertools.count(1)


def _padded(values: Floats, n_rows: int) -> Floats:
    """With zeros for the tiles' rows that no command has."""
    return np.concatenate([values, np.zeros(n_rows - len(values), np.float32)]).astype(np.float32)


class Program:
    """A slot under settings, ready to run: the one object that the loop reads once a frame.

    Immutable; made off the loop, so that nothing is computed or allocated when it is taken up.

    Attributes:
        token: names it in the frame path.
        native: the frame path's; the slot's memory and this object's.
        acts: what makes the commands, for people.
    """

    def __init__(self, slot: Slot, settings: Settings) -> None:
        self.slot = slot
        self.settings = settings
        self.token = next(_tokens)
        epochs = slot.epochs[: slot.n_epochs]
        alone = slot.fallback if slot.n_epochs > 1 else epochs[0]
        closed, polc, keep, held = settings.closed_sensors, settings.polc, 1.0 - settings.leak, False
        self.acts = "all sensors"
        if closed in slot.closures:
            self.acts = "the reconstructor without these"
            alone = slot.closures[closed]
            epochs = (alone,)
        elif closed and slot.low_order is not None and not slot.low_order.sensors & closed:
            self.acts = "natural stars' low orders, while high orders are held"
            alone = slot.low_order
            epochs, polc, keep = (alone,), False, 1.0
        elif closed:
            self.acts = "nothing: they are held"
            epochs, held = (alone,), True
        sensors = alone.sensors & ~closed
        whole_reference = settings.slope_reference + slot.slope_reference
        slope_reference, star_reference = slot.divided(whole_reference)
        alone_reference = alone.times(slope_reference)
        n_rows = len(alone_reference)
        reference = np.zeros_like(alone_reference)
        for part in epochs:
            reference += part.times(slope_reference)
        limit = np.minimum(slot.command_limit, np.float32(settings.command_limit))
        self._matrices = {alone, *epochs}
        self._held = (
            _padded(settings.offset, n_rows),
            _padded(limit, n_rows),
            reference,
            alone_reference,
            star_reference,
            (native.Matrices * len(epochs))(*(part.native() for part in epochs)),
            alone.native(),
        )
        offset, limits, all_epochs, one, stars, *matrices = self._held
        self.native = native.Program(
            self.token,
            slot.id,
            settings.id,
            settings.fault_budget,
            len(epochs),
            polc,
            sensors,
            held,
            settings.gain_ramp,
            slot.gain,
            keep * (1.0 - slot.gain) if polc else keep,
            settings.relaxation,
            keep,
            settings.slew_limit or math.inf,
            settings.rms_limit or math.inf,
            int(settings.watchdog * 1e9),
            *(vector.ctypes.data for vector in (offset, limits, all_epochs, one)),
            matrices[0],
            ctypes.pointer(matrices[1]),
            native.TipTiltLaw(
                settings.tip_tilt_gain,
                1.0 - settings.tip_tilt_leak,
                (ctypes.c_float * native.MAX_SENSORS)(*slot.star_weights),
                stars.ctypes.data,
            ),
        )

    def warm(self) -> None:
        """Touch every byte that a frame reads: the first product with a cold matrix takes 2-3 times as long."""
        for matrices in self._matrices:
            matrices.warm()


_REMEMBERED = 264  # programs that a change or snapshot which nobody has taken yet may name


class Owner:
    """What the library allocated, given back when nothing here uses it any more."""

    def __init__(self, pointer: Any, free: Callable[[Any], None], what: str) -> None:
        if not pointer:
            raise MemoryError(what)
        self.pointer = pointer
        weakref.finalize(self, free, pointer).atexit = False


def check_size(layout: Layout, delay: float, max_epochs: int) -> tuple[Any, int, int, float, int, int]:
    """What the library makes a loop from.

    Raises:
        ValueError: the frame path is not made for that.
    """
    if not 1 <= delay < HISTORY - 1 - MAX_EPOCHS:
        raise ValueError(f"delay: expected 1 to {HISTORY - 2 - MAX_EPOCHS} frames, got {delay}")
    if not 1 <= max_epochs <= MAX_EPOCHS:
        raise ValueError(f"epochs: expected 1 to {MAX_EPOCHS}, got {max_epochs}")
    n = len(layout.sensors)
    if n > native.MAX_SENSORS:
        raise ValueError(f"sensors: expected at most {native.MAX_SENSORS}, got {n}")
    counts = (ctypes.c_uint32 * n)(*(sensor.n_valid for sensor in layout.sensors))
    return counts, n, layout.n_commands, delay, max_epochs, sum(1 << w for w in layout.tip_tilt_sensors)


class Loop:
    """State, history and control law of one instrument. See the module's head for the law and the threads.

    A frame is: :meth:`add` for each sensor, then :meth:`answer`; or :meth:`hold`. Then ``command``, ``verdict`` and the
    other public attributes describe the answer, and once it is out, :meth:`prepare` gets ready for the next.

    Attributes:
        command: (n_commands,) the last answer m, m of wavefront.
        state: (n_commands,) u after it.
        tip_tilt: (n_commands,) t after it, m of wavefront.
        max_epochs: exposures that a reconstructor may use.
    """

    def __init__(self, layout: Layout, delay: float, max_epochs: int = 1, gate: Owner | None = None) -> None:
        """Allocate everything.

        Args:
            delay: mid-exposure to mid-command, frames, at least 1.
            max_epochs: exposures that a reconstructor may use, 1 to :data:`MAX_EPOCHS`.
            gate: the frame gate that this is the loop of; it has made it.
        """
        made = gate
        if made is None:
            made = Owner(lib.srt_loop_new(*check_size(layout, delay, max_epochs)), lib.srt_loop_free, "loop")
        self._owner = made
        self._pointer = made.pointer if gate is None else made.pointer.contents.loop
        self._c = c = self._pointer.contents
        self.delay = float(np.float32(delay))  # as it travels in events
        self.max_epochs = max_epochs
        self.n_sensors, self.all_sensors = int(c.n_sensors), int(c.all_sensors)
        self._n_slopes = layout.n_slopes
        m, n_rows = layout.n_commands, int(c.n_rows)
        self._counts = tuple(sensor.n_slopes for sensor in layout.sensors)
        self.command: Floats = native.view(made, c.command, (n_rows,))[:m]
        self.state: Floats = native.view(made, c.state, (n_rows,))[:m]
        self.tip_tilt: Floats = native.view(made, c.tip_tilt.command, (n_rows,))[:m]
        self._history: Floats = native.view(made, c.history, (HISTORY, n_rows))[:, :m]
        self._programs: dict[int, Program] = {}

    # -- for any thread to look at ----------------------------------------------------------------------------------

    @property
    def frame(self) -> int:
        """The next frame to answer."""
        return int(self._c.frame)

    @property
    def first_frame(self) -> int:
        """The session's first frame."""
        return int(self._c.first_frame)

    @property
    def answered(self) -> int:
        """The last frame answered; -1: none."""
        return int(self._c.answered)

    @property
    def sensors(self) -> int:
        """Bit w set once sensor w was added to the next frame."""
        return int(self._c.sensors)

    @property
    def tip_tilt_frame(self) -> int:
        """The newest of tip-tilt's own frames in the last answer; -1: none."""
        return int(self._c.tip_tilt.frame)

    @property
    def tip_tilt_counts(self) -> dict[str, int]:
        """Of tip-tilt's own frames, since the loop was made: ``frames``, ``partial``, ``held`` and ``skipped``, as
        HrtcStatus has them."""
        return {name: int(getattr(self._c.tip_tilt, name)) for name in native.TIP_TILT_COUNTERS}

    @property
    def used(self) -> int:
        """The sensors that had come when the last frame was answered, closed ones left out, and those of tip-tilt's own
        that it took in."""
        return int(self._c.used)

    @property
    def wanted(self) -> int:
        """The sensors that the next frame is made from."""
        return int(self._c.wanted)

    @property
    def closed(self) -> bool:
        """Whether the loop is closed for the next frame."""
        return bool(self._c.closed)

    @property
    def loop_state(self) -> LoopState:
        """``closed``, and else whether the loop relaxes or is held flat."""
        return LoopState.CLOSED if self._c.closed else LoopState.FLAT if self._c.held_flat else LoopState.OPEN

    @property
    def frames_closed(self) -> int:
        """Answered since the loop was closed."""
        return int(self._c.frames_closed)

    @property
    def gain(self) -> float:
        """Of the next frame, if the loop is closed."""
        return float(self._c.gain)

    @property
    def verdict(self) -> Verdict:
        """Of the last answer."""
        return Verdict(self._c.verdict)

    @property
    def n_clipped(self) -> int:
        """Of the last answer, as in DmCommand."""
        return int(self._c.n_clipped)

    @property
    def n_slewed(self) -> int:
        """Actuators of the last answer that the slew limit kept behind."""
        return int(self._c.n_slewed)

    @property
    def scaled(self) -> bool:
        """Whether the last answer was scaled down to ``rms_limit``."""
        return bool(self._c.scaled)

    @property
    def mirror_frame(self) -> int:
        """Of the last answer, as in DmCommand; so are the next two."""
        return int(self._c.mirror_frame)

    @property
    def mirror_frame_before(self) -> int:
        """See ``mirror_frame``."""
        return int(self._c.mirror_frame_before)

    @property
    def mirror_fraction(self) -> float:
        """See ``mirror_frame``."""
        return float(self._c.mirror_fraction)

    @property
    def consecutive_holds(self) -> int:
        """Frames held in a row."""
        return int(self._c.consecutive_holds)

    @property
    def opened_by_faults(self) -> int:
        """How often the loop opened because more frames in a row were held than the budget allows."""
        return int(self._c.opened_by_faults)

    @property
    def opened_by_silence(self) -> int:
        """How often the loop opened because no slopes came for longer than the watchdog allows."""
        return int(self._c.opened_by_silence)

    @property
    def program(self) -> Program | None:
        """What the next frame is made with; None before the first one."""
        return self.program_named(self._c.token)

    def program_named(self, token: int) -> Program | None:
        """A program that was posted not long ago."""
        return self._programs.get(token)

    @property
    def pending(self) -> bool:
        """Whether something was posted or requested that the next :meth:`prepare` would take up."""
        return bool(lib.srt_loop_pending(self._pointer))

    # -- from any thread, one at a time -----------------------------------------------------------------------------

    def post(self, program: Program) -> None:
        """Use ``program`` from the next frame that :meth:`prepare` prepares: one pointer is stored.

        Raises:
            ValueError: it uses more exposures than the loop remembers.
        """
        if program.slot.n_epochs > self.max_epochs:
            raise ValueError(f"uses {program.slot.n_epochs} exposures; this loop takes {self.max_epochs}")
        self._programs[program.token] = program
        lib.srt_loop_post(self._pointer, program.native)
        for token in list(self._programs)[:-_REMEMBERED]:
            if token != self._c.token:
                del self._programs[token]

    def request(self, closed: bool) -> None:
        """Close or open the loop from the next frame that is prepared: one flag is stored."""
        self.request_state(LoopState.CLOSED if closed else LoopState.OPEN)

    def request_state(self, state: LoopState) -> None:
        """The same; FLAT opens the loop and puts the offset on without relaxing, as fast as the slew limit lets."""
        lib.srt_loop_request(self._pointer, state)

    def use(self, crew: Crew | None) -> None:
        """Share the products with a crew, which must stay open until this was called again; None: with nobody. While
        the loop's thread does not run."""
        lib.srt_loop_use(self._pointer, None if crew is None else crew.pointer)

    # -- from the loop's thread -------------------------------------------------------------------------------------

    def start(self, frame: int, state: LoopState = LoopState.OPEN) -> None:
        """Begin a session at ``frame``: the mirror is taken to be flat until commands say otherwise.

        What was posted waits for the next :meth:`prepare`.
        """
        lib.srt_loop_start(self._pointer, frame, state)

    def resume(
        self,
        frame: int,
        first_frame: int,
        state: Floats,
        history: Floats,
        loop_state: LoopState,
        consecutive_holds: int,
        frames_closed: int,
        exposures: Mapping[int, tuple[Sequence[Floats], tuple[int, int, float]]] | None = None,
        tip_tilt: tuple[int, Floats] | None = None,
    ) -> None:
        """Continue after ``frame`` with a recorded state. Not while running.

        Args:
            history: the commands up to that of ``frame``, the last row.
            exposures: of earlier frames that were answered OK, by frame: the slopes of each sensor, and what was on the
                mirror, as in DmCommand. Of more than ``max_epochs - 1`` only the newest matter.
            tip_tilt: of its own loop, the newest frame and t (n_commands,).
        """
        self.start(first_frame, loop_state)
        self._c.frame = frame + 1
        self._c.consecutive_holds = consecutive_holds
        self._c.frames_closed = frames_closed
        self.state[:] = state
        if tip_tilt is not None:
            self._c.tip_tilt.frame, self.tip_tilt[:] = tip_tilt
        for row, command in enumerate(history[-HISTORY:], start=frame + 1 - len(history[-HISTORY:])):
            self._history[row % HISTORY] = command
        for earlier, (slopes, mirror) in (exposures or {}).items():
            if frame - self.max_epochs < earlier <= frame:
                values = np.concatenate(slopes).astype(np.float32)
                lib.srt_loop_remember(self._pointer, earlier, values.ctypes.data, *mirror)
        self.prepare()

    def prepare(self) -> None:
        """Take up what was posted or requested, and form c for the next frame, supposing its command was in time.

        Sensors that were added to the frame already have to be added again.
        """
        lib.srt_loop_prepare(self._pointer)

    def add(self, sensor: int, slopes: Floats) -> None:
        """Take the slopes (n_slopes_w,) of one of the high orders' sensors and form their product; they are copied.

        Those of a closed sensor are ignored.
        """
        if not self.all_sensors >> sensor & 1:
            raise ValueError(f"sensor {sensor}: its star is one of tip-tilt's own loop")
        values = np.ascontiguousarray(slopes, np.float32)
        if values.shape != (self._counts[sensor],):
            raise ValueError(f"sensor {sensor}: expected {self._counts[sensor]} slopes, got shape {values.shape}")
        lib.srt_loop_add(self._pointer, sensor, values.ctypes.data)

    def give_tip_tilt(self, frame: int, sensors: int, slopes: Floats) -> None:
        """Have the next answer take one of tip-tilt's own frames in, unless the loop is open; as the frame gate does.

        Args:
            sensors: bit w set: sensor w is one of its stars, and came with finite slopes.
            slopes: (n_slopes,) of which those stars' count, rad.
        """
        values = np.ascontiguousarray(slopes, np.float32)
        if values.shape != (self._n_slopes,):
            raise ValueError(f"expected {self._n_slopes} slopes, got shape {values.shape}")
        lib.srt_tip_tilt_give(self._pointer, frame, sensors & self._c.tip_tilt.sensors, values.ctypes.data)

    def answer(self, mirror_frame: int, mirror_frame_before: int, mirror_fraction: float) -> Verdict:
        """Answer a frame whose sensors were all added, closed ones or not; the arguments are SlopeFrame's."""
        assert self.sensors == self.wanted
        return Verdict(lib.srt_loop_answer(self._pointer, mirror_frame, mirror_frame_before, mirror_fraction))

    def hold(self, verdict: Verdict) -> Verdict:
        """Answer a frame without using its slopes: the state is kept (an open loop relaxes on)."""
        return Verdict(lib.srt_loop_hold(self._pointer, verdict))

    def flatten(self) -> Verdict:
        """Answer a frame with the offset alone, whatever came of its slopes and however far the mirror has to go."""
        return Verdict(lib.srt_loop_flatten(self._pointer))

    def history(self, frames: int) -> Floats:
        """The last commands, (n, n_commands) with n <= ``frames``, oldest first. A copy: not for the hot path.

        From another thread a command that is just being made may be in place of the oldest.
        """
        n = min(frames, HISTORY, self.frame - self.first_frame)
        rows: Sequence[int] = [(self.frame - n + i) % HISTORY for i in range(n)]
        return self._history[rows].copy()
