"""Covariances of slopes as they were measured, from a file, for Learn & Apply to use as they are.

An ``.npz`` file with

- ``slopes`` (n_slopes, n_slopes): of all slopes with each other, open loop or pseudo-open-loop, noise included, rad^2;
- ``truth`` (n_virtual, n_slopes), if there is a truth sensor: of its slopes with all others, in the same exposures,
  rad^2. It stands for a sensor on each science target, one after the other, at infinity, neither shifted nor rotated;
- ``truth_subapertures``: how many of them go across the pupil; by default one for each actuator of the finest mirror;
- ``fingerprint``, if wanted: of the instrument, in hexadecimal, as ``srtomo systems SYSTEM`` prints it. Another one's
  file is then refused.

Slopes are radians of wavefront tilt, sensor by sensor, all x then all y.
"""

from __future__ import annotations

import math
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.model import blind_modes, project_both_sides
from srtomo_srtc.reconstructors.learn_apply import virtual_system

Array = NDArray[np.float64]

_KEYS = ("slopes", "truth", "truth_subapertures", "fingerprint")
_SYMMETRIC = 1e-6  # how far a covariance may be from it, of its largest entry


def read_measured(path: str, system: System) -> dict[str, Any]:
    """Keywords of :func:`srtomo_srtc.reconstructors.learn_apply` from a file of measured covariances.

    Returns:
        ``slopes``, and with a truth sensor ``truth`` and ``virtual``.

    Raises:
        ValueError: in one line, what is wrong with it.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            content = {key: file[key] for key in file.files}
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except (ValueError, zipfile.BadZipFile):
        raise ValueError(f"{path}: expected an .npz file") from None
    for key in content:
        if key not in _KEYS:
            raise ValueError(f"{path}: {key}: expected one of {', '.join(_KEYS)}")
    if "slopes" not in content:
        raise ValueError(f"{path}: expected 'slopes', the covariance of all slopes")
    layout = Layout(system)
    if "fingerprint" in content and str(content["fingerprint"]) != layout.fingerprint.hex():
        raise ValueError(f"{path}: fingerprint: of another instrument than {system.name}")
    keywords: dict[str, Any] = {"slopes": _matrix(path, "slopes", content["slopes"], (layout.n_slopes,) * 2)}
    _require_covariance(path, keywords["slopes"], blind_modes(system, layout))
    if "truth" in content:
        across = content.get("truth_subapertures")
        keywords["virtual"] = virtual_system(system, None if across is None else int(across))
        shape = (Layout(keywords["virtual"]).n_slopes, layout.n_slopes)
        keywords["truth"] = _matrix(path, "truth", content["truth"], shape)
    elif "truth_subapertures" in content:
        raise ValueError(f"{path}: truth_subapertures: expected 'truth' with it")
    return keywords


def _matrix(path: str, name: str, values: NDArray[Any], shape: tuple[int, int]) -> Array:
    if values.shape != shape:
        raise ValueError(f"{path}: {name}: expected shape {shape}, got {values.shape}")
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise ValueError(f"{path}: {name}: expected finite numbers")
    return np.asarray(values, np.float64)


def _require_covariance(path: str, slopes: Array, blind: Array) -> None:
    """Positive definite where it is used: what the stars are blind to may have been taken out."""
    if not np.abs(slopes - slopes.T).max() <= _SYMMETRIC * np.abs(slopes).max() < math.inf:
        raise ValueError(f"{path}: slopes: expected a symmetric matrix")
    used = slopes.copy()
    project_both_sides(used, blind, gamma=used.trace() / len(used))
    try:
        np.linalg.cholesky(used)
    except np.linalg.LinAlgError:
        raise ValueError(
            f"{path}: slopes: expected positive definite; were there more exposures than {len(slopes)} slopes?"
        ) from None
