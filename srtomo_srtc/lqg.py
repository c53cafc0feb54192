"""Linear-quadratic-Gaussian control (section 2.2): a Kalman filter on the layers' wavefronts, with their wind.

The state x is the wavefront at the nodes of a grid on every layer. Everything else follows from covariances, without
interpolation: A is the regression of a layer on itself one frame before, frozen flow with what comes in from upwind
(eq. 4); C is that of the slopes on the state, and what the grids cannot show of the slopes is added to their noise.

Where the paper's equations are not followed to the letter:

- Eq. 6 gives the *predicted* state; with A = 0, where it says to find the static reconstructor (section 2.2.3), that is
  nothing at all. The static one is the limit of the *filtered* state ``x_k|k = x_k|k-1 + H (s_k - C x_k|k-1)``.
- Section 2.2.2's pseudo-open-loop slopes are ``s_k - D u_k-d``, not ``s_k - B u_k``; here D = -G.
- Mirrors are taken to be fast: no control Riccati equation; the command is the fit of the state predicted over the
  loop's delay.

Dense and cubic in the number of nodes: for small instruments, and as what other methods can be measured against.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import METRES_PER_RADIAN, Profile, covariance
from srtomo_srtc.covariance import (
    Sightline,
    Turbulence,
    slope_covariance,
    slope_wavefront_covariance,
    wavefront_covariance,
)
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.mirrors import interaction_matrix
from srtomo_srtc.model import blind_modes, layout_of, noise_covariance, project, sightlines
from srtomo_srtc.wind import carried, winds

Array = NDArray[np.float64]


_DIVERGED = 1e100


class RiccatiError(ArithmeticError):
    """The Riccati equation has no stabilising solution that could be found."""


@dataclass(frozen=True)
class LayeredModel:
    """The state-space model of eq. 4 for the turbulence alone; metres of wavefront, radians of slope.

    Attributes:
        prior: (n, n) covariance of the state, Sigma_phi.
        transition: (n, n) A, of one frame.
        excitation: (n, n) Sigma_nu; ``A Sigma_phi A^T + Sigma_nu = Sigma_phi``.
        observation: (n_slopes, n) C, without what the sensors are blind to.
        noise: (n_slopes, n_slopes) Sigma_eta, positive definite.
        delay: (n, n) the transition over the loop's delay.
        fit: (n_commands, n) from the state to commands.
    """

    prior: Array
    transition: Array
    excitation: Array
    observation: Array
    noise: Array
    delay: Array
    fit: Array


def layered_model(system: System, layout: Layout | None = None, *, step: float | None = None) -> LayeredModel:
    """Set the model up.

    Args:
        layout: where sensors and mirrors are taken to be; as in ``system`` when not given.
        step: of the layers' grids, m; the finest pitch of a mirror when not given.

    Raises:
        ValueError: the layout has other slopes or commands than the system.
    """
    layout = layout_of(system, layout)
    profile, velocity = Profile.of(system), winds(system)
    sensors = sightlines(system, layout, profile)
    fit = Fit(system, layout)
    views = list(fit.footprints(profile.heights))
    step = step or min(mirror.pitch for mirror in layout.mirrors)
    grids = _grids([*(s.nodes for s in sensors), *(points for _, points in views)], step)
    frame = 1 / system.loop.rate
    whole = math.floor(system.loop.delay)
    share = system.loop.delay - whole

    blind = blind_modes(system, layout)
    states = []
    residual = noise_covariance(system, layout, gain=1.0).toarray()
    to_slopes, to_wavefront = [], []
    for l, (x, y) in enumerate(grids):
        alone = Profile(profile.r0, profile.outer_scale, profile.heights[l : l + 1], profile.fractions[l : l + 1])
        nodes = Footprints(x[None], y[None])
        moved = [carried(nodes, velocity[l : l + 1], time) for time in (frame, share * frame)]
        seen = [Sightline(_layer(s.nodes, l), s.gradient) for s in sensors]
        views_here = [(view, _layer(points, l)) for view, points in views]
        turbulence = Turbulence.covering(alone, [nodes, *moved, *(s.nodes for s in seen), *(p for _, p in views_here)])
        variance = METRES_PER_RADIAN**2 * alone.fractions[0] * float(covariance(0.0, profile.r0, profile.outer_scale))
        prior = wavefront_covariance(turbulence, nodes, nodes) + variance
        factor = cho_factor(prior)
        # what is now at the nodes was a frame ago where the nodes have since come from
        steps = [cho_solve(factor, wavefront_covariance(turbulence, then, nodes) + variance).T for then in moved]
        cross = slope_wavefront_covariance(turbulence, seen, nodes)
        C = cho_solve(factor, cross.T).T
        residual += slope_covariance(turbulence, seen) - C @ cross.T
        right = sum(view.projection @ (wavefront_covariance(turbulence, p, nodes) + variance) for view, p in views_here)
        states.append((prior, *steps))
        to_slopes.append(C)
        to_wavefront.append(cho_solve(factor, np.asarray(right).T).T)
    prior, transition, part = (_block_diagonal([state[k] for state in states]) for k in range(3))
    excitation = prior - transition @ prior @ transition.T
    noise = project(project(residual, blind).T, blind)
    noise += noise.trace() / len(noise) * blind @ blind.T
    return LayeredModel(
        prior,
        transition,
        (excitation + excitation.T) / 2,
        project(np.hstack(to_slopes), blind),
        (noise + noise.T) / 2,
        part @ np.linalg.matrix_power(transition, whole),
        fit.solve(np.hstack(to_wavefront)),
    )


def _grids(points: list[Footprints], step: float) -> list[tuple[Array, Array]]:
    """On each layer the nodes of a square grid up to a step beyond the circle around all points."""
    grids = []
    for l in range(len(points[0].x)):
        x, y = (np.concatenate([getattr(p, axis)[l] for p in points]) for axis in "xy")
        centre = (x.max() + x.min()) / 2, (y.max() + y.min()) / 2
        radius = np.hypot(x - centre[0], y - centre[1]).max() + step
        line = step * np.arange(-math.ceil(radius / step), math.ceil(radius / step) + 1)
        grid_x, grid_y = np.meshgrid(line, line)
        inside = np.hypot(grid_x, grid_y) <= radius
        grids.append((grid_x[inside] + centre[0], grid_y[inside] + centre[1]))
    return grids


def _layer(points: Footprints, l: int) -> Footprints:
    return Footprints(points.x[l : l + 1], points.y[l : l + 1])


def _block_diagonal(blocks: list[Array]) -> Array:
    starts = np.cumsum([0] + [len(block) for block in blocks])
    out = np.zeros((starts[-1], starts[-1]))
    for start, block in zip(starts, blocks):
        out[start : start + len(block), start : start + len(block)] = block
    return out


def riccati(transition: Array, observation: Array, excitation: Array, noise: Array, tolerance: float = 1e-12) -> Array:
    """Covariance of the predicted state's error in the steady state: Sigma of eq. 8, by doubling.

    Each step covers twice as many frames as all before it.

    Args:
        transition, observation, excitation, noise: A, C, Sigma_nu and Sigma_eta, as in :class:`LayeredModel`.
        tolerance: of the last step, relative.

    Raises:
        RiccatiError: no convergence.
    """
    F = transition.T
    G = observation.T @ cho_solve(cho_factor(noise), observation)
    H = excitation.copy()
    identity = np.eye(len(F))
    for _ in range(60):
        both = np.linalg.solve(identity + G @ H, np.hstack([F, G]))
        WF, WG = both[:, : len(F)], both[:, len(F) :]
        change = F.T @ H @ WF
        G = G + F @ WG @ F.T
        F = F @ WF
        H = H + (change + change.T) / 2
        G = (G + G.T) / 2
        largest = np.abs(H).max()
        if not largest < _DIVERGED:
            break
        if np.abs(change).max() <= tolerance * largest:
            return H
    raise RiccatiError("riccati: no steady state found; is the noise positive and A stable?")


def kalman_gain(error: Array, observation: Array, noise: Array) -> Array:
    """H of eq. 7, (n, n_slopes), for a predicted state with ``error`` (n, n)."""
    PC = error @ observation.T
    return cho_solve(cho_factor(observation @ PC + noise), PC.T).T


class Lqg:
    """The controller: pseudo-open-loop slopes in, commands out, with a state in between.

    Attributes:
        model: of the turbulence.
        error: (n, n) steady covariance of the predicted state's error, m^2.
        gain: (n, n_slopes) H.
        commands_of: (n_commands, n) from the filtered state to what is to be on the mirror after the delay.
    """

    def __init__(self, system: System, layout: Layout | None = None, *, step: float | None = None) -> None:
        """Solve the Riccati equation. Arguments and errors as :func:`layered_model`."""
        layout = layout_of(system, layout)
        self.model = model = layered_model(system, layout, step=step)
        self.error = riccati(model.transition, model.observation, model.excitation, model.noise)
        self.gain = kalman_gain(self.error, model.observation, model.noise)
        self.commands_of = model.fit @ model.delay
        self._G = interaction_matrix(system, layout)
        self._predicted = np.zeros(len(model.prior))

    def filtered(self, slopes: Array) -> Array:
        """Take pseudo-open-loop slopes (n_slopes,) of the next frame; the state (n,) at its middle, knowing them."""
        state = self._predicted + self.gain @ (slopes - self.model.observation @ self._predicted)
        self._predicted = self.model.transition @ state
        return state

    def commands(self, slopes: Array, on_mirror: Array) -> Array:
        """Commands (n_commands,), m, from slopes y (n_slopes,) measured with ``on_mirror`` (n_commands,) in place."""
        return self.commands_of @ self.filtered(slopes + self._G @ on_mirror)
