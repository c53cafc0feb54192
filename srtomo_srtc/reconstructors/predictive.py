"""The predictive reconstructor: every layer moved with its wind over the loop's lag, from one exposure or several.

What is on the mirror is on average ``delay + (1-g)/g`` frames old. The wavefront to correct is therefore estimated that
much later than the newest exposure: with frozen flow, Sigma_phi_s between the pupil now and where the wind has since
taken the turbulence that the sensors saw (eq. 14 with moved intercepts). From one exposure, everything else is
:func:`implicit`'s, and the reconstructor has no extra size.

Of N exposures, each older one counts as further sensors whose footprints the wind has carried further. Sensors' noise
is white from one exposure to the next; but as the loop's filter passes it on, with ``g / (2-g)`` of its variance, that
of exposures i and j is correlated by ``(1-g)^|i-j|``. For what to do when an exposure is missing, the reconstructor for
the newest one alone comes along.

A wrong wind costs more than a right one gains: say with ``wind_uncertainty`` how well it is known, and it is used as
far as that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.linalg import toeplitz

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, n_parts
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.closures import Closures
from srtomo_srtc.covariance import Turbulence, slope_tiles
from srtomo_srtc.crossterms import right_hand_side
from srtomo_srtc.estimator import commands_from_tiles
from srtomo_srtc.fitting import KAPPA, Fit
from srtomo_srtc.gradient import OVERSAMPLING
from srtomo_srtc.memory import require
from srtomo_srtc.model import blind_modes, layout_of, noise_covariance, sightlines
from srtomo_srtc.provenance import Stages, provenance
from srtomo_srtc.reconstructors.implicit import Array, implicit
from srtomo_srtc.solve import SymmetricTiles
from srtomo_srtc.split import Split
from srtomo_srtc.tip_tilt import in_two_loops
from srtomo_srtc.wind import effective_lag, sensors_carried, winds, with_trusted_winds


@in_two_loops
def predictive(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
    split: bool = False,
    lag: float | None = None,
    epochs: int = 1,
    wind_uncertainty: float | Sequence[float] = 0.0,
    oversampling: int = OVERSAMPLING,
    fast: bool = False,
    closures: Closures = "none",
    threads: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Reconstructor, Array]:
    """Build the reconstructor and the interaction matrix that it goes with.

    Args:
        lag: from the middle of the newest exposure to when its correction counts, s; that of the system's loop when not
            given.
        epochs: consecutive exposures to estimate from. One more than 1 costs some ``epochs^3`` times the time, and the
            loop ``epochs + 1`` times the memory.
        wind_uncertainty: 1 sigma of each component of the layers' velocities, m/s, one for all or one for each: see
            :func:`srtomo_srtc.wind.with_trusted_winds`, which says how far a wind is then followed.
        closures: as :func:`implicit`; they are made from the newest exposure alone, and so predict less with
            several.

    Other arguments, return value and errors as :func:`implicit`.

    Raises:
        ValueError: also for fewer than one exposure or a negative uncertainty.
    """
    if epochs < 1:
        raise ValueError(f"epochs: expected at least 1, got {epochs}")
    lag = effective_lag(system.loop) if lag is None else lag
    gain = system.loop.gain if noise_gain is None else noise_gain
    believed = with_trusted_winds(system, wind_uncertainty)
    layout = layout_of(system, layout)
    if epochs > 1:
        require(_bytes_needed(layout, epochs, fast, split), f"predictive reconstructor of {system.name}")
    said = {"wind_uncertainty": np.asarray(wind_uncertainty, dtype=np.float64).tolist()}
    alone_is = 1 / (1 + epochs**2) if epochs > 1 else 1.0  # of the work, about

    def first(name: str, done: float) -> None:
        if progress is not None and (epochs == 1 or name != "done"):
            progress(name, alone_is * done)

    alone, G = implicit(
        believed, layout, label=label, noise_gain=gain, kappa=kappa, split=split, lag=lag, oversampling=oversampling,
        fast=fast, closures=closures, threads=threads, progress=first,
    )  # fmt: skip
    if epochs == 1:
        if believed is not system:
            alone = replace(alone, provenance={**alone.provenance, **said})
        return alone, G

    stages = Stages(progress)
    stages.enter(f"{epochs} exposures: geometry", alone_is)
    profile = Profile.of(believed)
    sensors = sightlines(believed, layout, profile, oversampling)
    velocity = winds(believed)
    ages = [lag + epoch / believed.loop.rate for epoch in range(epochs)]
    seen = [sensor for age in ages for sensor in sensors_carried(sensors, velocity, age)]
    fit = Fit(believed, layout, kappa)
    turbulence = Turbulence.covering(
        profile, [*(sensor.nodes for sensor in seen), *(points for _, points in fit.footprints(profile.heights))]
    )
    blind: Array = np.kron(np.eye(epochs), blind_modes(believed, layout)).astype(np.float64)
    one = noise_covariance(believed, layout, gain)
    noise = sparse.csr_array(sparse.kron(toeplitz((1 - gain) ** np.arange(epochs)), one))

    stages.enter(f"{epochs} exposures: wavefront-slope covariance", alone_is + 0.1 * (1 - alone_is))
    wanted = right_hand_side(fit, turbulence, seen, profile.heights, fast=fast, threads=threads)

    stages.enter(f"{epochs} exposures: slope covariance", alone_is + 0.3 * (1 - alone_is))
    S = slope_tiles(turbulence, seen, fast=fast, threads=threads)
    S.add(noise)

    solving = alone_is + 0.5 * (1 - alone_is)
    stages.enter(f"{epochs} exposures: solution", solving)
    parts = _of_several(Split.of(believed, layout, G), layout.n_slopes, epochs) if split else None
    R = commands_from_tiles(
        S, wanted, blind, fit.solve, parts, noise, threads, lambda done: stages.within(done, solving, 1.0)
    )
    del S, wanted

    stages.enter("done", 1.0)
    reconstructor = Reconstructor.from_matrices(
        R.reshape(layout.n_commands, epochs, layout.n_slopes).transpose(1, 0, 2),
        G,
        fingerprint=alone.fingerprint,
        gain=alone.gain,
        command_limit=alone.command_limit,
        label=label,
        fallback=alone.R[0],
        threads=threads,
        provenance=provenance(
            believed,
            "predictive",
            gain,
            {**alone.provenance["seconds"], **stages.seconds},
            kappa=kappa,
            split=split,
            lag_s=lag,
            epochs=epochs,
            **said,
            oversampling=oversampling,
            fast=fast,
            closures=closures,
        ),
    )
    reconstructor = replace(reconstructor, closures=alone.closures, low_order=alone.low_order)
    return reconstructor, G


def _of_several(split: Split, n_slopes: int, epochs: int) -> Split:
    """The same split of all exposures' slopes; what natural stars answer for is their low orders in the newest."""
    starts = n_slopes * np.arange(epochs)[:, None]
    older = np.zeros((len(split.measured), (epochs - 1) * n_slopes))
    return Split(
        (starts + split.blind).ravel(),
        (starts + split.seeing).ravel(),
        np.hstack([split.measured, older]),
        split.answer,
        split.low_order,
    )


def _bytes_needed(layout: Layout, epochs: int, fast: bool, split: bool) -> float:
    """Memory of :func:`predictive` with several exposures at its peak, about."""
    dtype = np.dtype(np.float32 if fast else np.float64)
    n, m = epochs * layout.n_slopes, layout.n_commands
    right = m * n * dtype.itemsize
    # R and its copies in float32, one of them frozen, while Q is formed
    ending = right + (2 * 4 * n_parts(epochs) + 8) * m * layout.n_slopes
    solving = SymmetricTiles.bytes_needed(n, dtype) + right
    if split:
        # the lasers' own part of both, and what comes of them
        solving += solving + right
    return 2 * 8 * m * layout.n_slopes + 3 * 8 * m**2 + max(solving, ending)
