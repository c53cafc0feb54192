"""The right-hand side of the fit: mirrors' wavefronts in all science directions, correlated with all slopes.

    B = sum_i w_i N_i^T W (1 - piston) Sigma_phi_i_s

so that the implicit reconstructor is ``(N^T W N + kappa I)^-1 B S^-1``. Sigma_phi_s of a whole pupil is never formed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_srtc.covariance import Share, Sightline, Turbulence, slope_products
from srtomo_srtc.fitting import Fit
from srtomo_srtc.parallel import Progress, silent

Array = NDArray[np.float64]


def right_hand_side(
    fit: Fit,
    turbulence: Turbulence,
    sensors: Sequence[Sightline],
    heights: Array,
    *,
    fast: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> Array:
    """B, the covariance of the fit's projected wavefront with all slopes.

    Args:
        heights: (n_layers,) of the turbulence, m along the line of sight.
        fast: float32, from tables: wrong by less than 1e-5 of the norm.

    Returns:
        (n_commands, n_slopes) rad m.
    """
    shares = _shares(fit, fit.grid.weight[:, None], heights)
    return _without_piston(
        fit, slope_products(turbulence, sensors, shares, fast=fast, threads=threads, progress=progress)
    )[0]


def right_hand_side_and_tilts(
    fit: Fit,
    turbulence: Turbulence,
    sensors: Sequence[Sightline],
    heights: Array,
    *,
    fast: bool = False,
    threads: int = 1,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """As :func:`right_hand_side`, with the covariance of tip and tilt in each direction with all slopes.

    Args:
        fast: as for :func:`right_hand_side`.

    Returns:
        B (n_commands, n_slopes) rad m; (n_views, 2, n_slopes) rad m, of tip and tilt in m rms.
    """
    means = np.column_stack([fit.grid.weight, fit.grid.tilts])
    shares = _shares(fit, means, heights)
    right, low = _without_piston(
        fit, slope_products(turbulence, sensors, shares, fast=fast, threads=threads, progress=progress)
    )
    return right, low[:, 1:]


def _without_piston(fit: Fit, products: Array) -> tuple[Array, Array]:
    """B, and the means (n_views, n_means, n_slopes), the first of which is piston, from the sums of :func:`_sums`."""
    n_commands = len(fit.normal)
    low = products[n_commands:].reshape(len(fit.views), -1, products.shape[1])
    for view, (piston, *_) in zip(fit.views, low, strict=True):
        # in two steps: the outer product of an extremely large telescope is as large as B
        for rows in np.array_split(np.arange(n_commands), math.ceil(n_commands / 512)):
            products[rows] -= np.multiply.outer((view.weight * view.pistons[rows]).astype(products.dtype), piston)
    return products[:n_commands], low


def _sums(fit: Fit, means: Array, index: int) -> sparse.csr_array:
    """(n_points, n_commands + n_views n_means) ``w W N`` of a direction, and the means in its own columns."""
    view = fit.views[index]
    mine = sparse.csr_array((np.ones(1), ([0], [index])), shape=(1, len(fit.views)))
    own = sparse.kron(mine, sparse.csr_array(means), format="csr")
    weighted = sparse.csr_array(view.modes * (view.weight * view.light)[:, None])
    return sparse.csr_array(sparse.hstack([weighted, own], format="csr"))


def _shares(fit: Fit, means: Array, heights: Array) -> list[Share]:
    return [Share(points, _sums(fit, means, i)) for i, (_, points) in enumerate(fit.footprints(heights))]
