"""What every estimator supposes of an instrument: sightlines, noise, and the modes that its sensors are blind to."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline
from srtomo_srtc.geometry import SeenLattice, cell_light, footprints
from srtomo_srtc.gradient import OVERSAMPLING, gradient_operator
from srtomo_srtc.memory import require
from srtomo_srtc.noise import MeasuredNoise, SlopeNoise, sensor_noise

Array = NDArray[np.float64]

_BYTES_OF_MEASURED = 60.0  # an entry, while the sensors' blocks become one sparse matrix
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
        seen = SeenLattice.towards(operator.lattice, *aim)
        lines.append(Sightline(nodes, operator.matrix, seen, operator.stencils))
    return lines


def noise_covariance(system: System, layout: Layout, gain: float) -> sparse.csr_array:
    """Sigma_nn as a loop of this gain passes it on: ``g / (2-g)`` of the sensors' variances.

    All of it: photons and read-out, the covariance of x with y where spots are elongated, measured ones from files.

    Returns:
        (n_slopes, n_slopes) rad^2; sensors are independent of each other.

    Raises:
        ValueError: a file with a measured covariance cannot be used.
        MemoryError: one line, before any work, if there is not enough for measured covariances.
    """
    blocks = [noise.matrix() for noise in _noises(system, layout)]
    return sparse.csr_array(gain / (2 - gain) * sparse.block_diag(blocks, format="csr"))


def noise_whitening(system: System, layout: Layout, gain: float) -> sparse.csr_array:
    """W with ``W Sigma_nn W^T = I`` and ``Sigma_nn^-1 = W^T W``, for :func:`noise_covariance`'s Sigma_nn.

    Returns:
        (n_slopes, n_slopes) lower triangular, 1/rad.

    Raises:
        ValueError, MemoryError: as :func:`noise_covariance`.
    """
    blocks = [noise.whitening() for noise in _noises(system, layout)]
    return sparse.csr_array(math.sqrt((2 - gain) / gain) * sparse.block_diag(blocks, format="csr"))


def _noises(system: System, layout: Layout) -> list[SlopeNoise | MeasuredNoise]:
    pairs = list(zip(system.sensors, layout.sensors, strict=True))
    measured = sum(place.n_slopes**2 for sensor, place in pairs if sensor.noise_covariance is not None)
    if measured:
        require(_BYTES_OF_MEASURED * measured, f"measured noise of {system.name}")
    return [sensor_noise(system, sensor, place) for sensor, place in pairs]


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
