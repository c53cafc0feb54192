"""A bag through the same loop: what was recorded goes in, and commands are compared bit for bit.

What depended on time in the running loop is taken from the record: which frames were held because messages were missing
or late, and at which frame each setting, transition and swap took effect. All else, non-finite slopes and an unknown
history among it, the loop decides again by itself. No ROS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core import wire
from srtomo_core.bag import BagError, BagReader
from srtomo_core.layout import Layout
from srtomo_core.messages import decode
from srtomo_core.reconstructor import Reconstructor, block_table
from srtomo_core.system import System
from srtomo_rtc.loop import Loop, Program, Settings, Slot, Verdict
from srtomo_rtc.vmm import KERNEL

Floats = NDArray[np.float32]

_TIMED = (Verdict.HOLD_INCOMPLETE, Verdict.HOLD_MISSING, Verdict.HOLD_BEHIND)
_WINDOW = 400  # frames that the bag's order of messages may be off by
_PROGRAM_KINDS = (0, 2, 3)  # HrtcEvent.SETTINGS, COMMIT, ROLLBACK
_LOOP, _SESSION = 1, 6  # HrtcEvent.LOOP, SESSION
_SHOWN = 5  # differing frames that are kept for the report


@dataclass
class Outcome:
    """What a replay found.

    Attributes:
        compared: frames whose recorded answer was compared.
        differing: of these, answers that differ in a bit of a command, in the verdict or in the reconstructor.
        held: of those compared, answers that were holds.
        unanswered: frames with slopes but without a recorded command.
        skipped: frames that could not be replayed, for the reason in ``gaps``.
        first_differing: the first few frames that differ, with what differs.
        gaps: why the replay lost the thread, and where it took it up again.
    """

    compared: int = 0
    differing: int = 0
    held: int = 0
    unanswered: int = 0
    skipped: int = 0
    first_frame: int | None = None
    last_frame: int | None = None
    first_differing: list[str] = field(default_factory=list)
    gaps: list[str] = field(default_factory=list)

    def note_difference(self, frame: int, what: str) -> None:
        """Count a frame that differs."""
        self.differing += 1
        if len(self.first_differing) < _SHOWN:
            self.first_differing.append(f"frame {frame}: {what}")


class _Frame(NamedTuple):
    """What the bag holds of one exposure."""

    slopes: list[Floats | None]
    mirror: list[tuple[int, int, float]]


class Replay:
    """Replays one bag.

    Args:
        reader: the bag.
        supplied: reconstructors that the HRTC had from files, not from the wire.

    Raises:
        BagError: the bag says nothing of its instrument, or was made with another kernel.
    """

    def __init__(self, reader: BagReader, supplied: list[Reconstructor] | None = None) -> None:
        self._reader = reader
        text = reader.metadata.get("system")
        if text is None:
            raise BagError(f"{reader.path}: does not say which instrument it is of: not recorded by 'srtomo record'?")
        self.system = System.model_validate_json(text)
        self.layout = Layout(self.system)
        self._starts = [int(start) // 2 for start in self.layout.slope_start]
        self._slots = {r.sha256: _filled(self.layout, r.R[0], r.Q[0], r.slope_reference, r.command_limit, r.gain,
                                         r.sha256) for r in supplied or []}  # fmt: skip
        self._events: list[Any] = []
        self._states: dict[tuple[int, int], Any] = {}
        self._read_everything_but_frames()

    # -- what is not a frame ----------------------------------------------------------------------------------------

    def _topic(self, topic: wire.Topic) -> str | None:
        try:
            return self._reader.topic(topic.name)
        except BagError:
            return None

    def _of(self, topic: wire.Topic) -> Iterator[bytes]:
        name = self._topic(topic)
        if name is not None:
            for message in self._reader.messages(name):
                yield message.data

    def _read_everything_but_frames(self) -> None:
        manifests = {}
        for data in self._of(wire.RECONSTRUCTOR):
            message = decode(wire.RECONSTRUCTOR.type, data)
            manifests[bytes(message.sha256)] = message
        blocks: dict[bytes, dict[int, wire.ReconstructorBlock]] = {}
        for data in self._of(wire.RECONSTRUCTOR_BLOCK):
            block = wire.read_block(data)
            blocks.setdefault(block.sha256, {})[block.number] = block
        for sha256, message in manifests.items():
            table = block_table(message.n_commands, message.n_epochs)
            if len(blocks.get(sha256, {})) == len(table) and message.n_slopes == self.layout.n_slopes:
                R = np.zeros((message.n_commands, message.n_slopes), np.float32)
                Q = np.zeros((message.n_commands, message.n_commands), np.float32)
                for block in blocks[sha256].values():
                    target = R if block.matrix == 0 else Q
                    target[block.first_row : block.first_row + len(block.rows)] = block.rows
                self._slots[sha256] = _filled(
                    self.layout, R, Q, message.slope_reference, message.command_limit, message.gain, sha256
                )
        seen = set()
        for data in self._of(wire.EVENT):
            # a late joiner's recorder gets the latched events again
            if data not in seen:
                seen.add(data)
                self._events.append(decode(wire.EVENT.type, data))
        for event in self._events:
            if event.kernel and event.kernel != KERNEL:
                raise BagError(
                    f"{self._reader.path}: made with kernel {event.kernel}, this is {KERNEL}: bits would differ"
                )
        self.delay = next((float(e.delay) for e in self._events if e.delay > 0), self.system.loop.delay)
        for data in self._of(wire.STATE):
            state = decode(wire.STATE.type, data)
            self._states[state.session, state.frame] = state

    def _program(self, event: Any) -> Program | None:
        slot = self._slots.get(bytes(event.sha256))
        if slot is None:
            return None
        return Program(
            slot,
            Settings(
                id=event.settings,
                offset=np.array(event.offset, np.float32),
                slope_reference=np.array(event.slope_reference, np.float32),
                polc=bool(event.polc),
                leak=event.leak,
                relaxation=event.relaxation,
                command_limit=event.command_limit,
                fault_budget=event.fault_budget,
            ),
        )

    # -- frames -----------------------------------------------------------------------------------------------------

    def run(self, start: int = 0, progress: Callable[[float], None] = lambda done: None) -> Outcome:
        """Replay and compare.

        Args:
            start: first frame to replay; above 0 the replay starts after the last recorded HrtcState before it.
            progress: called with the share that is done, 0 to 1.

        Raises:
            BagError: there is nothing to replay, or nothing to start from.
        """
        slopes, commands = self._topic(wire.SLOPES), self._topic(wire.COMMAND)
        if slopes is None or commands is None:
            raise BagError(f"{self._reader.path}: holds no slopes or no commands")
        total = self._reader.counts[slopes] + self._reader.counts[commands]
        outcome = Outcome()
        frames: dict[tuple[int, int], _Frame] = {}
        answers: dict[tuple[int, int], wire.DmCommand] = {}
        newest: dict[int, int] = {}
        sessions: dict[int, _Session] = {}
        for done, message in enumerate(self._reader.messages(slopes, commands)):
            if done % 4096 == 0:
                progress(done / total)
            try:
                if message.topic == slopes:
                    self._place(wire.read_slope_frame(message.data), frames)
                    continue
                command = wire.read_dm_command(message.data)
            except wire.WireError:
                continue  # the loop dropped it too
            key = command.session, command.frame
            answers.setdefault(key, command)
            if command.session not in sessions:
                sessions[command.session] = _Session(self, command.session, start, outcome)
            newest[command.session] = max(newest.get(command.session, 0), command.frame)
            sessions[command.session].advance(newest[command.session] - _WINDOW, frames, answers)
        for session, one in sessions.items():
            one.advance(newest[session], frames, answers)
        outcome.unanswered = len({key for key in frames if key[0] in sessions and key[1] >= start})
        progress(1.0)
        if outcome.compared == 0:
            raise BagError(f"{self._reader.path}: no frame could be compared. {' '.join(outcome.gaps)}".rstrip())
        return outcome

    def _place(self, message: wire.SlopeFrame, frames: dict[tuple[int, int], _Frame]) -> None:
        if message.fingerprint != self.layout.fingerprint or message.sensor + message.n_sensors > len(self._starts) - 1:
            return
        key = message.session, message.frame
        if key not in frames:
            frames[key] = _Frame([None] * (len(self._starts) - 1), [])
        frame = frames[key]
        frame.mirror.append((message.mirror_frame, message.mirror_frame_before, message.mirror_fraction))
        taken = 0
        for sensor in range(message.sensor, message.sensor + message.n_sensors):
            n = self._starts[sensor + 1] - self._starts[sensor]
            count = message.n_subapertures if message.n_sensors == 1 else n
            first = message.first_subaperture
            own = frame.slopes[sensor]
            if own is None:
                # a packet that never came leaves NaN, which the loop would hold
                own = frame.slopes[sensor] = np.full(2 * n, np.nan, np.float32)
            elif count == n:
                return  # a duplicate: the loop took the first
            own[first : first + count] = message.slopes[taken : taken + count]
            own[n + first : n + first + count] = message.slopes[taken + count : taken + 2 * count]
            taken += 2 * count


def _name(verdict: int) -> str:
    return Verdict(verdict).name if verdict in list(Verdict) else str(verdict)


def _filled(
    layout: Layout, R: Floats, Q: Floats, slope_reference: Floats, limit: Floats, gain: float, sha256: bytes
) -> Slot:
    slot = Slot(layout)
    slot.fill(R, Q, slope_reference, limit, gain, sha256)
    return slot


class _Session:
    """One slope session's loop."""

    def __init__(self, replay: Replay, session: int, start: int, outcome: Outcome) -> None:
        self._replay = replay
        self._session = session
        self._start = start
        self._outcome = outcome
        self._loop = Loop(replay.layout, replay.delay)
        # events of other sessions have no part in this one, but for what was in force before it began
        events = replay._events
        own = [i for i, e in enumerate(events) if e.session == session]
        begin = next((i for i in own if events[i].kind == _SESSION), own[0] if own else len(events))
        self._events = [e for i, e in enumerate(events) if i < begin and e.kind in _PROGRAM_KINDS]
        self._events = self._events[-1:] + [events[i] for i in own if i >= begin]
        self._next_event = 0
        self._in_step = False
        self._frame = 0
        self._begin()

    def _begin(self) -> None:
        beginning = next((e for e in self._events if e.kind == _SESSION), None)
        if beginning is not None and self._start <= beginning.first_frame:
            self._frame = int(beginning.first_frame)
            self._in_step = True
            return
        self._resume_near(self._start)

    def _resume_near(self, at: int) -> None:
        """Continue after a recorded state: the last before ``at``, or else the first after it."""
        frames = sorted(frame for session, frame in self._replay._states if session == self._session)
        before = [frame for frame in frames if frame < at]
        after = [frame for frame in frames if frame >= at]
        if not before and not after:
            self._in_step = False
            self._frame = at
            self._outcome.gaps.append(f"No recorded state to start from at frame {at}.")
            return
        self._resume(before[-1] if before else after[0])

    def _resume(self, frame: int) -> bool:
        state = self._replay._states[self._session, frame]
        program, passed = None, 0
        for i, event in enumerate(self._events):
            if event.session == self._session and event.first_frame > frame:
                break
            passed = i + 1
            if (
                event.kind in _PROGRAM_KINDS
                and event.settings == state.settings
                and bytes(event.sha256) == bytes(state.sha256)
            ):
                program = self._replay._program(event)
        if state.reconstructor and program is None:
            self._outcome.gaps.append(f"Reconstructor {state.reconstructor:016x} of frame {frame} is not in the bag.")
            self._in_step = False
            self._frame = frame + 1
            return False
        self._next_event = passed
        self._loop = Loop(self._replay.layout, self._replay.delay)
        if program is not None:
            self._loop.post(program)
        history = np.asarray(state.history, np.float32).reshape(int(state.n_frames), -1)
        self._loop.resume(
            frame,
            int(state.first_frame),
            np.asarray(state.state, np.float32),
            history,
            bool(state.loop_state),
            int(state.consecutive_holds),
        )
        self._frame = frame + 1
        self._in_step = True
        return True

    def advance(
        self, until: int, frames: dict[tuple[int, int], _Frame], answers: dict[tuple[int, int], wire.DmCommand]
    ) -> None:
        """Replay every frame up to ``until``, and forget it."""
        while self._frame <= until:
            key = self._session, self._frame
            frame, command = frames.pop(key, None), answers.pop(key, None)
            if not self._in_step and (self._session, self._frame - 1) in self._replay._states:
                self._resume(self._frame - 1)
            if not self._in_step:
                self._outcome.skipped += 1
                self._frame += 1
                continue
            self._apply_events()
            if self._in_step:
                self._answer(frame, command)
            else:
                self._outcome.skipped += 1
            self._frame += 1
        # what lies before the start is of no use any more
        for key in [key for key in frames if key[0] == self._session and key[1] < self._frame]:
            del frames[key]

    def _apply_events(self) -> None:
        loop = self._loop
        while self._next_event < len(self._events):
            event = self._events[self._next_event]
            if event.session == self._session and event.first_frame > self._frame:
                break
            self._next_event += 1
            if event.kind == _SESSION:
                loop.start(int(event.first_frame), closed=bool(event.loop_state))
            elif event.kind == _LOOP:
                loop.request(closed=bool(event.loop_state))
            elif event.kind in _PROGRAM_KINDS:
                program = self._replay._program(event)
                if program is None:
                    self._outcome.gaps.append(
                        f"Reconstructor {event.reconstructor:016x}, used from frame {self._frame}, is not in the bag."
                    )
                    self._in_step = False
                else:
                    loop.post(program)
        loop.prepare()

    def _answer(self, frame: _Frame | None, command: wire.DmCommand | None) -> None:
        loop, outcome = self._loop, self._outcome
        timed = command is not None and command.verdict in _TIMED
        complete = frame is not None and all(own is not None for own in frame.slopes)
        if timed:
            assert command is not None
            loop.hold(Verdict(command.verdict))
        elif complete:
            assert frame is not None
            for sensor, own in enumerate(frame.slopes):
                assert own is not None
                loop.add(sensor, own)
            loop.answer(*frame.mirror[0])
        elif command is not None and command.verdict == Verdict.OPEN:
            # the flat that a stopping HRTC leaves behind answers no slopes
            loop.state[:] = 0
            loop.hold(Verdict.OPEN)
        else:
            self._in_step = False
            outcome.skipped += 1
            outcome.gaps.append(f"Slopes of frame {self._frame} are not in the bag: on from the next recorded state.")
            return
        if command is None:
            return
        if self._frame < self._start:
            return
        outcome.first_frame = self._frame if outcome.first_frame is None else outcome.first_frame
        outcome.last_frame = self._frame
        outcome.compared += 1
        outcome.held += loop.verdict not in (Verdict.OK, Verdict.OPEN)
        identity = loop.program.slot.id if loop.program is not None else 0
        if command.verdict != loop.verdict:
            outcome.note_difference(self._frame, f"verdict {_name(command.verdict)} recorded, {loop.verdict.name} now")
        elif command.reconstructor != identity:
            outcome.note_difference(
                self._frame, f"reconstructor {command.reconstructor:016x} recorded, {identity:016x} now"
            )
        else:
            different = command.commands.view(np.uint32) != loop.command.view(np.uint32)
            if different.any():
                worst = float(np.nanmax(np.abs(command.commands - loop.command)))
                size = f", by {worst:.2g} m at most" if math.isfinite(worst) else ""
                outcome.note_difference(self._frame, f"{int(different.sum())} commands{size}")
