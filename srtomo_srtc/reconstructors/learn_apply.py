"""Learn & Apply: from slopes to the slopes of virtual sensors on the science targets, and from those to commands.

    R = C Sigma_{s_beta s_alpha} P [ P (Sigma_ss + Sigma_nn) P + gamma (I - P) ]^-1 P      (sections 2.3.2 and 4.3)

C is the mirrors' own control matrix, an inverse of what the virtual sensors see of them. Wavefronts never appear, so
that both covariances can be measured ones, used as they are: all slopes with each other (open loop or pseudo-open-loop,
noise and all), and those of a truth sensor with all others. In the predictive form the virtual sensors measure the sky
as the wind will have moved it after the loop's lag.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, slope_covariance, wavefront_covariance
from srtomo_srtc.estimator import commands_from
from srtomo_srtc.memory import require
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, layout_of, noise_covariance, sightlines
from srtomo_srtc.provenance import Stages, reconstructor_of
from srtomo_srtc.reconstructors.least_squares import weighted_inverse
from srtomo_srtc.split import Split
from srtomo_srtc.tip_tilt import in_two_loops
from srtomo_srtc.wind import sensors_carried, winds

Array = NDArray[np.float64]

KAPPA = 3e-4
"""Default regularisation of the control matrix, relative to the mean diagonal of the normal equations."""


@in_two_loops
def learn_apply(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    virtual: System | None = None,
    slopes: Array | None = None,
    truth: Array | None = None,
    control_matrix: Array | None = None,
    lag: float = 0.0,
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
            leaves ``g / (2-g)`` of its variance. Measured ``slopes`` have their noise already.
        virtual: the same instrument with the virtual sensors, or the truth sensor, for sensors; by default
            :func:`virtual_system`.
        slopes: measured covariance (n_slopes, n_slopes) of all slopes with each other, noise included, rad^2.
        truth: measured covariance (n_virtual, n_slopes) of the virtual sensors' slopes with all others, rad^2.
        control_matrix: (n_commands, n_virtual) from virtual slopes to commands, m/rad; by default a least-squares
            inverse of the modelled response, targets weighted.
        lag: the wind moves the layers by this time between the slopes and the command, s; see
            :func:`srtomo_srtc.wind.effective_lag`. A measured ``truth`` has its own.
        kappa: regularisation of the control matrix, relative to the mean diagonal of its normal equations.
        split: natural stars control tip-tilt alone, lasers everything else.
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: the layout has other slopes or commands than the system; a matrix is of another shape than stated;
            the virtual sensors belong to other mirrors; a dark sub-aperture; or nothing to split.
        MemoryError: one line, before any work, if there is not enough.
    """
    layout = layout_of(system, layout)
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = Stages(progress)

    stages.enter("geometry", 0.0)
    virtual = virtual_system(system) if virtual is None else virtual
    virtual_layout = Layout(virtual)
    if virtual.mirrors != system.mirrors or virtual_layout.n_commands != layout.n_commands:
        raise ValueError("virtual: expected the mirrors of the system")
    n_virtual, n_slopes = virtual_layout.n_slopes, layout.n_slopes
    _expect("slopes", slopes, (n_slopes, n_slopes))
    _expect("truth", truth, (n_virtual, n_slopes))
    _expect("control_matrix", control_matrix, (layout.n_commands, n_virtual))
    require(
        8.0 * (4 * n_slopes**2 + 2 * n_slopes * n_virtual + layout.n_commands * (4 * n_slopes + 3 * n_virtual)),
        f"Learn & Apply reconstructor of {system.name}",
    )
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile)
    seen = sensors_carried(sightlines(virtual, virtual_layout, profile), winds(system), -lag)
    turbulence = Turbulence.covering(profile, [s.nodes for s in [*sensors, *seen]])

    stages.enter("interaction matrix", 0.1)
    G = interaction_matrix(system, layout)
    if control_matrix is None:
        virtual_layout.mirrors = layout.mirrors
        control_matrix = weighted_inverse(
            interaction_matrix(virtual, virtual_layout),
            sparse.diags_array(_target_weights(system, virtual, virtual_layout)),
            np.zeros((n_virtual, 0)),
            kappa,
        )

    stages.enter("slope covariance", 0.3)
    noise = noise_covariance(system, layout, gain)
    if slopes is None:
        S = slope_covariance(turbulence, sensors) + noise.toarray()
    else:
        S = np.array(slopes, dtype=np.float64)
    stages.enter("virtual-slope covariance", 0.6)
    right = slope_cross_covariance(turbulence, sensors, seen) if truth is None else np.asarray(truth, np.float64).T

    stages.enter("solution", 0.9)
    parts = Split.of(system, layout, G) if split else None
    # commands are fewer than virtual slopes: C goes in before the solution
    R = commands_from(S, right @ control_matrix.T, blind_modes(system, layout), lambda commands: commands, parts, noise)
    return reconstructor_of(
        system,
        R,
        G,
        method="learn_apply",
        label=label,
        gain=gain,
        stages=stages,
        kappa=kappa,
        split=split,
        lag_s=lag,
        measured=[name for name, given in (("slopes", slopes), ("truth", truth)) if given is not None],
        virtual_sensors=[sensor.name for sensor in virtual.sensors],
    )


def virtual_system(system: System, subapertures: int | None = None) -> System:
    """The instrument with one virtual sensor on each science target, at infinity, neither shifted nor rotated.

    Args:
        subapertures: across the pupil; by default one for each actuator of the finest mirror.
    """
    if subapertures is None:
        finest = min(mirror.pitch for mirror in Layout(system).mirrors)
        subapertures = round(system.telescope.diameter / finest)
    like = max(system.sensors, key=lambda sensor: sensor.subapertures)
    stars, sensors = [], []
    for i, target in enumerate(system.science.targets):
        name = f"virtual_{i}"
        stars.append({"name": name, "kind": "natural", "position": target.position.model_dump()})
        own = {"name": name, "guide_star": name, "subapertures": subapertures, "shift": (0.0, 0.0), "rotation": 0.0}
        own["noise_covariance"] = None  # of another sensor
        sensors.append(like.model_dump() | own)
    # the real stars stay: the mirrors' edges depend on the field
    return system.with_changes(
        {"guide_stars": [*(star.model_dump() for star in system.guide_stars), *stars], "sensors": sensors}
    )


def slope_cross_covariance(turbulence: Turbulence, sensors: list[Sightline], others: list[Sightline]) -> Array:
    """(n_slopes, n_others) rad^2, between all slopes of two sets of sensors."""
    return np.block(
        [
            [
                (other.gradient @ (sensor.gradient @ wavefront_covariance(turbulence, sensor.nodes, other.nodes)).T).T
                for other in others
            ]
            for sensor in sensors
        ]
    )


def _target_weights(system: System, virtual: System, layout: Layout) -> Array:
    """(n_virtual,) each virtual slope's share: its target's weight over its number of slopes."""
    weight = {target.position: target.weight for target in system.science.targets}
    return np.concatenate(
        [
            np.full(place.n_slopes, weight.get(virtual.star_of(sensor).position, 1.0) / place.n_slopes)
            for sensor, place in zip(virtual.sensors, layout.sensors, strict=True)
        ]
    )


def _expect(name: str, matrix: Array | None, shape: tuple[int, int]) -> None:
    if matrix is not None and np.shape(matrix) != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {np.shape(matrix)}")
