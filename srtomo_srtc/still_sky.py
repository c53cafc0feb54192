"""Wavefront error under a sky that stands still, in the time that one reconstructor takes.

What :class:`srtomo_srtc.predict.Prediction` gives without lag, but only its total, and without any covariance of the
pupil's points with each other or with slopes: with B the right-hand side of the fit, N^T N its normal matrix and
S = Sigma_ss + Sigma_nn, the residual is

    tr Sigma_phi - 2 tr(R B^T) + tr(N^T N R S R^T)

less the same of tip and tilt. How it divides into fitting and tomography is not asked.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from srtomo_core.layout import Layout
from srtomo_core.system import System
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_tiles, wavefront_covariance
from srtomo_srtc.crossterms import right_hand_side_and_tilts
from srtomo_srtc.estimator import divide
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.memory import require
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.predict import jitter
from srtomo_srtc.reconstructors.implicit import bytes_needed

Array = NDArray[np.float64]

_ROWS = 1024  # of the pupil's points that are correlated with all at a time


def best_wfe(system: System, *, threads: int = 1) -> float:
    """What the best reconstructor leaves: that of :func:`srtomo_srtc.reconstructors.implicit.implicit`.

    In float32, and with slopes' covariances interpolated where sensors are rotated: within 1e-3 of the prediction.

    Args:
        threads: to compute with, apart from those of the BLAS library.

    Returns:
        Rms over the science directions with their weights, piston and tip-tilt removed, m.

    Raises:
        MemoryError: one line, before any work, if there is not enough.
    """
    layout = Layout(system)
    sky = _Sky(system, layout, threads)
    n_commands = len(sky.fit.normal)
    X = sky.asked[:n_commands].copy()
    divide(X, sky.S, blind_modes(system, layout), threads)
    # R = (N^T N)^-1 X is never formed; X is what S was inverted for, so that X S X^T = X B^T. Nearly all of the sky's
    # variance is taken off by this product: float32 sums would cost 0.01 nm
    answers = sky.fit.solve(X.astype(np.float64) @ sky.asked.T)
    return sky.wfe(answers, sky.fit.solve(answers[:, :n_commands].T))


def wfe_of(R: Array, system: System, layout: Layout, mismatch: Array, *, threads: int = 1) -> float:
    """What a given reconstructor leaves with sensors and mirrors where ``layout`` has them; as :func:`best_wfe`
    counts it.

    Args:
        R: (n_commands, n_slopes) m/rad.
        mismatch: (n_commands, n_commands) ``Q - R G``, as :meth:`srtomo_srtc.predict.Prediction.budgets` takes it.
        threads: as for :func:`best_wfe`.

    Raises:
        MemoryError: as :func:`best_wfe`.
    """
    sky = _Sky(system, layout, threads)
    settled = lu_solve(lu_factor(np.eye(len(R)) - mismatch), R)
    return sky.wfe(settled @ sky.asked.T, settled @ sky.S.product(settled.T))


class _Sky:
    """Covariances of an instrument.

    Attributes:
        fit: of the mirrors.
        asked: (n_commands + 2 n_views + 2 n_stars, n_slopes) B; covariance of each direction's tip and tilt with the
            slopes; the slopes of the stars' jitter.
        S: of slopes with their noise.
    """

    def __init__(self, system: System, layout: Layout, threads: int) -> None:
        require(bytes_needed(layout, fast=True) + 4.0 * layout.n_commands * layout.n_slopes, f"design of {system.name}")
        profile = Profile.of(system)
        sensors = sightlines(system, layout, profile)
        self.fit = Fit(system, layout)
        turbulence = Turbulence.covering(
            profile, [*(s.nodes for s in sensors), *(points for _, points in self.fit.footprints(profile.heights))]
        )
        right, tilts = right_hand_side_and_tilts(
            self.fit, turbulence, sensors, profile.heights, fast=True, threads=threads
        )
        self.S = slope_tiles(turbulence, sensors, fast=True, threads=threads)
        self.S.add(noise_covariance(system, layout, system.loop.gain))
        self.asked = np.vstack([right, tilts.reshape(-1, layout.n_slopes), jitter(system, layout).T]).astype(
            right.dtype
        )
        self._tilt_weights = self.fit.grid.tilts
        self._power = _high_order_power(self.fit, turbulence)

    def wfe(self, answers: Array, made: Array) -> float:
        """Of a reconstructor, m rms; ``answers`` is R times ``asked`` transposed, ``made`` is R S R^T."""
        n_commands, n_views = len(self.fit.normal), len(self.fit.views)
        explained, tilts, shaken = np.split(answers, [n_commands, n_commands + 2 * n_views], axis=1)
        made = made + shaken @ shaken.T
        variance = self._power - 2 * float(explained.trace()) + self._in_pupil(made)
        for n, view in enumerate(self.fit.views):
            seen = self._tilt_weights.T @ view.modes
            own = 2 * float((seen @ tilts[:, 2 * n : 2 * n + 2]).trace()) - float(np.vdot(seen, seen @ made))
            variance += view.weight * own
        return math.sqrt(max(variance, 0.0))

    def _in_pupil(self, made: Array) -> float:
        """``tr(N^T N made)``, without the fit's regularisation."""
        return float(np.vdot(self.fit.normal, made)) - self.fit.ridge * float(made.trace())


def _high_order_power(fit: Fit, turbulence: Turbulence) -> float:
    """Variance of the wavefront without piston and tip-tilt, m^2: the same in all directions and from all layers."""
    x, y = fit.grid.x, fit.grid.y
    one_layer = Turbulence(np.array([turbulence.fractions.sum()]), turbulence.table)
    low = np.sqrt(fit.grid.weight)[:, None] * fit.grid.low_orders
    everything = Footprints(x[None], y[None])
    within = 0.0
    for rows in np.array_split(np.arange(len(x)), math.ceil(len(x) / _ROWS)):
        covariance = wavefront_covariance(one_layer, Footprints(x[None, rows], y[None, rows]), everything)
        within += float(np.vdot(low[rows], covariance @ low))
    # the covariance's own trace is 0, as it is less its value at no separation
    return -within
