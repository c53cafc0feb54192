"""Stage, check, warm and commit a reconstructor; all of it off the loop's thread.

A reconstructor comes as a manifest and row blocks. Shapes are checked against the instrument before memory is touched;
when the last row is in, the whole is checked (:func:`check`), copied into a slot that the loop does not use, and
touched until warm. Nothing reaches the loop before :meth:`Swap.commit`, which posts one reference. There are three
slots: active, staged and previous.

Threads: two at a time, neither of them the loop's. One transfers and stages (``begin``, ``take``, ``forget``,
``stage``, ``stage_whole``, ``scratch``), which may take a minute. The other says what the loop runs (``commit``,
``roll_back``, ``change_settings``), and never waits for that: the lock that is between them is held while slots change
hands, and while a :class:`~srtomo_rtc.loop.Program` is made, but not while one is checked, filled or warmed for
staging. A slot that is being filled is in nobody's hands: it cannot be committed or rolled back to. ``holds`` and
``save_active`` may be called, attributes and ``missing`` read, from any thread.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackError, eigs

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import LowOrder, Reconstructor, ReconstructorError, block_table, n_parts
from srtomo_core.system import System
from srtomo_core.wire import ReconstructorBlock
from srtomo_rtc.compression import LIMIT, error_to_noise, int16_to_noise
from srtomo_rtc.loop import Matrices, Program, Settings, Slot, star_weights, used_by
from srtomo_rtc.lowrank import Factors, factorise

Floats = NDArray[np.float32]

STABILITY_LIMIT = 0.8
"""A reconstructor whose spectral radius of ``Q - R G_cal`` (see :func:`stability`) is not below this is refused."""

SCALE_LIMITS = (0.5, 1.2)
"""Where ``w.(G_cal R w) / w.w`` must lie for the slopes w = G_cal v of smooth, seen shapes v of each mirror.

A wrong sign or scale is refused. In slopes, not in commands: with several mirrors a shape may rightly come back on
others that look the same to the sensors. Where sensors are closed, the estimate with the rest rightly corrects less
(with stars far apart under strong high layers 0.43 of a shape where all together do 0.75): what a closure corrects must
lie there relative to what the newest exposure of all sensors does.
"""

MAX_CLOSURES = 8
"""Sets of closed sensors that a reconstructor may have R and Q for, unless a parameter says otherwise."""

_SMOOTH_SHAPES = 20
_ANGLES = 4  # a half circle and an epoch after the first
_PROBE_TOLERANCE = 1e-3
_LOW_ORDER_MARGIN = 1.5


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
    closed_sensors: tuple[int, ...] = ()
    low_order_commands: Floats = field(default_factory=lambda: np.zeros(0, np.float32))
    low_order_slopes: Floats = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def id(self) -> int:
        """First 8 bytes of the digest."""
        return int.from_bytes(self.sha256[:8], "big")


@dataclass(frozen=True)
class Check:
    """The numbers of a passed check.

    Attributes:
        stability: :func:`stability`, of the fallback and the closures too: the largest one.
        scale: range of ``w.(G_cal R w) / w.w`` for the slopes w of smooth shapes, R summed over the epochs, and of the
            fallback's; NaN where no mirror is seen.
        unseen: names of mirrors that no sensor sees, whose sign and scale nothing here can tell.
        compression: what a kernel that does not hold R in float32 makes of it; empty: nothing.
    """

    stability: float
    scale: tuple[float, float]
    unseen: tuple[str, ...] = ()
    compression: str = ""

    def __str__(self) -> str:
        text = f"stability {self.stability:.3f}"
        if not math.isnan(self.scale[0]):
            text += f", scale {self.scale[0]:.2f} to {self.scale[1]:.2f}"
        if self.unseen:
            text += f"; {', '.join(self.unseen)}: seen by no sensor, sign and scale not checked"
        return f"{text}; {self.compression}" if self.compression else text


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


def spectral_radius(matrix: NDArray[np.inexact]) -> float:
    """Largest absolute eigenvalue of a square matrix, real or complex (Arnoldi; dense where that does not converge)."""
    if len(matrix) > 30:
        try:
            start = np.random.default_rng(0).standard_normal(len(matrix))
            values = eigs(matrix, k=4, which="LM", v0=start, return_eigenvectors=False, maxiter=2000, tol=1e-6)
            return float(np.abs(values).max())
        except ArpackError:  # no convergence, or nothing to start from: a matrix of zeros
            pass
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def stability(mismatch: NDArray[np.float64]) -> float:
    """The number below 1 that makes pseudo-open-loop control stable at every delay and gain.

    With ``E_j = Q_j - R_j G_cal`` the loop's own response is ``u[k] = (1-g) u[k-1] + g sum_j E_j u~[k-j]``. A mode that
    grows or lasts, ``z^k`` with ``|z| >= 1``, needs an eigenvalue e of ``E(z) = sum_j E_j z^-j`` with
    ``1 - (1-g)/z = g e d(z)``, where the delay's ``|d(z)| <= 1`` and the left side is at least g: so ``|e| >= 1``. The
    spectral radius of E(z) outside the unit circle is nowhere larger than on it (it is subharmonic), so that the number
    is its largest value there; of one epoch that is ``rho(Q - R G_cal)``. The sum of all E_j, z = 1, is not enough.
    On the circle it is sampled at so many angles that a polynomial of that degree is at most 8 % larger in between.

    Args:
        mismatch: (n_epochs, n_commands, n_commands) E_j.
    """
    degree = len(mismatch) - 1
    if degree == 0:
        return spectral_radius(mismatch[0])
    angles = np.linspace(0, math.pi, _ANGLES * degree + 1)
    return max(
        spectral_radius(np.tensordot(np.exp(-1j * angle * np.arange(degree + 1)), mismatch, 1)) for angle in angles
    )


def seen_low_orders(system: System, layout: Layout) -> tuple[bool, bool]:
    """Whether some sensor sees overall tip-tilt; and focus, which one lenslet alone takes for a tilt.

    Sensors of tip-tilt's own loop do not count: what they see is not the high orders'.
    """
    high_orders = [
        (system.star_of(sensor), place)
        for w, (sensor, place) in enumerate(zip(system.sensors, layout.sensors, strict=True))
        if w not in layout.tip_tilt_sensors
    ]
    return any(star.tip_tilt == "seen" for star, _ in high_orders), any(
        star.focus == "seen" and place.n_valid > 1 for star, place in high_orders
    )


def smooth_shapes(layout: Layout, tip_tilt: bool, focus: bool = True, mirror: int = 0) -> NDArray[np.float64]:
    """Low-order shapes of a mirror, (n_shapes, n_commands): polynomials in x and y, orthonormal, without piston.

    Its commands alone make them; ``tip_tilt`` and ``focus`` say whether some sensor sees those: if not, the shapes are
    orthogonal to them. At most a quarter as many as the mirror has actuators: more are not smooth.
    """
    place = layout.mirrors[mirror]
    x, y = (place.actuators / np.abs(place.actuators).max()).T
    tilts, quadratics = [x, y], [x * y, y * y, x * x + y * y]
    higher = [x**a * y ** (degree - a) for degree in range(3, 7) for a in range(degree, -1, -1)]
    unseen = [np.ones_like(x)] + ([] if tip_tilt else tilts) + ([] if focus else quadratics[2:])
    seen = (tilts if tip_tilt else []) + (quadratics if focus else quadratics[:2]) + higher
    q, _ = np.linalg.qr(np.stack([*unseen, *seen], axis=1))
    n_shapes = min(_SMOOTH_SHAPES, len(x) // 4)
    shapes = np.zeros((n_shapes, layout.n_commands))
    shapes[:, layout.commands_of(mirror)] = q.T[len(unseen) : len(unseen) + n_shapes]
    return shapes


def check(
    reconstructor: Reconstructor,
    layout: Layout,
    G_cal: Floats,
    tip_tilt: bool,
    focus: bool = True,
    delay: float = 1.0,
) -> Check:
    """Check a whole reconstructor against the instrument's calibrated interaction matrix.

    Args:
        G_cal: (n_slopes, n_commands), rad/m; 0 for mirrors that no sensor sees (multi-object correction in open loop).
        tip_tilt, focus: whether some sensor sees these overall.
        delay: of the loop, frames; what is left as an integrator (the low order) is not stable at every one.

    Raises:
        Refused: with the reason.
    """
    if reconstructor.fingerprint != layout.fingerprint:
        raise Refused(
            f"made for another instrument (fingerprint {reconstructor.fingerprint.hex()[:12]}, "
            f"this one is {layout.fingerprint.hex()[:12]})"
        )
    shape = layout.n_commands, layout.n_slopes
    if reconstructor.R.shape[1:] != shape:
        raise Refused(f"expected R of shape {(reconstructor.n_epochs, *shape)}, got {reconstructor.R.shape}")
    if not 0 < reconstructor.gain <= 1:
        raise Refused(f"gain: expected above 0 and at most 1, got {reconstructor.gain:g}")
    for name in ("R", "Q", "fallback_R", "fallback_Q", "slope_reference", "probe_commands", "probe_slopes"):
        values = getattr(reconstructor, name)
        if values is not None and not np.isfinite(values).all():
            raise Refused(f"{name}: holds values that are not finite")
    _check_closures(reconstructor, layout)
    if not (reconstructor.command_limit > 0).all():
        raise Refused("command_limit: expected every limit above 0")
    if layout.tip_tilt_sensors:
        for R, _ in (reconstructor.parts[0], reconstructor.parts[n_parts(reconstructor.n_epochs) - 1]):
            _check_tip_tilt(R, layout, G_cal)
        # from here on the high orders': their Q is of the slopes that their loop has
        G_cal = G_cal.copy()
        for w in layout.tip_tilt_sensors:
            G_cal[layout.slopes_of(w)] = 0
    seen = [bool(G_cal[:, layout.commands_of(i)].any()) for i in range(len(layout.mirrors))]
    _check_probes(reconstructor, layout, seen)

    n = reconstructor.n_epochs
    alone = reconstructor.parts[n:]
    sums = [reconstructor.R.sum(axis=0), *(R for R, _ in alone)]
    groups = [reconstructor.parts[:n], *([part] for part in alone)]
    stabilities = [stability(np.stack([Q - R @ G_cal for R, Q in group]).astype(np.float64)) for group in groups]
    low = high = math.nan
    if any(seen):
        shapes = [smooth_shapes(layout, tip_tilt, focus, mirror) for mirror, some in enumerate(seen) if some]
        slopes = np.concatenate(shapes).astype(np.float32) @ G_cal.T
        power = np.einsum("ij,ij->i", slopes, slopes, dtype=np.float64)
        ratios = [np.einsum("ij,ij->i", slopes, slopes @ R.T @ G_cal.T, dtype=np.float64) / power for R in sums]
        whole = len(ratios) - len(reconstructor.closures)
        low, high = _check_scale(ratios[:whole], "of the slopes of smooth shapes, {} is corrected")
        for closure, ratio in zip(reconstructor.closures, ratios[whole:], strict=True):
            closed = ", ".join(sensor.name for w, sensor in enumerate(layout.sensors) if closure.sensors >> w & 1)
            relative = "without " + closed + ", {} of what else is corrected of smooth shapes"
            _check_scale([ratio / ratios[whole - 1]], relative)
    if not max(stabilities) < STABILITY_LIMIT:
        raise Refused(
            f"not stable enough: spectral radius of Q - R G_cal is {max(stabilities):.3f}, limit {STABILITY_LIMIT:g}"
        )
    if reconstructor.low_order is not None:
        _check_low_order(reconstructor.low_order, reconstructor.gain, G_cal, delay)
    unseen = tuple(mirror.name for mirror, some in zip(layout.mirrors, seen, strict=True) if not some)
    return Check(max(stabilities), (low, high), unseen)


def _check_scale(ratios: list[Floats], told: str) -> tuple[float, float]:
    """The range of all, which must be within :data:`SCALE_LIMITS`.

    Args:
        told: with {} where the range goes.

    Raises:
        Refused: it is not.
    """
    low, high = float(np.min(ratios)), float(np.max(ratios))
    if not SCALE_LIMITS[0] <= low <= high <= SCALE_LIMITS[1]:
        limits = f"expected {SCALE_LIMITS[0]:g} to {SCALE_LIMITS[1]:g}"
        raise Refused(f"wrong sign or scale: {told.format(f'{low:.3g} to {high:.3g}')}, {limits}")
    return low, high


def _check_tip_tilt(R: Floats, layout: Layout, G_cal: Floats) -> None:
    """What tip-tilt's own loop makes of each star's alone has the sign and scale that the star's weight says.

    With that any of them can be lost: what the rest makes lies in between.

    Raises:
        Refused: with the star.
    """
    weights = star_weights(layout, R)
    tilts = np.zeros((2, layout.n_slopes), np.float32)
    for w in layout.tip_tilt_sensors:
        place = layout.sensors[w]
        c, s = math.cos(place.rotation), math.sin(place.rotation)
        tilts[:, layout.slopes_of(w)] = np.kron([[c, -s], [s, c]], np.ones(place.n_valid))
    for w in layout.tip_tilt_sensors:
        own = layout.slopes_of(w)
        seen = tilts[:, own] @ R[:, own].T @ G_cal.T
        ratios = np.einsum("ij,ij->i", seen, tilts) / np.einsum("ij,ij->i", tilts, tilts) / max(weights[w], 1e-9)
        if not (SCALE_LIMITS[0] <= ratios.min() and ratios.max() <= SCALE_LIMITS[1]):
            raise Refused(
                f"wrong sign or scale: of the tip-tilt that {layout.sensors[w].name} sees, {ratios.min():.3g} to "
                f"{ratios.max():.3g} is corrected, expected {SCALE_LIMITS[0]:g} to {SCALE_LIMITS[1]:g}"
            )


def _check_probes(reconstructor: Reconstructor, layout: Layout, seen: list[bool]) -> None:
    """Every Q belongs to its R, and is 0 for commands of mirrors that no sensor sees."""
    if len(reconstructor.probe_commands) == 0:
        raise Refused("probe_commands: expected at least one, to check that Q belongs to R")
    for i, (R, Q) in enumerate(reconstructor.parts):
        through_r = reconstructor.probe_slopes @ R.T
        through_q = reconstructor.probe_commands @ Q.T
        error = float(np.linalg.norm(through_r - through_q))
        scale = float(np.linalg.norm(through_r))
        for mirror, some in enumerate(seen):
            if not some and Q[:, layout.commands_of(mirror)].any():
                raise Refused(
                    f"Q is not 0 for {layout.mirrors[mirror].name}, which no sensor sees: made for a closed loop"
                )
        # an older exposure may count for nothing, and so does the newest if no mirror is seen
        may_be_zero = not any(seen) or 0 < i < reconstructor.n_epochs
        if not (error <= _PROBE_TOLERANCE * scale and (scale > 0 or may_be_zero)):
            raise Refused(f"Q is not R G: they differ by {error / scale if scale else math.inf:.2g} on probes")


def _check_closures(reconstructor: Reconstructor, layout: Layout) -> None:
    """Each is for another set of sensors, and does without them."""
    all_sensors = (1 << len(layout.sensors)) - 1
    masks = [closure.sensors for closure in reconstructor.closures]
    if len(set(masks)) < len(masks) or not all(0 < mask < all_sensors for mask in masks):
        raise Refused(f"closed_sensors: expected distinct sets of some sensors, got {masks}")
    for closure in reconstructor.closures:
        if not (np.isfinite(closure.R).all() and np.isfinite(closure.Q).all()):
            raise Refused("closures: hold values that are not finite")
        if used_by(closure.R, layout) & closure.sensors:
            raise Refused(f"closures: the one for sensors {closure.sensors:#b} uses some of them")


def _check_low_order(low_order: LowOrder, gain: float, G_cal: Floats, delay: float) -> None:
    """The integrator is stable with a gain half as large again: all roots of ``z^n - z^(n-1) + 1.5 g e`` are inside the
    unit circle, for each eigenvalue e of what the modes look like to the slopes that control them."""
    if not (np.isfinite(low_order.commands).all() and np.isfinite(low_order.slopes).all()):
        raise Refused("low_order: holds values that are not finite")
    frames = math.ceil(delay)
    for value in np.linalg.eigvals((low_order.slopes @ G_cal @ low_order.commands.T).astype(np.float64)):
        polynomial = np.zeros(frames + 1, np.complex128)
        polynomial[:2] = 1, -1
        polynomial[-1] += _LOW_ORDER_MARGIN * gain * value
        if not np.abs(np.roots(polynomial)).max() < 1:
            raise Refused(f"low_order: an integrator of gain {gain:g} times {value:.2g} is not stable enough")


class Swap:
    """Slots, the transfer under way, and what the loop is to run.

    Args:
        layout, system: the instrument.
        G_cal: (n_slopes, n_commands) calibrated interaction matrix, rad/m.
        settings: at the start.
        post: hands a Program to the loop (``Loop.post``), which must have taken it up before the next one is posted, or
            else run no frame before: slots are used again.
        max_epochs: exposures that a reconstructor may use: the loop's. Three slots and a transfer have room for so many
            and, with more than one, a fallback: ``4 (max_epochs + 1) n_commands (n_slopes + n_commands)`` floats.
        kernel: float32; int16, which holds R in half the memory; tlr, which holds it in tiles of low rank. Both refuse
            what that would spoil, and tlr also what is no smaller than with int16. Closures it holds in float32.
        max_closures: sets of closed sensors that a reconstructor may have R and Q for. Room for them, in three slots
            and a transfer as above, is made when the first such reconstructor comes.

    Attributes:
        settings, active, staged, previous: what the loop is to run, and what may be committed or rolled back to.

    Raises:
        ValueError: G_cal is not of the instrument's shape.
    """

    def __init__(
        self,
        system: System,
        layout: Layout,
        G_cal: Floats,
        settings: Settings,
        post: Callable[[Program], None],
        max_epochs: int = 1,
        kernel: str = "float32",
        max_closures: int = MAX_CLOSURES,
    ) -> None:
        if G_cal.shape != (layout.n_slopes, layout.n_commands):
            raise ValueError(f"G_cal: expected shape {(layout.n_slopes, layout.n_commands)}, got {G_cal.shape}")
        self._system, self._layout = system, layout
        self._kernel = kernel
        self._G_cal = G_cal
        self._sees_tip_tilt, self._sees_focus = seen_low_orders(system, layout)
        self._post = post
        self._max_epochs, self._max_closures = max_epochs, max_closures
        self._slots = [Slot(layout, max_epochs, kernel) for _ in range(3)]
        self._manifest: Manifest | None = None
        self._R = np.zeros((n_parts(max_epochs), layout.n_commands, layout.n_slopes), np.float32)
        self._Q = np.zeros((n_parts(max_epochs), layout.n_commands, layout.n_commands), np.float32)
        self._table: list[tuple[int, int, int, int]] = []
        self._waiting: frozenset[int] = frozenset()
        self._lock = threading.Lock()  # of the attributes below
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
        self._check_epochs(manifest.n_epochs)
        if (manifest.n_commands, manifest.n_slopes) != (layout.n_commands, layout.n_slopes):
            raise Refused(
                f"expected {layout.n_commands} commands x {layout.n_slopes} slopes, "
                f"got {manifest.n_commands} x {manifest.n_slopes}"
            )
        self._check_number(len(manifest.closed_sensors))
        table = block_table(manifest.n_commands, manifest.n_epochs, len(manifest.closed_sensors))
        if manifest.n_blocks != len(table):
            raise Refused(f"expected {len(table)} blocks, got {manifest.n_blocks}")
        if len(manifest.probe_commands) % layout.n_commands or len(manifest.probe_slopes) % layout.n_slopes:
            raise Refused("probe_commands, probe_slopes: expected whole vectors")
        self._low_order_of(manifest)
        parts = n_parts(manifest.n_epochs, len(manifest.closed_sensors))
        if parts > len(self._R):
            self._R = np.zeros((parts, layout.n_commands, layout.n_slopes), np.float32)
            self._Q = np.zeros((parts, layout.n_commands, layout.n_commands), np.float32)
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
        target = (self._R if matrix == 0 else self._Q)[epoch]
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
            reconstructor = Reconstructor.from_parts(
                manifest.n_epochs,
                self._R,
                self._Q,
                fingerprint=manifest.fingerprint,
                gain=manifest.gain,
                slope_reference=manifest.slope_reference,
                command_limit=manifest.command_limit,
                probe_commands=manifest.probe_commands.reshape(-1, self._layout.n_commands),
                probe_slopes=manifest.probe_slopes.reshape(-1, self._layout.n_slopes),
                label=manifest.label,
                closed=manifest.closed_sensors,
                low_order=self._low_order_of(manifest),
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
        self._check_epochs(reconstructor.n_epochs)
        self._check_number(len(reconstructor.closures))
        result = check(
            reconstructor,
            self._layout,
            self._G_cal,
            self._sees_tip_tilt,
            self._sees_focus,
            self._system.loop.delay,
        )
        factors: list[Factors] = []
        if self._kernel == "int16":
            result = replace(result, compression=self._check_int16(reconstructor))
        elif self._kernel == "tlr":
            factors, compression = self._factorise(reconstructor)
            result = replace(result, compression=compression)
        slot = self._reserve()
        slot.fill(reconstructor, factors)
        # with the settings of now: those of the commit may be others, but every matrix was just written
        Program(slot, self.settings).warm()
        held = Held(slot, result, reconstructor)
        with self._lock:
            self.staged = held
        return held

    def _reserve(self) -> Slot:
        """A slot that neither the loop nor a roll-back uses, nor a commit from now on: nothing is staged in it."""
        with self._lock:
            in_use = {id(held.slot) for held in (self.active, self.previous) if held is not None}
            free = [slot for slot in self._slots if id(slot) not in in_use]
            staged = None if self.staged is None else self.staged.slot
            slot = next((one for one in free if one is not staged), free[0])
            if slot is staged:
                self.staged = None
        return slot

    def scratch(self) -> tuple[NDArray[Any], ...]:
        """R's tiles of a slot that the loop does not use, to measure with; what was staged in it is lost.

        For low rank, which has none before there are factors, new ones of 16 bits: an upper bound.
        """
        if self._kernel == "tlr":
            return Matrices(self._layout, "int16").R_tiles
        return self._reserve().epochs[0].R_tiles

    def matrices(self) -> list[tuple[int, int]]:
        """Address and bytes of each of the matrices of all slots."""
        parts = {id(part): part for slot in self._slots for part in (*slot.epochs, slot.fallback)}
        return [(array.ctypes.data, array.nbytes) for part in parts.values() for array in part.memory]

    def _check_epochs(self, n_epochs: int) -> None:
        if not 1 <= n_epochs <= self._max_epochs:
            raise Refused(f"uses {n_epochs} exposures; this loop takes {self._max_epochs} (parameter max_epochs)")

    def _low_order_of(self, manifest: Manifest) -> LowOrder | None:
        rows = manifest.low_order_commands, manifest.low_order_slopes
        try:
            return LowOrder.from_rows(*rows, self._layout.n_commands, self._layout.n_slopes)
        except ReconstructorError as error:
            raise Refused(str(error)) from None

    def _check_number(self, n_closures: int) -> None:
        if n_closures > self._max_closures:
            raise Refused(
                f"has R and Q for {n_closures} sets of closed sensors; this loop takes {self._max_closures} "
                "(parameter max_closures)"
            )

    def _check_int16(self, reconstructor: Reconstructor) -> str:
        low_order = [] if reconstructor.low_order is None else [reconstructor.low_order.R]
        try:
            ratio = max(
                int16_to_noise(self._system, self._layout, R)
                for R in [*(R for R, _ in reconstructor.parts), *low_order]
            )
        except ValueError as error:
            raise Refused(f"16 bits: {error}") from None
        if not ratio <= LIMIT:
            raise Refused(
                f"16 bits would err by {ratio:.2g} of what photon noise leaves in the commands, limit {LIMIT:g}: "
                "it takes kernel float32"
            )
        return f"16 bits err by {ratio:.1g} of photon noise"

    def _factorise(self, reconstructor: Reconstructor) -> tuple[list[Factors], str]:
        """Each part's R in factors, and what that makes of it.

        Raises:
            Refused: they err too much, make the loop unstable, or are no smaller than 16-bit integers.
        """
        found, shares, ratios = [], [], []
        parts = reconstructor.parts[: n_parts(reconstructor.n_epochs)]
        for R, _ in parts:
            try:
                factors = factorise(self._system, self._layout, R)
            except ValueError as error:
                raise Refused(f"low rank: {error}") from None
            shares.append(share := factors.nbytes / R.nbytes)
            if share >= 0.5:
                raise Refused(
                    f"low rank would take {share:.2f} of float32's memory, where 16 bits take 0.5: "
                    "it takes kernel int16 or float32"
                )
            ratios.append(ratio := error_to_noise(self._system, self._layout, R, factors.applied()))
            if not ratio <= LIMIT:
                raise Refused(
                    f"low rank would err by {ratio:.2g} of what photon noise leaves in the commands, limit {LIMIT:g}: "
                    "it takes kernel float32"
                )
            found.append(factors)
        applied = [Q - own.applied() @ self._G_cal for own, (_, Q) in zip(found, parts, strict=True)]
        mismatch = np.stack(applied).astype(np.float64)
        n = reconstructor.n_epochs
        radius = max(stability(mismatch[:n]), stability(mismatch[n:]) if len(mismatch) > n else 0.0)
        if not radius < STABILITY_LIMIT:
            raise Refused(f"low rank: spectral radius of Q - R G_cal is {radius:.3f}, limit {STABILITY_LIMIT:g}")
        what = f"low rank takes {max(shares):.2f} of float32's memory and errs by {max(ratios):.1g} of photon noise"
        return found, what

    def forget(self) -> None:
        """Give the transfer under way up."""
        self._manifest = None

    def save_active(self, path: str) -> None:
        """Write the active reconstructor to a file, for a restart."""
        active = self.active
        if active is not None:
            active.reconstructor.save(path)

    # -- what the loop runs -----------------------------------------------------------------------------------------

    def holds(self, sha256: bytes) -> bool:
        """Whether the reconstructor with this SHA-256 is active or staged."""
        with self._lock:
            return any(held is not None and held.slot.sha256 == sha256 for held in (self.active, self.staged))

    def commit(self, identity: int, sha256: bytes) -> Program:
        """Post the staged reconstructor to the loop; the active one becomes the previous.

        Raises:
            Refused: nothing is staged under that id and SHA-256.
        """
        with self._lock:
            program = self._run(self.staged, identity, sha256, "staged")
            self.previous, self.active, self.staged = self.active, self.staged, None
        return program

    def roll_back(self, identity: int, sha256: bytes) -> Program:
        """Post the previous reconstructor to the loop; the active one becomes the previous.

        Raises:
            Refused: the previous one does not have that id and SHA-256.
        """
        with self._lock:
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
        with self._lock:
            self.settings = replace(self.settings, id=self.settings.id + 1, **changes)  # type: ignore[arg-type]
            if self.active is None:
                return None
            program = Program(self.active.slot, self.settings)
            if "closed_sensors" in changes:
                program.warm()
            self._post(program)
        return program
