"""What every estimator supposes of an instrument: sightlines, noise, and the modes that its sensors are blind to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline
from srtomo_srtc.geometry import footprints
from srtomo_srtc.gradient import gradient_operator
from srtomo_srtc.noise import slope_variance

Array = NDArray[np.float64]


def ground_prior(system: System) -> System:
    """The same system with all its turbulence at the ground: same r0 and outer scale, no tomography to speak of."""
    ground = system.atmosphere.layers[0].model_copy(update={"altitude": 0.0, "fraction": 1.0})
    return system.with_changes({"atmosphere.layers": [ground.model_dump()]})


def sightlines(system: System, layout: Layout, profile: Profile) -> list[Sightline]:
    """Every sensor's nodes on the profile's layers, with its gradient operator."""
    lines = []
    for sensor, place in zip(system.sensors, layout.sensors, strict=True):
        star = system.star_of(sensor)
        operator = gradient_operator(system.telescope, place)
        nodes = footprints(operator.x, operator.y, star.position, system.los_range(star), profile.heights)
        lines.append(Sightline(nodes, operator.matrix))
    return lines


def noise_prior(system: System, layout: Layout, gain: float) -> Array:
    """(n_slopes,) slope variances, rad^2, as a loop of this gain passes them on: ``g / (2-g)`` of the sensor's."""
    pairs = zip(system.sensors, layout.sensors, strict=True)
    return gain / (2 - gain) * np.concatenate([slope_variance(s, place, system.loop.rate) for s, place in pairs])


def tip_tilt_means(system: System, layout: Layout) -> Array:
    """Orthonormal slope vectors that ``P = I - M M^T`` removes.

    Returns:
        (n_slopes, n) M: for each sensor on a blind star, a constant in x and a constant in y.
    """
    columns = []
    for w, sensor in enumerate(system.sensors):
        if system.star_of(sensor).tip_tilt == "blind":
            n_valid = layout.sensors[w].n_valid
            first = layout.slopes_of(w).start
            for start in (first, first + n_valid):
                column = np.zeros(layout.n_slopes)
                column[start : start + n_valid] = n_valid**-0.5
                columns.append(column)
    return np.stack(columns, axis=1) if columns else np.zeros((layout.n_slopes, 0))


def project(matrix: Array, means: Array) -> Array:
    """P times a matrix (n_slopes, n)."""
    return matrix - means @ (means.T @ matrix)


def project_both_sides(S: Array, means: Array, gamma: float) -> None:
    """Turn S into ``P S P + gamma (I - P)`` where it lies."""
    product = S @ means
    half = product - 0.5 * means @ (means.T @ product + gamma * np.eye(means.shape[1]))
    update = means @ half.T
    S -= update
    S -= update.T
