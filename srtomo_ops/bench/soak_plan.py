"""What a soak sends: drawn beforehand from a seed, so that who sends and who checks need to tell each other nothing.

Every frame's slopes are one of a few random vectors or the negative of one. In every stretch of :data:`STRETCH` frames
one frame has a fault. Several reconstructors take turns, which differ everywhere: a command made with parts of two
is far from those of either.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_core.wire import MIRROR_UNKNOWN, SlopeFrameWriter
from srtomo_sim.mirror import interaction_matrix

SESSION = 1
STRETCH = 100
"""Frames of which one has a fault, far enough from the next that it is answered before."""

RECONSTRUCTORS = 4
"""Each has to give way to the next one in memory, before it comes again."""

_MARGIN = 8  # frames at either end of a stretch without a fault
_VECTORS = 32
_SLOPE = 1e-7  # rad rms
_DAMPING = 1e-2  # of the least-squares reconstructors, of the largest eigenvalue of G'G
_DIFFERENCE = 0.05  # of the rms element of a reconstructor, to the others


class Fault(enum.IntEnum):
    """What is wrong with a frame; ``victim`` is the sensor in question, where it is one alone."""

    NONE = 0
    NONFINITE = 1  # a slope of the victim is NaN
    DUPLICATE = 2  # the victim's message comes twice
    LATE = 3  # the whole frame comes after the answer to its successor
    OVERTAKEN = 4  # the whole frame comes after its successor, at once
    NO_SENSOR = 5  # nothing comes from the victim
    NO_FRAME = 6  # nothing comes
    MALFORMED = 7  # the victim's message is cut off
    FOREIGN = 8  # the victim's message is another instrument's


SKIPPED = (Fault.NO_SENSOR, Fault.MALFORMED, Fault.FOREIGN)
"""Faults by which the victim's slopes do not come."""


@dataclass(frozen=True)
class Plan:
    """What every frame is.

    Attributes:
        vectors: (n, n_slopes) rad, float32.
        rows: (frames,) which of them a frame has.
        faults: (frames,) of :class:`Fault`.
        victims: (frames,) sensors.
    """

    layout: Layout
    vectors: NDArray[np.float32]
    rows: NDArray[np.uint8]
    faults: NDArray[np.uint8]
    victims: NDArray[np.uint8]

    @classmethod
    def of(cls, layout: Layout, frames: int, seed: int) -> Plan:
        """Draw it."""
        random = np.random.default_rng([seed, frames])
        some = random.standard_normal((_VECTORS, layout.n_slopes)) * _SLOPE
        # a sensor of a few slopes has as much to say in a command as one of many
        counts = np.array([sensor.n_slopes for sensor in layout.sensors])
        some *= np.repeat(np.sqrt(counts.max() / counts), counts)
        faults = np.zeros(frames, np.uint8)
        starts = np.arange(0, frames - STRETCH + 1, STRETCH)
        places = starts + random.integers(_MARGIN, STRETCH - _MARGIN, len(starts))
        # every kind as often, in random order
        kinds = np.arange(len(places)) % (len(Fault) - 1) + 1
        random.shuffle(kinds)
        faults[places] = kinds
        return cls(
            layout,
            np.concatenate([some, -some]).astype(np.float32),
            random.integers(0, 2 * _VECTORS, frames).astype(np.uint8),
            faults,
            random.integers(0, len(layout.sensors), frames).astype(np.uint8),
        )

    @property
    def frames(self) -> int:
        """How many there are."""
        return len(self.rows)

    def slopes(self, frame: int, sensor: int) -> NDArray[np.float32]:
        """What a sensor sends in a frame, NaN included."""
        own = self.vectors[self.rows[frame], self.layout.slopes_of(sensor)]
        if self.faults[frame] == Fault.NONFINITE and self.victims[frame] == sensor:
            own = own.copy()
            own[frame % len(own)] = np.nan
        return own

    def copies(self, frame: int) -> NDArray[np.int64]:
        """(sensors,) how often each sensor's slopes of a frame are sent whole."""
        n, victim = np.ones(len(self.layout.sensors), np.int64), self.victims[frame]
        fault = self.faults[frame]
        if fault == Fault.NO_FRAME:
            n[:] = 0
        elif fault in SKIPPED:
            n[victim] = 0
        elif fault == Fault.DUPLICATE:
            n[victim] = 2
        return n


class Sensors:
    """Writes a plan's messages, one a sensor."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan

        def writers(fingerprint: bytes) -> list[SlopeFrameWriter]:
            return [
                SlopeFrameWriter(sensor.name, SESSION, fingerprint, w, 1, sensor.n_valid)
                for w, sensor in enumerate(plan.layout.sensors)
            ]

        self._own = writers(plan.layout.fingerprint)
        self._foreign = writers(bytes(32))

    def messages(self, frame: int, stamp_ns: int) -> list[bytes]:
        """All that is sent of a frame, in order; ``stamp_ns`` since the epoch."""
        plan = self._plan
        fault, victim = plan.faults[frame], plan.victims[frame]
        made = []
        for w in range(len(self._own)) if fault != Fault.NO_FRAME else ():
            hit = fault != Fault.NONE and w == victim
            if hit and fault == Fault.NO_SENSOR:
                continue
            writer = (self._foreign if hit and fault == Fault.FOREIGN else self._own)[w]
            writer.values[:] = plan.slopes(frame, w)
            message = writer.write(stamp_ns, frame, MIRROR_UNKNOWN, MIRROR_UNKNOWN, 1.0)
            made.append(message[:-5] if hit and fault == Fault.MALFORMED else message)
            if hit and fault == Fault.DUPLICATE:
                # by its stamp a recorder can tell it from one message that came by two ways
                made.append(writer.write(stamp_ns + 1, frame, MIRROR_UNKNOWN, MIRROR_UNKNOWN, 1.0))
        return made


class Matrices(NamedTuple):
    """What the loop runs with.

    Attributes:
        G: (n_slopes, n_commands) rad/m, of the simulated instrument.
        good: :data:`RECONSTRUCTORS` that pass every check of the HRTC.
        bad: one that it has to refuse: the first with its sign changed.
    """

    G: NDArray[np.float64]
    good: list[Reconstructor]
    bad: Reconstructor

    @classmethod
    def of(cls, system: System, layout: Layout, seed: int) -> Matrices:
        """Damped least squares, each with its own damping and a few per cent of its own."""
        G = interaction_matrix(system, layout)
        normal = G.T @ G
        largest = np.linalg.norm(normal, 2)
        random = np.random.default_rng(seed)

        def reconstructor(number: int, sign: float = 1.0) -> Reconstructor:
            R = np.linalg.solve(normal + _DAMPING * (1 + number / RECONSTRUCTORS) * largest * np.eye(len(normal)), G.T)
            R += _DIFFERENCE * np.sqrt(np.mean(R**2)) * random.standard_normal(R.shape)
            return Reconstructor.from_matrices(
                sign * R,
                G,
                fingerprint=layout.fingerprint,
                gain=system.loop.gain,
                command_limit=layout.stroke,
                label=f"soak {number}" if sign > 0 else "wrong sign",
            )

        return cls(G, [reconstructor(number) for number in range(RECONSTRUCTORS)], reconstructor(0, -1.0))

    def save(self, folder: Path) -> None:
        """One file a reconstructor, for :meth:`load`."""
        for name, one in zip(_files(folder), (*self.good, self.bad), strict=True):
            one.save(name)

    @staticmethod
    def load(folder: Path) -> tuple[list[Reconstructor], Reconstructor]:
        """The good ones and the bad one."""
        *good, bad = (Reconstructor.load(name) for name in _files(folder))
        return good, bad


def _files(folder: Path) -> list[Path]:
    return [folder / f"{name}.npz" for name in (*(f"good_{i}" for i in range(RECONSTRUCTORS)), "bad")]
