"""Tomography in the space of Karhunen-Loeve modes on virtual mirrors, projected onto the real ones (section 6.2).

Every layer carries a virtual mirror, finer by a chosen factor than the real mirror that is nearest to it. The layer's
wavefront at its actuators, without piston, has the covariance ``U diag(v) U^T``: U are its Karhunen-Loeve modes, v
their variances. With D the slopes of all modes of all layers, and B their wavefronts towards the targets,

    R = F B diag(v) D^T P [ P (D diag(v) D^T + Sigma_nn) P + gamma (I - P) ]^-1 P

What the virtual mirrors cannot make, or is in the modes left out, is not in the model: it aliases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, eigh

from srtomo_core.layout import Layout, MirrorLayout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.atmosphere import CovarianceTable, Profile
from srtomo_srtc.covariance import Sightline
from srtomo_srtc.estimator import commands_from
from srtomo_srtc.fitting import KAPPA, Fit, View
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import influence, interaction_matrix
from srtomo_srtc.model import blind_modes, layout_of, noise_covariance, sightlines
from srtomo_srtc.provenance import Stages, reconstructor_of
from srtomo_srtc.split import Split
from srtomo_srtc.tip_tilt import in_two_loops

Array = NDArray[np.float64]

PITCH_FACTOR = 1.5
"""Default pitch of the nearest real mirror over that of a virtual one: MORFEO's."""

_COUPLING = 0.3  # of the virtual mirrors
_MARGIN = 1.0  # pitches that a virtual mirror goes beyond what is seen of its layer


@dataclass(frozen=True)
class LayerModes:
    """Independent modes of one layer.

    Attributes:
        variances: (n_modes,) of their coefficients, m^2.
        slopes: (n_slopes, n_modes) rad/m.
        wavefronts: (n_commands, n_modes) ``sum_i w_i N_i^T W`` times the modes' wavefronts towards the targets, the
            right-hand side of the fit.
    """

    variances: Array
    slopes: Array
    wavefronts: Array


@in_two_loops
def modal(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    pitch_factor: float = PITCH_FACTOR,
    kept: float = 1.0,
    kappa: float = KAPPA,
    split: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Reconstructor, Array]:
    """Build the reconstructor and the interaction matrix that it goes with.

    Args:
        system: sky, stars, noise, targets.
        layout: where sensors and mirrors are taken to be; as in ``system`` when not given.
        label: for people.
        noise_gain: loop gain g, the system's when not given: in a loop the estimate sees noise through a filter that
            leaves ``g / (2-g)`` of its variance.
        pitch_factor: pitch of the nearest real mirror over that of a layer's virtual one.
        kept: share of each layer's modes that is used, 0 to 1, those of the largest variances.
        kappa: regularisation of the fit, relative to the mean square of an influence function over the pupil.
        split: natural stars control tip-tilt alone, lasers everything else.
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: ``pitch_factor`` or ``kept`` out of range; the layout has other slopes or commands than the system,
            or a dark sub-aperture; or there is nothing to split.
        MemoryError: one line, before most of the work, if there is not enough.
    """
    if not pitch_factor > 0:
        raise ValueError(f"pitch_factor: expected above 0, got {pitch_factor:g}")
    if not 0 < kept <= 1:
        raise ValueError(f"kept: expected above 0 and at most 1, got {kept:g}")
    layout = layout_of(system, layout)
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)

    stages.enter("geometry", 0.0)
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile)
    fit = Fit(system, layout, kappa)
    targets = list(fit.footprints(profile.heights))
    mirrors = _virtual_mirrors(layout, profile, [*(s.nodes for s in sensors), *(p for _, p in targets)], pitch_factor)
    n_modes, n_nodes = max(m.n_actuators for m in mirrors), max(s.nodes.x.shape[1] for s in sensors)
    require(
        8.0 * (3 * layout.n_slopes**2 + 4 * layout.n_slopes * layout.n_commands)
        + 8.0 * n_modes * (4 * n_modes + 2 * max(n_nodes, len(fit.grid.x)) + 2 * layout.n_slopes),
        f"modal reconstructor of {system.name}",
    )

    stages.enter("interaction matrix", 0.05)
    G = interaction_matrix(system, layout)
    parts = Split.of(system, layout, G) if split else None

    stages.enter("modes", 0.1)
    layers = (_layer_modes(mirror, layer, profile, sensors, targets, kept) for layer, mirror in enumerate(mirrors))
    R = reconstruct(
        layers, noise_covariance(system, layout, gain), layout.n_commands, blind_modes(system, layout), fit, parts
    )
    return reconstructor_of(
        system,
        R,
        G,
        method="modal",
        label=label,
        gain=gain,
        stages=stages,
        kappa=kappa,
        split=split,
        pitch_factor=pitch_factor,
        kept=kept,
    )


def reconstruct(
    layers: Iterable[LayerModes],
    noise: sparse.csr_array,
    n_commands: int,
    blind: Array,
    fit: Fit,
    split: Split | None = None,
) -> Array:
    """R (n_commands, n_slopes) from the modes of all layers.

    Args:
        noise: (n_slopes, n_slopes) Sigma_nn, rad^2.
        blind: (n_slopes, n) orthonormal slope vectors to be left out.
    """
    S = noise.toarray()
    right = np.zeros((len(S), n_commands))
    for layer in layers:
        weighted = layer.slopes * layer.variances
        S += weighted @ layer.slopes.T
        right += weighted @ layer.wavefronts.T
    return commands_from(S, right, blind, fit.solve, split, noise)


def karhunen_loeve(covariance: Array, kept: float = 1.0) -> tuple[Array, Array]:
    """Modes of a wavefront known at points, piston apart.

    Args:
        covariance: (n, n) up to a constant, m^2.
        kept: share of the modes wanted.

    Returns:
        (n, n_modes) orthonormal modes without piston, largest variance first, and their variances (n_modes,).
    """
    centred = covariance - covariance.mean(axis=0)
    centred -= centred.mean(axis=1, keepdims=True)
    n = len(centred)
    wanted = max(1, round(kept * (n - 1)))
    # piston, of no variance, is made the smallest by far
    variances, modes = eigh(centred - centred.trace() / n, overwrite_a=True, driver="evd")
    return modes[:, : -wanted - 1 : -1], variances[: -wanted - 1 : -1]


def _virtual_mirrors(
    layout: Layout, profile: Profile, seen: list[Footprints], pitch_factor: float
) -> list[MirrorLayout]:
    mirrors = []
    for layer, height in enumerate(profile.heights):
        nearest = min(layout.mirrors, key=lambda mirror: abs(mirror.altitude - height))
        pitch = nearest.pitch / pitch_factor
        reach = max(float(np.hypot(p.x[layer], p.y[layer]).max()) for p in seen) + _MARGIN * pitch
        half = math.ceil(reach / pitch)
        axis = pitch * np.arange(-half, half + 1)
        x, y = np.meshgrid(axis, axis)
        mask = np.hypot(x, y) <= reach
        actuators = np.stack([x[mask], y[mask]], axis=1)
        mirrors.append(MirrorLayout(f"layer_{layer}", float(height), pitch, _COUPLING, math.inf, mask, actuators))
    return mirrors


def _layer_modes(
    mirror: MirrorLayout,
    layer: int,
    profile: Profile,
    sensors: list[Sightline],
    targets: list[tuple[View, Footprints]],
    kept: float,
) -> LayerModes:
    x, y = mirror.actuators.T
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    table = CovarianceTable.build(profile.r0, profile.outer_scale, float(distance.max()))
    modes, variances = karhunen_loeve(profile.fractions[layer] * table(distance), kept)
    # at its actuators the virtual mirror is to have the modes' values
    commands = cho_solve(cho_factor(influence(mirror, x, y)), modes)

    def seen(points: Footprints) -> Array:
        return influence(mirror, points.x[layer], points.y[layer]) @ commands

    return LayerModes(
        variances,
        np.concatenate([sensor.gradient @ seen(sensor.nodes) for sensor in sensors]),
        np.sum([view.projection @ seen(points) for view, points in targets], axis=0),
    )
