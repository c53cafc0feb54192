"""The reconstructor: one immutable object, its checksum and its file.

Pseudo-open-loop control of gain g with exposures ``y[k-j]``, j = 0 .. n_epochs-1, of slopes and the states ``u~[k-j]``
that were on the mirror during them::

    u[k] = (1-g) u[k-1] + g sum_j ( R_j (y[k-j] - y_ref) + Q_j u~[k-j] ),     Q_j = R_j G

R_0 alone has the wrong gain: with more than one exposure, a whole reconstructor for the newest one alone comes along,
the fallback for when the loop does not have the others. So may :class:`Closure` and :class:`LowOrder`, for when sensors
are closed.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]

_FORMAT = "srtomo-reconstructor-1"
_ROWS_PER_BLOCK = 64
_PROBES = 4
_ROWS_AT_ONCE = 512


class ReconstructorError(ValueError):
    """A reconstructor, or its file, that cannot be used; one line that says what is wrong."""


def _frozen(values: ArrayLike) -> Floats:
    array = np.array(values, dtype="<f4", order="C")
    array.setflags(write=False)
    return array


def _product(R: Floats, G: NDArray[np.float64], threads: int) -> NDArray[np.float64]:
    """R G in float64, stretches of rows on each thread: R is never whole in float64."""
    pieces = threads * max(1, len(R) // (threads * _ROWS_AT_ONCE))
    with ThreadPoolExecutor(threads) as pool:
        parts = pool.map(lambda rows: rows.astype(np.float64) @ G, np.array_split(R, pieces))
        return np.concatenate(list(parts))


@dataclass(frozen=True)
class Block:
    """Rows ``first_row ..`` of ``R`` (matrix 0) or ``Q`` (matrix 1) of one epoch, or of the fallback."""

    index: int
    epoch: int
    matrix: int
    first_row: int
    rows: Floats


@dataclass(frozen=True, eq=False)
class Closure:
    """A whole reconstructor, for one exposure, for when some sensors are closed: a laser that was shut or tripped.

    Attributes:
        sensors: bit w set: sensor w is closed.
        R: (n_commands, n_slopes) m/rad; columns of closed sensors are 0.
        Q: (n_commands, n_commands) R G.
    """

    sensors: int
    R: Floats
    Q: Floats


@dataclass(frozen=True, eq=False)
class LowOrder:
    """Tip-tilt, and what else natural stars answer for, from their slopes alone.

    For when no reconstructor is there for the sensors that are closed. It acts as an integrator, ``u[k] = u[k-1] + g
    commands^T slopes (y - y_ref)``, which leaves everything else as it was.

    Attributes:
        commands: (n_modes, n_commands) m; each a shape.
        slopes: (n_modes, n_slopes) 1/rad; 0 for sensors that it does without.
    """

    commands: Floats
    slopes: Floats

    @classmethod
    def from_rows(cls, commands: ArrayLike, slopes: ArrayLike, n_commands: int, n_slopes: int) -> LowOrder | None:
        """From both, row after row, as they travel; None if they are empty.

        Raises:
            ReconstructorError: no whole rows.
        """
        flat = _frozen(commands).ravel(), _frozen(slopes).ravel()
        if not any(map(len, flat)):
            return None
        if len(flat[0]) * n_slopes != len(flat[1]) * n_commands or len(flat[0]) % n_commands:
            raise ReconstructorError(f"low_order: expected modes of {n_commands} commands and of {n_slopes} slopes")
        return cls(flat[0].reshape(-1, n_commands), flat[1].reshape(-1, n_slopes))

    @property
    def R(self) -> Floats:
        """(n_commands, n_slopes) m/rad."""
        return self.commands.T @ self.slopes


def n_parts(n_epochs: int, n_closures: int = 0) -> int:
    """Pairs of R and Q of a reconstructor: one an epoch; with more than one, the fallback's; one a closure."""
    return n_epochs + (n_epochs > 1) + n_closures


def block_table(n_commands: int, n_epochs: int, n_closures: int = 0) -> list[tuple[int, int, int, int]]:
    """The blocks that a reconstructor travels in: (epoch, matrix, first_row, n_rows), by block index.

    The fallback, if there is one, travels as epoch ``n_epochs``, closures as those after it.
    """
    return [
        (epoch, matrix, first, min(_ROWS_PER_BLOCK, n_commands - first))
        for epoch in range(n_parts(n_epochs, n_closures))
        for matrix in (0, 1)
        for first in range(0, n_commands, _ROWS_PER_BLOCK)
    ]


@dataclass(frozen=True, eq=False)
class Reconstructor:
    """R and Q = R G of every epoch, with all that the loop needs to use them. Arrays are read-only float32.

    Attributes:
        fingerprint: of the layout that it is made for, 32 bytes.
        R: (n_epochs, n_commands, n_slopes), m/rad.
        Q: (n_epochs, n_commands, n_commands).
        gain: loop gain, 0 < g <= 1; the noise prior was built for it.
        slope_reference: (n_slopes,) rad.
        command_limit: (n_commands,) m of wavefront.
        probe_commands, probe_slopes: (n_probes, n_commands) v in m and (n_probes, n_slopes) G v in rad, so that whoever
            receives R and Q can check that they belong together.
        label: for people; not part of the identity.
        provenance: what made it, from what; JSON values; not part of the identity.
        fallback_R, fallback_Q: (n_commands, n_slopes) m/rad and (n_commands, n_commands), for the newest exposure
            alone; with several epochs, and only then.
        closures: each for another set of sensors that are closed.
        low_order: for when others are, or None.
    """

    fingerprint: bytes
    R: Floats
    Q: Floats
    gain: float
    slope_reference: Floats
    command_limit: Floats
    probe_commands: Floats
    probe_slopes: Floats
    label: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    fallback_R: Floats | None = None
    fallback_Q: Floats | None = None
    closures: tuple[Closure, ...] = ()
    low_order: LowOrder | None = None

    def __post_init__(self) -> None:
        for name in ("R", "Q", "slope_reference", "command_limit", "probe_commands", "probe_slopes"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        object.__setattr__(self, "gain", float(np.float32(self.gain)))
        if self.R.ndim != 3:
            raise ReconstructorError(f"R: expected (epochs, commands, slopes), got shape {self.R.shape}")
        epochs, commands, slopes = self.R.shape
        for name, shape in (
            ("Q", (epochs, commands, commands)),
            ("slope_reference", (slopes,)),
            ("command_limit", (commands,)),
            ("probe_commands", (len(self.probe_commands), commands)),
            ("probe_slopes", (len(self.probe_commands), slopes)),
        ):
            if getattr(self, name).shape != shape:
                raise ReconstructorError(f"{name}: expected shape {shape}, got {getattr(self, name).shape}")
        for name, shape in (("fallback_R", (commands, slopes)), ("fallback_Q", (commands, commands))):
            value = getattr(self, name)
            if (value is None) != (epochs == 1):
                raise ReconstructorError(f"{name}: expected with several epochs, and only then")
            if value is not None:
                object.__setattr__(self, name, _frozen(value))
                if value.shape != shape:
                    raise ReconstructorError(f"{name}: expected shape {shape}, got {value.shape}")
        closures = tuple(Closure(int(c.sensors), _frozen(c.R), _frozen(c.Q)) for c in self.closures)
        object.__setattr__(self, "closures", closures)
        for closure in closures:
            if (closure.R.shape, closure.Q.shape) != ((commands, slopes), (commands, commands)):
                raise ReconstructorError(f"closures: expected shapes {(commands, slopes)} and {(commands, commands)}")
        if self.low_order is not None:
            low = LowOrder(_frozen(self.low_order.commands), _frozen(self.low_order.slopes))
            object.__setattr__(self, "low_order", low)
            if (low.commands.shape, low.slopes.shape) != ((len(low.commands), commands), (len(low.commands), slopes)):
                raise ReconstructorError(f"low_order: expected modes of {commands} commands and of {slopes} slopes")
        if len(self.fingerprint) != 32:
            raise ReconstructorError(f"fingerprint: expected 32 bytes, got {len(self.fingerprint)}")

    @classmethod
    def from_matrices(
        cls,
        R: ArrayLike,
        G: ArrayLike,
        *,
        fingerprint: bytes,
        gain: float,
        command_limit: ArrayLike,
        slope_reference: ArrayLike | None = None,
        label: str = "",
        provenance: Mapping[str, Any] | None = None,
        fallback: ArrayLike | None = None,
        closures: Mapping[int, ArrayLike] | None = None,
        low_order: LowOrder | None = None,
        threads: int = 1,
    ) -> Reconstructor:
        """A reconstructor from R and the interaction matrix G (n_slopes, n_commands).

        Each Q is formed in float64 from R as it will be applied, rounded to float32.

        Args:
            R: (n_commands, n_slopes), or (n_epochs, n_commands, n_slopes) with a ``fallback`` (n_commands, n_slopes).
            closures: R (n_commands, n_slopes) by the bits of the sensors that are closed.
            threads: to form Q with, apart from those of the BLAS library.
        """
        applied = np.asarray(R, dtype=np.float32)
        applied = applied[None] if applied.ndim == 2 else applied
        model = np.asarray(G, dtype=np.float64)
        if applied.ndim != 3 or model.shape != applied.shape[:0:-1]:
            raise ReconstructorError(f"G: expected shape {applied.shape[:0:-1]}, got {model.shape}")
        n_commands, n_slopes = applied.shape[1:]
        alone = None if fallback is None else np.asarray(fallback, dtype=np.float32)
        without = {sensors: np.asarray(part, dtype=np.float32) for sensors, part in (closures or {}).items()}
        # any fixed vectors do: they only have to excite every row of Q
        probes = np.random.default_rng(0).standard_normal((_PROBES, n_commands)).astype(np.float32) * np.float32(1e-7)
        return cls(
            fingerprint=fingerprint,
            R=_frozen(applied),
            Q=_frozen(np.stack([_product(part, model, threads) for part in applied])),
            gain=gain,
            slope_reference=_frozen(np.zeros(n_slopes) if slope_reference is None else slope_reference),
            command_limit=_frozen(command_limit),
            probe_commands=probes,
            probe_slopes=_frozen(probes.astype(np.float64) @ model.T),
            label=label,
            provenance=dict(provenance or {}),
            fallback_R=alone,
            fallback_Q=None if alone is None else _frozen(_product(alone, model, threads)),
            closures=tuple(
                Closure(sensors, part, _frozen(_product(part, model, threads))) for sensors, part in without.items()
            ),
            low_order=low_order,
        )

    @classmethod
    def from_parts(
        cls, n_epochs: int, R: Floats, Q: Floats, *, closed: Sequence[int] = (), **fields: Any
    ) -> Reconstructor:
        """From R (n_parts, n_commands, n_slopes) and Q in the order of :attr:`parts`; ``fields`` are all others.

        Args:
            closed: the sensors of each closure, as its bits.
        """
        fallback = {} if n_epochs == 1 else {"fallback_R": R[n_epochs], "fallback_Q": Q[n_epochs]}
        first = n_parts(n_epochs)
        closures = tuple(Closure(sensors, R[first + i], Q[first + i]) for i, sensors in enumerate(closed))
        return cls(R=R[:n_epochs], Q=Q[:n_epochs], closures=closures, **fallback, **fields)

    @property
    def parts(self) -> list[tuple[Floats, Floats]]:
        """R and Q of each epoch, the fallback's if there is one, and each closure's; views, not copies."""
        pairs = list(zip(self.R, self.Q, strict=True))
        if self.fallback_R is not None and self.fallback_Q is not None:
            pairs.append((self.fallback_R, self.fallback_Q))
        return [*pairs, *((closure.R, closure.Q) for closure in self.closures)]

    @property
    def n_epochs(self) -> int:
        """Exposures used."""
        return int(self.R.shape[0])

    @property
    def n_commands(self) -> int:
        """Rows of R."""
        return int(self.R.shape[1])

    @property
    def n_slopes(self) -> int:
        """Columns of R."""
        return int(self.R.shape[2])

    @cached_property
    def sha256(self) -> bytes:
        """Digest of all that decides a command: fingerprint, shapes, gain, limits, reference, every R and Q, closures'
        sensors, the low order."""
        digest = hashlib.sha256(_FORMAT.encode())
        digest.update(self.fingerprint)
        digest.update(np.array(self.R.shape, dtype="<u4").tobytes())
        digest.update(np.array([self.gain], dtype="<f4").tobytes())
        for array in (self.slope_reference, self.command_limit, self.R, self.Q, *sum(self.parts[self.n_epochs :], ())):
            digest.update(array.data)
        digest.update(np.array([closure.sensors for closure in self.closures], dtype="<u4").tobytes())
        if self.low_order is not None:
            digest.update(self.low_order.commands.data)
            digest.update(self.low_order.slopes.data)
        return digest.digest()

    @property
    def id(self) -> int:
        """First 8 bytes of the digest: never 0 in practice, so 0 can mean none."""
        return int.from_bytes(self.sha256[:8], "big")

    def blocks(self) -> Iterator[Block]:
        """The rows in the order of :func:`block_table`; views, not copies."""
        parts = self.parts
        for index, (epoch, matrix, first, rows) in enumerate(
            block_table(self.n_commands, self.n_epochs, len(self.closures))
        ):
            yield Block(index, epoch, matrix, first, parts[epoch][matrix][first : first + rows])

    def save(self, path: str | Path, interaction_matrix: ArrayLike | None = None) -> None:
        """Write an ``.npz`` with R, Q, provenance and, when given, G; whole or not at all."""
        extra = {} if interaction_matrix is None else {"G": np.asarray(interaction_matrix, dtype=np.float32)}
        if self.fallback_R is not None and self.fallback_Q is not None:
            extra |= {"fallback_R": self.fallback_R, "fallback_Q": self.fallback_Q}
        if self.closures:
            extra |= {
                "closed": np.array([closure.sensors for closure in self.closures], np.uint32),
                "closed_R": np.stack([closure.R for closure in self.closures]),
                "closed_Q": np.stack([closure.Q for closure in self.closures]),
            }
        if self.low_order is not None:
            extra |= {"low_order_commands": self.low_order.commands, "low_order_slopes": self.low_order.slopes}
        header = {
            "format": _FORMAT,
            "sha256": self.sha256.hex(),
            "fingerprint": self.fingerprint.hex(),
            "gain": self.gain,
            "label": self.label,
            "provenance": dict(self.provenance),
        }
        write_npz(
            path,
            header,
            R=self.R,
            Q=self.Q,
            slope_reference=self.slope_reference,
            command_limit=self.command_limit,
            probe_commands=self.probe_commands,
            probe_slopes=self.probe_slopes,
            **extra,
        )

    @classmethod
    def load(cls, path: str | Path) -> Reconstructor:
        """Read a file of :meth:`save`.

        Raises:
            ReconstructorError: the file is not one, or its content does not match its checksum.
        """
        header, arrays = read_npz(path, _FORMAT)
        try:
            closed = [arrays[name] for name in ("closed", "closed_R", "closed_Q")] if "closed" in arrays else [()] * 3
            low_order = None
            if "low_order_commands" in arrays:
                low_order = LowOrder(arrays["low_order_commands"], arrays["low_order_slopes"])
            reconstructor = cls(
                fingerprint=bytes.fromhex(header["fingerprint"]),
                gain=header["gain"],
                label=header["label"],
                provenance=header["provenance"],
                **{name: arrays[name] for name in ("R", "Q", "slope_reference", "command_limit",
                                                   "probe_commands", "probe_slopes")},
                **{name: arrays[name] for name in ("fallback_R", "fallback_Q") if name in arrays},
                closures=tuple(Closure(*each) for each in zip(*closed, strict=True)),
                low_order=low_order,
            )  # fmt: skip
            expected = header["sha256"]
        except (KeyError, TypeError) as error:
            raise ReconstructorError(f"{path}: damaged, {error} is missing") from None
        except ReconstructorError as error:
            raise ReconstructorError(f"{path}: {error}") from None
        if reconstructor.sha256.hex() != expected:
            raise ReconstructorError(f"{path}: damaged, its content does not match its checksum")
        return reconstructor


_MATRIX_FORMAT = "srtomo-interaction-matrix-1"


def save_interaction_matrix(path: str | Path, G: ArrayLike, fingerprint: bytes, provenance: Mapping[str, Any]) -> None:
    """Write a calibrated interaction matrix G (n_slopes, n_commands), rad/m, with the fingerprint of its layout."""
    header = {"format": _MATRIX_FORMAT, "fingerprint": fingerprint.hex(), "provenance": dict(provenance)}
    write_npz(path, header, G=_frozen(G))


def load_interaction_matrix(path: str | Path, fingerprint: bytes | None = None) -> Floats:
    """Read G (n_slopes, n_commands) from a file of :func:`save_interaction_matrix`.

    Raises:
        ReconstructorError: not such a file, damaged, or of another layout than ``fingerprint``.
    """
    header, arrays = read_npz(path, _MATRIX_FORMAT)
    if "G" not in arrays or arrays["G"].ndim != 2:
        raise ReconstructorError(f"{path}: damaged, G is missing")
    if fingerprint is not None and header.get("fingerprint") != fingerprint.hex():
        raise ReconstructorError(
            f"{path}: made for another instrument (fingerprint {str(header.get('fingerprint'))[:12]}, "
            f"expected {fingerprint.hex()[:12]})"
        )
    return _frozen(arrays["G"])


def write_npz(path: str | Path, header: Mapping[str, Any], **arrays: Any) -> None:
    """Write arrays and a JSON header to an uncompressed ``.npz``; a reader never sees half a file."""
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    try:
        with open(partial, "wb") as stream:
            np.savez(stream, header=np.array(json.dumps(header, sort_keys=True)), **arrays)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


def read_npz(path: str | Path, format_name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a file of :func:`write_npz`: its header and its arrays.

    Raises:
        ReconstructorError: not readable, or not of this format.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        header = json.loads(str(arrays.pop("header")[()]))
    except OSError as error:
        raise ReconstructorError(f"{path}: {error.strerror or error}") from None
    except (ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile):
        raise ReconstructorError(f"{path}: not a srtomo file, or cut off") from None
    if header.get("format") != format_name:
        raise ReconstructorError(f"{path}: expected format {format_name}, got {header.get('format')!r}")
    return header, arrays
