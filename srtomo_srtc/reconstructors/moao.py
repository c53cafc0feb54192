"""Multi-object correction: a reconstructor for one science direction, whose mirror no sensor sees (eq. 18).

The implicit estimate towards that direction alone, in open loop: G = 0, so Q = 0, and the loop's gain is only a filter
over time. An instrument with several arms runs one of these for each, on the same slopes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.fitting import KAPPA
from srtomo_srtc.reconstructors.implicit import implicit

Array = NDArray[np.float64]


def moao(
    system: System,
    layout: Layout | None = None,
    *,
    target: int = 0,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
    split: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Reconstructor, Array]:
    """Build the reconstructor of one direction's mirrors.

    Args:
        target: which of ``system.science.targets``, from 0; its weight plays no part.

        All others as :func:`srtomo_srtc.reconstructors.implicit.implicit` takes them.

    Returns:
        The reconstructor, and G (n_slopes, n_commands), which is 0.

    Raises:
        ValueError: no such target; or as ``implicit``.
    """
    if system.loop.tip_tilt is not None:
        raise ValueError("loop.tip_tilt: its stars would have to see the mirror, which here no sensor does")
    n_targets = len(system.science.targets)
    if not 0 <= target < n_targets:
        raise ValueError(f"target: expected 0 to {n_targets - 1}, got {target}")
    alone = system.with_changes({f"science.targets.{i}.weight": float(i == target) for i in range(n_targets)})
    made, G = implicit(alone, layout, label=label, noise_gain=noise_gain, kappa=kappa, split=split, progress=progress)
    unseen = np.zeros_like(G)
    reconstructor = Reconstructor.from_matrices(
        made.R[0],
        unseen,
        fingerprint=made.fingerprint,
        gain=made.gain,
        command_limit=made.command_limit,
        label=label,
        provenance={**made.provenance, "method": "moao", "target": target},
    )
    return reconstructor, unseen
