"""The explicit LMMSE reconstructor: slopes to the wavefront on every layer, and from there to commands (eq. 11-13, 15).

``R = C W_L`` with ``C = F sum_i w_i N_i^T T_beta_i``: :mod:`srtomo_srtc.layer_estimate`, on grids of nodes that rays
interpolate (:mod:`srtomo_srtc.raytrace`), with what is known of them beforehand (:mod:`srtomo_srtc.layer_prior`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.fitting import KAPPA, Fit
from srtomo_srtc.layer_estimate import COLUMNS, covariance_form, information_form
from srtomo_srtc.layer_prior import exact_covariance, exact_inverse, sparse_inverse
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, layout_of, noise_covariance, noise_whitening, sightlines
from srtomo_srtc.provenance import Stages, reconstructor_of
from srtomo_srtc.raytrace import layer_grids, propagation
from srtomo_srtc.tip_tilt import in_two_loops

Array = NDArray[np.float64]
Prior = Literal["exact", "laplacian"]
Form = Literal["covariance", "information"]
Solver = Literal["direct", "cg"]

_COARSER = 3  # grid steps of the preconditioner's second grid


@in_two_loops
def explicit(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
    prior: Prior = "exact",
    form: Form | None = None,
    solver: Solver = "direct",
    oversampling: float | Sequence[float] = 2.0,
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
        prior: covariance of each layer: ``exact``, or by the sparse Laplacian of eq. 37.
        form: of eq. 13; ``covariance`` with the exact prior and ``information`` with the sparse one when not given.
        solver: of the information form: ``direct``, a factorisation, or ``cg``, preconditioned conjugate gradients.
        oversampling: nodes of a layer's grid to the smallest sub-aperture, on a side; for all layers, or one each for
            the layers with turbulence.
        tolerance: of conjugate gradients, relative residual.
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: the layout has other slopes or commands than the system, or a dark sub-aperture; options that
            exclude each other.
        MemoryError: it would not fit; in one line, before any of it is allocated.
        ArithmeticError: conjugate gradients do not converge.
    """
    layout = layout_of(system, layout)
    if form is None:
        form = "covariance" if prior == "exact" and solver == "direct" else "information"
    if form == "covariance" and (prior, solver) != ("exact", "direct"):
        raise ValueError("form: covariance goes with the exact prior and the direct solver")
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)

    stages.enter("geometry", 0.0)
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile)
    fit = Fit(system, layout, kappa)
    targets = list(fit.footprints(profile.heights))
    steps = _grid_steps(layout, oversampling, len(profile.heights))
    grids = layer_grids([*(s.nodes for s in sensors), *(points for _, points in targets)], steps)
    sizes = np.array([grid.n_nodes for grid in grids])
    require(_memory(form, prior, solver, sizes, layout), f"explicit {form} form on {sizes.sum()} nodes")
    H = sparse.vstack([s.gradient @ propagation(grids, s.nodes) for s in sensors], format="csr")
    blind = blind_modes(system, layout)

    stages.enter("interaction matrix", 0.05)
    G = interaction_matrix(system, layout)

    stages.enter("fit", 0.1)
    wanted = np.zeros((layout.n_commands, H.shape[1]))
    for view, points in targets:
        wanted += view.projection @ propagation(grids, points)
    wanted = fit.solve(wanted)

    stages.enter("prior", 0.15)
    statistics = exact_covariance if form == "covariance" else exact_inverse if prior == "exact" else sparse_inverse
    blocks = [statistics(grid, profile, l) for l, grid in enumerate(grids)]

    stages.enter("solution", 0.2)
    if form == "covariance":
        R = covariance_form(wanted, H, blocks, noise_covariance(system, layout, gain), blind)
    else:
        whitening = noise_whitening(system, layout, gain)
        R = information_form(
            wanted,
            H,
            blocks,
            whitening.T @ whitening,
            blind,
            coarse=[grid.refinement(_COARSER) for grid in grids] if solver == "cg" else None,
            tolerance=tolerance,
            progress=None if progress is None else lambda done: progress("solution", 0.2 + 0.8 * done),
        )

    return reconstructor_of(
        system,
        R,
        G,
        method="explicit",
        label=label,
        gain=gain,
        stages=stages,
        kappa=kappa,
        prior=prior,
        form=form,
        solver=solver,
        tolerance=tolerance if solver == "cg" else None,
        grid_steps_m=steps,
        nodes=sizes.tolist(),
    )


def _grid_steps(layout: Layout, oversampling: float | Sequence[float], n_layers: int) -> list[float]:
    each = [float(oversampling)] * n_layers if isinstance(oversampling, int | float) else list(map(float, oversampling))
    if len(each) != n_layers or not all(0 < n < math.inf for n in each):
        raise ValueError(f"oversampling: expected a positive number, or {n_layers}, one for each layer with turbulence")
    size = min(place.size for place in layout.sensors)
    return [size / n for n in each]


def _memory(form: Form, prior: Prior, solver: Solver, sizes: NDArray[np.int64], layout: Layout) -> float:
    """Bytes at most, a little generously."""
    nodes, slopes, commands = int(sizes.sum()), layout.n_slopes, layout.n_commands
    rows = commands * (2 * nodes + 3 * slopes)
    priors = int((sizes**2).sum() + 4 * (sizes**2).max()) if prior == "exact" else 0
    work: float
    if form == "covariance":
        work = 2 * slopes**2 + 2 * slopes * int(sizes.max())
    elif solver == "cg":
        work = COLUMNS * (10 * nodes + 2 * slopes) + priors + 2 * (nodes / _COARSER**2) ** 2
    elif prior == "exact":
        work = 2 * nodes**2
    else:
        work = 1.5 * nodes**2  # two full triangles of values and indices: what the factors can never exceed
    return 8.0 * (rows + priors + work)
