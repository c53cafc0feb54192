"""Influence functions from a file: what a mirror's actuators do, measured or computed elsewhere."""

from __future__ import annotations

import hashlib
import math
import zipfile
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_EDGE = 0.01  # of a function's largest value: what may be left of it at the edge of its window


@dataclass(frozen=True)
class InfluenceFunctions:
    """Functions on square windows, each centred on its actuator; zero beyond.

    Attributes:
        step: of the grid at the mirror's conjugate, m.
        values: (n, size, size) indexed [function, y, x], wavefront per command; one for every actuator, or n = 1 for
            all. ``size`` is odd: the middle is the actuator's place.
        digest: of what they are (SHA-256, hexadecimal); functions are equal if theirs are.
    """

    step: float
    values: NDArray[np.float64] = field(compare=False)
    digest: str

    @property
    def reach(self) -> float:
        """Half the width of the windows, m."""
        return (self.values.shape[1] - 1) / 2 * self.step

    def of(self, actuator: int) -> NDArray[np.float64]:
        """(size, size) of one actuator."""
        return self.values[actuator if len(self.values) > 1 else 0]


def read_influence(path: str, n_actuators: int) -> InfluenceFunctions:
    """Read an ``.npz`` file with ``step`` (m) and ``functions``, (size, size) or (n_actuators, size, size).

    Raises:
        ValueError: in one line, what is wrong with it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            step, values = float(file["step"]), np.asarray(file["functions"], dtype=np.float64)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except (KeyError, TypeError, ValueError, zipfile.BadZipFile):
        raise ValueError(f"{path}: expected an .npz file with 'step' and 'functions'") from None
    if values.ndim == 2:
        values = values[None]
    size = values.shape[-1]
    if values.ndim != 3 or len(values) not in (1, n_actuators) or values.shape[1] != size or size < 3 or size % 2 == 0:
        raise ValueError(
            f"{path}: functions: expected one or {n_actuators}, each square and odd, got shape {values.shape}"
        )
    if not (0 < step < math.inf and np.isfinite(values).all()):
        raise ValueError(f"{path}: expected a step above 0 and finite functions")
    peaks = np.abs(values).max(axis=(1, 2))
    rims = np.maximum(np.abs(values[:, [0, -1]]).max(axis=(1, 2)), np.abs(values[:, :, [0, -1]]).max(axis=(1, 2)))
    if (rims > _EDGE * peaks).any():
        raise ValueError(f"{path}: functions: expected zero at the edges of their windows; wider windows are needed")
    digest = hashlib.sha256(np.float64(step).tobytes() + np.array(values.shape, "<i8").tobytes())
    digest.update(np.ascontiguousarray(values, "<f8").tobytes())
    return InfluenceFunctions(step, values, digest.hexdigest())
