"""A bank of reconstructors for changing seeing and flux: between a few of them, any other costs one pass over memory.

With the profile's shape fixed, a minimum-variance reconstructor depends on turbulence and noise through their ratio
alone: ``R(a Sigma, b Sigma_nn) = R(Sigma, b/a Sigma_nn)``. Each of its singular values is a smooth step of the ratio's
logarithm, so that polynomials through Chebyshev nodes, five a decade, follow all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System
from srtomo_srtc.memory import require
from srtomo_srtc.model import noise_covariance
from srtomo_srtc.reconstructors.implicit import implicit

NODES_PER_DECADE = 5

_COMMON = 0.05  # how far noise variances may scale by different factors, relative


@dataclass(frozen=True)
class Bank:
    """Reconstructors at Chebyshev nodes of ``x = log(r0^(-5/3) / noise)``, noise as a factor on the system's own.

    Attributes:
        system: what they were built for, but for r0.
        low, high: range of x.
        template: a Reconstructor whose R and Q are to be replaced.
        matrices: (n_nodes, n_commands (n_slopes + n_commands)) float32: R then Q of each node, flat.
    """

    system: System
    low: float
    high: float
    template: Reconstructor
    matrices: NDArray[np.float32]

    @classmethod
    def build(
        cls,
        system: System,
        r0: tuple[float, float],
        noise: tuple[float, float] = (1.0, 1.0),
        *,
        method: Callable[..., tuple[Reconstructor, Any]] = implicit,
        progress: Callable[[str, float], None] = lambda stage, done: None,
        **keywords: Any,
    ) -> Bank:
        """Build the reconstructors: :data:`NODES_PER_DECADE` and one more.

        Args:
            r0: least and greatest Fried parameter, zenith, m.
            noise: least and greatest factor on all noise variances.
            method: any of the reconstructors' that weighs turbulence against noise; ``keywords`` go to it.
            progress: called with the name of each stage and the share of the work done before it, 0 to 1.

        Raises:
            ValueError: an empty range.
            MemoryError: the bank does not fit.
        """
        if not (0 < r0[0] <= r0[1] and 0 < noise[0] <= noise[1]):
            raise ValueError(f"bank: expected ranges above 0 in rising order, got r0 {r0} and noise {noise}")
        low, high = _abscissa(r0[1], noise[1]), _abscissa(r0[0], noise[0])
        n = math.ceil(NODES_PER_DECADE * (high - low) / math.log(10)) + 1
        layout = Layout(system)
        size = layout.n_commands * (layout.n_slopes + layout.n_commands)
        require(4.0 * n * size, f"bank of {n} reconstructors")
        matrices = np.empty((n, size), np.float32)
        for k, node in enumerate(_nodes(n)):
            x = (low + high) / 2 + (high - low) / 2 * node
            built, _ = method(
                system.with_changes({"atmosphere.r0": math.exp(-0.6 * x)}),
                progress=lambda stage, done, k=k: progress(f"{k + 1} of {n}, {stage}", (k + done) / n),
                **keywords,
            )
            if built.n_epochs != 1:
                raise ValueError(f"bank: expected reconstructors of one exposure, got {built.n_epochs}")
            matrices[k] = np.concatenate([built.R.ravel(), built.Q.ravel()])
        return cls(system, low, high, built, matrices)

    def at(self, r0: float, noise: float = 1.0) -> Reconstructor:
        """The reconstructor for a Fried parameter (zenith, m) and a factor on all noise variances.

        Raises:
            ValueError: beyond the range that the bank was built for.
        """
        x = _abscissa(r0, noise)
        margin = 1e-9
        if not self.low - margin <= x <= self.high + margin:
            raise ValueError(
                f"bank: r0 {r0:g} m with {noise:g} times the noise is as r0 {math.exp(-0.6 * x):g} m, outside "
                f"{math.exp(-0.6 * self.high):g} to {math.exp(-0.6 * self.low):g} m"
            )
        span = self.high - self.low
        weights = _lagrange(len(self.matrices), (2 * x - self.low - self.high) / span if span else 0.0)
        R, Q = np.split(weights.astype(np.float32) @ self.matrices, [self.template.R.size])
        return replace(
            self.template,
            R=R.reshape(self.template.R.shape),
            Q=Q.reshape(self.template.Q.shape),
            provenance={**self.template.provenance, "bank": {"nodes": len(weights), "r0": r0, "noise": noise}},
        )

    def of(self, system: System) -> Reconstructor:
        """The reconstructor for a system with another r0, and with other photons.

        Raises:
            ValueError: the system differs in more, its noise does not scale by a common factor (read noise keeps it
                from doing so when faint), or it is beyond the bank's range.
        """
        own = self.system
        same_but = {f"sensors.{i}.photons": sensor.photons for i, sensor in enumerate(own.sensors)}
        same_but["atmosphere.r0"] = own.atmosphere.r0
        if len(system.sensors) != len(own.sensors) or system.with_changes(same_but) != own:
            raise ValueError("bank: expected the system that it was built for, but for r0 and photons")
        after, before = (noise_covariance(s, Layout(s), s.loop.gain) for s in (system, own))
        ratio = after.data / before.data
        factor = math.exp(float(np.mean(np.log(ratio))))
        if max(ratio.max() / factor, factor / ratio.min()) > 1 + _COMMON:
            raise ValueError(
                f"bank: the noise changes by factors from {ratio.min():.3g} to {ratio.max():.3g}, expected one for all"
            )
        return self.at(system.atmosphere.r0, factor)


def _abscissa(r0: float, noise: float) -> float:
    return -5 / 3 * math.log(r0) - math.log(noise)


def _nodes(n: int) -> NDArray[np.float64]:
    """Zeros of the Chebyshev polynomial T_n."""
    return np.cos((2 * np.arange(n) + 1) * np.pi / (2 * n))


def _lagrange(n: int, t: float) -> NDArray[np.float64]:
    """Weights of the values at the nodes in the polynomial through them, at t (barycentric formula)."""
    apart = t - _nodes(n)
    if (hit := np.abs(apart) < 1e-14).any():
        return hit.astype(np.float64)
    terms = (-1.0) ** np.arange(n) * np.sin((2 * np.arange(n) + 1) * np.pi / (2 * n)) / apart
    return terms / terms.sum()
