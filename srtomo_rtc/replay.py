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
from srtomo_core.bag import BagError, BagMessage, BagReader
from srtomo_core.exposure import Exposure, fits, subaperture_starts
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import LowOrder, Reconstructor, ReconstructorError, block_table, n_parts
from srtomo_core.system import System
from srtomo_rtc.events import PROGRAM_KINDS, SCALARS, EventKind
from srtomo_rtc.loop import MAX_EPOCHS, Loop, LoopState, Program, Settings, Slot, Verdict
from srtomo_rtc.lowrank import factorise
from srtomo_rtc.vmm import KERNELS

_TIMED = (Verdict.HOLD_INCOMPLETE, Verdict.HOLD_MISSING, Verdict.HOLD_BEHIND)
_WINDOW = 400  # frames that the bag's order of messages may be off by
_STARS = 4096  # frames of tip-tilt's own stars that are kept for commands that may have them in
_SHOWN = 5  # differing frames that are kept for the report

_Key = tuple[int, int]  # session, frame


def _kernel(name: str) -> str | None:
    """The kernel of a name in an event; None: it is not known here."""
    for kernel, known in KERNELS.items():
        if name == known or (kernel == "tlr" and name.startswith(f"{known}-")):
            return kernel
    return None


@dataclass
class Outcome:
    """What a replay found.

    Attributes:
        compared: frames whose recorded answer was compared.
        differing: of these, answers that differ in a bit of a command, in the verdict or in the reconstructor.
        held: of those compared, answers that were holds.
        unanswered: frames with slopes but without a recorded answer, once the session had begun.
        skipped: recorded answers that could not be compared, for the reasons in ``gaps``.
        first_differing: the first few frames that differ, with what differs.
        gaps: why and where the replay lost the thread; it takes it up at the next recorded state or session.
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
        self._reconstructors = {r.sha256: r for r in supplied or []}
        self._slots: dict[tuple[bytes, str], Slot] = {}
        self.stars = _Stars(self.layout)
        self.events: list[Any] = []
        self.states: dict[_Key, Any] = {}
        self._read_everything_but_frames()
        self.max_epochs = max((r.n_epochs for r in self._reconstructors.values()), default=1)

    # -- what is not a frame ----------------------------------------------------------------------------------------

    def _topic(self, topic: wire.Topic) -> str | None:
        try:
            return self._reader.topic(topic.name)
        except BagError:
            return None

    def _of(self, topic: wire.Topic) -> Iterator[BagMessage]:
        name = self._topic(topic)
        return iter(()) if name is None else self._reader.messages(name)

    def _read_everything_but_frames(self) -> None:
        self._read_reconstructors()
        seen = set()
        for message in self._of(wire.EVENT):
            # a late joiner's recorder gets the latched events again
            if message.data not in seen:
                seen.add(message.data)
                self.events.append(self._reader.decode(message))
        for event in self.events:
            if event.kernel and _kernel(event.kernel) is None:
                raise BagError(
                    f"{self._reader.path}: made with kernel {event.kernel}, here are {', '.join(KERNELS.values())}: "
                    "bits would differ"
                )
        for message in self._of(wire.STATE):
            state = self._reader.decode(message)
            self.states[state.session, state.frame] = state

    def _read_reconstructors(self) -> None:
        manifests = {}
        for recorded in self._of(wire.RECONSTRUCTOR):
            message = self._reader.decode(recorded)
            if (message.n_commands, message.n_slopes) == (
                self.layout.n_commands,
                self.layout.n_slopes,
            ) and 1 <= message.n_epochs <= MAX_EPOCHS:
                manifests[bytes(message.sha256)] = message
        columns = (self.layout.n_slopes, self.layout.n_commands)
        sizes = {sha256: (message.n_epochs, len(message.closed_sensors)) for sha256, message in manifests.items()}
        tables = {sha256: set(block_table(columns[1], *size)) for sha256, size in sizes.items()}
        matrices = {
            sha256: [np.full((n_parts(*size), columns[1], n), np.nan, np.float32) for n in columns]
            for sha256, size in sizes.items()
        }
        for recorded in self._of(wire.RECONSTRUCTOR_BLOCK):
            try:
                block = wire.read_block(recorded.data)
            except wire.WireError:
                continue
            place = (block.epoch, block.matrix, block.first_row, len(block.rows))
            if place in tables.get(block.sha256, ()) and block.rows.shape[1] == columns[block.matrix]:
                rows = slice(block.first_row, block.first_row + len(block.rows))
                matrices[block.sha256][block.matrix][block.epoch, rows] = block.rows
        for sha256, message in manifests.items():
            R, Q = matrices[sha256]
            try:
                reconstructor = Reconstructor.from_parts(
                    message.n_epochs,
                    R,
                    Q,
                    fingerprint=bytes(message.fingerprint),
                    gain=message.gain,
                    slope_reference=message.slope_reference,
                    command_limit=message.command_limit,
                    probe_commands=message.probe_commands.reshape(-1, self.layout.n_commands),
                    probe_slopes=message.probe_slopes.reshape(-1, self.layout.n_slopes),
                    closed=message.closed_sensors.tolist(),
                    low_order=LowOrder.from_rows(message.low_order_commands, message.low_order_slopes, *columns[::-1]),
                )
            except (ReconstructorError, ValueError):
                continue  # the HRTC refused it
            if reconstructor.sha256 == sha256:
                self._reconstructors[sha256] = reconstructor

    def program(self, event: Any) -> Program | None:
        """What the loop runs from an event on; None if its reconstructor is not known.

        Raises:
            BagError: its low-rank factors do not come out here as they did there.
        """
        reconstructor = self._reconstructors.get(bytes(event.sha256))
        if reconstructor is None:
            return None
        key = reconstructor.sha256, _kernel(event.kernel) or "float32"
        slot = self._slots.get(key)
        if slot is None:
            slot = self._slots[key] = Slot(self.layout, reconstructor.n_epochs, key[1])
            low_rank = reconstructor.parts if key[1] == "tlr" else []
            slot.fill(reconstructor, [factorise(self.system, self.layout, R) for R, _ in low_rank])
        if slot.kernel == "tlr" and slot.kernel_name != event.kernel:
            raise BagError(
                f"{self._reader.path}: made with kernel {event.kernel}; the factors of reconstructor "
                f"{reconstructor.id:016x} come out as {slot.kernel_name} here, with another LAPACK or processor: "
                "bits would differ"
            )
        return Program(
            slot,
            Settings(
                id=event.settings,
                offset=np.array(event.offset, np.float32),
                slope_reference=np.array(event.slope_reference, np.float32),
                closed_sensors=event.closed_sensors,
                **{name: getattr(event, name) for name in SCALARS},
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
        starts = subaperture_starts(self.layout)
        named = {one.session for one in (*self.events, *self.states.values())}
        frames: dict[_Key, Exposure] = {}
        answers: dict[_Key, wire.DmCommand] = {}
        newest: dict[int, int] = {}
        sessions: dict[int, _Session] = {}
        own = self.layout.tip_tilt_sensors
        for done, message in enumerate(self._reader.messages(slopes, commands)):
            if done % 4096 == 0:
                progress(done / total)
            try:
                if message.topic == slopes:
                    slope_frame = wire.read_slope_frame(message.data)
                    # the loop dropped all others too
                    if slope_frame.fingerprint == self.layout.fingerprint and fits(slope_frame, starts):
                        key = slope_frame.session, slope_frame.frame
                        if slope_frame.sensor in own:
                            self.stars.put(slope_frame)
                            continue
                        if key not in frames and key[0] in named:
                            frames[key] = Exposure(starts)
                            if key[0] not in sessions and len(frames) > _WINDOW:
                                del frames[next(iter(frames))]  # nobody has answered yet
                        if key in frames:
                            frames[key].put(slope_frame)
                    continue
                command = wire.read_dm_command(message.data)
            except wire.WireError:
                continue
            session = command.session
            answers.setdefault((session, command.frame), command)
            if session not in sessions:
                sessions[session] = _Session(self, session, start, outcome)
            newest[session] = max(newest.get(session, 0), command.frame)
            sessions[session].advance(newest[session] - _WINDOW, frames, answers)
        for session, one in sessions.items():
            one.advance(newest[session], frames, answers)
        outcome.unanswered += sum(key[0] in sessions and key[1] >= start for key in frames)
        progress(1.0)
        if outcome.compared == 0:
            raise BagError(f"{self._reader.path}: no frame could be compared. {' '.join(outcome.gaps)}".rstrip())
        return outcome


class _Stars:
    """Slopes of tip-tilt's own stars, by session, frame and sensor; the first that came, as in the loop."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._frames: dict[_Key, dict[int, NDArray[np.float32]]] = {}

    def put(self, message: wire.SlopeFrame) -> None:
        """Keep a message of whole sensors."""
        frame = self._frames.setdefault((message.session, message.frame), {})
        taken = 0
        for sensor in range(message.sensor, message.sensor + message.n_sensors):
            n = self._layout.sensors[sensor].n_slopes
            frame.setdefault(sensor, message.slopes[taken : taken + n])
            taken += n
        if len(self._frames) > _STARS:
            del self._frames[next(iter(self._frames))]

    def slopes(self, session: int, frame: int, sensors: int) -> NDArray[np.float32] | None:
        """(n_slopes,) of which those of ``sensors`` (bit w) count; None: some are not in the bag."""
        slopes = np.zeros(self._layout.n_slopes, np.float32)
        came = self._frames.get((session, frame), {})
        for sensor in self._layout.tip_tilt_sensors:
            if sensors >> sensor & 1:
                own = came.get(sensor)
                if own is None or len(own) != self._layout.sensors[sensor].n_slopes:
                    return None
                slopes[self._layout.slopes_of(sensor)] = own
        return slopes


def _name(verdict: int) -> str:
    return Verdict(verdict).name if verdict in list(Verdict) else str(verdict)


class _Entry(NamedTuple):
    """An event by the first frame that it holds for; ``program`` is the event that says what runs from then on."""

    frame: int
    event: Any
    program: Any


def _timeline(events: list[Any], session: int) -> list[_Entry]:
    """The events that change a session's loop. Its beginnings carry over what ran before, whatever session that was."""
    timeline = []
    running = None
    for event in events:
        if event.kind in PROGRAM_KINDS:
            running = event
        if event.session == session and event.kind in (EventKind.SESSION, EventKind.LOOP, *PROGRAM_KINDS):
            timeline.append(_Entry(int(event.first_frame), event, running if event.reconstructor else None))
    return timeline


class _Session:
    """One slope session's loop."""

    def __init__(self, replay: Replay, session: int, start: int, outcome: Outcome) -> None:
        self._replay = replay
        self._session = session
        self._start = start
        self._outcome = outcome
        self._loop = Loop(replay.layout, replay.system.loop.delay, replay.max_epochs)
        self._past: dict[int, tuple[Exposure | None, wire.DmCommand]] = {}
        self._timeline = _timeline(replay.events, session)
        self._next = 0
        self._in_step = False
        self._lost = f"No recorded state to start from at frame {start}."
        beginnings = [entry.frame for entry in self._timeline if entry.event.kind == EventKind.SESSION]
        beginnings += [frame + 1 for of, frame in replay.states if of == session]
        before = [frame for frame in beginnings if frame <= start]
        # the last before the start, or else the first after it
        self._frame = max(before) if before else min(beginnings, default=start)

    def advance(self, until: int, frames: dict[_Key, Exposure], answers: dict[_Key, wire.DmCommand]) -> None:
        """Replay every frame up to ``until``, and forget it."""
        while self._frame <= until:
            self._remember(frames, answers)
            key = self._session, self._frame
            exposure, command = frames.pop(key, None), answers.pop(key, None)
            self._reach()
            if command is None:
                # the recording lost the answer, or the HRTC was not active: what the loop did is not known
                self._lose(f"The answer to frame {self._frame} is not in the bag.")
                if exposure is not None and self._frame >= self._start:
                    self._outcome.unanswered += 1
            elif self._in_step:
                self._answer(exposure, command)
            if command is not None and not self._in_step:
                self._skip()
            if command is not None:
                self._past[self._frame] = exposure, command
            self._frame = self._frame + 1 if self._in_step else min(until + 1, self._next_known(frames, answers))
        self._remember(frames, answers)
        # slopes that came again after their answer, or before the first
        for key in [key for key in frames if key[0] == self._session and key[1] < self._frame]:
            del frames[key]

    def _remember(self, frames: dict[_Key, Exposure], answers: dict[_Key, wire.DmCommand]) -> None:
        """Keep the exposures just before this frame with their answers: a loop that is resumed may use them."""
        first = self._frame - self._replay.max_epochs + 1
        for frame in range(first, self._frame):
            command = answers.pop((self._session, frame), None)
            if command is not None:
                self._past[frame] = frames.get((self._session, frame)), command
        for frame in [frame for frame in self._past if frame < first]:
            del self._past[frame]

    def _exposures(self, frame: int, first_frame: int, n: int) -> dict[int, tuple[Any, tuple[int, int, float]]] | None:
        """Up to ``n`` exposures that end with ``frame`` and were all answered OK; None if the bag lacks one of them."""
        found: dict[int, tuple[Any, tuple[int, int, float]]] = {}
        for earlier in range(frame, max(frame - n, first_frame - 1), -1):
            exposure, command = self._past.get(earlier, (None, None))
            if command is None:
                return None
            everyone = self._loop.all_sensors
            if command.verdict != Verdict.OK or command.sensors & everyone != everyone:
                break
            if exposure is None or exposure.arrived != self._loop.all_sensors:
                return None
            found[earlier] = (
                exposure.slopes,
                (command.mirror_frame, command.mirror_frame_before, command.mirror_fraction),
            )
        return found

    def _next_known(self, *recorded: dict[_Key, Any]) -> int:
        """The next frame of which anything is known; a count that jumps far is not walked along."""
        known = [frame for items in recorded for session, frame in items if session == self._session]
        known += [frame + 1 for session, frame in self._replay.states if session == self._session]
        known += [entry.frame for entry in self._timeline]
        return min((frame for frame in known if frame > self._frame), default=self._frame + 1)

    def _lose(self, reason: str) -> None:
        if self._in_step:
            self._in_step = False
            self._lost = reason

    def _skip(self) -> None:
        if self._frame < self._start:
            return
        self._outcome.skipped += 1
        if self._lost:
            self._outcome.gaps.append(self._lost)
            self._lost = ""

    def _reach(self) -> None:
        """Apply what holds from this frame on; where the record allows, take up a lost thread."""
        if not self._in_step and (self._session, self._frame - 1) in self._replay.states:
            self._resume(self._frame - 1)
        while self._next < len(self._timeline) and self._timeline[self._next].frame <= self._frame:
            entry = self._timeline[self._next]
            self._next += 1
            if entry.event.kind == EventKind.SESSION:
                self._begin(entry)
            elif self._in_step and entry.event.kind == EventKind.LOOP:
                self._loop.request_state(LoopState(entry.event.loop_state))
                self._loop.prepare()  # a loop that was opened and closed again between two frames begins its ramp anew
            elif self._in_step:
                self._run(entry.program)
        if self._in_step:
            self._loop.prepare()

    def _begin(self, entry: _Entry) -> None:
        if entry.frame != self._frame:
            return  # the replay starts after it
        self._loop = Loop(self._replay.layout, entry.event.delay, self._replay.max_epochs)
        self._loop.start(entry.frame, LoopState(entry.event.loop_state))
        self._in_step = True
        if entry.program is not None:
            self._run(entry.program)

    def _run(self, event: Any) -> None:
        program = self._replay.program(event)
        if program is None:
            self._lose(f"Reconstructor {event.reconstructor:016x}, in use at frame {self._frame}, is not in the bag.")
        else:
            self._loop.post(program)

    def _resume(self, frame: int) -> None:
        state = self._replay.states[self._session, frame]
        running, delay = None, self._replay.system.loop.delay
        for event in self._replay.events:
            if event.session == self._session and event.first_frame > frame:
                break
            delay = event.delay or delay
            if (
                event.kind in PROGRAM_KINDS
                and event.settings == state.settings
                and bytes(event.sha256) == bytes(state.sha256)
            ):
                running = event
        self._next = sum(entry.frame <= frame for entry in self._timeline)
        self._loop = Loop(self._replay.layout, delay, self._replay.max_epochs)
        self._in_step = True
        if state.reconstructor and running is None:
            self._lose(f"Settings and reconstructor in use at frame {frame} are not in the bag.")
        elif state.reconstructor:
            self._run(running)
        exposures = self._exposures(frame, int(state.first_frame), self._replay.max_epochs - 1)
        if exposures is None:
            self._lose(
                f"Exposures before frame {frame + 1}, of which a reconstructor uses several, are not in the bag."
            )
        if self._in_step and exposures is not None:
            history = np.asarray(state.history, np.float32).reshape(int(state.n_frames), -1)
            self._loop.resume(
                frame,
                int(state.first_frame),
                np.asarray(state.state, np.float32),
                history,
                LoopState(state.loop_state),
                int(state.consecutive_holds),
                int(state.frames_closed),
                exposures,
                (int(state.tip_tilt_frame), np.asarray(state.tip_tilt, np.float32)),
            )

    def _answer(self, exposure: Exposure | None, command: wire.DmCommand) -> None:
        loop = self._loop
        if stars := command.sensors & ~loop.all_sensors:
            slopes = self._replay.stars.slopes(self._session, command.tip_tilt_frame, stars)
            if slopes is None:
                self._lose(f"Frame {command.tip_tilt_frame} of tip-tilt's own stars is not in the bag.")
                return
            loop.give_tip_tilt(command.tip_tilt_frame, stars, slopes)
        if command.verdict == Verdict.OPEN and command.sensors == 0:
            # the flat that a stopping HRTC leaves behind, or one that hears nothing, answers no slopes
            loop.flatten()
        elif command.verdict in _TIMED:
            loop.hold(Verdict(command.verdict))
        elif exposure is not None and exposure.arrived & loop.wanted == loop.wanted:
            for sensor, own in enumerate(exposure.slopes):
                if loop.all_sensors >> sensor & 1:
                    loop.add(sensor, own)
            loop.answer(*exposure.mirror)
        elif command.verdict in list(Verdict) and command.verdict != Verdict.OK:
            loop.hold(Verdict(command.verdict))  # whatever the slopes were, they were not used
        else:
            self._lose(f"Slopes of frame {self._frame} are not in the bag.")
            return
        if self._frame >= self._start:
            self._compare(command)

    def _compare(self, command: wire.DmCommand) -> None:
        loop, outcome = self._loop, self._outcome
        outcome.first_frame = self._frame if outcome.first_frame is None else outcome.first_frame
        outcome.last_frame = self._frame
        outcome.compared += 1
        outcome.held += loop.verdict not in (Verdict.OK, Verdict.OPEN)
        identity = loop.program.slot.id if loop.program is not None else 0
        if command.verdict != loop.verdict:
            what = f"verdict {_name(command.verdict)} recorded, {loop.verdict.name} now"
        elif command.reconstructor != identity:
            what = f"reconstructor {command.reconstructor:016x} recorded, {identity:016x} now"
        elif command.tip_tilt_frame != loop.tip_tilt_frame:
            what = f"tip-tilt of frame {command.tip_tilt_frame} recorded, of {loop.tip_tilt_frame} now"
        elif len(command.commands) != len(loop.command):
            what = f"{len(command.commands)} commands recorded, {len(loop.command)} now"
        else:
            different = command.commands.view(np.uint32) != loop.command.view(np.uint32)
            if not different.any():
                return
            worst = float(np.nanmax(np.abs(command.commands - loop.command)))
            size = f", by {worst:.2g} m at most" if math.isfinite(worst) else ""
            what = f"{int(different.sum())} commands{size}"
        outcome.note_difference(self._frame, what)
