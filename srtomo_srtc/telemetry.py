"""Second moments of pseudo-open-loop slopes, from the messages of a running or recorded loop, in bounded memory.

    s[k] = P (y[k] + G m~[k])

y are the slopes as measured, m~ what was on the mirrors in that exposure, whatever the loop made of it: open, held,
clipped or offset. P takes the blind modes of each sensor out.

The window is a ring of blocks of equal time, and a block a few stretches. Of every stretch the last part is held out,
for models to be judged by frames that they were not fitted to: of a window by blocks, the latest ones by stretches.
Blocks leave the window as frames are answered and time passes, whether new ones count or not. Every q-th exposure
counts: successive frames say nearly the same of the turbulence, and noise is learned from few.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import sgemm, ssyrk

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_core.wire import DmCommand, SlopeFrame
from srtomo_srtc.matching import Matched, Matcher, Tally
from srtomo_srtc.memory import require
from srtomo_srtc.model import blind_modes, layout_of

Floats = NDArray[np.float32]

WINDOW = 16.0
"""s of a window by default."""

BLOCKS = 8
"""Blocks of a window by default."""

STRETCHES = 2
"""Of a block. Of as many stretches as a window has blocks the latest held-out frames are: enough for a jackknife."""

COUNTED_RATE = 125.0
"""Hz: frames that count, by default; of a slower loop every one."""

HELD_OUT = 0.2
"""Share of every block that is held out."""

_BATCH = 256  # rows that become pseudo-open-loop slopes at a time: enough for products to run at full speed


class NoWindow(ValueError):
    """There is no window to learn from; the text says why.

    Attributes:
        session: the current one, 0 before any.
        frame: the newest of it that was answered, or -1.
    """

    def __init__(self, reason: str, session: int, frame: int) -> None:
        super().__init__(reason)
        self.session = session
        self.frame = frame


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Whole frames that are in no moment, so that a model fitted to those can be judged.

    Runs of successive counted frames, one run a stretch; oldest first.

    Attributes:
        slopes: (n_held, n_slopes) pseudo-open-loop slopes without blind modes, P (y + G m~), rad.
        measured: (n_held, n_slopes) slopes as measured, without blind modes, P y, rad.
        frames: (n_held,) exposure numbers.
        block: (n_held,) index, ascending from 0, of the part of the window that each belongs to: what a jackknife
            leaves out.
        reconstructor: (n_held,) id of the reconstructor that answered the exposure; 0 when none was active, or the loop
            open.
    """

    slopes: NDArray[np.float32]
    measured: NDArray[np.float32]
    frames: NDArray[np.int64]
    block: NDArray[np.intp]
    reconstructor: NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class Statistics:
    """First and second moments of pseudo-open-loop slopes ``s = P (y + G m~)`` over a window.

    P takes the blind modes (a laser star's tip-tilt) out of each frame; m~ is what was on the mirrors in the exposure.

    Attributes:
        covariance: (n_slopes, n_slopes) about ``mean``, divided by the number of frames, rad^2.
        mean: (n_slopes,) rad. ``covariance + outer(mean, mean)`` is the second moment about zero.
        n_frames: how many.
        interval: s between counted frames (they may be every q-th exposure).
        duration: s from the window's first counted frame to its last.
        lagged: lag in exposures to (n_slopes, n_slopes) <s[k] s[k-lag]^T> about ``mean``, rad^2.
        lagged_frames: lag to the number of pairs in it.
        held_out: frames that are in none of these.
        session, first_frame, last_frame: the exposures that the window spans.
    """

    covariance: NDArray[np.float32]
    mean: NDArray[np.float64]
    n_frames: int
    interval: float
    duration: float
    lagged: Mapping[int, NDArray[np.float32]]
    lagged_frames: Mapping[int, int]
    held_out: HeldOut
    session: int
    first_frame: int
    last_frame: int


@dataclass(frozen=True, eq=False)
class Recent:
    """The latest held-out frames, for what cannot wait for a window; there may be none.

    Attributes:
        held_out: of the last half window; its blocks are stretches.
        session, first_frame, last_frame: the exposures that they span; -1 without any.
    """

    held_out: HeldOut
    session: int
    first_frame: int
    last_frame: int


class _Block:
    """Running sums of one stretch of the window; matrices in Fortran order, of squares the upper triangle."""

    def __init__(self, index: int, n_slopes: int, lags: Sequence[int]) -> None:
        self.index = index
        self.n_frames = 0
        self.sum = np.zeros(n_slopes)
        self.squares = np.zeros((n_slopes, n_slopes), np.float32, order="F")
        self.lagged = {lag: np.zeros((n_slopes, n_slopes), np.float32, order="F") for lag in lags}
        self.lagged_frames = dict.fromkeys(lags, 0)
        self.held_out: list[tuple[Floats, Floats, NDArray[np.int64], NDArray[np.uint64]]] = []
        self.first_frame = self.last_frame = -1

    def add(self, rows: Floats) -> None:
        """Count frames (n, n_slopes)."""
        self.n_frames += len(rows)
        self.sum += rows.sum(axis=0, dtype=np.float64)
        self.squares = ssyrk(1.0, rows.T, beta=1.0, c=self.squares, overwrite_c=1)

    def add_lagged(self, lag: int, rows: Floats, earlier: Floats) -> None:
        """Count pairs, (n, n_slopes) each."""
        self.lagged_frames[lag] += len(rows)
        self.lagged[lag] = sgemm(1.0, rows.T, earlier.T, beta=1.0, c=self.lagged[lag], trans_b=1, overwrite_c=1)


def _pooled(sums: list[Floats], n_frames: int, mean: NDArray[np.float64]) -> Floats:
    """Second moment about the mean, from blocks' sums of products; with memory for the result alone."""
    moment = np.zeros_like(sums[0])
    for products in sums:
        moment += products
    moment /= np.float32(n_frames)
    for j, one in enumerate(mean):
        moment[:, j] -= (mean * one).astype(np.float32)
    return moment


def _mirrored(upper: Floats) -> Floats:
    """Itself, with the upper triangle in the lower one's place as well."""
    for j in range(1, len(upper)):
        upper[j, :j] = upper[:j, j]
    return upper


def _ranks(labels: NDArray[np.int64]) -> NDArray[np.intp]:
    """Which of the different labels each is, from 0."""
    return np.asarray(np.unique(labels, return_inverse=True)[1], np.intp)


class Telemetry:
    """Accumulates :class:`Statistics` from SlopeFrames and DmCommands. One thread calls everything.

    Memory: ``4 n_slopes^2`` bytes a block, the one being filled included, and as many for each lag in it; once more for
    the window's moments when they are asked for; and some for batches and held-out frames.

    Attributes:
        every: exposures from one counted frame to the next.
        tally: what became of the frames asked for; :class:`Tally`.
    """

    def __init__(
        self,
        system: System,
        G: NDArray[np.floating],
        *,
        layout: Layout | None = None,
        window: float = WINDOW,
        blocks: int = BLOCKS,
        every: int | None = None,
        lags: Sequence[int] = (),
        held_out: float = HELD_OUT,
    ) -> None:
        """Begin with an empty window.

        Args:
            G: (n_slopes, n_commands) the calibrated interaction matrix, rad/m.
            layout: of the slopes and commands; as in the system when not given.
            window: s.
            blocks: that the window consists of.
            every: exposures from one counted frame to the next; by default what makes :data:`COUNTED_RATE`.
            lags: in exposures, at which lagged moments are formed.
            held_out: share of every stretch that is held out, 0 for none.

        Raises:
            ValueError: G is of another instrument, or a block is too short for some counted frames.
            MemoryError: one line, before any work, if there is not enough.
        """
        layout = layout_of(system, layout)
        if G.shape != (layout.n_slopes, layout.n_commands):
            raise ValueError(f"G: expected shape ({layout.n_slopes}, {layout.n_commands}), got {G.shape}")
        if blocks < 1 or any(lag < 1 for lag in lags) or not 0 <= held_out < 1:
            raise ValueError("blocks and lags: expected at least 1; held_out: expected 0 to less than 1")
        rate = system.loop.rate
        self.every = max(1, round(rate / COUNTED_RATE)) if every is None else every
        # counted frames, held-out ones included
        self._stretch_length = round(window * rate / blocks / STRETCHES / self.every)
        self._block_length = STRETCHES * self._stretch_length
        self._fit_length = self._stretch_length - round(held_out * self._stretch_length)
        if self.every < 1 or self._fit_length < 2:
            raise ValueError(f"window: {window:g} s in {blocks} blocks leaves fewer than 2 counted frames a half block")
        self._lags = tuple(sorted(set(lags)))
        n, m = G.shape
        require(
            4.0 * n * n * (blocks + 2) * (1 + len(self._lags))
            + 16.0 * n * (self._block_length - STRETCHES * self._fit_length) * (blocks + 1)
            + 4.0 * (4 * n + m) * _BATCH,
            f"telemetry of {system.name}",
        )
        self._period = 1 / rate
        self._G_transposed = np.ascontiguousarray(G.T, np.float32)
        self._blind = np.ascontiguousarray(blind_modes(system, layout), np.float32)
        self._matcher = Matcher(layout, self._is_wanted)
        self._measured, self._mirror = np.empty((_BATCH, n), np.float32), np.empty((_BATCH, m), np.float32)
        self._n_blocks = blocks
        self._blocks: deque[_Block] = deque()  # the last one is being filled
        self._last = 0, -1  # session and frame that were put together
        self._tally_then = vars(self.tally).copy()
        self.restart()

    def restart(self) -> None:
        """Empty the window."""
        self._batch: list[Matched] = []
        self._tail = np.empty((0, len(self._blind)), np.float32)  # the last rows, for pairs at a lag
        self._tail_frames: list[int] = []
        self._blocks.clear()
        self._session = 0

    @property
    def tally(self) -> Tally:
        """What became of the frames asked for so far."""
        return self._matcher.tally

    @property
    def newest(self) -> tuple[int, int]:
        """The session that commands come for, and its newest frame that was answered; 0 and -1 before."""
        return self._matcher.session, self._matcher.newest

    def add_slopes(self, message: bytes | SlopeFrame) -> None:
        """Take a SlopeFrame, serialised or read."""
        self._matcher.add_slopes(message)

    def add_command(self, message: bytes | DmCommand) -> None:
        """Take a DmCommand, serialised or read. Once in a while this takes as long as a batch of frames."""
        self._matcher.add_command(message)
        self._take()

    def feed(self, bag: BagReader) -> None:
        """Take all slopes and commands of a bag.

        Raises:
            BagError: the bag holds none, or is damaged.
        """
        slopes, commands = bag.topic(wire.SLOPES.name), bag.topic(wire.COMMAND.name)
        for message in bag.messages(slopes, commands):
            (self.add_slopes if message.topic == slopes else self.add_command)(message.data)
        self._take(final=True)

    def age(self, idle: float = 0.0) -> None:
        """Drop what has left the window; to be called where time passes without commands.

        Args:
            idle: s since the last command came.
        """
        if self._session not in (0, self._matcher.session):
            self.restart()  # commands come for another session, of which no frame is put together yet
        frames = round(idle / self._period)
        if frames >= self._block_length * self.every:
            self._flush()  # or the batch would be counted when it is old
        self._drop(self._place(self._matcher.newest + frames)[0])

    def refusal(self, what: str) -> NoWindow:
        """Why there is no window, with what became of the frames since the last one that was put together.

        Args:
            what: is wrong, in few words.
        """
        tally, (session, newest), (last_session, last) = vars(self.tally), self.newest, self._last
        why = [
            f"{name.replace('_', ' ')} {count - self._tally_then[name]}"
            for name, count in tally.items()
            if count > self._tally_then[name] and name not in ("matched", "open", "held", "clipped", "sessions")
        ]
        where = f" in the last of {tally['sessions']} sessions" if tally["sessions"] > 1 else ""
        since = f"since frame {last}" if session and session == last_session else "so far"
        return NoWindow(f"telemetry: {what}{where}; {since}: {', '.join(why) or 'nothing came'}", session, newest)

    def statistics(self) -> Statistics:
        """The moments of the window as it stands.

        Raises:
            NoWindow: fewer than two frames were counted in it.
        """
        self._flush()
        self.age()
        blocks = [block for block in self._blocks if block.n_frames]
        n_frames = sum(block.n_frames for block in blocks)
        if n_frames < 2:
            raise self.refusal(f"expected at least 2 frames to count, got {n_frames}")
        mean = np.sum([block.sum for block in blocks], axis=0) / n_frames
        covariance = _mirrored(_pooled([block.squares for block in blocks], n_frames, mean))
        lagged: dict[int, NDArray[np.float32]] = {}
        lagged_frames: dict[int, int] = {}
        for lag in self._lags:
            pairs = sum(block.lagged_frames[lag] for block in blocks)
            if pairs:
                lagged_frames[lag] = pairs
                lagged[lag] = _pooled([block.lagged[lag] for block in blocks], pairs, mean)
        first, last = blocks[0].first_frame, blocks[-1].last_frame
        return Statistics(
            covariance,
            mean,
            n_frames,
            interval=self.every * self._period,
            duration=(last - first) * self._period,
            lagged=lagged,
            lagged_frames=lagged_frames,
            held_out=self._held_out(),
            session=self._session,
            first_frame=first,
            last_frame=last,
        )

    def recent(self) -> Recent:
        """The held-out frames of the last half window as it stands; in time and memory next to nothing."""
        self._flush()
        held = self._held_out(self._stretch(self._matcher.newest) + 1 - self._n_blocks)
        first, last = (int(held.frames[0]), int(held.frames[-1])) if len(held.frames) else (-1, -1)
        return Recent(held, self._session, first, last)

    def _held_out(self, since: int | None = None) -> HeldOut:
        """Of the window, by its blocks; or of the stretches from one on, by these."""
        n = len(self._blind)
        parts = [part for block in self._blocks for part in block.held_out]
        if since is not None:
            parts = [part for part in parts if self._stretch(part[2][-1]) >= since]
        if not parts:
            empty = np.empty((0, n), np.float32)
            parts = [(empty, empty, np.empty(0, np.int64), np.empty(0, np.uint64))]
        slopes, measured, frames, reconstructor = (np.concatenate(column) for column in zip(*parts, strict=True))
        stretch = self._stretch(frames)
        if since is None:
            return HeldOut(slopes, measured, frames, _ranks(stretch // STRETCHES), reconstructor)
        some = stretch >= since
        return HeldOut(slopes[some], measured[some], frames[some], _ranks(stretch[some]), reconstructor[some])

    # -- frames -----------------------------------------------------------------------------------------------------

    def _is_wanted(self, frame: int) -> bool:
        """Whether a frame counts, or is the earlier one of a pair."""
        return any((frame + lag) % self.every == 0 for lag in (0, *self._lags))

    def _stretch(self, frame: Any) -> Any:
        """The stretch that a frame is in, or frames are; every block begins with one."""
        return frame // self.every // self._stretch_length

    def _place(self, frame: int) -> tuple[int, bool]:
        """The block that a frame is in, and whether it is held out there."""
        stretch, place = divmod(frame // self.every, self._stretch_length)
        return stretch // STRETCHES, place >= self._fit_length

    def _take(self, final: bool = False) -> None:
        taken = self._matcher.take(final)
        for exposure in taken:
            if exposure.session != self._session:
                # frame numbers begin anew: the window does too
                self._flush()
                self.restart()
                self._session = exposure.session
            self._batch.append(exposure)
            if len(self._batch) == _BATCH:
                self._flush()
        if taken:
            self._last, self._tally_then = (taken[-1].session, taken[-1].frame), vars(self.tally).copy()

    def _flush(self) -> None:
        """Turn the batch into rows of pseudo-open-loop slopes, and count these."""
        batch, self._batch = self._batch, []
        if not batch:
            return
        measured, mirror = self._measured[: len(batch)], self._mirror[: len(batch)]
        for i, exposure in enumerate(batch):
            measured[i], mirror[i] = exposure.slopes, exposure.mirror
        slopes = self._seen(measured + mirror @ self._G_transposed)
        frames = [exposure.frame for exposure in batch]
        reconstructor = np.array([exposure.reconstructor if exposure.closed else 0 for exposure in batch], np.uint64)
        known = self._tail_frames + frames
        rows = np.concatenate([self._tail, slopes]) if self._lags else slopes
        row_of = {frame: i for i, frame in enumerate(known)}
        places = [self._place(frame) for frame in frames]
        counted = [frame % self.every == 0 for frame in frames]
        for index in sorted({block for (block, _), counts in zip(places, counted, strict=True) if counts}):
            block = self._block(index)
            here = [i for i, place in enumerate(places) if counted[i] and place[0] == index]
            fit = [i for i in here if not places[i][1]]
            held = [i for i in here if places[i][1]]
            if fit:
                block.add(slopes[fit])
                block.first_frame = frames[fit[0]] if block.first_frame < 0 else block.first_frame
                block.last_frame = frames[fit[-1]]
            if held:
                block.held_out.append(
                    (slopes[held], self._seen(measured[held]), np.array(frames)[held], reconstructor[held])
                )
            for lag in self._lags:
                # the earlier one of a pair must not be held out either
                pairs = [
                    (row_of[frames[i]], row_of[frames[i] - lag])
                    for i in fit
                    if frames[i] - lag in row_of and not self._place(frames[i] - lag)[1]
                ]
                if pairs:
                    now, earlier = np.array(pairs).T
                    block.add_lagged(lag, rows[now], rows[earlier])
        if self._lags:
            keep = [i for i, frame in enumerate(known) if frame > known[-1] - self._lags[-1]]
            self._tail, self._tail_frames = rows[keep], [known[i] for i in keep]

    def _seen(self, rows: Floats) -> Floats:
        """Rows without blind modes: each times P."""
        return np.asarray(rows - (rows @ self._blind) @ self._blind.T)

    def _block(self, index: int) -> _Block:
        if not self._blocks or self._blocks[-1].index != index:
            self._drop(index)
            self._blocks.append(_Block(index, len(self._blind), self._lags))
        return self._blocks[-1]

    def _drop(self, index: int) -> None:
        """Drop the blocks that have left a window whose block ``index`` is the one being filled."""
        while self._blocks and self._blocks[0].index < index - self._n_blocks:
            self._blocks.popleft()
