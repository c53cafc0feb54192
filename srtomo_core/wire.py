"""The wire: topics and their quality of service in one table, and the hot messages as checked CDR buffers.

``SlopeFrame`` and ``DmCommand`` are read and written without a typed message in between: little-endian CDR, every
length checked against the buffer before it is believed. All other messages travel typed.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

PACKAGE = "msgs_schema"


@dataclass(frozen=True)
class Topic:
    """One row of the table.

    ``depth`` is a number of messages at both ends, unless ``seconds`` asks for the messages of that time at the writer
    and the recorder (``depth`` then is a plain reader's). A depth costs nothing, only messages that wait do; Fast DDS
    keeps no more than 5000 of a topic, whatever is asked.
    """

    name: str
    type: str
    depth: int
    seconds: float = 0.0
    transient_local: bool = False

    def depth_at(self, messages_per_second: float) -> int:
        """Depth of a writer, or of a reader that must miss nothing."""
        return max(self.depth, math.ceil(self.seconds * messages_per_second))

    def qos(self, depth: int | None = None) -> dict[str, int]:
        """Keyword arguments of ``rclpy.qos.QoSProfile``, by the policies' numbers: core imports no ROS."""
        return {
            "history": 1,  # keep last
            "depth": self.depth if depth is None else depth,
            "reliability": 1,  # reliable
            "durability": 1 if self.transient_local else 2,
        }


# At a reader, one reconstructor's at least. The writer keeps two, so that a late reader finds the current one whole,
# and no more: they are large.
_BLOCKS = 4096

SLOPES = Topic("wfs/slopes", f"{PACKAGE}/msg/SlopeFrame", 64, seconds=1.0)
COMMAND = Topic("hrtc/command", f"{PACKAGE}/msg/DmCommand", 64, seconds=1.0)
EVENT = Topic("hrtc/event", f"{PACKAGE}/msg/HrtcEvent", 256, transient_local=True)
STATE = Topic("hrtc/state", f"{PACKAGE}/msg/HrtcState", 8)
STATUS = Topic("hrtc/status", f"{PACKAGE}/msg/HrtcStatus", 16)
RECONSTRUCTOR = Topic("srtc/reconstructor", f"{PACKAGE}/msg/Reconstructor", 1, transient_local=True)
RECONSTRUCTOR_BLOCK = Topic(
    "srtc/reconstructor_block", f"{PACKAGE}/msg/ReconstructorBlock", _BLOCKS, transient_local=True
)
PROFILE = Topic("srtc/profile", f"{PACKAGE}/msg/AtmosphereProfile", 4, transient_local=True)
HEALTH = Topic("srtc/health", f"{PACKAGE}/msg/ModelHealth", 64, transient_local=True)
TELESCOPE = Topic("telescope/status", f"{PACKAGE}/msg/TelescopeStatus", 4, transient_local=True)
RECORDER_STATUS = Topic("recorder/status", f"{PACKAGE}/msg/RecorderStatus", 16)
SIM_STATUS = Topic("sim/status", f"{PACKAGE}/msg/SimStatus", 16)
SIM_PROFILE = Topic("sim/profile", f"{PACKAGE}/msg/AtmosphereProfile", 4, transient_local=True)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 16)

TOPICS = (
    SLOPES,
    COMMAND,
    EVENT,
    STATE,
    STATUS,
    RECONSTRUCTOR,
    RECONSTRUCTOR_BLOCK,
    PROFILE,
    HEALTH,
    TELESCOPE,
    RECORDER_STATUS,
    SIM_STATUS,
    SIM_PROFILE,
    DIAGNOSTICS,
)
"""Every topic; all reliable, keep last. Names are relative to the instrument's namespace, but for /diagnostics."""

MIRROR_UNKNOWN = -(2**63)
"""SlopeFrame.mirror_frame of a sensor that does not know which command was on the mirror."""


class WireError(ValueError):
    """A buffer that is not the message it should be."""


class SlopeFrame(NamedTuple):
    """A SlopeFrame as read; ``slopes`` is a read-only view of the buffer. Fields as in msgs_schema/msg."""

    stamp_sec: int
    stamp_nanosec: int
    session: int
    frame: int
    fingerprint: bytes
    sensor: int
    n_sensors: int
    first_subaperture: int
    n_subapertures: int
    mirror_frame: int
    mirror_frame_before: int
    mirror_fraction: float
    slopes: NDArray[np.float32]


class DmCommand(NamedTuple):
    """A DmCommand as read; ``commands`` is a read-only view of the buffer. Fields as in msgs_schema/msg."""

    stamp_sec: int
    stamp_nanosec: int
    session: int
    frame: int
    reconstructor: int
    settings: int
    sensors: int
    verdict: int
    loop_state: int
    n_clipped: int
    gain: float
    tip_tilt_frame: int
    mirror_frame: int
    mirror_frame_before: int
    mirror_fraction: float
    latency: float
    commands: NDArray[np.float32]


class ReconstructorBlock(NamedTuple):
    """A ReconstructorBlock as read; ``rows`` is a read-only view of the buffer.

    Fields as in msgs_schema/msg, but for ``number``, which is ``index`` there.
    """

    id: int
    sha256: bytes
    number: int
    epoch: int
    matrix: int
    first_row: int
    rows: NDArray[np.float32]


_ENCAPSULATION = b"\x00\x01\x00\x00"  # little-endian CDR
_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_SLOPES = struct.Struct("<QQ32sHHHHqqfI")
_COMMAND = struct.Struct("<QQQIIBBHfqqqffI")
_BLOCK = struct.Struct("<Q32sIIB3xIIII")
_FLOAT = np.dtype("<f4")


def _body_start(frame_id_bytes: int) -> int:
    """Where the first 8-byte field after a Header stands; CDR aligns from after the 4 bytes of encapsulation."""
    end = 4 + _STAMP.size + _LENGTH.size + frame_id_bytes
    return end + (4 - end) % 8


def _read_header(buffer: bytes, body: struct.Struct) -> int:
    if len(buffer) < 4 + _STAMP.size + _LENGTH.size or buffer[:2] != _ENCAPSULATION[:2]:
        raise WireError(f"expected little-endian CDR with a header, got {len(buffer)} bytes")
    start = _body_start(_LENGTH.unpack_from(buffer, 12)[0])
    if start + body.size > len(buffer):
        raise WireError(f"cut off: {len(buffer)} bytes, the fixed fields alone end at {start + body.size}")
    return start


def _read_floats(buffer: bytes, offset: int, count: int) -> NDArray[np.float32]:
    # trailing padding up to 3 bytes is allowed by some writers
    if not 0 <= len(buffer) - offset - 4 * count < 4:
        raise WireError(f"{count} floats announced, {len(buffer) - offset} bytes there")
    return np.frombuffer(buffer, _FLOAT, count, offset)


def read_slope_frame(buffer: bytes) -> SlopeFrame:
    """Read a serialised SlopeFrame.

    Raises:
        WireError: the buffer is cut off, of another encoding, or announces lengths that it does not hold.
    """
    start = _read_header(buffer, _SLOPES)
    sec, nanosec = _STAMP.unpack_from(buffer, 4)
    *fields, count = _SLOPES.unpack_from(buffer, start)
    slopes = _read_floats(buffer, start + _SLOPES.size, count)
    frame = SlopeFrame._make((sec, nanosec, *fields, slopes))
    if count != 2 * frame.n_subapertures:
        raise WireError(f"{frame.n_subapertures} sub-apertures announced with {count} slopes")
    return frame


def read_dm_command(buffer: bytes) -> DmCommand:
    """Read a serialised DmCommand.

    Raises:
        WireError: as for :func:`read_slope_frame`.
    """
    start = _read_header(buffer, _COMMAND)
    sec, nanosec = _STAMP.unpack_from(buffer, 4)
    *fields, count = _COMMAND.unpack_from(buffer, start)
    return DmCommand._make((sec, nanosec, *fields, _read_floats(buffer, start + _COMMAND.size, count)))


def read_block(buffer: bytes) -> ReconstructorBlock:
    """Read a serialised ReconstructorBlock.

    Raises:
        WireError: as for :func:`read_slope_frame`.
    """
    if len(buffer) < 4 + _BLOCK.size or buffer[:2] != _ENCAPSULATION[:2]:
        raise WireError(f"expected little-endian CDR of a reconstructor block, got {len(buffer)} bytes")
    *fields, n_rows, n_columns, count = _BLOCK.unpack_from(buffer, 4)
    if count != n_rows * n_columns:
        raise WireError(f"{n_rows} x {n_columns} announced with {count} floats")
    rows = _read_floats(buffer, 4 + _BLOCK.size, count).reshape(n_rows, n_columns)
    return ReconstructorBlock._make((*fields, rows))


def write_block(block: ReconstructorBlock) -> bytes:
    """Serialise a ReconstructorBlock."""
    n_rows, n_columns = block.rows.shape
    body = _BLOCK.pack(*block[:-1], n_rows, n_columns, n_rows * n_columns)
    return _ENCAPSULATION + body + np.ascontiguousarray(block.rows, _FLOAT).tobytes()


class _Writer:
    """A message of fixed size, written again and again into one buffer."""

    def __init__(self, frame_id: str, body: struct.Struct, count: int) -> None:
        name = frame_id.encode() + b"\x00"
        self._start = _body_start(len(name))
        self.buffer = bytearray(self._start + body.size + 4 * count)
        self.buffer[:4] = _ENCAPSULATION
        _LENGTH.pack_into(self.buffer, 12, len(name))
        self.buffer[16 : 16 + len(name)] = name
        self.values: NDArray[np.float32] = np.frombuffer(self.buffer, _FLOAT, count, self._start + body.size)


class SlopeFrameWriter(_Writer):
    """Writes the SlopeFrames of one sensor, of several adjacent ones, or one packet of a sensor again and again.

    Put the slopes into ``values``.
    """

    def __init__(
        self,
        name: str,
        session: int,
        fingerprint: bytes,
        sensor: int,
        n_sensors: int,
        n_subapertures: int,
        first_subaperture: int = 0,
    ) -> None:
        super().__init__(name, _SLOPES, 2 * n_subapertures)
        self._fixed = (session, fingerprint, sensor, n_sensors, first_subaperture, n_subapertures)

    def write(
        self, stamp_ns: int, frame: int, mirror_frame: int, mirror_frame_before: int, mirror_fraction: float
    ) -> bytes:
        """The serialised message with the slopes now in ``values``. ``stamp_ns``: end of the exposure, UTC, ns."""
        session, fingerprint, sensor, n_sensors, first, n_sub = self._fixed
        _STAMP.pack_into(self.buffer, 4, *divmod(stamp_ns, 1_000_000_000))
        _SLOPES.pack_into(self.buffer, self._start, session, frame, fingerprint, sensor, n_sensors, first, n_sub,
                          mirror_frame, mirror_frame_before, mirror_fraction, 2 * n_sub)  # fmt: skip
        return bytes(self.buffer)


class DmCommandWriter(_Writer):
    """Writes DmCommands of ``n_commands``. Put the commands into ``values``."""

    def __init__(self, name: str, n_commands: int) -> None:
        super().__init__(name, _COMMAND, n_commands)
        self._count = n_commands

    def write(self, stamp_sec: int, stamp_nanosec: int, *fields: float) -> bytes:
        """The serialised message; ``fields`` are those of :class:`DmCommand` from session to latency, in order."""
        _STAMP.pack_into(self.buffer, 4, stamp_sec, stamp_nanosec)
        _COMMAND.pack_into(self.buffer, self._start, *fields, self._count)
        return bytes(self.buffer)
