"""Ground-layer correction: what all directions have in common (section 2.6).

Optical averaging (eq. 22) is the mean over the stars of each sensor's own inverse, ``<(G N)^+ s>``, without statistics.
Low orders that some stars are blind to are taken from those that see them (:mod:`srtomo_srtc.split`), not averaged with
nothing. Numerical averaging is eq. 19 with many directions over the field: it needs priors, and should do better.

Eq. 22 as the limit of eq. 19 is printed for stars so far apart that they share nothing; that drops the ground layer,
which all stars share. With it the limit is no longer the mean, and the numerical form weights stars by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, layout_of, project
from srtomo_srtc.provenance import Stages, reconstructor_of
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.split import Split
from srtomo_srtc.split import bytes_needed as split_needs
from srtomo_srtc.tip_tilt import in_two_loops

Array = NDArray[np.float64]

CUTOFF = 0.1
"""Singular values of a sensor's interaction matrix below this share of the largest are left out of its inverse."""

DIRECTIONS = 24
"""Default number of directions of the numerical form."""

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@in_two_loops
def glao(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    averaging: Literal["optical", "numerical"] = "optical",
    cutoff: float = CUTOFF,
    field: float | None = None,
    directions: int = DIRECTIONS,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Reconstructor, Array]:
    """Build the reconstructor and the interaction matrix that it goes with.

    Args:
        system: stars, sensors, mirrors; sky and noise too for the numerical form. Its science targets play no part.
        layout: where sensors and mirrors are taken to be; as in ``system`` when not given.
        label: for people.
        noise_gain: of the numerical form, as :func:`srtomo_srtc.reconstructors.implicit.implicit` takes it.
        averaging: over the stars' own inverses, or over directions of one estimate.
        cutoff: of the optical form's inverses, relative to the largest singular value.
        field: radius of the numerical form's field, rad; by default that of the guide stars.
        directions: number of the numerical form's, spread evenly over the field.
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: the layout has other slopes or commands than the system, or a dark sub-aperture.
        MemoryError: one line, before any work, if there is not enough.
    """
    if averaging == "numerical":
        wide = over_field(system, field, directions)
        made, G = implicit(wide, layout, label=label, noise_gain=noise_gain, progress=progress)
        details = {"method": "glao", "averaging": averaging, "directions": directions}
        return replace(made, provenance={**made.provenance, **details}), G

    layout = layout_of(system, layout)
    require(_bytes_needed(system, layout), f"ground-layer reconstructor of {system.name}")
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)
    stages.enter("interaction matrix", 0.0)
    G = interaction_matrix(system, layout)
    stages.enter("inverses", 0.7)
    R = mean_of_inverses(system, layout, G, cutoff)
    return reconstructor_of(
        system, R, G, method="glao", label=label, gain=gain, stages=stages, averaging=averaging, cutoff=cutoff
    )


def mean_of_inverses(system: System, layout: Layout, G: Array, cutoff: float) -> Array:
    """(n_commands, n_slopes) eq. 22, over the sensors of at least half the finest one's sub-apertures across."""
    blind = blind_modes(system, layout)
    taking_part = _taking_part(system)
    split = None
    if len({system.star_of(sensor).tip_tilt for sensor in system.sensors}) > 1:
        split = Split.of(system, layout, G)
    R = np.zeros(G.T.shape)
    for w in range(len(system.sensors)):
        own = layout.slopes_of(w)
        if w in taking_part:
            M = blind[own]
            inverse = np.asarray(np.linalg.pinv(project(G[own], M), rcond=cutoff), np.float64)
            R[:, own] = project(inverse.T, M).T / len(taking_part)
        if split is not None:
            R[:, own] += split.answer @ split.measured[:, own] - split.low_order @ R[:, own]
    return R


def _taking_part(system: System) -> list[int]:
    finest = max(sensor.subapertures for sensor in system.sensors)
    return [w for w, sensor in enumerate(system.sensors) if 2 * sensor.subapertures >= finest]


def _bytes_needed(system: System, layout: Layout) -> float:
    """Memory of the optical form at its peak, about."""
    n, m = max(layout.sensors[w].n_slopes for w in _taking_part(system)), layout.n_commands
    least = min(n, m)
    # both factors, their product, what was factored and its copies
    inverse = 8.0 * (6 * n * m + 5 * least**2)
    # both roundings of R while Q is formed
    ending = 8.0 * (m * layout.n_slopes + 3 * m**2)
    return 2 * 8.0 * m * layout.n_slopes + max(inverse, ending, split_needs(system, layout))


def over_field(system: System, field: float | None = None, directions: int = DIRECTIONS) -> System:
    """The system with equally weighted science targets spread evenly over a disc.

    Args:
        field: radius, rad; by default that of the guide stars.
        directions: how many.
    """
    if field is None:
        field = max(math.hypot(star.position.x, star.position.y) for star in system.guide_stars)
    spiral = [(field * math.sqrt((i + 0.5) / directions), i * _GOLDEN_ANGLE) for i in range(directions)]
    positions = [{"x": r * math.cos(angle), "y": r * math.sin(angle)} for r, angle in spiral]
    return system.with_changes({"science.targets": [{"position": position} for position in positions]})
