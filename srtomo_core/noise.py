"""Noise of a sensor as it was measured, from a file."""

from __future__ import annotations

import math
import zipfile

import numpy as np
from numpy.typing import NDArray

_SYMMETRIC = 1e-6  # how far a measured covariance may be from it, of its largest entry


def read_noise(path: str, n_slopes: int) -> NDArray[np.float64]:
    """Read ``covariance`` (n_slopes, n_slopes), rad^2, all x then all y, of one frame, from an ``.npz`` file.

    Raises:
        ValueError: in one line, what is wrong with it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            covariance = np.asarray(file["covariance"], dtype=np.float64)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except (KeyError, TypeError, ValueError, zipfile.BadZipFile):
        raise ValueError(f"{path}: expected an .npz file with numbers in 'covariance'") from None
    if covariance.shape != (n_slopes, n_slopes):
        raise ValueError(f"{path}: covariance: expected shape {(n_slopes, n_slopes)}, got {covariance.shape}")
    if not np.abs(covariance - covariance.T).max() <= _SYMMETRIC * np.abs(covariance).max() < math.inf:
        raise ValueError(f"{path}: covariance: expected finite numbers, symmetric")
    covariance = (covariance + covariance.T) / 2
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise ValueError(f"{path}: covariance: expected positive definite; are there frames enough?") from None
    return covariance
