"""Noise-weighted least squares on the tomographic interaction matrix (eq. 20-21), the virtual-DM approach::

    R = (D^T N^-1 D + kappa I)^-1 D^T N^-1

D, in the paper ``G T_alpha^dm`` (eq. 20 prints P for T), is what the mirrors look like to every sensor towards its own
star. No statistics of the turbulence enter. Tip-tilt and focus that stars are blind to are given no weight: N^-1 stands
for ``N^-1 - N^-1 M (M^T N^-1 M)^-1 M^T N^-1``, M being those modes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, layout_of, noise_whitening
from srtomo_srtc.provenance import Stages, reconstructor_of
from srtomo_srtc.tip_tilt import in_two_loops

Array = NDArray[np.float64]

KAPPA = 1e-3
"""Default regularisation, relative to the mean diagonal of ``D^T N^-1 D``."""


@in_two_loops
def least_squares(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Reconstructor, Array]:
    """Build the reconstructor and the interaction matrix that it inverts.

    Args:
        system: stars, sensors, noise, mirrors.
        layout: where sensors and mirrors are taken to be; as in ``system`` when not given.
        label: for people.
        noise_gain: loop gain that the provenance states; the weights do not depend on it.
        kappa: regularisation, relative to the mean diagonal of ``D^T N^-1 D``.
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: the layout has other slopes or commands than the system, or a dark sub-aperture.
        MemoryError: one line, before any work, if there is not enough.
    """
    layout = layout_of(system, layout)
    require(bytes_needed(layout), f"least-squares reconstructor of {system.name}")
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)

    stages.enter("interaction matrix", 0.0)
    G = interaction_matrix(system, layout)

    stages.enter("solution", 0.7)
    whitening = noise_whitening(system, layout, gain)
    R = weighted_inverse(G, whitening.T @ whitening, blind_modes(system, layout), kappa)
    return reconstructor_of(system, R, G, method="least_squares", label=label, gain=gain, stages=stages, kappa=kappa)


def bytes_needed(layout: Layout) -> float:
    """Memory of :func:`least_squares` at its peak, about: D, weighted, R and a copy, and the normal equations."""
    return 8.0 * layout.n_commands * (4 * layout.n_slopes + 2 * layout.n_commands)


def weighted_inverse(D: Array, weight: sparse.sparray, blind: Array, kappa: float) -> Array:
    """``(D^T W D + kappa I)^-1 D^T W`` with no weight on blind modes.

    Args:
        D: (n_slopes, n_commands).
        weight: (n_slopes, n_slopes) W, symmetric: an inverse covariance, rad^-2.
        blind: (n_slopes, n_modes) of full rank.
        kappa: relative to the mean diagonal of ``D^T W D``.

    Returns:
        (n_commands, n_slopes)
    """
    weighted = weight @ D
    if blind.shape[1]:
        heavy = weight @ blind
        weighted -= heavy @ np.linalg.solve(blind.T @ heavy, blind.T @ weighted)
    normal = D.T @ weighted
    normal[np.diag_indices_from(normal)] += kappa * normal.trace() / len(normal)
    return cho_solve(cho_factor(normal), weighted.T)
