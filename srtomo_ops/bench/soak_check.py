"""Whether a recording holds what a soak sent, and commands that were each made by one reconstructor alone. No ROS.

Every command is computed anew in float64 from the recorded slopes, from the commands recorded before it, and from the
reconstructor that it names. Files of the bag are taken one after the other, so that each can be deleted when it was.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srtomo_core import wire
from srtomo_core.bag import BagMessage, BagReader
from srtomo_core.reconstructor import Reconstructor
from srtomo_ops.bench.soak_plan import SESSION, SKIPPED, Fault, Plan
from srtomo_rtc.loop import Verdict

Floats = NDArray[np.float64]

TOLERANCE = 1e-5
"""Of a command, of the largest of its frame: float32 leaves some 1e-6."""

_VERDICTS = {
    Fault.NONE: (Verdict.OK,),
    Fault.NONFINITE: (Verdict.HOLD_NONFINITE,),
    Fault.DUPLICATE: (Verdict.OK,),
    Fault.LATE: (Verdict.HOLD_MISSING,),
    # in time, if the loop takes all of both frames in one go
    Fault.OVERTAKEN: (Verdict.OK, Verdict.HOLD_MISSING, Verdict.HOLD_INCOMPLETE),
    Fault.NO_SENSOR: (Verdict.HOLD_INCOMPLETE,),
    Fault.NO_FRAME: (Verdict.HOLD_MISSING,),
    Fault.MALFORMED: (Verdict.HOLD_INCOMPLETE,),
    Fault.FOREIGN: (Verdict.HOLD_INCOMPLETE,),
}

_BLOCK = 1024  # commands that are computed at once
_LAG = 1024  # frames that the recording's order may be off by: while it changes from topics to ring its clock is two


class SoakError(ValueError):
    """Something that must not happen in a soak did; one line that says what and where."""


class Check:
    """Takes what was recorded, in order, then :meth:`finish`.

    Args:
        delay, leak: of the instrument's loop, which is closed from frame 0 on.
        reconstructors: all that may make a command.

    Attributes:
        frames: commands so far: each frame has had exactly one.
        error: largest difference between a command and its float64 counterpart, of the largest of its frame.
        swaps: first frame and id of each reconstructor, in order.
        verdicts: how often each was given.
        largest: of all commands, m.
    """

    def __init__(self, plan: Plan, delay: float, leak: float, reconstructors: Iterable[Reconstructor]) -> None:
        self._plan = plan
        self._known = {r.id: _Law(plan, r, leak) for r in reconstructors}
        self._whole = math.floor(delay)
        self._part = delay - self._whole
        n_commands = plan.layout.n_commands
        # the last commands of the block before; a flat mirror before frame 0
        self._past = np.zeros((self._whole + 1, n_commands))
        self._block: list[wire.DmCommand] = []
        self._copies: dict[int, NDArray[np.int64]] = {}
        self._early: dict[int, wire.DmCommand] = {}  # commands whose predecessors are yet to come
        self._next_whole = 0  # the next frame whose slopes are to be counted
        self.frames = 0
        self.error = 0.0
        self.largest = 0.0
        self.swaps: list[tuple[int, int]] = []
        self.verdicts: Counter[Verdict] = Counter()
        self._late = 0  # slope messages that came after the answer to their frame

    # -- what was recorded ------------------------------------------------------------------------------------------

    def read(self, file: Path) -> None:
        """Take the next file of the bag.

        Raises:
            SoakError: it is cut off, or something in it must not be.
        """
        with BagReader(file) as bag:
            if bag.cut:
                raise SoakError(bag.cut)
            topics = [name for name in bag.topics if name.endswith((wire.SLOPES.name, wire.COMMAND.name))]
            for message in bag.messages(*topics):
                self.take(message)

    def take(self, message: BagMessage) -> None:
        """Take the next message of slopes or commands.

        Raises:
            SoakError: it must not be, or not here.
        """
        if message.type == wire.COMMAND.type:
            command = wire.read_dm_command(message.data)
            if command.session != SESSION or command.frame < self.frames or command.frame in self._early:
                raise SoakError(f"a command for frame {command.frame} of session {command.session} too many")
            self._early[command.frame] = command
            while self.frames in self._early:
                self._take_command(self._early.pop(self.frames))
            if len(self._early) > _LAG:
                raise SoakError(f"frame {self.frames} has no command")
        else:
            self._take_slopes(message.data)

    def finish(self) -> None:
        """Check what is left, and that nothing is missing.

        Raises:
            SoakError: something is.
        """
        self._compute()
        if self.frames != self._plan.frames:
            raise SoakError(f"frame {self.frames} has no command")
        self._count_slopes(self._plan.frames)

    # -- slopes -----------------------------------------------------------------------------------------------------

    def _take_slopes(self, data: bytes) -> None:
        plan = self._plan
        try:
            slopes = wire.read_slope_frame(data)
        except wire.WireError:
            return  # the recorder counts them
        frame, sensor = slopes.frame, slopes.sensor
        if slopes.fingerprint != plan.layout.fingerprint:
            return
        if slopes.session != SESSION or not self._next_whole <= frame < plan.frames:
            raise SoakError(f"slopes of frame {frame}, session {slopes.session}, where nobody sent any")
        if slopes.slopes.tobytes() != plan.slopes(frame, sensor).tobytes():
            raise SoakError(f"frame {frame}: slopes of sensor {sensor} are not those that were sent")
        copies = self._copies.get(frame)
        if copies is None:
            copies = self._copies[frame] = np.zeros(len(plan.layout.sensors), np.int64)
        copies[sensor] += 1

    def _count_slopes(self, end: int) -> None:
        """Hold the slopes of all frames before ``end`` against what was sent."""
        none = np.zeros(len(self._plan.layout.sensors), np.int64)
        for frame in range(self._next_whole, end):
            copies = self._copies.pop(frame, none)
            if not np.array_equal(copies, self._plan.copies(frame)):
                raise SoakError(f"frame {frame}: {copies} messages of each sensor, sent {self._plan.copies(frame)}")
        self._next_whole = max(end, self._next_whole)

    # -- commands ---------------------------------------------------------------------------------------------------

    def _take_command(self, command: wire.DmCommand) -> None:
        plan, frame = self._plan, self.frames
        if frame >= plan.frames:
            raise SoakError(f"a command for frame {frame} of {plan.frames}")
        fault, verdict = Fault(plan.faults[frame]), Verdict(command.verdict)
        if verdict not in _VERDICTS[fault] or not command.loop_state:
            state = "closed" if command.loop_state else "open"
            raise SoakError(f"frame {frame}, {fault.name}: answered with {verdict.name}, loop {state}")
        if command.reconstructor not in self._known:
            raise SoakError(f"frame {frame}: reconstructor {command.reconstructor:016x} is none of ours")
        if not self.swaps or self.swaps[-1][1] != command.reconstructor:
            self.swaps.append((frame, command.reconstructor))
        if fault in (Fault.LATE, Fault.OVERTAKEN) and verdict != Verdict.OK:
            self._late += len(plan.layout.sensors) - command.sensors.bit_count()
        self.verdicts[verdict] += 1
        self.frames += 1
        self._block.append(command)
        if len(self._block) == _BLOCK:
            self._compute()
        self._count_slopes(max(0, frame - _LAG))

    def _compute(self) -> None:
        """Every command of the block anew, from those recorded before it."""
        if not self._block:
            return
        commands, self._block = self._block, []
        first, n, before = commands[0].frame, len(commands), len(self._past)
        got = np.concatenate([self._past, np.stack([command.commands for command in commands])])
        seen = (1 - self._part) * got[before - self._whole :][:n] + self._part * got[before - self._whole - 1 :][:n]
        wanted = got[before - 1 :][:n].copy()  # held, unless it says otherwise
        ok = np.array([command.verdict == Verdict.OK for command in commands])
        made_by = np.array([command.reconstructor for command in commands], np.uint64)
        for identity in np.unique(made_by):
            which = np.flatnonzero(ok & (made_by == identity))
            wanted[which] = self._known[int(identity)].commands(
                wanted[which], seen[which], self._plan.rows[first + which]
            )
        new = got[before:]
        off = np.abs(new - wanted).max(axis=1)
        scale = np.maximum(np.abs(wanted).max(axis=1), 1e-12)
        wrong = np.flatnonzero(~(off <= np.where(ok, TOLERANCE * scale, 0.0)))  # what is not finite is wrong, too
        if len(wrong):
            i = wrong[0]
            raise SoakError(f"frame {first + i}: commands are off by {off[i] / scale[i]:.1e} of the largest")
        self.error = max(self.error, float((off / scale).max()))
        self.largest = max(self.largest, float(np.abs(new).max()))
        self._past = got[len(got) - before :]

    # -- what that can tell -----------------------------------------------------------------------------------------

    def contrast(self) -> float:
        """How far a command would be off with one sensor's product, or its part of the mirror, of another
        reconstructor: the least of all pairs, sensors and slope vectors, of the largest command that came.

        It has to be well above :data:`TOLERANCE`, or the check tells nothing about mixtures.
        """
        laws = list(self._known.values())
        least = min(
            float(np.abs(a.part(w) - b.part(w)).max(axis=1).min())
            for a, b in itertools.combinations(laws, 2)
            for w in range(len(self._plan.layout.sensors))
        )
        return least / self.largest

    def expected_counters(self) -> dict[str, int]:
        """What hrtc/status has to say of these frames."""
        plan, faults = self._plan, Counter(map(int, self._plan.faults))
        return {
            "commands": plan.frames,
            "held_nonfinite": faults[Fault.NONFINITE],
            "held_incomplete": self.verdicts[Verdict.HOLD_INCOMPLETE],
            "held_missing": self.verdicts[Verdict.HOLD_MISSING],
            "held_behind": 0,
            "held_history": 0,
            "dropped_duplicate": faults[Fault.DUPLICATE],
            "dropped_late": self._late,
            "dropped_session": 0,
            "dropped_fingerprint": faults[Fault.FOREIGN],
            "dropped_malformed": faults[Fault.MALFORMED],
            "loop_opened_by_faults": 0,
        }

    def expected_records(self) -> dict[str, int]:
        """What the recorder has to report; what nobody sent it cannot tell from what was lost."""
        plan, faults = self._plan, Counter(map(int, self._plan.faults))
        skipped = sum(faults[fault] for fault in SKIPPED)
        n = len(plan.layout.sensors)
        whole = plan.frames * n + faults[Fault.DUPLICATE] - skipped - n * faults[Fault.NO_FRAME]
        odd = faults[Fault.MALFORMED] + faults[Fault.FOREIGN]
        return {
            "slopes": whole + odd,
            "commands": plan.frames,
            "lost": skipped + n * faults[Fault.NO_FRAME],
            "duplicates": faults[Fault.DUPLICATE],
            "malformed": faults[Fault.MALFORMED],
            "of_another_instrument": faults[Fault.FOREIGN],
            "overrun": 0,
        }


class _Law:
    """The control law in float64 for one reconstructor, and a plan's vectors through it."""

    def __init__(self, plan: Plan, reconstructor: Reconstructor, leak: float) -> None:
        self._plan, self._R = plan, reconstructor.R[0].astype(np.float64)
        self._deviations = plan.vectors.astype(np.float64) - reconstructor.slope_reference
        self._Q = reconstructor.Q[0].astype(np.float64)
        self._products = self._deviations @ self._R.T
        self._gain = reconstructor.gain
        self._keep = (1 - leak) * (1 - self._gain)
        self._limit = reconstructor.command_limit.astype(np.float64)

    def commands(self, before: Floats, seen: Floats, rows: NDArray[np.uint8]) -> Floats:
        """``clip((1-leak) (1-g) u[k-1] + g (Q u~[k] + R (y[k] - y_ref)))``, frame by frame (n, n_commands)."""
        wanted = self._keep * before + self._gain * (seen @ self._Q.T + self._products[rows])
        return np.clip(wanted, -self._limit, self._limit)

    def part(self, sensor: int) -> Floats:
        """(vectors, n_commands) what one sensor has in a command, m."""
        own = self._plan.layout.slopes_of(sensor)
        part: Floats = self._gain * self._deviations[:, own] @ self._R[:, own].T
        return part
