"""The loop's thread in C, and another that posts programs, asks for snapshots and takes what is told, all at once.

No lock of the interpreter orders the two: a thread sanitizer sees what they share (``make sanitize``).
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_ops.simulate import plain_settings, program_of
from srtomo_rtc import native
from srtomo_rtc.hrtc import Hrtc
from srtomo_rtc.loop import Verdict

FRAMES = 3000
SESSION = 3


class Kept(ctypes.Structure):
    """``kept`` of drive_gate.c."""

    _fields_ = [
        ("commands", ctypes.c_void_p),
        ("size", ctypes.c_size_t),
        ("count", ctypes.c_size_t),
        ("room", ctypes.c_size_t),
    ]


@pytest.fixture
def driver(tmp_path):
    """drive_gate.c, with the frame path that is loaded here."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    made, here = tmp_path / "drive.so", Path(__file__).parent
    headers = here.parents[1] / "srtomo_rtc" / "native"
    words = [compiler, "-O2", "-shared", "-fPIC", "-I", headers, "-o", made, here / "drive_gate.c", native.lib._name]
    subprocess.run(words, check=True)
    return ctypes.CDLL(str(made))


def test_what_is_posted_is_taken_up_whole_and_what_is_told_is_true(driver, mini):
    """Every command is bit for bit that of a loop in lockstep with the same programs from the same frames on."""
    layout = mini.layout
    programs = [program_of(layout, one, plain_settings(layout)) for one in (mini.a, mini.b)]
    writer = wire.SlopeFrameWriter("all", SESSION, layout.fingerprint, 0, len(layout.sensors), layout.n_slopes // 2)
    slopes = np.random.default_rng(0).standard_normal((16, layout.n_slopes)) * 1e-7
    messages = []
    for frame in range(FRAMES):
        writer.values[:] = slopes[frame % 8] * (-1 if frame % 16 > 7 else 1)
        messages.append(writer.write(frame, frame, wire.MIRROR_UNKNOWN, wire.MIRROR_UNKNOWN, 1.0))
    joined = b"".join(messages)

    def new(publish) -> Hrtc:
        made = Hrtc(layout, 2.0, publish)
        made.loop.post(programs[0])
        made.loop.request(closed=True)
        return made

    hrtc = new(lambda _: None)
    size = len(wire.DmCommandWriter("dm", layout.n_commands).buffer)
    commands = ctypes.create_string_buffer(size * FRAMES)
    kept = Kept(ctypes.addressof(commands), size, 0, FRAMES)
    hrtc._c.publish = ctypes.cast(driver.keep, native.PUBLISH)
    hrtc._c.publish_context = ctypes.addressof(kept)
    failures = []
    drive = driver.drive
    drive.argtypes = (ctypes.POINTER(native.Gate), ctypes.c_char_p, ctypes.c_size_t, ctypes.c_size_t)
    arguments = (hrtc.gate, joined, len(messages[0]), FRAMES)
    loop = threading.Thread(target=lambda: failures.append(drive(*arguments)))
    changes, snapshots, posted = [], [], 0
    loop.start()
    while loop.is_alive():
        posted += 1
        hrtc.loop.post(programs[posted % 2])
        time.sleep(1e-3)
        hrtc.want_snapshot()
        while not hrtc.changes.empty():
            changes.append(hrtc.changes.get())
        while not hrtc.snapshots.empty():
            snapshots.append(hrtc.snapshots.get())
    loop.join()
    while not hrtc.changes.empty():
        changes.append(hrtc.changes.get())
    assert failures == [0] and kept.count == FRAMES and hrtc.counters.changes_lost == 0
    found = [wire.read_dm_command(commands.raw[i * size : (i + 1) * size]) for i in range(FRAMES)]

    expected: list[wire.DmCommand] = []
    again = new(lambda buffer: expected.append(wire.read_dm_command(buffer)))
    taken_up = {change.frame: change.program for change in changes if change.what == "PROGRAM"}
    assert len(taken_up) > 1 and snapshots
    if 0 in taken_up:
        again.loop.post(taken_up.pop(0))
    again.start()
    for frame, message in enumerate(messages):
        if frame in taken_up:
            again.loop.post(taken_up[frame])
            again.idle(0)
        again.offer(message, frame)
        again.advance()
    assert taken_up and snapshots
    for one, other in zip(found, expected, strict=True):
        assert (one.frame, one.reconstructor, one.verdict) == (other.frame, other.reconstructor, Verdict.OK)
        assert one.commands.tobytes() == other.commands.tobytes()
    for snapshot in snapshots:
        assert np.array_equal(snapshot.state, found[snapshot.frame].commands)
