"""Slopes, their answers, and the commands that were on the mirrors meanwhile, put together exposure by exposure.

Messages come as they are, serialised or read, in any order within :data:`HORIZON` frames; events are not needed, since
every command names the reconstructor that made it and holds the offset. What cannot be put together is left out and
counted with its reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core.exposure import Exposure, fits, subaperture_starts
from srtomo_core.layout import Layout
from srtomo_core.wire import MIRROR_UNKNOWN, DmCommand, SlopeFrame, WireError, read_dm_command, read_slope_frame

Floats = NDArray[np.float32]

HORIZON = 128
"""Frames that a message may be behind the newest command; a command stays at hand twice as long."""

_OPEN = 1  # DmCommand's verdict; above it, the last command was held
_SENSORS_ARE_THOSE_THAT_CAME = (3, 4, 5)  # held because some did not; with others, the sensors are those not closed


class Matched(NamedTuple):
    """One exposure and what was on the mirrors in it.

    Attributes:
        slopes: (n_slopes,) y, as measured, rad.
        mirror: (n_commands,) m~, averaged over the exposure, m of wavefront; clipped and with the offset, as it was.
        reconstructor: id of what answered the exposure; 0 when none was active.
        verdict: DmCommand's, how it was answered.
        n_clipped: actuators at their limit in that answer.
    """

    session: int
    frame: int
    slopes: Floats
    mirror: Floats
    reconstructor: int
    verdict: int
    n_clipped: int

    @property
    def closed(self) -> bool:
        """Whether the loop was closed, held answers included."""
        return self.verdict != _OPEN


@dataclass
class Tally:
    """What became of the frames asked for, and of odd messages.

    Attributes:
        matched: frames put together; of these
        open, held: with the loop open; held by the HRTC: good all the same, since the mirrors' shape is known.
        clipped: whose answer has some actuator at its limit.
        absent: frame numbers of which nothing came.
        incomplete: some slopes did not come.
        unanswered: no command came for them.
        sensor_closed: some sensor was closed, and whatever it sent was not the sky's.
        unknown_mirror: a command that was on the mirrors is not at hand, or nobody knows which it was.
        nonfinite: some slope, or the mirrors' shape, is no number.
        late, duplicate, malformed, foreign: messages behind the horizon; repeated; unreadable or of impossible
            content; of another instrument or of a session that has ended.
        sessions: slope sessions that commands came for.
    """

    matched: int = 0
    open: int = 0
    held: int = 0
    clipped: int = 0
    absent: int = 0
    incomplete: int = 0
    unanswered: int = 0
    sensor_closed: int = 0
    unknown_mirror: int = 0
    nonfinite: int = 0
    late: int = 0
    duplicate: int = 0
    malformed: int = 0
    foreign: int = 0
    sessions: int = 0

    @property
    def left_out(self) -> int:
        """Frames asked for that were not put together."""
        return (
            self.absent + self.incomplete + self.unanswered + self.sensor_closed + self.unknown_mirror + self.nonfinite
        )


@dataclass
class _Session:
    """What has come of one session and is not done with."""

    exposures: dict[int, Exposure | None] = field(default_factory=dict)  # None: only the answer has come
    commands: dict[int, DmCommand] = field(default_factory=dict)
    newest: int = -1  # frame that was answered
    done: int = -1  # frames up to here are decided
    all_open: bool = True  # no sensor was closed when the last frame was decided


class Matcher:
    """Puts exposures together. One thread calls everything.

    The current session is the one that commands come for; the HRTC has chosen it.
    """

    def __init__(self, layout: Layout, wanted: Callable[[int], bool] = lambda frame: True) -> None:
        """Make a matcher of an instrument.

        Args:
            wanted: frames to put together; slopes of others are not looked at.

        Raises:
            ValueError: tip-tilt has a loop of its own, whose stars' slopes are not of these frames.
        """
        if layout.tip_tilt_sensors:
            raise ValueError("loop.tip_tilt: telemetry of such an instrument is not put together, nor learned from")
        self.tally = Tally()
        self._wanted = wanted
        self._fingerprint = layout.fingerprint
        self._starts = subaperture_starts(layout)
        self._all_sensors = (1 << len(layout.sensors)) - 1
        self._n_commands = layout.n_commands
        self._flat = np.zeros(layout.n_commands, np.float32)
        self._sessions: dict[int, _Session] = {}
        self._ended: set[int] = set()
        self._current = 0
        self._free: list[Exposure] = []

    @property
    def session(self) -> int:
        """The current session; 0 before the first command."""
        return self._current

    @property
    def newest(self) -> int:
        """The newest frame of the current session that was answered, whether it was put together or not; or -1."""
        session = self._sessions.get(self._current)
        return -1 if session is None else session.newest

    def add_slopes(self, message: bytes | SlopeFrame) -> None:
        """Take a SlopeFrame, serialised or read; its slopes are copied."""
        if not isinstance(message, SlopeFrame):
            try:
                message = read_slope_frame(message)
            except WireError:
                self.tally.malformed += 1
                return
        if message.fingerprint != self._fingerprint or message.session in self._ended:
            self.tally.foreign += 1
            return
        if not fits(message, self._starts):
            self.tally.malformed += 1
            return
        if not self._wanted(message.frame):
            return
        session = self._session(message.session)
        if message.frame <= session.done:
            self.tally.late += 1
            return
        exposure = session.exposures.get(message.frame)
        if exposure is None:
            if len(session.exposures) >= 2 * HORIZON:
                # slopes without any answers: nothing moves the horizon on
                del session.exposures[min(session.exposures)]
                self.tally.unanswered += 1
            exposure = self._free.pop() if self._free else Exposure(self._starts)
            exposure.clear()
            session.exposures[message.frame] = exposure
        if not exposure.put(message):
            self.tally.duplicate += 1

    def add_command(self, message: bytes | DmCommand) -> None:
        """Take a DmCommand, serialised or read; the mirrors obey the first that comes for a frame."""
        if not isinstance(message, DmCommand):
            try:
                message = read_dm_command(message)
            except WireError:
                self.tally.malformed += 1
                return
        if message.session in self._ended:
            self.tally.foreign += 1
            return
        if len(message.commands) != self._n_commands or message.session == 0:
            self.tally.malformed += 1
            return
        if message.session != self._current:
            self._begin(message.session)
        session = self._session(message.session)
        if message.frame in session.commands:
            self.tally.duplicate += 1
            return
        session.commands[message.frame] = message
        session.newest = max(session.newest, message.frame)
        if self._wanted(message.frame) and message.frame > session.done:
            session.exposures.setdefault(message.frame, None)

    def take(self, final: bool = False) -> list[Matched]:
        """The exposures of the current session that can be decided now, in order of their frames.

        An exposure waits for what is missing, and those after it wait with it, until it is behind the horizon.

        Args:
            final: nothing more will come: decide everything.
        """
        found: list[Matched] = []
        for number, session in self._sessions.items():
            for frame in sorted(session.exposures):
                behind = final or session.newest - frame >= HORIZON
                decided, matched = self._match(number, session, frame, behind)
                if not decided:
                    break
                if session.done >= 0:
                    self.tally.absent += sum(map(self._wanted, range(session.done + 1, frame)))
                session.done = frame
                exposure = session.exposures.pop(frame)
                if exposure is not None:
                    self._free.append(exposure)
                if matched is not None:
                    found.append(matched)
        self._forget()
        return found

    def _match(self, number: int, session: _Session, frame: int, behind: bool) -> tuple[bool, Matched | None]:
        """Put one exposure together.

        Returns:
            Whether it is decided, as it has to be ``behind`` the horizon; and the exposure, unless it is left out.
        """
        exposure, answer = session.exposures[frame], session.commands.get(frame)
        if answer is not None and answer.verdict not in _SENSORS_ARE_THOSE_THAT_CAME:
            session.all_open = answer.sensors == self._all_sensors
        if answer is not None and not session.all_open:
            self.tally.sensor_closed += 1
            return True, None
        if exposure is None or exposure.arrived != self._all_sensors:
            self.tally.incomplete += behind
            return behind, None
        if answer is None:
            self.tally.unanswered += behind
            return behind, None
        on = exposure.mirror
        if on[0] == MIRROR_UNKNOWN:
            on = answer.mirror_frame, answer.mirror_frame_before, answer.mirror_fraction
        mirror = self._shape(session, *on)
        if mirror is None:
            self.tally.unknown_mirror += behind
            return behind, None
        slopes = np.concatenate(exposure.slopes)
        if not (np.isfinite(slopes).all() and np.isfinite(mirror).all()):
            self.tally.nonfinite += 1
            return True, None
        self.tally.matched += 1
        self.tally.open += answer.verdict == _OPEN
        self.tally.held += answer.verdict > _OPEN
        self.tally.clipped += answer.n_clipped > 0
        return True, Matched(number, frame, slopes, mirror, answer.reconstructor, answer.verdict, answer.n_clipped)

    def _shape(self, session: _Session, frame: int, before: int, fraction: float) -> Floats | None:
        after = self._shown(session, frame)
        if fraction == 1 or after is None:
            return after
        earlier = self._shown(session, before)
        if earlier is None or not 0 <= fraction <= 1:
            return None
        return np.float32(fraction) * after + np.float32(1 - fraction) * earlier

    def _shown(self, session: _Session, frame: int) -> Floats | None:
        if frame < 0:  # before a session's first command
            return self._flat
        command = session.commands.get(frame)
        return None if command is None else command.commands

    def _session(self, number: int) -> _Session:
        if number not in self._sessions:
            # slopes may run ahead of their session's first command: of one session at a time
            for other in [other for other in self._sessions if other != self._current]:
                del self._sessions[other]
            self._sessions[number] = _Session()
        return self._sessions[number]

    def _begin(self, number: int) -> None:
        if self._current:
            self._ended.add(self._current)
            self._sessions.pop(self._current, None)
        self._current = number
        self.tally.sessions += 1

    def _forget(self) -> None:
        """Drop commands that nothing within the horizon can have had on its mirrors."""
        for session in self._sessions.values():
            for frame in [frame for frame in session.commands if session.newest - frame >= 2 * HORIZON]:
                del session.commands[frame]
