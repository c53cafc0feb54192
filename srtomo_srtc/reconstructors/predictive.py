"""The predictive reconstructor: every layer moved with its wind over the loop's lag; one exposure, no extra size.

What is on the mirror is on average ``delay + (1-g)/g`` frames old. The wavefront to correct is therefore estimated that
much later than the exposure: with frozen flow, Sigma_phi_s between the pupil now and where the wind has since taken the
turbulence that the sensors saw (eq. 14 with moved intercepts). Everything else is :func:`implicit`'s.

A wrong wind costs more than a right one gains: use it where the wind is known, in direction to some tens of degrees.
"""

from __future__ import annotations

from collections.abc import Callable

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.fitting import KAPPA
from srtomo_srtc.gradient import OVERSAMPLING
from srtomo_srtc.reconstructors.implicit import Array, implicit
from srtomo_srtc.wind import effective_lag


def predictive(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
    split: bool = False,
    lag: float | None = None,
    oversampling: int = OVERSAMPLING,
    fast: bool = False,
    threads: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Reconstructor, Array]:
    """Build the reconstructor and the interaction matrix that it goes with.

    Args:
        lag: from the middle of an exposure to when its correction counts, s; that of the system's loop when not given.

    Other arguments, return value and errors as :func:`implicit`.
    """
    if lag is None:
        lag = effective_lag(system.loop)
    return implicit(
        system,
        layout,
        label=label,
        noise_gain=noise_gain,
        kappa=kappa,
        split=split,
        lag=lag,
        oversampling=oversampling,
        fast=fast,
        threads=threads,
        progress=progress,
    )
