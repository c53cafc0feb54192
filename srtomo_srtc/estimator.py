"""The estimate that all covariance-based reconstructors share (eq. 10): slopes to anything correlated with them.

    R = F Sigma_xs P [ P (Sigma_ss + Sigma_nn) P + gamma (I - P) ]^-1 P

P takes out of the slopes what their stars are blind to. F is linear and the caller's: what is estimated may be the
pupil's wavefront, virtual slopes or coefficients of modes, as long as they come down to commands in the end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from srtomo_srtc.model import project, project_both_sides
from srtomo_srtc.parallel import Progress, silent
from srtomo_srtc.solve import SymmetricTiles
from srtomo_srtc.split import Split

Array = NDArray[np.float64]

_ROWS = 512  # projected at a time


def estimator(S: Array, right: Array, blind: Array) -> Array:
    """``P [P S P + gamma (I - P)]^-1 P Sigma_sx``, the transpose of what turns slopes into x.

    Args:
        S: (n_slopes, n_slopes) covariance of slopes with their noise, rad^2; overwritten.
        right: (n_slopes, n) Sigma_sx.
        blind: (n_slopes, n_modes) orthonormal; what P removes.
    """
    project_both_sides(S, blind, gamma=S.trace() / len(S))
    # S is symmetric: its transpose is the same matrix in the order that LAPACK factors without a copy
    return project(cho_solve(cho_factor(S.T, overwrite_a=True), project(right, blind)), blind)


def divide(
    right: NDArray[np.floating], S: SymmetricTiles, blind: Array, threads: int = 1, progress: Progress = silent
) -> None:
    """Turn Sigma_xs into ``Sigma_xs P [P S P + gamma (I - P)]^-1 P`` where it lies: :func:`estimator` for many slopes.

    Args:
        right: (n, n_slopes) Sigma_xs, C-ordered; overwritten.
        S: covariance of slopes with their noise, rad^2; overwritten.
        blind: (n_slopes, n_modes) orthonormal; what P removes.
        threads: to compute with.
    """
    S.project(blind, gamma=S.trace() / len(S))
    _project_rows(right, blind)
    # costs n^3 / 3 and n^2 a row
    factoring = len(S) / (len(S) + 3 * len(right))
    S.factor(threads, lambda done: progress(factoring * done))
    S.divide(right, threads, lambda done: progress(factoring + (1 - factoring) * done))
    _project_rows(right, blind)


def _project_rows(matrix: NDArray[np.floating], blind: Array) -> None:
    modes = blind.astype(matrix.dtype)
    for start in range(0, len(matrix), _ROWS):
        part = matrix[start : start + _ROWS]
        part -= (part @ modes) @ modes.T


def commands_from(
    S: Array, right: Array, blind: Array, fit: Callable[[Array], Array], split: Split | None, noise: sparse.csr_array
) -> Array:
    """The reconstructor, from all slopes together or with tip-tilt split off.

    Args:
        S, right, blind: as :func:`estimator` takes them.
        fit: x (n, n_slopes) to commands (n_commands, n_slopes), column by column.
        split: who estimates what; everyone everything when None.
        noise: (n_slopes, n_slopes) the part of S that is noise, rad^2; only natural stars' matters, and only to
            ``split``.

    Returns:
        (n_commands, n_slopes) R, m/rad.
    """
    if split is None:
        return fit(estimator(S, right, blind).T)
    lasers, natural = split.blind, split.seeing
    R = np.empty((len(split.low_order), len(S)))
    high_order = fit(estimator(S[np.ix_(lasers, lasers)], right[lasers], _within(blind, lasers)).T)
    R[:, lasers] = high_order - split.low_order @ high_order
    own = S[np.ix_(natural, natural)]
    low_order = (own - noise[natural][:, natural].toarray()) @ split.measured[:, natural].T
    R[:, natural] = split.answer @ estimator(own, low_order, _within(blind, natural)).T
    return R


def commands_from_tiles(
    S: SymmetricTiles,
    right: NDArray[np.floating],
    blind: Array,
    fit: Callable[[Any, int], NDArray[np.floating]],
    split: Split | None,
    noise: sparse.csr_array,
    threads: int = 1,
    progress: Progress = silent,
) -> NDArray[np.floating]:
    """As :func:`commands_from`, for many slopes: in the precision of S and ``right``, both of which are overwritten.

    Args:
        right: (n, n_slopes) Sigma_xs, C-ordered.
        fit: x to commands as :func:`commands_from` takes it, on so many threads.
    """
    if split is None:
        divide(right, S, blind, threads, progress)
        return fit(right, threads)
    lasers, natural = split.blind, split.seeing
    own = S.part(natural).dense().astype(np.float64)
    mine = right[:, lasers]
    divide(mine, S.part(lasers), _within(blind, lasers), threads, progress)
    high_order = fit(mine, threads)
    del mine
    # commands come in the place of what they were made from
    R = right
    R[:, lasers] = high_order
    R[:, lasers] -= split.low_order.astype(R.dtype) @ high_order
    low_order = (own - noise[natural][:, natural].toarray()) @ split.measured[:, natural].T
    R[:, natural] = split.answer @ estimator(own, low_order, _within(blind, natural)).T
    return R


def _within(blind: Array, group: NDArray[np.intp]) -> Array:
    """The modes of some sensors alone; each mode belongs to one sensor."""
    part = blind[group]
    return part[:, part.any(axis=0)]
