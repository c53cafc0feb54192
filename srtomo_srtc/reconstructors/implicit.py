"""The implicit (spatio-angular) LMMSE reconstructor (eq. 14, 18, 19).

Slopes to the pupil's wavefront towards the science targets, without layers in between, and from there to commands::

    R = F Sigma_phi_s P [ P (Sigma_ss + Sigma_nn) P + gamma (I - P) ]^-1 P

P takes tip-tilt and focus out of every sensor whose star is blind to them; natural stars' slopes take part in the same
estimate, or with ``split`` control tip-tilt alone (:mod:`srtomo_srtc.split`). F fits the mirrors to the wavefront in
the least-squares sense over targets and pupil.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.closures import Closures, low_order_of, sets_of_lasers, without
from srtomo_srtc.covariance import Turbulence, slope_tiles
from srtomo_srtc.crossterms import right_hand_side
from srtomo_srtc.estimator import commands_from_tiles
from srtomo_srtc.fitting import KAPPA, Fit
from srtomo_srtc.gradient import OVERSAMPLING
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.provenance import Stages, provenance
from srtomo_srtc.solve import SymmetricTiles
from srtomo_srtc.split import Split
from srtomo_srtc.split import bytes_needed as split_needs
from srtomo_srtc.tip_tilt import in_two_loops
from srtomo_srtc.wind import sensors_carried, winds

Array = NDArray[np.float64]


@in_two_loops
def implicit(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
    split: bool = False,
    lag: float = 0.0,
    oversampling: int = OVERSAMPLING,
    fast: bool = False,
    closures: Closures = "none",
    threads: int = 1,
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
        split: natural stars control tip-tilt alone, lasers everything else.
        lag: estimate the wavefront so much later than the exposure, every layer gone with its wind, s.
        oversampling: of the gradients' nodes, 1, 2 or 4 a sub-aperture.
        fast: float32, and interpolated covariances where that is quicker; the wavefront error stays within 0.1 nm.
        closures: for when a laser goes away, also build what does without it: ``singles``, each laser alone, or
            ``pairs``, every two as well; both with the ``low_order`` of natural stars for when others are closed.
        threads: to compute with, apart from those of the BLAS library.
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: the layout has other slopes or commands than the system, or a dark sub-aperture; or there is
            nothing to split; or closures of a split estimate.
        MemoryError: one line, before any work, if there is not enough.
    """
    if split and closures != "none":
        raise ValueError("closures: expected without split")
    nominal = Layout(system)
    layout = nominal if layout is None else layout
    if (*layout.slope_start, *layout.command_start) != (*nominal.slope_start, *nominal.command_start):
        raise ValueError("layout: expected the slopes and commands of the system")
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)

    stages.enter("geometry", 0.0)
    low_orders = split_needs(system, layout) if split else 0.0
    n_closures = len(sets_of_lasers(system, closures))
    require(bytes_needed(layout, fast, low_orders, n_closures), f"implicit reconstructor of {system.name}")
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile, oversampling)
    fit = Fit(system, layout, kappa)
    later = sensors_carried(sensors, winds(system), lag) if lag else sensors
    turbulence = Turbulence.covering(
        profile,
        [*(s.nodes for s in [*sensors, *later]), *(points for _, points in fit.footprints(profile.heights))],
    )
    blind, noise = blind_modes(system, layout), noise_covariance(system, layout, gain)

    stages.enter("interaction matrix", 0.1)
    G = interaction_matrix(system, layout, threads)

    stages.enter("wavefront-slope covariance", 0.15)
    wanted = right_hand_side(
        fit,
        turbulence,
        later,
        profile.heights,
        fast=fast,
        threads=threads,
        progress=lambda done: stages.within(done, 0.15, 0.45),
    )

    stages.enter("slope covariance", 0.45)
    S = slope_tiles(
        turbulence, sensors, fast=fast, threads=threads, progress=lambda done: stages.within(done, 0.45, 0.55)
    )
    S.add(noise)

    stages.enter("solution", 0.55)
    parts = Split.of(system, layout, G) if split else None
    sets, variants = sets_of_lasers(system, closures), {}
    ends = 0.8 if sets else 1.0
    R = commands_from_tiles(
        S, wanted, blind, fit.solve, parts, noise, threads, lambda done: stages.within(done, 0.55, ends)
    )
    if sets:
        stages.enter("closures", ends)
        variants = without(R, S, blind, layout, sets, threads, lambda done: stages.within(done, ends, 1.0))
    del S, wanted

    stages.enter("done", 1.0)
    reconstructor = Reconstructor.from_matrices(
        R,
        G,
        fingerprint=nominal.fingerprint,
        gain=system.loop.gain,
        command_limit=nominal.stroke,
        label=label,
        closures=variants,
        low_order=None if closures == "none" else low_order_of(system, layout, G),
        threads=threads,
        provenance=provenance(
            system,
            "predictive" if lag else "implicit",
            gain,
            stages.seconds,
            kappa=kappa,
            split=split,
            lag_s=lag,
            oversampling=oversampling,
            fast=fast,
            closures=closures,
        ),
    )
    return reconstructor, G


def bytes_needed(layout: Layout, fast: bool, low_orders: float = 0.0, n_closures: int = 0) -> float:
    """Memory of :func:`implicit` at its peak, about.

    Args:
        low_orders: what the split takes, if there is one (:func:`srtomo_srtc.split.bytes_needed`).
        n_closures: sets of closed lasers that something is built for.
    """
    dtype = np.dtype(np.float32 if fast else np.float64)
    matrix = layout.n_slopes * layout.n_commands
    tiles, right = SymmetricTiles.bytes_needed(layout.n_slopes, dtype), matrix * dtype.itemsize
    solving = tiles + right
    if low_orders:
        # the lasers' own part of both, and what comes of them
        solving = tiles + right + max(low_orders, tiles + 2 * right)
    # R in float64, and twice in float32, while Q is formed
    ending = matrix * (8 + 2 * 4)
    # R in float64, then rounded and frozen, and Q
    closing = n_closures * (16 * matrix + 4 * layout.n_commands**2)
    return matrix * 8 + 3 * 8 * layout.n_commands**2 + max(solving, ending) + closing
