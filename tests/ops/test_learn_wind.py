"""The wind of each layer: from pairs of exposures drawn from covariances, and from the plant's moving screens."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_ops.simulate import program_of, run
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky, prepare
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_covariance
from srtomo_srtc.learn_wind import LayerWind, learn_winds, with_winds
from srtomo_srtc.mirrors import interaction_matrix as model_matrix
from srtomo_srtc.model import blind_modes, noise_covariance, sightlines
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.wind import sensors_carried, winds

LIMIT = 100


def _system(**changes: Any) -> System:
    layers = [
        {"altitude": 0.0, "fraction": 0.55, "wind_speed": 7.0, "wind_direction": 0.5},
        {"altitude": 9000.0, "fraction": 0.45, "wind_speed": 14.0, "wind_direction": -2.0},
    ]
    return load_system("mini", {"loop.rate": 500.0, "atmosphere.layers": layers, **changes})


def _still(system: System) -> System:
    """What the SRTC knows before: no wind."""
    return system.with_changes({"atmosphere.layers.*.wind_speed": 0.0})


def _statistics(rows: np.ndarray, pairs: dict[int, tuple[np.ndarray, np.ndarray]], interval: float) -> Any:
    """As telemetry has them."""
    return SimpleNamespace(
        lagged={lag: (now.T @ then / len(now)).astype(np.float32) for lag, (now, then) in pairs.items()},
        lagged_frames={lag: len(now) for lag, (now, _) in pairs.items()},
        interval=interval,
        covariance=(rows.T @ rows / len(rows)).astype(np.float32),
    )


def _drawn(system: System, lag: int, n: int, seed: int) -> Any:
    """Independent pairs of exposures ``lag`` apart, frozen flow between them."""
    layout, profile = Layout(system), Profile.of(system)
    now = sightlines(system, layout, profile, 4)
    then = sensors_carried(now, winds(system), lag / system.loop.rate)
    turbulence = Turbulence.covering(profile, [line.nodes for line in (*now, *then)])
    C = slope_covariance(turbulence, [*now, *then])
    noise = noise_covariance(system, layout, 1.0).toarray()
    C[: layout.n_slopes, : layout.n_slopes] += noise
    C[layout.n_slopes :, layout.n_slopes :] += noise
    C[np.diag_indices_from(C)] += 1e-9 * C.trace() / len(C)
    draws = np.random.default_rng(seed).standard_normal((n, len(C))) @ np.linalg.cholesky(C).T
    blind = blind_modes(system, layout)
    first, second = (part - (part @ blind) @ blind.T for part in np.split(draws, 2, axis=1))
    return _statistics(first, {lag: (first, second)}, interval=20.0)


def _pulls(system: System, found: tuple[LayerWind, ...]) -> np.ndarray:
    error = np.array([wind.velocity for wind in found]) - winds(system)
    return error / np.array([np.sqrt(np.diag(wind.covariance)) for wind in found])


def test_from_pairs_drawn_from_covariances() -> None:
    system = _system()
    found = learn_winds(_still(system), _drawn(system, 25, 3000, 1), limit=LIMIT)
    assert [wind.reason for wind in found] == ["", ""]
    assert np.abs(_pulls(system, found)).max() < 4, found
    assert max(wind.sigma for wind in found) < 1.0
    told = with_winds(_still(system), found)
    np.testing.assert_allclose(winds(told), winds(system), atol=4 * max(wind.sigma for wind in found))


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [1e-3, 1e-5])
def test_a_layer_that_is_hardly_there_says_so(fraction: float) -> None:
    layers = [
        {"altitude": 0.0, "fraction": 1 - fraction, "wind_speed": 7.0, "wind_direction": 0.5},
        {"altitude": 9000.0, "fraction": fraction, "wind_speed": 14.0, "wind_direction": -2.0},
    ]
    system = _system(**{"atmosphere.layers": layers})
    strong, weak = learn_winds(_still(system), _drawn(system, 25, 400, 2), limit=LIMIT)
    assert not strong.reason
    assert f"too little of it is seen: {100 * fraction:.1f} % of the turbulence" in weak.reason
    assert winds(with_winds(_still(system), (strong, weak)))[1] == pytest.approx([0, 0])


def test_lagged_moments_are_needed() -> None:
    with pytest.raises(ValueError, match="lagged moments"):
        learn_winds(_system(), SimpleNamespace(lagged={}))  # type: ignore[arg-type]


class _Telescope(Plant):
    """Keeps the pseudo-open-loop slopes as the model has them."""

    def __init__(self, system: System, sky: Sky) -> None:
        super().__init__(system, sky)
        self._G = model_matrix(system, sky.layout).astype(np.float32)
        self.rows: list[np.ndarray] = []

    def measure(self, frame: int) -> np.ndarray:
        slopes = super().measure(frame)
        self.rows.append(slopes + self._G @ self._line.shape(frame))
        return slopes


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_from_a_closed_loop() -> None:
    """12 s each, the plant's screens, noise and mirrors."""
    system = _system()
    layout, n = Layout(system), 6000
    blind = blind_modes(system, layout)
    pulls = []
    for seed in (3, 4, 5):
        plant = _Telescope(system, prepare(system, n, seed, science_every=n))
        run(plant, {0: program_of(layout, implicit(_still(system), fast=True)[0])})
        rows = np.array(plant.rows)
        rows -= (rows @ blind) @ blind.T
        pairs = {lag: (rows[lag:], rows[:-lag]) for lag in (10, 20)}
        found = learn_winds(_still(system), _statistics(rows, pairs, 1 / system.loop.rate), limit=LIMIT)
        error = np.array([wind.velocity for wind in found]) - winds(system)
        print(f"seed {seed}: errors {error.round(2).tolist()} m/s, sigma {[round(wind.sigma, 2) for wind in found]}")
        assert np.hypot(*error.T).max() < 1.0
        pulls.append(_pulls(system, found))
    print("rms of the errors, in sigmas:", np.sqrt(np.mean(np.square(pulls))).round(2))
    assert np.sqrt(np.mean(np.square(pulls))) < 2
