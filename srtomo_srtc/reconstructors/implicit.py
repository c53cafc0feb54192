"""The implicit (spatio-angular) LMMSE reconstructor (eq. 14, 18, 19).

Slopes to the pupil's wavefront towards the science targets, without layers in between, and from there to commands::

    R = F Sigma_phi_s P [ P (Sigma_ss + Sigma_nn) P + gamma (I - P) ]^-1 P

P takes the mean x and mean y slope out of every sensor whose star is blind to tip-tilt; natural stars' slopes take
part in the same estimate. F fits the mirrors to the wavefront in the least-squares sense over targets and pupil.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance, slope_wavefront_covariance
from srtomo_srtc.fitting import KAPPA, Fit
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import noise_prior, project, project_both_sides, sightlines, tip_tilt_means
from srtomo_srtc.provenance import Stages, provenance

Array = NDArray[np.float64]


def implicit(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
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
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: the layout has other slopes or commands than the system, or a dark sub-aperture.
    """
    nominal = Layout(system)
    layout = nominal if layout is None else layout
    if (*layout.slope_start, *layout.command_start) != (*nominal.slope_start, *nominal.command_start):
        raise ValueError("layout: expected the slopes and commands of the system")
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)

    stages.enter("geometry", 0.0)
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile)
    fit = Fit(system, layout, kappa)
    targets = list(fit.footprints(profile.heights))
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *(points for _, points in targets)])

    stages.enter("interaction matrix", 0.1)
    G = interaction_matrix(system, layout)

    stages.enter("slope covariance", 0.15)
    S = slope_covariance(turbulence, sensors)
    S[np.diag_indices_from(S)] += noise_prior(system, layout, gain)
    means = tip_tilt_means(system, layout)
    project_both_sides(S, means, gamma=S.trace() / len(S))

    stages.enter("wavefront-slope covariance", 0.4)
    right = np.zeros((layout.n_slopes, layout.n_commands))
    for view, points in targets:
        right += slope_wavefront_covariance(turbulence, sensors, points) @ view.projection.T

    stages.enter("solution", 0.8)
    # S is symmetric: its transpose is the same matrix in the order that LAPACK factors without a copy
    factor = cho_factor(S.T, overwrite_a=True)
    R = fit.solve(project(cho_solve(factor, project(right, means)), means).T)

    stages.enter("done", 1.0)
    reconstructor = Reconstructor.from_matrices(
        R,
        G,
        fingerprint=nominal.fingerprint,
        gain=system.loop.gain,
        command_limit=nominal.stroke,
        label=label,
        provenance=provenance(system, "implicit", gain, stages.seconds, kappa=kappa),
    )
    return reconstructor, G
