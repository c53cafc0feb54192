"""What every estimator supposes of an instrument: sightlines, noise, and the modes that its sensors are blind to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline
from srtomo_srtc.geometry import SeenLattice, cell_light, footprints
from srtomo_srtc.gradient import OVERSAMPLING, gradient_operator
from srtomo_srtc.noise import slope_noise

Array = NDArray[np.float64]

_LIGHT_POINTS = 32  # across a sub-aperture when the centroid of its light is found


def ground_prior(system: System) -> System:
    """The same system with all its turbulence at the ground: same r0 and outer scale, no tomography to speak of."""
    ground = system.atmosphere.layers[0].model_copy(update={"altitude": 0.0, "fraction": 1.0})
    return system.with_changes({"atmosphere.layers": [ground.model_dump()]})


def layout_of(system: System, layout: Layout | None) -> Layout:
    """Where sensors and mirrors are taken to be: ``layout``, or as in the system.

    Raises:
        ValueError: ``layout`` has other slopes or commands than the system.
    """
    nominal = Layout(system)
    if layout is None:
        return nominal
    if (*layout.slope_start, *layout.command_start) != (*nominal.slope_start, *nominal.command_start):
        raise ValueError("layout: expected the slopes and commands of the system")
    return layout


def sightlines(system: System, layout: Layout, profile: Profile, oversampling: int = OVERSAMPLING) -> list[Sightline]:
    """Every sensor's nodes on the profile's layers, with its gradient operator."""
    lines = []
    for sensor, place in zip(system.sensors, layout.sensors, strict=True):
        star = system.star_of(sensor)
        operator = gradient_operator(system.telescope, place, oversampling)
        aim = star.position, system.los_range(star), profile.heights
        nodes = footprints(operator.x, operator.y, *aim)
        lines.append(Sightline(nodes, operator.matrix, SeenLattice.towards(operator.lattice, *aim)))
    return lines


def noise_prior(system: System, layout: Layout, gain: float) -> Array:
    """(n_slopes,) slope variances, rad^2, as a loop of this gain passes them on: ``g / (2-g)`` of the sensor's."""
    pairs = zip(system.sensors, layout.sensors, strict=True)
    return gain / (2 - gain) * np.concatenate([slope_noise(system, s, place).variance for s, place in pairs])


def elongation_prior(system: System, layout: Layout, gain: float) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """What :func:`noise_prior` leaves out where spots are elongated: the covariance of a sub-aperture's y with its x.

    Returns:
        Rows, columns and values (rad^2) of the noise covariance's entries below the diagonal; none for round spots.
    """
    rows, columns, values = [], [], []
    for w, (sensor, place) in enumerate(zip(system.sensors, layout.sensors, strict=True)):
        covariance = slope_noise(system, sensor, place).covariance
        elongated = np.flatnonzero(covariance)
        columns.append(layout.slopes_of(w).start + elongated)
        rows.append(columns[-1] + place.n_valid)
        values.append(gain / (2 - gain) * covariance[elongated])
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def low_order_slopes(system: System, layout: Layout, sensor: int) -> tuple[Array, Array]:
    """What one sensor's slopes are for overall tip-tilt, and for focus.

    Returns:
        (n_slopes, 2) a constant in x and a constant in y along the sensor's axes; (n_slopes, 1) the light-weighted mean
        gradient of ``(x^2 + y^2) / 2``, m. Zero in other sensors' slopes.
    """
    place, own = layout.sensors[sensor], layout.slopes_of(sensor)
    tip_tilt = np.zeros((layout.n_slopes, 2))
    tip_tilt[own] = np.kron(np.eye(2), np.ones((place.n_valid, 1)))
    _, u, v = (part[:, 0, 0] for part in cell_light(system.telescope, place, 1, _LIGHT_POINTS))
    x, y = place.to_pupil(place.local[:, 0] + place.size * (u - 0.5), place.local[:, 1] + place.size * (v - 0.5))
    c, s = np.cos(place.rotation), np.sin(place.rotation)
    focus = np.zeros((layout.n_slopes, 1))
    focus[own, 0] = np.concatenate([c * x + s * y, c * y - s * x])
    return tip_tilt, focus


def blind_modes(system: System, layout: Layout) -> Array:
    """Orthonormal slope vectors that ``P = I - M M^T`` removes.

    Returns:
        (n_slopes, n) M: of each sensor, the tip-tilt and the focus that its star is blind to. A single lenslet is never
        blind to focus, which it takes for a tilt.
    """
    bases = [np.zeros((layout.n_slopes, 0))]
    for w, sensor in enumerate(system.sensors):
        star = system.star_of(sensor)
        tip_tilt, focus = low_order_slopes(system, layout, w)
        modes = [tip_tilt] if star.tip_tilt == "blind" else []
        if star.focus == "blind" and layout.sensors[w].n_valid > 1:
            modes.append(focus)
        if modes:
            bases.append(np.zeros((layout.n_slopes, sum(mode.shape[1] for mode in modes))))
            bases[-1][layout.slopes_of(w)] = np.linalg.qr(np.hstack(modes)[layout.slopes_of(w)])[0]
    return np.hstack(bases)


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
