"""How long a reconstructor takes to build, held against this machine's matrix product."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Sightline, Turbulence, slope_wavefront_covariance
from srtomo_srtc.crossterms import right_hand_side
from srtomo_srtc.fitting import Fit
from srtomo_srtc.geometry import Footprints
from srtomo_srtc.model import noise_covariance, sightlines
from srtomo_srtc.parallel import run
from srtomo_srtc.reconstructors import implicit

TOLERANCE = 0.05
"""Of the residual on random slopes. Float32 and tables leave up to 1e-2, which costs less than 0.01 nm of wavefront
error; a wrong entry leaves about 1."""

_GEMM = 2048
_PAIRS = 2  # of slopes of each sensor on which the result is checked


class Build(NamedTuple):
    """One reconstructor, built and checked.

    Attributes:
        seconds: from the instrument's description to R, Q and G.
        cpu_seconds: of all threads meanwhile; less than ``threads`` times ``seconds`` where cores were idle or others'.
        stages: seconds of each part.
        peak_bytes: of this process, everything included.
        solving_flops: of the Cholesky factorisation and the solution; they are the stage ``solution``, fit included.
        gemm_flops: a second, of the matrix product in the same precision and on as many threads.
        residual: of the normal equations on random slopes, relative.
    """

    commands: int
    slopes: int
    seconds: float
    cpu_seconds: float
    stages: dict[str, float]
    peak_bytes: float
    solving_flops: float
    gemm_flops: float
    residual: float

    @property
    def solving_rate(self) -> float:
        """Operations a second while solving."""
        return self.solving_flops / self.stages["solution"]


def measure(
    system: System, *, fast: bool = True, threads: int = 1, progress: Callable[[str, float], None] | None = None
) -> Build:
    """Build the implicit reconstructor of a system; compilation is not counted.

    Raises:
        ValueError: the result is wrong.
    """
    implicit(load_system("mini"), fast=fast, threads=threads)
    gemm = gemm_rate(np.float32 if fast else np.float64, threads)
    start, cpu_start = time.perf_counter(), time.process_time()
    reconstructor, _ = implicit(system, fast=fast, threads=threads, progress=progress)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0
    residual = residual_of(system, reconstructor)
    if not residual < TOLERANCE:
        raise ValueError(f"the reconstructor is wrong: residual {residual:.1e}, expected below {TOLERANCE:g}")
    n, m = reconstructor.n_slopes, reconstructor.n_commands
    stages: dict[str, float] = reconstructor.provenance["seconds"]
    return Build(
        m,
        n,
        seconds,
        cpu_seconds,
        {**stages, "Q = R G, and the rest": seconds - sum(stages.values())},
        peak,
        n**3 / 3 + 2 * n**2 * m + 2 * m**2 * n,
        gemm,
        residual,
    )


def gemm_rate(dtype: DTypeLike, threads: int) -> float:
    """Operations a second of as many matrix products at a time as there are threads; the best of three."""
    a = np.ones((_GEMM, _GEMM), dtype)
    out = [np.empty_like(a) for _ in range(threads)]
    tasks = [partial(np.matmul, a, a, out=c) for c in out]
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        run(tasks, threads)
        best = min(best, time.perf_counter() - start)
    return float(2 * _GEMM**3 * threads / best)


def residual_of(system: System, reconstructor: Reconstructor, seed: int = 0) -> float:
    """``|R (Sigma_ss + Sigma_nn) v - F Sigma_phi_s v|``, relative, for differences v of two slopes of a sensor.

    Such a v has no part in what blind stars are blind to (tip-tilt), so that it goes through the projector unchanged.
    Covariances go layer by layer and in float64, whatever way the reconstructor was made.
    """
    layout, profile = Layout(system), Profile.of(system)
    sensors, fit = sightlines(system, layout, profile), Fit(system, layout)
    rng = np.random.default_rng(seed)
    samples, chosen = [], []
    for w, sensor in enumerate(sensors):
        n_valid = layout.sensors[w].n_valid
        if n_valid > 1:
            pairs = np.concatenate([rng.choice(n_valid, 2, replace=False) + n_valid * (i % 2) for i in range(_PAIRS)])
            samples.append(_some_slopes(sensor, pairs))
            chosen.append(layout.slope_start[w] + pairs)
    columns = np.concatenate(chosen)
    turbulence = Turbulence.covering(
        profile, [*(s.nodes for s in sensors), *(points for _, points in fit.footprints(profile.heights))]
    )
    covariance = np.hstack([slope_wavefront_covariance(turbulence, sensors, s.nodes) @ s.gradient.T for s in samples])
    covariance += noise_covariance(system, layout, system.loop.gain)[:, columns].toarray()
    # float32 suffices, and R is large
    found = reconstructor.R[0] @ covariance.astype(np.float32)
    wanted = fit.solve(right_hand_side(fit, turbulence, samples, profile.heights))
    error, scale = (matrix[:, ::2] - matrix[:, 1::2] for matrix in (found - wanted, wanted))
    return float(np.linalg.norm(error) / np.linalg.norm(scale))


def _some_slopes(sensor: Sightline, slopes: np.ndarray) -> Sightline:
    gradient = sensor.gradient[slopes]
    used = np.unique(gradient.indices)
    return Sightline(Footprints(sensor.nodes.x[:, used], sensor.nodes.y[:, used]), gradient[:, used])
