"""Stage, check, warm and commit a reconstructor; all of it off the loop's thread.

A reconstructor comes as a manifest and row blocks. Shapes are checked against the instrument before memory is touched;
when the last row is in, the whole is checked (:meth:`Swap.check`), copied into the slot that the loop does not use, and
touched until warm. Nothing reaches the loop before :meth:`Swap.commit`, which posts one reference. There are three
slots: active, staged and previous.

Threads: one thread at a time, any but the loop's, calls everything here; the node has a worker for it. Attributes and
``missing`` may be read from any thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackError, eigs

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, ReconstructorError, block_table
from srtomo_core.system import System
from srtomo_core.wire import ReconstructorBlock
from srtomo_rtc.loop import Program, Settings, Slot

Floats = NDArray[np.float32]

STABILITY_LIMIT = 0.8
"""A reconstructor whose spectral radius of ``Q - R G_cal`` is not below this is refused."""

SCALE_LIMITS = (0.5, 1.2)
"""Where ``v.(R G_cal v) / v.v`` must lie for smooth, seen shapes v: a wrong sign or scale is refused."""

_SMOOTH_SHAPES = 20
_PROBE_TOLERANCE = 1e-3


class Refused(ValueError):
    """A reconstructor or request that is refused; one line that says why."""


@dataclass(frozen=True)
class Manifest:
    """What a Reconstructor message says of itself, as plain values; names as in msgs_schema/msg/Reconstructor."""

    sha256: bytes
    fingerprint: bytes
    n_commands: int
    n_slopes: int
    n_epochs: int
    n_blocks: int
    gain: float
    slope_reference: Floats
    command_limit: Floats
    probe_commands: Floats
    probe_slopes: Floats
    label: str = ""

    @property
    def id(self) -> int:
        """First 8 bytes of the digest."""
        return int.from_bytes(self.sha256[:8], "big")


@dataclass(frozen=True)
class Check:
    """The numbers of a passed check: ``stability`` is rho(Q - R G_cal), ``scale`` the range of v.(R G_cal v)/v.v."""

    stability: float
    scale: tuple[float, float]


@dataclass(frozen=True)
class Held:
    """A reconstructor in a slot."""

    slot: Slot
    check: Check
    reconstructor: Reconstructor

    @property
    def label(self) -> str:
        """For people."""
        return self.reconstructor.label


def spectral_radius(matrix: NDArray[np.float64]) -> float:
    """Largest absolute eigenvalue of a square matrix (Arnoldi; dense where that does not converge)."""
    if len(matrix) > 30:
        try:
            start = np.random.default_rng(0).standard_normal(len(matrix))
            values = eigs(matrix, k=4, which="LM", v0=start, return_eigenvectors=False, maxiter=2000, tol=1e-6)
            return float(np.abs(values).max())
        except ArpackError:  # no convergence, or nothing to start from: a matrix of zeros
            pass
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def smooth_shapes(layout: Layout, tip_tilt: bool) -> NDArray[np.float64]:
    """Low-order shapes of the mirrors, (n_shapes, n_commands): polynomials in x and y, orthonormal, without piston.

    They stand on the first mirror, whose commands alone make them; ``tip_tilt`` says whether some sensor sees those.
    """
    mirror = layout.mirrors[0]
    x, y = (mirror.actuators / np.abs(mirror.actuators).max()).T
    powers = [(a, degree - a) for degree in range(9) for a in range(degree, -1, -1)]
    polynomials = np.stack([x**a * y**b for a, b in powers[: _SMOOTH_SHAPES + 3]], axis=1)
    q, _ = np.linalg.qr(polynomials)
    unseen = 1 if tip_tilt else 3
    shapes = np.zeros((q.shape[1] - unseen, layout.n_commands))
    shapes[:, layout.commands_of(0)] = q.T[unseen:]
    return shapes[:_SMOOTH_SHAPES]


def check(reconstructor: Reconstructor, layout: Layout, G_cal: Floats, tip_tilt: bool) -> Check:
    """Check a whole reconstructor against the instrument's calibrated interaction matrix.

    Args:
        G_cal: (n_slopes, n_commands), rad/m.
        tip_tilt: whether some sensor sees overall tip-tilt.

    Raises:
        Refused: with the reason.
    """
    if reconstructor.fingerprint != layout.fingerprint:
        raise Refused(
            f"made for another instrument (fingerprint {reconstructor.fingerprint.hex()[:12]}, "
            f"this one is {layout.fingerprint.hex()[:12]})"
        )
    if (reconstructor.n_epochs, reconstructor.n_commands, reconstructor.n_slopes) != (
        1,
        layout.n_commands,
        layout.n_slopes,
    ):
        raise Refused(f"expected R of shape (1, {layout.n_commands}, {layout.n_slopes}), got {reconstructor.R.shape}")
    if not 0 < reconstructor.gain <= 1:
        raise Refused(f"gain: expected above 0 and at most 1, got {reconstructor.gain:g}")
    for name in ("R", "Q", "slope_reference", "probe_commands", "probe_slopes"):
        if not np.isfinite(getattr(reconstructor, name)).all():
            raise Refused(f"{name}: holds values that are not finite")
    if not (reconstructor.command_limit > 0).all():
        raise Refused("command_limit: expected every limit above 0")
    R = reconstructor.R[0]
    Q = reconstructor.Q[0]
    _check_probes(reconstructor, R, Q)
    closed = R @ G_cal
    shapes = smooth_shapes(layout, tip_tilt)
    ratios = np.einsum("ij,ij->i", shapes, shapes @ closed.T.astype(np.float64))
    low, high = float(ratios.min()), float(ratios.max())
    if not SCALE_LIMITS[0] <= low <= high <= SCALE_LIMITS[1]:
        raise Refused(
            f"wrong sign or scale: v.(R G_cal v)/v.v of smooth shapes is {low:.3g} to {high:.3g}, "
            f"expected {SCALE_LIMITS[0]:g} to {SCALE_LIMITS[1]:g}"
        )
    stability = spectral_radius((Q - closed).astype(np.float64))
    if not stability < STABILITY_LIMIT:
        raise Refused(
            f"not stable enough: spectral radius of Q - R G_cal is {stability:.3f}, limit {STABILITY_LIMIT:g}"
        )
    return Check(stability, (low, high))


def _check_probes(reconstructor: Reconstructor, R: Floats, Q: Floats) -> None:
    if len(reconstructor.probe_commands) == 0:
        raise Refused("probe_commands: expected at least one, to check that Q belongs to R")
    through_r = reconstructor.probe_slopes @ R.T
    through_q = reconstructor.probe_commands @ Q.T
    error = float(np.linalg.norm(through_r - through_q))
    scale = float(np.linalg.norm(through_r))
    if not (scale > 0 and error <= _PROBE_TOLERANCE * scale):
        raise Refused(f"Q is not R G: they differ by {error / scale if scale else math.inf:.2g} on probes")


class Swap:
    """Slots, the transfer under way, and what the loop is to run.

    Args:
        layout, system: the instrument.
        G_cal: (n_slopes, n_commands) calibrated interaction matrix, rad/m.
        settings: at the start.
        post: hands a Program to the loop (``Loop.post``), which must have taken it up before the next one is posted, or
            else run no frame before: slots are used again.

    Raises:
        ValueError: G_cal is not of the instrument's shape.
    """

    def __init__(
        self, system: System, layout: Layout, G_cal: Floats, settings: Settings, post: Callable[[Program], None]
    ) -> None:
        if G_cal.shape != (layout.n_slopes, layout.n_commands):
            raise ValueError(f"G_cal: expected shape {(layout.n_slopes, layout.n_commands)}, got {G_cal.shape}")
        self._layout = layout
        self._G_cal = G_cal
        self._tip_tilt = any(star.tip_tilt == "seen" for star in map(system.star_of, system.sensors))
        self._post = post
        self._slots = [Slot(layout) for _ in range(3)]
        self._manifest: Manifest | None = None
        self._R = np.zeros((layout.n_commands, layout.n_slopes), np.float32)
        self._Q = np.zeros((layout.n_commands, layout.n_commands), np.float32)
        self._table: list[tuple[int, int, int, int]] = []
        self._waiting: frozenset[int] = frozenset()
        self.settings = settings
        self.active: Held | None = None
        self.staged: Held | None = None
        self.previous: Held | None = None

    # -- transfer ---------------------------------------------------------------------------------------------------

    def begin(self, manifest: Manifest) -> None:
        """Start a transfer; one that was under way is forgotten.

        Raises:
            Refused: the manifest does not fit the instrument.
        """
        self._manifest = None
        layout = self._layout
        if manifest.fingerprint != layout.fingerprint:
            raise Refused(
                f"made for another instrument (fingerprint {manifest.fingerprint.hex()[:12]}, "
                f"this one is {layout.fingerprint.hex()[:12]})"
            )
        if manifest.n_epochs != 1:
            raise Refused(f"uses {manifest.n_epochs} exposures; this loop takes 1")
        if (manifest.n_commands, manifest.n_slopes) != (layout.n_commands, layout.n_slopes):
            raise Refused(
                f"expected {layout.n_commands} commands x {layout.n_slopes} slopes, "
                f"got {manifest.n_commands} x {manifest.n_slopes}"
            )
        table = block_table(manifest.n_commands, manifest.n_epochs)
        if manifest.n_blocks != len(table):
            raise Refused(f"expected {len(table)} blocks, got {manifest.n_blocks}")
        if len(manifest.probe_commands) % layout.n_commands or len(manifest.probe_slopes) % layout.n_slopes:
            raise Refused("probe_commands, probe_slopes: expected whole vectors")
        self._table = table
        self._waiting = frozenset(range(len(table)))
        self._manifest = manifest

    def take(self, block: ReconstructorBlock) -> bool:
        """Put one block in its place; blocks of other transfers are ignored. True when it was the last one.

        Raises:
            Refused: its shape is not what the table says; the transfer is forgotten.
        """
        manifest = self._manifest
        if manifest is None or block.sha256 != manifest.sha256 or block.number not in self._waiting:
            return False
        epoch, matrix, first, rows = self._table[block.number]
        target = self._R if matrix == 0 else self._Q
        if (block.epoch, block.matrix, block.first_row, block.rows.shape) != (
            epoch,
            matrix,
            first,
            (rows, target.shape[1]),
        ):
            self._manifest = None
            raise Refused(f"block {block.number}: expected {rows} rows x {target.shape[1]}, got {block.rows.shape}")
        target[first : first + rows] = block.rows
        self._waiting -= {block.number}
        return not self._waiting

    @property
    def missing(self) -> tuple[int, list[int]] | None:
        """(id, block indices) of the transfer under way, if any is."""
        manifest, waiting = self._manifest, self._waiting
        if manifest is None or not waiting:
            return None
        return manifest.id, sorted(waiting)

    def stage(self) -> Held:
        """Check what was transferred and put it, warm, into the staged slot.

        Raises:
            Refused: with the reason; what was staged before stays.
        """
        manifest, self._manifest = self._manifest, None
        if manifest is None or self._waiting:
            raise Refused("no whole reconstructor has come")
        try:
            reconstructor = Reconstructor(
                fingerprint=manifest.fingerprint,
                R=self._R[None],
                Q=self._Q[None],
                gain=manifest.gain,
                slope_reference=manifest.slope_reference,
                command_limit=manifest.command_limit,
                probe_commands=manifest.probe_commands.reshape(-1, self._layout.n_commands),
                probe_slopes=manifest.probe_slopes.reshape(-1, self._layout.n_slopes),
                label=manifest.label,
            )
        except ReconstructorError as error:
            raise Refused(str(error)) from None
        if reconstructor.sha256 != manifest.sha256:
            raise Refused(
                f"checksum: content gives {reconstructor.sha256.hex()[:12]}, manifest says {manifest.sha256.hex()[:12]}"
            )
        return self.stage_whole(reconstructor)

    def stage_whole(self, reconstructor: Reconstructor) -> Held:
        """As :meth:`stage`, for a reconstructor that is whole already (from a file)."""
        result = check(reconstructor, self._layout, self._G_cal, self._tip_tilt)
        in_use = {id(held.slot) for held in (self.active, self.previous) if held is not None}
        slot = next(slot for slot in self._slots if id(slot) not in in_use)
        slot.fill(reconstructor)
        Program(slot, self.settings).warm()
        self.staged = Held(slot, result, reconstructor)
        return self.staged

    def forget(self) -> None:
        """Give the transfer under way up."""
        self._manifest = None

    def save_active(self, path: str) -> None:
        """Write the active reconstructor to a file, for a restart."""
        if self.active is not None:
            self.active.reconstructor.save(path)

    # -- what the loop runs -----------------------------------------------------------------------------------------

    def commit(self, identity: int, sha256: bytes) -> Program:
        """Post the staged reconstructor to the loop; the active one becomes the previous.

        Raises:
            Refused: nothing is staged under that id and SHA-256.
        """
        program = self._run(self.staged, identity, sha256, "staged")
        self.previous, self.active, self.staged = self.active, self.staged, None
        return program

    def roll_back(self, identity: int, sha256: bytes) -> Program:
        """Post the previous reconstructor to the loop; the active one becomes the previous.

        Raises:
            Refused: the previous one does not have that id and SHA-256.
        """
        program = self._run(self.previous, identity, sha256, "kept as the previous one")
        self.previous, self.active = self.active, self.previous
        return program

    def _run(self, held: Held | None, identity: int, sha256: bytes, where: str) -> Program:
        if held is None:
            raise Refused(f"no reconstructor is {where}")
        if held.slot.id != identity:
            raise Refused(f"reconstructor {identity:016x} is not {where}: that is {held.slot.id:016x}")
        if held.slot.sha256 != sha256:
            raise Refused(f"reconstructor {identity:016x} has SHA-256 {held.slot.sha256.hex()}, got {sha256.hex()}")
        program = Program(held.slot, self.settings)
        self._post(program)
        return program

    def change_settings(self, **changes: object) -> Program | None:
        """New settings, under a new id, from the next frame on; None while no reconstructor is active."""
        self.settings = replace(self.settings, id=self.settings.id + 1, **changes)  # type: ignore[arg-type]
        if self.active is None:
            return None
        program = Program(self.active.slot, self.settings)
        self._post(program)
        return program
