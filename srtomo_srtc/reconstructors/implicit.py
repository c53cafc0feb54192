"""The implicit (spatio-angular) LMMSE reconstructor (eq. 14, 18, 19).

Slopes to the pupil's wavefront towards the science targets, without layers in between, and from there to commands::

    R = F Sigma_phi_s P [ P (Sigma_ss + Sigma_nn) P + gamma (I - P) ]^-1 P

P takes the mean x and mean y slope out of every sensor whose star is blind to tip-tilt; natural stars' slopes take
part in the same estimate. F fits the mirrors to the wavefront in the least-squares sense over targets and pupil.
"""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, slope_covariance, slope_wavefront_covariance
from srtomo_srtc.geometry import footprints, pupil_grid
from srtomo_srtc.gradient import gradient_operator
from srtomo_srtc.mirrors import interaction_matrix, mirror_wavefronts
from srtomo_srtc.noise import slope_variance

Array = NDArray[np.float64]

KAPPA = 1e-4
"""Default regularisation of the fit, relative to the mean square of an influence function over the pupil."""

_POINTS_PER_PITCH = 2  # finer changes the residual by less than 0.05 nm


def implicit(
    system: System,
    layout: Layout | None = None,
    *,
    label: str = "",
    noise_gain: float | None = None,
    kappa: float = KAPPA,
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
        progress: called with the name of each stage and the share of the work done before it, 0 to 1.

    Returns:
        The reconstructor, and G (n_slopes, n_commands) rad/m.

    Raises:
        ValueError: the layout has other slopes or commands than the system, or a dark sub-aperture.
    """
    nominal = Layout(system)
    layout = nominal if layout is None else layout
    if (*layout.slope_start, *layout.command_start) != (*nominal.slope_start, *nominal.command_start):
        raise ValueError("layout: expected the slopes and commands of the system")
    gain = system.loop.gain if noise_gain is None else noise_gain
    stages = _Stages(progress)

    stages.enter("geometry", 0.0)
    profile = Profile.of(system)
    sensors = sightlines(system, layout, profile)
    grid = pupil_grid(system.telescope, min(mirror.pitch for mirror in layout.mirrors) / _POINTS_PER_PITCH)
    directions = [target.position for target in system.science.targets]
    targets = [footprints(grid.x, grid.y, direction, np.inf, profile.heights) for direction in directions]
    turbulence = Turbulence.covering(profile, [*(s.nodes for s in sensors), *targets])

    stages.enter("interaction matrix", 0.05)
    G = interaction_matrix(system, layout)

    stages.enter("slope covariance", 0.1)
    S = slope_covariance(turbulence, sensors)
    S[np.diag_indices_from(S)] += noise_prior(system, layout, gain)
    means = tip_tilt_means(system, layout)
    _project_both_sides(S, means, gamma=S.trace() / len(S))

    stages.enter("wavefront-slope covariance", 0.35)
    weights = np.array([target.weight for target in system.science.targets])
    weights /= weights.sum()
    normal = np.zeros((layout.n_commands, layout.n_commands))
    fitted = np.zeros((layout.n_slopes, layout.n_commands))
    for direction, points, weight in zip(directions, targets, weights, strict=True):
        modes = mirror_wavefronts(layout, grid.x, grid.y, direction)
        modes -= grid.weight @ modes
        weighted = modes.T * (weight * grid.weight)
        normal += weighted @ modes
        fitted += slope_wavefront_covariance(turbulence, sensors, points) @ weighted.T

    stages.enter("solution", 0.8)
    normal[np.diag_indices_from(normal)] += kappa * normal.trace() / len(normal)
    # S is symmetric: its transpose is the same matrix in the order that LAPACK factors without a copy
    factor = cho_factor(S.T, overwrite_a=True)
    estimated = _project(cho_solve(factor, _project(fitted, means)), means)
    R = cho_solve(cho_factor(normal), estimated.T)

    stages.enter("done", 1.0)
    reconstructor = Reconstructor.from_matrices(
        R,
        G,
        fingerprint=nominal.fingerprint,
        gain=system.loop.gain,
        command_limit=nominal.stroke,
        label=label,
        provenance=_provenance(system, gain, kappa, stages.seconds),
    )
    return reconstructor, G


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


def _project(matrix: Array, means: Array) -> Array:
    """P times a matrix (n_slopes, n)."""
    return matrix - means @ (means.T @ matrix)


def _project_both_sides(S: Array, means: Array, gamma: float) -> None:
    """Turn S into ``P S P + gamma (I - P)`` where it lies."""
    product = S @ means
    half = product - 0.5 * means @ (means.T @ product + gamma * np.eye(means.shape[1]))
    update = means @ half.T
    S -= update
    S -= update.T


class _Stages:
    """Names and times of the stages, told to whoever wants to know."""

    def __init__(self, progress: Callable[[str, float], None] | None) -> None:
        self.seconds: dict[str, float] = {}
        self._progress = progress
        self._name = ""
        self._since = 0.0

    def enter(self, name: str, done: float) -> None:
        now = time.perf_counter()
        if self._name:
            self.seconds[self._name] = round(now - self._since, 3)
        self._name, self._since = name, now
        if self._progress is not None:
            self._progress(name, done)


def _provenance(system: System, gain: float, kappa: float, seconds: dict[str, float]) -> dict[str, Any]:
    try:
        own_version = importlib.metadata.version("srtomo")
    except importlib.metadata.PackageNotFoundError:
        own_version = "not installed"
    return {
        "method": "implicit",
        "system": system.name,
        "zenith_angle_rad": system.zenith_angle,
        "atmosphere": system.atmosphere.model_dump(mode="json"),
        "noise": {
            "gain": gain,
            "variance_factor": gain / (2 - gain),
            "rate_hz": system.loop.rate,
            "sensors": {
                sensor.name: sensor.model_dump(
                    mode="json",
                    include={"photons", "spot_fwhm", "excess_noise", "read_noise", "pixels", "pixel_scale"},
                )
                for sensor in system.sensors
            },
        },
        "kappa": kappa,
        "versions": {
            "srtomo": own_version,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "numba": numba.__version__,
        },
        "seconds": seconds,
    }
