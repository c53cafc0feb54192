"""The implicit LMMSE reconstructor without its covariance matrix: conjugate gradients and FFT products (eq. 39, 40).

The same matrix as :func:`srtomo_srtc.reconstructors.implicit`'s, to the solver's tolerance. Sigma_ss is never formed:
sensors that are only shifted against each other correlate by convolution (:mod:`srtomo_srtc.toeplitz`).

Eq. 39 solves ``(Sigma_ss + N) zeta = s`` for slopes s, and for the reconstructor's columns with unit slopes. The matrix
is symmetric: rows, of which there are fewer, come from ``(Sigma_ss + N) r = Sigma_s_phi F^T e`` for unit commands e.
Slopes are counted in standard deviations of their noise, and made independent of each other where spots are elongated,
which makes of the matrix ``I + B`` with B of signal-to-noise ratios; the few that are large are taken care of by the
preconditioner.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc import conjugate_gradients
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.conjugate_gradients import Operator
from srtomo_srtc.covariance import Turbulence, slope_wavefront_covariance
from srtomo_srtc.fitting import KAPPA, Fit
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, layout_of, noise_whitening, project, sightlines
from srtomo_srtc.provenance import Stages, reconstructor_of
from srtomo_srtc.tip_tilt import in_two_loops
from srtomo_srtc.toeplitz import ToeplitzCovariance

Array = NDArray[np.float64]

_COLUMNS = 64  # solved for at a time
_RANK = 0.25  # of the preconditioner, of the slopes
_LARGEST_RANK = 1024


@in_two_loops
def iterative(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
    tolerance: float = 1e-6,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Reconstructor, Array]:
    """Build the reconstructor and the interaction matrix that it goes with.

    Args:
        system: sky, stars, noise, targets.
        layout: where sensors and mirrors are taken to be; as in ``system`` when not given. Slopes and commands must be
            the same ones: only places may differ.
        label: for people.
        noise_gain: loop gain g, the system's when not given: in a loop the estimate sees noise through a filter that
            leaves ``g / (2-g)`` of its variance.
        kappa: regularisation of the fit, relative to the mean square of an influence function over the pupil.
        tolerance: of the solution, relative residual.
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: a sensor of more than a few slopes is rotated against the others, has other sub-apertures, or looks
            at a star at another range; the layout has other slopes or commands than the system, or a dark sub-aperture.
        MemoryError: it would not fit; in one line, before any of it is allocated.
        ArithmeticError: no convergence.
    """
    layout = layout_of(system, layout)
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)

    stages.enter("geometry", 0.0)
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile)
    fit = Fit(system, layout, kappa)
    rank = min(int(_RANK * layout.n_slopes), _LARGEST_RANK)
    correlated = len(fit.grid.x) * max(s.nodes.x.shape[1] for s in sensors)
    require(
        8 * (layout.n_slopes * (3 * layout.n_commands + 4 * rank) + 2 * correlated)
        + ToeplitzCovariance.bytes_needed(sensors),
        "iterative reconstructor",
    )
    covariance = ToeplitzCovariance(profile, sensors, [sensor.name for sensor in system.sensors])

    stages.enter("interaction matrix", 0.05)
    G = interaction_matrix(system, layout)

    stages.enter("wavefront-slope covariance", 0.1)
    targets = list(fit.footprints(profile.heights))
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *(points for _, points in targets)])
    right = np.zeros((layout.n_slopes, layout.n_commands))
    for w, sensor in enumerate(sensors):
        for view, points in targets:
            right[layout.slopes_of(w)] += slope_wavefront_covariance(turbulence, [sensor], points) @ view.projection.T
    right = fit.solve(right.T).T

    stages.enter("preconditioner", 0.2)
    solve = solver(
        covariance.product,
        noise_whitening(system, layout, gain),
        blind_modes(system, layout),
        rank,
        tolerance=tolerance,
    )

    stages.enter("solution", 0.25)
    for start in range(0, layout.n_commands, _COLUMNS):
        if progress is not None:
            progress("solution", 0.25 + 0.75 * start / layout.n_commands)
        columns = slice(start, start + _COLUMNS)
        right[:, columns] = solve(right[:, columns])
    return reconstructor_of(
        system,
        right.T,
        G,
        method="iterative",
        label=label,
        gain=gain,
        stages=stages,
        kappa=kappa,
        tolerance=tolerance,
    )


def solver(product: Operator, whitening: sparse.csr_array, blind: Array, rank: int, *, tolerance: float) -> Operator:
    """``P [P (Sigma_ss + N) P + gamma (I - P)]^-1 P`` times slopes (n_slopes, n), by iteration (eq. 39a).

    Args:
        product: Sigma_ss times slopes.
        whitening: (n_slopes, n_slopes) W with ``W N W^T = I``, 1/rad.
        blind: (n_slopes, n) M, orthonormal; P = I - M M^T.
        rank: of the preconditioner.
        tolerance: relative residual, in standard deviations of the noise.
    """
    W, Wt = whitening, whitening.T.tocsr()
    outside = np.linalg.qr(W @ blind)[0]

    def signal(z: Array) -> Array:
        return project(W @ product(Wt @ project(z, outside)), outside)

    precondition = conjugate_gradients.nystrom(signal, W.shape[0], rank)

    def solve(b: Array) -> Array:
        whitened = project(W @ b, outside)
        z = conjugate_gradients.solve(lambda z: z + signal(z), whitened, precondition, tolerance=tolerance)
        return Wt @ project(z, outside)

    return solve
