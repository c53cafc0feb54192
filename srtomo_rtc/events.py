"""What the HRTC tells of itself, as plain fields of HrtcEvent and HrtcState: enough for an exact replay. No ROS.

Any thread may call any of these: they read what no longer changes.
"""

from __future__ import annotations

import enum
from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srtomo_rtc.hrtc import Change, Snapshot
from srtomo_rtc.loop import LoopState, Program, Settings


class EventKind(enum.IntEnum):
    """The constants of msgs_schema/msg/HrtcEvent."""

    SETTINGS = 0
    LOOP = 1
    COMMIT = 2
    ROLLBACK = 3
    STAGED = 4
    REFUSED = 5
    SESSION = 6
    LIFECYCLE = 7


SCALARS = (
    "polc", "leak", "relaxation", "command_limit", "slew_limit", "rms_limit", "gain_ramp", "fault_budget", "watchdog",
    "tip_tilt_gain", "tip_tilt_leak",
)  # fmt: skip
"""Of Settings: what an operator sets by a parameter of that name, and what HrtcEvent carries under it."""

PROGRAM_KINDS = (EventKind.SETTINGS, EventKind.COMMIT, EventKind.ROLLBACK)
"""Events that say what the loop runs from their first frame on."""


def _floats(values: NDArray[np.float32]) -> array[float]:
    # what ROS messages take without looking at each element
    return array("f", np.ascontiguousarray(values, np.float32).tobytes())


def event_fields(
    kind: EventKind,
    text: str = "",
    *,
    session: int = 0,
    frame: int = 0,
    loop_state: LoopState = LoopState.OPEN,
    delay: float = 0.0,
    program: Program | None = None,
    settings: Settings | None = None,
) -> dict[str, Any]:
    """Fields of an HrtcEvent but for its header; ``settings`` are for when no program runs yet."""
    fields: dict[str, Any] = {
        "kind": int(kind),
        "text": text,
        "session": session,
        "first_frame": frame,
        "loop_state": int(loop_state),
        "delay": delay,
    }
    if program is not None:
        slot = program.slot
        fields |= {"reconstructor": slot.id, "sha256": list(slot.sha256), "kernel": slot.kernel_name}
        settings = program.settings
    if settings is not None:
        fields |= {"settings": settings.id, "closed_sensors": settings.closed_sensors}
        fields |= {name: getattr(settings, name) for name in SCALARS}
    if program is not None and kind in PROGRAM_KINDS:
        fields |= {
            "offset": _floats(program.settings.offset),
            "slope_reference": _floats(program.settings.slope_reference),
        }
    return fields


def change_fields(change: Change, kind: EventKind, text: str, delay: float) -> dict[str, Any]:
    """Fields of the HrtcEvent that tells of something the loop took up; ``kind`` and ``text`` say at whose wish."""
    return event_fields(
        kind,
        text,
        session=change.session,
        frame=change.frame,
        loop_state=change.loop_state,
        delay=delay,
        program=change.program,
    )


def state_fields(snapshot: Snapshot) -> dict[str, Any]:
    """Fields of the HrtcState that holds a snapshot, but for its header."""
    fields: dict[str, Any] = {
        "session": snapshot.session,
        "frame": snapshot.frame,
        "loop_state": int(snapshot.loop_state),
        "consecutive_holds": snapshot.consecutive_holds,
        "frames_closed": snapshot.frames_closed,
        "first_frame": snapshot.first_frame,
        "state": _floats(snapshot.state),
        "n_frames": len(snapshot.history),
        "history": _floats(snapshot.history),
        "tip_tilt_frame": snapshot.tip_tilt_frame,
        "tip_tilt": _floats(snapshot.tip_tilt),
    }
    if snapshot.program is not None:
        slot = snapshot.program.slot
        fields |= {
            "reconstructor": slot.id,
            "sha256": list(slot.sha256),
            "settings": snapshot.program.settings.id,
        }
    return fields
