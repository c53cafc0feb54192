"""The frame path's C library (``native/``), as ctypes sees it: structures and signatures, nothing else.

The structures mirror ``native/frame.h`` and ``native/ros.c``; loading compares their sizes. Calls release the
interpreter; which thread may make them is said where they are declared and in the classes that wrap them. Any thread
may load and make views. SRTOMO_FRAME_PATH is a folder to load from instead: ``make sanitize`` has its own build there.
"""

from __future__ import annotations

import ctypes
import os
import sysconfig
from ctypes import (
    POINTER,
    Structure,
    c_bool,
    c_char_p,
    c_double,
    c_float,
    c_int,
    c_int32,
    c_int64,
    c_size_t,
    c_uint32,
    c_uint64,
    c_void_p,
)
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

MAX_SENSORS = 32
BINS = 384

PUBLISH = ctypes.CFUNCTYPE(c_int, c_void_p, c_void_p, c_size_t)
"""(context, message, bytes) -> 0, or else it did not go out."""


class Product(Structure):
    """``srt_product``."""

    _fields_ = [
        ("tiles", c_void_p),
        ("n_tiles", c_size_t),
        ("n_columns", c_size_t),
        ("first", c_size_t),
        ("last", c_size_t),
        ("vector", c_void_p),
        ("sums", c_void_p),
        ("int16", c_bool),
    ]


class Block(Structure):
    """``srt_block``."""

    _fields_ = [("U", c_void_p), ("first", c_uint32), ("last", c_uint32), ("whole", c_uint32)]


class Zone(Structure):
    """``srt_zone``."""

    _fields_ = [
        ("columns", c_void_p),
        ("n_columns", c_uint32),
        ("needs", c_uint32),
        ("n_inner", c_uint32),
        ("scratch", c_uint32),
        ("V", c_void_p),
        ("V_scales", c_void_p),
        ("blocks", POINTER(Block)),
        ("U_bytes", c_size_t),
    ]


class LowRank(Structure):
    """``srt_low_rank``."""

    _fields_ = [
        ("zones", POINTER(Zone)),
        ("n_zones", c_uint32),
        ("n_tiles", c_uint32),
        ("scratch", c_void_p),
    ]


class Matrices(Structure):
    """``srt_matrices``."""

    _fields_ = [
        ("R", c_void_p * MAX_SENSORS),
        ("R_scales", c_void_p * MAX_SENSORS),
        ("low_rank", POINTER(LowRank)),
        ("rows", c_void_p),
        ("Q", c_void_p),
    ]


class TipTiltLaw(Structure):
    """``srt_tip_tilt_law``."""

    _fields_ = [("gain", c_float), ("keep", c_float), ("weight", c_float * MAX_SENSORS), ("reference", c_void_p)]


class Program(Structure):
    """``srt_program``."""

    _fields_ = [
        ("token", c_uint64),
        ("reconstructor", c_uint64),
        ("settings", c_uint32),
        ("fault_budget", c_uint32),
        ("n_epochs", c_uint32),
        ("polc", c_uint32),
        ("sensors", c_uint32),
        ("held", c_uint32),
        ("ramp", c_uint32),
        ("gain", c_float),
        ("keep", c_float),
        ("relaxation", c_float),
        ("retained", c_float),
        ("slew", c_float),
        ("rms", c_float),
        ("watchdog_ns", c_int64),
        ("offset", c_void_p),
        ("limit", c_void_p),
        ("reference", c_void_p),
        ("alone_reference", c_void_p),
        ("epochs", POINTER(Matrices)),
        ("alone", POINTER(Matrices)),
        ("tip_tilt", TipTiltLaw),
    ]


TIP_TILT_COUNTERS = ("frames", "partial", "held", "skipped")


class TipTilt(Structure):
    """``srt_tip_tilt``."""

    _fields_ = [
        ("sensors", c_uint32),
        ("used", c_uint32),
        ("frame", c_int64),
        *((name, c_uint64) for name in TIP_TILT_COUNTERS),
        ("command", c_void_p),
    ]


class Loop(Structure):
    """What others may look at of ``srt_loop``, which stands first in it."""

    _fields_ = [
        ("frame", c_int64),
        ("first_frame", c_int64),
        ("answered", c_int64),
        ("mirror_frame", c_int64),
        ("mirror_frame_before", c_int64),
        ("token", c_uint64),
        ("opened_by_faults", c_uint64),
        ("opened_by_silence", c_uint64),
        ("mirror_fraction", c_float),
        ("gain", c_float),
        ("sensors", c_uint32),
        ("used", c_uint32),
        ("all_sensors", c_uint32),
        ("wanted", c_uint32),
        ("consecutive_holds", c_uint32),
        ("frames_closed", c_uint32),
        ("n_clipped", c_uint32),
        ("n_slewed", c_uint32),
        ("scaled", c_int32),
        ("verdict", c_int32),
        ("closed", c_int32),
        ("held_flat", c_int32),
        ("requested", c_int32),
        ("n_sensors", c_uint32),
        ("n_commands", c_uint32),
        ("n_rows", c_uint32),
        ("n_slopes", c_uint32),
        ("max_epochs", c_uint32),
        ("command", c_void_p),
        ("state", c_void_p),
        ("history", c_void_p),
        ("tip_tilt", TipTilt),
    ]


COUNTERS = (
    "commands",
    "held_nonfinite",
    "held_incomplete",
    "held_missing",
    "held_behind",
    "held_history",
    "held_closed",
    "dropped_duplicate",
    "dropped_late",
    "dropped_session",
    "dropped_fingerprint",
    "dropped_malformed",
    "clipped",
    "slewed",
    "scaled",
    "fallback",
    "changes_lost",
)


class Counters(Structure):
    """``srt_counters``."""

    _fields_ = [(name, c_uint64) for name in COUNTERS]


class Latency(Structure):
    """``srt_latency``."""

    _fields_ = [
        ("deadline_ns", c_int64),
        ("misses", c_int64),
        ("max_ns", c_int64),
        ("sum", c_double),
        ("squares", c_double),
        ("counts", c_int64 * BINS),
    ]


FAULTS, GOES_ON, SILENCE = 1, 3, 4
"""Of ``srt_reason``: the loop opened by itself; a session goes on with another frame; the loop opened by itself."""


class Change(Structure):
    """``srt_change``."""

    _fields_ = [
        ("session", c_uint64),
        ("token", c_uint64),
        ("frame", c_int64),
        ("number", c_int64),
        ("what", c_int32),
        ("reason", c_int32),
        ("state", c_int32),
    ]


class Snapshot(Structure):
    """``srt_snapshot``."""

    _fields_ = [
        ("session", c_uint64),
        ("token", c_uint64),
        ("frame", c_int64),
        ("first_frame", c_int64),
        ("stamp_sec", c_int32),
        ("stamp_nanosec", c_uint32),
        ("consecutive_holds", c_uint32),
        ("frames_closed", c_uint32),
        ("loop_state", c_int32),
        ("state", c_void_p),
        ("history", c_void_p),
        ("tip_tilt_frame", c_int64),
        ("tip_tilt", c_void_p),
    ]


class Ring(Structure):
    """``srt_ring``."""

    _fields_ = [
        ("memory", c_void_p),
        ("capacity", c_uint64),
        ("ahead", c_int64),
        ("position", c_uint64),
        ("number", c_uint64),
    ]


class Gate(Structure):
    """``srt_gate``."""

    _fields_ = [
        ("loop", POINTER(Loop)),
        ("session", c_uint64),
        ("last_slopes_ns", c_int64),
        ("last_tip_tilt_ns", c_int64),
        ("counters", Counters),
        ("latency", Latency),
        ("frame_latency", Latency),
        ("largest_message", c_size_t),
        ("publish", PUBLISH),
        ("publish_context", c_void_p),
        ("ring", Ring),
        ("failure", c_int32),
        ("stop", c_int32),
    ]


class Ros(Structure):
    """``srt_ros``."""

    _fields_ = [
        ("context", c_void_p),
        ("slopes", c_void_p),
        ("commands", c_void_p),
        ("wake", c_void_p),
        ("poll_ns", c_int64),
        ("received", c_void_p),
        ("received_room", c_size_t),
        ("received_count", c_size_t),
    ]


_LOOP, _GATE, _WORDS = POINTER(Loop), POINTER(Gate), POINTER(c_uint32)

_FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "srt_instructions": (c_char_p, ()),
    "srt_crew_new": (c_void_p, (c_uint32, c_int64, c_size_t)),
    "srt_crew_free": (None, (c_void_p,)),
    "srt_crew_thread": (c_int32, (c_void_p, c_uint32)),
    "srt_crew_multiply": (None, (c_void_p, POINTER(Product))),
    "srt_low_rank_multiply": (None, (c_void_p, POINTER(LowRank), c_uint32, c_uint32, c_void_p, c_void_p)),
    "srt_loop_use": (None, (_LOOP, c_void_p)),
    "srt_interleave": (None, (c_void_p, c_size_t, c_void_p)),
    "srt_loop_new": (_LOOP, (_WORDS, c_uint32, c_uint32, c_float, c_uint32, c_uint32)),
    "srt_loop_free": (None, (_LOOP,)),
    "srt_loop_start": (None, (_LOOP, c_int64, c_int)),
    "srt_loop_forget": (None, (_LOOP,)),
    "srt_loop_remember": (None, (_LOOP, c_int64, c_void_p, c_int64, c_int64, c_float)),
    "srt_loop_prepare": (None, (_LOOP,)),
    "srt_loop_add": (None, (_LOOP, c_uint32, c_void_p)),
    "srt_loop_answer": (c_int, (_LOOP, c_int64, c_int64, c_float)),
    "srt_loop_hold": (c_int, (_LOOP, c_int)),
    "srt_loop_flatten": (c_int, (_LOOP,)),
    "srt_loop_post": (c_uint64, (_LOOP, POINTER(Program))),
    "srt_loop_request": (None, (_LOOP, c_int)),
    "srt_loop_pending": (c_int, (_LOOP,)),
    "srt_received": (c_int64, (c_int64, c_int64)),
    "srt_latency_add": (None, (POINTER(Latency), c_int64)),
    "srt_tip_tilt_give": (None, (_LOOP, c_int64, c_uint32, c_void_p)),
    "srt_gate_new": (_GATE, (_WORDS, c_uint32, c_uint32, c_float, c_uint32, c_uint32, c_char_p, c_int64, c_int64)),
    "srt_gate_free": (None, (_GATE,)),
    "srt_gate_start": (None, (_GATE,)),
    "srt_gate_offer": (c_int64, (_GATE, c_char_p, c_size_t, c_int64)),
    "srt_gate_advance": (None, (_GATE,)),
    "srt_gate_idle": (None, (_GATE, c_int64)),
    "srt_gate_not_flat": (c_int, (_GATE,)),
    "srt_gate_flatten": (None, (_GATE,)),
    "srt_gate_next_change": (c_int, (_GATE, POINTER(Change))),
    "srt_gate_want_snapshot": (None, (_GATE,)),
    "srt_gate_next_snapshot": (POINTER(Snapshot), (_GATE,)),
    "srt_gate_snapshot_done": (None, (_GATE,)),
    "srt_abi": (c_size_t, ()),
}
_ROS_FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "srt_run": (c_int, (_GATE, POINTER(Ros))),
    "srt_ros_error": (None, (c_char_p, c_size_t)),
    "srt_ros_abi": (c_size_t, ()),
}


def _load(name: str, functions: dict[str, tuple[Any, tuple[Any, ...]]]) -> ctypes.CDLL:
    path = Path(os.environ.get("SRTOMO_FRAME_PATH") or Path(sysconfig.get_path("data"), "lib"), name)
    try:
        library = ctypes.CDLL(str(path))
        for function, (result, arguments) in functions.items():
            getattr(library, function).restype = result
            getattr(library, function).argtypes = arguments
    except (OSError, AttributeError) as error:
        raise ImportError(f"{path}: {error}; install srtomo again", name=__name__) from None
    return library


def _must_agree(library: int, here: int) -> None:
    if library != here:
        raise ImportError(
            "the compiled frame path is of another version than its Python: install srtomo again", name=__name__
        )


lib: Any = _load("libsrtomo_frame.so", _FUNCTIONS)


def load_ros() -> Any:
    """The library with ``srt_run``; rclpy must be loaded already.

    Raises:
        ImportError: it is not there, of another version, or ROS is not.
    """
    library = _load("libsrtomo_frame_ros.so", _ROS_FUNCTIONS)
    _must_agree(library.srt_ros_abi(), ctypes.sizeof(Ros))
    return library


class _Memory:
    """What NumPy takes for an array; keeps what owns the memory."""

    def __init__(self, owner: object, address: int, shape: tuple[int, ...], kind: str) -> None:
        self._owner = owner
        self.__array_interface__ = {"data": (address, False), "shape": shape, "typestr": kind, "version": 3}


def view(owner: object, address: int, shape: tuple[int, ...], kind: str = "<f4") -> NDArray[Any]:
    """Memory of the library as an array, which keeps ``owner``."""
    return np.asarray(_Memory(owner, address, shape, kind))


_must_agree(
    lib.srt_abi(),
    sum(map(ctypes.sizeof, (Product, Block, Zone, LowRank, Matrices, Program, Loop, Change, Snapshot, Gate))),
)
