"""The sky learned from covariances: of exact ones, of frames drawn from a known sky, and of what is no sky at all."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import null_space

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.atmosphere import Profile
from srtomo_srtc.covariance import Turbulence, slope_tiles, wavefront_covariance
from srtomo_srtc.frozen_flow import independent_frames
from srtomo_srtc.learn import LearnError, default_altitudes, fit, learn, photons_for, strengths_at
from srtomo_srtc.likelihood import information, inverse_of, non_negative_step, score
from srtomo_srtc.model import blind_modes, noise_covariance, project, sightlines
from srtomo_srtc.sampling import Sampling
from srtomo_srtc.sky_model import SkyModel
from srtomo_srtc.telemetry import HeldOut, Statistics
from srtomo_srtc.wind import sensors_carried, winds

ALTITUDES = np.array([0.0, 3000.0, 10000.0])  # of mini


@pytest.fixture(scope="module")
def system() -> System:
    """Mini's stars on 6 x 6 sensors with noise that matters."""
    mini = load_system("mini")
    sensors = [sensor.model_dump() | {"subapertures": 6, "photons": 2e5} for sensor in mini.sensors[:3]]
    return mini.with_changes({"sensors": sensors})


def covariance(
    system: System, r0: float, outer_scale: float, fractions, levels, altitudes=ALTITUDES, oversampling: int = 4
) -> np.ndarray:
    """(n_slopes, n_slopes) of slopes and noise without blind modes, straight from the covariances of wavefronts."""
    layout = Layout(system)
    los = r0 * math.cos(system.zenith_angle) ** 0.6
    profile = Profile(los, outer_scale, np.asarray(altitudes) * system.airmass, np.asarray(fractions))
    sensors = sightlines(system, layout, profile, oversampling)
    S = slope_tiles(Turbulence.covering(profile, [s.nodes for s in sensors]), sensors, fast=True).dense().astype(float)
    N = noise_covariance(system, layout, 1.0).toarray()
    for w, level in enumerate(levels):
        N[layout.slopes_of(w)] *= level
    blind = blind_modes(system, layout)
    return project(project(S + N, blind).T, blind)


def statistics(moment: np.ndarray, n_frames: int, interval: float = math.inf) -> Statistics:
    """Of frames that are ``interval`` (s) apart."""
    n = len(moment)
    nothing = HeldOut(*(np.empty((0, n), np.float32),) * 2, *(np.empty(0, int),) * 3)
    return Statistics(
        moment.astype(np.float32),
        np.zeros(n),
        n_frames,
        interval,
        interval * (n_frames - 1),
        {},
        {},
        nothing,
        1,
        0,
        1,
    )


def drawn(C: np.ndarray, n_frames: int, seed) -> np.ndarray:
    """Second moment of independent frames."""
    values, vectors = np.linalg.eigh(C)
    draw = np.random.default_rng(seed).standard_normal((len(C), n_frames))
    frames = (vectors * np.sqrt(np.maximum(values, 0))) @ draw
    return frames @ frames.T / n_frames


@dataclass(frozen=True, eq=False)
class Night:
    """A sky drawn far from the file's; its covariance is the model's own, so that chance alone is left."""

    r0: float
    outer_scale: float
    strengths: np.ndarray
    levels: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, system: System, model: SkyModel, number: int) -> Night:
        draw = np.random.default_rng([7, number])
        r0, fractions, levels = draw.uniform(0.08, 0.25), draw.dirichlet([2, 2, 2]), draw.uniform(0.5, 3, 3)
        outer_scale = math.exp(draw.uniform(math.log(10), math.log(60)))
        strengths = (r0 * math.cos(system.zenith_angle) ** 0.6) ** (-5 / 3) * fractions
        C = model.turbulence(strengths, outer_scale).astype(float)
        C += sum(level * noise for level, noise in zip(levels, model.noise))
        return cls(r0, outer_scale, strengths, levels, C)

    @property
    def fractions(self) -> np.ndarray:
        return self.strengths / self.strengths.sum()

    def drawn(self, number: int, n_frames: int) -> np.ndarray:
        return drawn(self.covariance, n_frames, [8, number])

    def best_possible(self, model: SkyModel, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What no estimator is better than to first order: one step of scoring from the truth itself.

        Its errors ``J F^-1 g`` have the covariance ``J F^-1 J^T / n_frames`` exactly (the Cramer-Rao bound).

        Returns:
            (8,) errors of log r0, the fractions, L0^-1.5 and the noise levels under the second moment ``S``; (8, 8)
            their covariance from one frame.
        """
        seen = null_space(model.sampling.blind.T)
        near, far = self.outer_scale / 1.01, self.outer_scale * 1.01
        slope = model.turbulence(self.strengths, near).astype(float) - model.turbulence(self.strengths, far)
        slope /= near**-1.5 - far**-1.5
        bases = [*(model.layer(l, self.outer_scale) for l in range(3)), slope, *model.noise]
        C = seen.T @ self.covariance @ seen
        whitened = [np.linalg.solve(C, seen.T @ basis @ seen) for basis in bases]
        F = 0.5 * np.array([[np.sum(a * b.T) for a in whitened] for b in whitened])
        excess = np.linalg.solve(C, seen.T @ S @ seen) - np.eye(len(C))
        g = 0.5 * np.array([np.sum(basis * excess.T) for basis in whitened])
        total = self.strengths.sum()
        J = np.zeros((8, 7))
        J[0, :3] = -0.6 / total
        J[1:4, :3] = (np.eye(3) - self.fractions[:, None]) / total
        J[4:, 3:] = np.eye(4)
        inverse = np.linalg.inv(F)
        return J @ inverse @ g, J @ inverse @ J.T


# --- likelihood -----------------------------------------------------------------------------------------------------


def test_score_and_information_are_the_likelihood_s_derivatives() -> None:
    draw = np.random.default_rng(3)
    n, theta = 12, np.array([1.0, 0.5, 2.0])
    roots = draw.standard_normal((3, n, n))
    bases = [root @ root.T for root in roots]
    S = 1.7 * bases[0] + 0.2 * bases[1] + bases[2]

    def likelihood(theta: np.ndarray) -> float:
        C = sum(t * B for t, B in zip(theta, bases))
        return -0.5 * (np.linalg.slogdet(C)[1] + np.trace(np.linalg.solve(C, S)))

    C = sum(t * B for t, B in zip(theta, bases))
    step = 1e-4 * np.eye(3)
    numeric = [(likelihood(theta + e) - likelihood(theta - e)) / 2e-4 for e in step]
    single = [B.astype(np.float32) for B in bases]
    inverse = inverse_of(C)
    assert inverse == pytest.approx(np.linalg.inv(C), rel=1e-9, abs=1e-12)
    g = score(inverse.astype(np.float32), (S - C).astype(np.float32), single)
    assert g == pytest.approx(numeric, rel=1e-3)
    # the information is minus the mean curvature: that at S = C
    S = C
    curvature = [
        [
            (
                likelihood(theta + a + b)
                - likelihood(theta + a - b)
                - likelihood(theta - a + b)
                + likelihood(theta - a - b)
            )
            / 4e-6
            for a in 10 * step
        ]
        for b in 10 * step
    ]
    assert information(inverse.astype(np.float32), single) == pytest.approx(-np.array(curvature), rel=1e-2)


def test_a_step_is_newton_s_unless_something_would_turn_negative() -> None:
    F = np.array([[2.0, 0.9], [0.9, 1.0]])
    theta = np.array([1.0, 1.0])
    assert non_negative_step(theta, np.array([0.1, 0.2]), F) == pytest.approx(theta + np.linalg.solve(F, [0.1, 0.2]))
    g = np.array([0.0, -5.0])
    best = non_negative_step(theta, g, F)
    assert best[1] == 0
    # along the first alone: its own gradient vanishes there
    assert (g - F @ (best - theta))[0] == pytest.approx(0, abs=1e-9)


# --- exact covariances ----------------------------------------------------------------------------------------------


def test_a_sky_far_from_the_instrument_file_s_is_found(system: System) -> None:
    # made with twice as many nodes as the fit has
    fractions, levels = [0.2, 0.45, 0.35], [2.0, 0.7, 1.3]
    told = learn(
        system,
        statistics(covariance(system, 0.11, 14.0, fractions, levels, oversampling=8), 1000),
        altitudes=ALTITUDES,
    )
    assert told.r0 == pytest.approx(0.11, rel=0.003)
    assert told.outer_scale == pytest.approx(14, rel=0.02)
    assert told.fractions == pytest.approx(fractions, abs=0.002)
    assert [level.factor for level in told.noise] == pytest.approx(levels, rel=0.005)
    assert [group.layers for group in told.groups] == [(0,), (1,), (2,)]
    low, high = told.outer_scale_range
    assert low < told.outer_scale < high < math.inf


def test_the_paper_s_stencil_would_not_do(system: System) -> None:
    # with two node cells across a sub-aperture, part of the slopes' variance is missing
    fractions = [0.2, 0.45, 0.35]
    coarse = covariance(system, 0.11, 14.0, fractions, [1, 1, 1], oversampling=2)
    told = learn(system, statistics(coarse, 1000), altitudes=ALTITUDES)
    assert 0.01 < told.r0 / 0.11 - 1 < 0.025
    # it goes with the square of the nodes' distance
    finer = covariance(system, 0.11, 14.0, fractions, [1, 1, 1], oversampling=4)
    ratio = (learn(system, statistics(finer, 1000), altitudes=ALTITUDES).r0 / 0.11 - 1) / (told.r0 / 0.11 - 1)
    assert ratio == pytest.approx(1 / 4, abs=0.06)


def test_the_learned_system_has_what_was_learned(system: System) -> None:
    levels = [2.0, 0.5, 1.0]
    truth = covariance(system, 0.2, 40.0, [0.5, 0.0, 0.5], levels)
    learned = learn(system, statistics(truth, 1000), altitudes=ALTITUDES).system(system)
    assert learned.atmosphere.r0 == pytest.approx(0.2, rel=0.005)
    layout = Layout(system)
    before, after = (noise_covariance(s, layout, 1.0).diagonal() for s in (system, learned))
    for w, level in enumerate(levels):
        own = layout.slopes_of(w)
        assert after[own].sum() / before[own].sum() == pytest.approx(level, rel=0.02)
    strengths = {layer.altitude: layer.fraction for layer in learned.atmosphere.layers}
    assert strengths[0] == pytest.approx(0.5, abs=0.01)
    assert strengths.get(3000.0, 0.0) < 0.01
    assert winds(learned)[0] == pytest.approx(winds(system)[0])  # the wind of the file, altitude by altitude
    assert Layout(learned).fingerprint == layout.fingerprint


def test_photons_for_a_noise_level(system: System) -> None:
    place = Layout(system).sensors[0]
    sensor = system.sensors[0].model_copy(update={"read_noise": 0.0})
    assert photons_for(system, sensor, place, 4.0) == pytest.approx(sensor.photons / 4)  # photon noise: 1 / N
    dark = sensor.model_copy(update={"read_noise": 1e4})
    assert photons_for(system, dark, place, 4.0) == pytest.approx(sensor.photons / 2, rel=1e-3)  # read-out: 1 / N^2


def test_layers_that_the_stars_cannot_tell_apart_are_one(system: System) -> None:
    altitudes = [0.0, 300.0, 10000.0]
    truth = covariance(system, 0.15, 20.0, [0.5, 0.2, 0.3], [1, 1, 1], altitudes)
    told = learn(system, statistics(truth, 1000), altitudes=altitudes)
    low, high = told.groups
    assert (low.layers, high.layers) == ((0, 1), (2,))
    assert low.fraction == pytest.approx(0.7, abs=0.003)
    assert "correlate by -0.9" in low.reason or "correlate by -1.0" in low.reason
    assert high.reason == ""
    # the sum is known better than either
    assert low.sigma < 0.01


def test_the_default_altitudes_are_what_the_stars_resolve() -> None:
    gnao = load_system("gnao_ltao_sr")
    grid = default_altitudes(gnao, Layout(gnao))
    # 0.4 m sub-apertures, stars 15 arcsec apart: 5.5 km along the line of sight shift by one
    assert np.diff(grid) * gnao.airmass == pytest.approx(0.5 * 0.4 / (15 / 206265), rel=1e-3)
    assert grid[0] == 0 and 14e3 < grid[-1] <= 18e3
    assert strengths_at(gnao, grid).sum() == pytest.approx(1)
    assert len(default_altitudes(load_system("mavis"), Layout(load_system("mavis")))) == 10


def test_errors_on_the_default_grid_allow_for_turbulence_in_between(system: System) -> None:
    # layers at altitudes drawn without regard to the grid; no chance but that
    layout = Layout(system)
    grid, sampling = default_altitudes(system, layout), Sampling.of(system, layout, 2000)
    pulls = []
    for number in range(3):
        draw = np.random.default_rng([13, number])
        n = int(draw.integers(3, 7))
        at, fractions, levels = np.sort(draw.uniform(0, 16e3, n)), draw.dirichlet(np.full(n, 2.0)), [2.0, 0.7, 1.3]
        model = SkyModel(system, layout, sampling, at * system.airmass)
        strengths = (0.15 * math.cos(system.zenith_angle) ** 0.6) ** (-5 / 3) * fractions
        C = model.turbulence(strengths, 25.0) + sum(level * noise for level, noise in zip(levels, model.noise))
        told = learn(system, statistics(C, 10**6))
        shares = fractions @ np.array([np.interp(at, grid, unit) for unit in np.eye(len(grid))]).T
        pulls += [(group.fraction - shares[list(group.layers)].sum()) / group.sigma for group in told.groups]
        pulls.append((told.r0 - 0.15) / told.r0_sigma)
        pulls += [(level.factor - levels[level.sensor]) / level.sigma for level in told.noise]
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.3
    assert np.abs(pulls).max() < 3


# --- frames ---------------------------------------------------------------------------------------------------------


def test_plain_least_squares_would_not_do(system: System) -> None:
    # a window that is worth 25 independent frames: the same frames, the same bases, whitened or not
    layout = Layout(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, 2000), ALTITUDES * system.airmass)
    C = covariance(system, 0.12, 25.0, [0.5, 0.3, 0.2], [1.5, 1.5, 1.5])
    los = 0.12 * math.cos(system.zenith_angle) ** 0.6
    bases = [*(model.layer(l, 25.0) for l in range(3)), *model.noise]
    flat = np.stack([basis.ravel() for basis in bases], axis=1).astype(float)
    plain, whitened = [], []
    for seed in range(8):
        S = model.measured(drawn(C, 25, seed))
        plain.append(max(np.linalg.lstsq(flat, S.ravel(), rcond=None)[0][:3].sum(), 1e-9) ** -0.6 / los - 1)
        whitened.append(fit(model, S, np.ones(3), 25.0).strengths.sum() ** -0.6 / los - 1)
    assert np.sqrt(np.mean(np.square(plain))) > 0.05
    assert np.sqrt(np.mean(np.square(whitened))) < 0.02


def test_noise_that_is_taken_for_granted_spoils_r0(system: System) -> None:
    # three times the noise of the file, not fitted: the turbulence has to make up for it
    layout = Layout(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, 2000), ALTITUDES * system.airmass)
    S = model.measured(covariance(system, 0.2, 25.0, [0.5, 0.3, 0.2], [3, 3, 3]))
    layers = [model.layer(l, 25.0) for l in range(3)]
    c = np.full(3, 5.0)
    for _ in range(15):
        C = model.unseen(float(S.trace()) / len(S)) + sum(model.noise) + sum(a * B for a, B in zip(c, layers))
        A = inverse_of(C.astype(float)).astype(np.float32)
        c = np.maximum(
            non_negative_step(c, score(A, S + model.unseen(S.trace() / len(S)) - C, layers), information(A, layers)),
            1e-6,
        )
    assert c.sum() ** -0.6 < 0.85 * 0.2 * math.cos(system.zenith_angle) ** 0.6
    assert learn(system, statistics(covariance(system, 0.2, 25.0, [0.5, 0.3, 0.2], [3, 3, 3]), 99)).r0 == pytest.approx(
        0.2, rel=0.01
    )


def test_bright_stars_do_not_hinder_the_errors() -> None:
    # 30 times the light: no noise covers what a coarse stencil takes from the smallest variances
    file = load_system("gnao_ltao_sr")
    bright = file.with_changes({f"sensors.{w}.photons": 30 * sensor.photons for w, sensor in enumerate(file.sensors)})
    altitudes = [layer.altitude for layer in bright.atmosphere.layers]
    S = covariance(bright, 0.15, 25.0, bright.atmosphere.fractions, [1] * len(bright.sensors), altitudes=altitudes)
    told = learn(bright, statistics(S, 1000), limit=800)
    assert told.r0 == pytest.approx(0.15, rel=0.05)
    assert all(0 < group.sigma < 0.3 for group in told.groups)


def test_an_outer_scale_that_is_not_seen_has_no_upper_end(system: System) -> None:
    told = learn(
        system,
        statistics(drawn(covariance(system, 0.12, 80.0, [0.5, 0.3, 0.2], [1, 1, 1]), 60, 5), 60),
        altitudes=ALTITUDES,
    )
    low, high = told.outer_scale_range
    assert 10 < low < 80
    assert math.isinf(high)


def test_stated_errors_are_the_cramer_rao_bound(system: System) -> None:
    # no chance: the second moment is the covariance itself
    layout = Layout(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, 2000), ALTITUDES * system.airmass)
    for number in range(4):
        night = Night.of(system, model, number)
        told = learn(system, statistics(night.covariance, 300), altitudes=ALTITUDES)
        low, high = (scale**-1.5 for scale in told.outer_scale_range)
        stated = [told.r0_sigma / told.r0, *(group.sigma for group in told.groups), (low - high) / 2]
        stated += [level.sigma for level in told.noise]
        _, covariance = night.best_possible(model, night.covariance)
        ratio = stated / np.sqrt(np.diag(covariance) / 300)
        # the outer scale's derivative is a difference to one side, taken before the last step
        assert ratio[:4] == pytest.approx(np.ones(4), abs=0.02)
        assert ratio[4] == pytest.approx(1, abs=0.05)
        assert ratio[5:] == pytest.approx(np.ones(3), abs=0.002)


def test_what_is_told_is_the_best_that_these_frames_allow(system: System) -> None:
    # the best possible estimate has luck of its own: apart from it by little of its error, whatever that luck
    layout = Layout(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, 2000), ALTITUDES * system.airmass)
    for number in range(6):
        night = Night.of(system, model, number)
        S = night.drawn(number, 300)
        told = learn(system, statistics(S, 300), altitudes=ALTITUDES)
        wrong, covariance = night.best_possible(model, S)
        sigma = np.sqrt(np.diag(covariance) / 300)[:4]
        apart = np.array([math.log(told.r0 / night.r0), *(told.fractions - night.fractions)]) - wrong[:4]
        assert np.abs(apart / sigma).max() < 0.2
        stated = [told.r0_sigma / told.r0, *(group.sigma for group in told.groups)]
        # they are those of the sky as it is told, so that they have a little luck too
        assert stated == pytest.approx(sigma, rel=0.08)


def test_a_fit_ends_whose_outer_scale_comes_and_goes(system: System) -> None:
    # the layers are built anew on the way, and what they lack of their sum has to be theirs
    layout = Layout(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, 2000), ALTITUDES * system.airmass)
    told = learn(system, statistics(Night.of(system, model, 239).drawn(239, 300), 300), altitudes=ALTITUDES)
    assert told.iterations < 10


@pytest.mark.slow
def test_1200_nights_are_calibrated(system: System) -> None:
    # of truths drawn far from the file's, how many lie within the stated 1-sigma interval; of 400 nights chance
    # alone would put one share in twenty outside of what is wanted
    layout = Layout(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, 2000), ALTITUDES * system.airmass)
    names = [f"{altitude:g} m" for altitude in ALTITUDES]
    within: dict[str, list[bool]] = {name: [] for name in ("r0", *names, "told as one", "noise", "outer scale")}
    for number in range(1200):
        night = Night.of(system, model, number)
        told = learn(system, statistics(night.drawn(number, 300), 300), altitudes=ALTITUDES)
        within["r0"].append(abs(told.r0 - night.r0) < told.r0_sigma)
        for group in told.groups:
            name = names[group.layers[0]] if len(group.layers) == 1 else "told as one"
            within[name].append(abs(group.fraction - night.fractions[list(group.layers)].sum()) < group.sigma)
        within["noise"] += [abs(n.factor - night.levels[n.sensor]) < n.sigma for n in told.noise]
        within["outer scale"].append(told.outer_scale_range[0] < night.outer_scale < told.outer_scale_range[1])
    share = {name: float(np.mean(hits)) for name, hits in within.items()}
    print("\n" + "\n".join(f"{name:<12} {100 * value:5.1f} % of {len(within[name])}" for name, value in share.items()))
    assert len(within["told as one"]) < 0.01 * 1200
    for name in ("r0", *names, "outer scale"):
        assert 0.64 <= share[name] <= 0.73, (name, share)


# --- frames that resemble each other --------------------------------------------------------------------------------


def test_lagged_covariances_are_those_of_layers_carried_by_the_wind(system: System) -> None:
    layout = Layout(system)
    sampling = Sampling.of(system, layout, 2000, 2)
    profile = Profile(1.0, 25.0, ALTITUDES * system.airmass, np.array([0.5, 0.3, 0.2]))
    model = SkyModel(system, layout, sampling, profile.heights)
    lines = sightlines(system, layout, profile, 1)
    now = Turbulence.covering(profile, [s.nodes for s in [*lines, *sensors_carried(lines, winds(system), 0.1)]])
    then = sensors_carried(lines, winds(system), 0.1)
    blocks = [
        [(b.gradient @ (a.gradient @ wavefront_covariance(now, a.nodes, b.nodes)).T).T for b in then] for a in lines
    ]
    expected = model.measured(np.block(blocks))
    found = model.lagged(profile.fractions, 25.0, winds(system), 0.1)
    # rotated sensors' tables interpolate
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()
    assert np.abs(found - found.T).max() > 0.01 * np.abs(found).max()  # time has a direction


def test_how_many_independent_frames_there_are(system: System) -> None:
    layout = Layout(system)
    model = SkyModel(system, layout, Sampling.of(system, layout, 2000, 8), ALTITUDES * system.airmass)
    strengths = np.array([10.0, 5.0, 5.0])
    turbulence = model.turbulence(strengths, 25.0)
    C = turbulence + sum(model.noise) + model.unseen(1e-12)
    bases, influences = [turbulence, model.noise[0]], np.eye(2)

    def frames(wind: float, interval: float) -> np.ndarray:
        flow, covariance = wind * winds(system), C.astype(float)
        return independent_frames(model, strengths, 25.0, covariance, bases, influences, flow, 0.67, interval, 400)

    assert frames(1, math.inf) == pytest.approx([400, 400])
    assert frames(1, 100.0) == pytest.approx([400, 400], rel=0.01)
    still, slow, fast = frames(0, 0.01)[0], frames(0.3, 0.01)[0], frames(1, 0.01)[0]
    assert 1 <= still < 1.5
    assert 1 < slow < 0.6 * fast < 200
    assert frames(1, 0.01)[1] > 3 * fast  # noise is new in every frame, and tells of itself
    # what no frame tells of, such as the share of a group that has it all, leaves the others' alone
    expected = frames(1, 0.01)
    influences = np.vstack([[0, 0], influences])
    assert frames(1, 0.01) == pytest.approx([400, *expected])


# --- fewer slopes ---------------------------------------------------------------------------------------------------


def test_blocks_of_sub_apertures_are_modelled_as_large_ones() -> None:
    gnao = load_system("gnao_ltao_sr")
    layout = Layout(gnao)
    sampling = Sampling.of(gnao, layout, 700)
    assert 500 < len(sampling) <= 700
    assert {part.sensor for part in sampling.parts} == {0, 1, 2, 3}  # the one-lens sensor is left out
    assert len({part.place.size for part in sampling.parts}) == 2
    profile = Profile(0.2, 30.0, np.array([0.0, 9000.0]), np.array([0.6, 0.4]))
    both = []
    for lines in (sampling.sightlines(gnao, profile), sightlines(gnao, layout, profile, 8)):
        both.append(slope_tiles(Turbulence.covering(profile, [s.nodes for s in lines]), lines, fast=True).dense())
    mean = sampling.reduced(both[1])
    assert np.abs(both[0] - mean).max() < 0.01 * np.abs(mean).max()
    # what sees nothing blind sees nothing blind in fewer slopes
    blind = sampling.reduction @ blind_modes(gnao, layout)
    assert np.abs(blind - sampling.blind @ (sampling.blind.T @ blind)).max() < 1e-12


def test_all_slopes_where_they_are_few(system: System) -> None:
    sampling = Sampling.of(system, Layout(system), 2000)
    assert (sampling.reduction.toarray() == np.eye(Layout(system).n_slopes)).all()


# --- no sky ---------------------------------------------------------------------------------------------------------


def test_what_is_no_sky_is_refused(system: System) -> None:
    good = covariance(system, 0.15, 25.0, [0.5, 0.3, 0.2], [1, 1, 1])
    n = len(good)

    def told(moment: np.ndarray, frames: int = 500, **more):
        return learn(system, statistics(moment, frames), altitudes=ALTITUDES, **more)

    broken = good.copy()
    broken[3, 4] = np.nan
    with pytest.raises(LearnError, match="not finite"):
        told(broken)
    with pytest.raises(LearnError, match="too few"):
        told(good, 10)
    with pytest.raises(LearnError, match="do not move"):
        told(np.zeros((n, n)))
    for noise in (1e-14, 1e-13, 1e-12):
        with pytest.raises(LearnError, match="no sky fits"):
            told(noise * np.eye(n))  # and nothing else
    with pytest.raises(LearnError):
        told(-good)
    with pytest.raises(ValueError, match="shape"):
        told(good[1:, 1:])
    with pytest.raises(ValueError, match="ascending"):
        learn(system, statistics(good, 500), altitudes=[0.0, 5000.0, 3000.0])
    with pytest.raises(ValueError, match="velocity"):
        told(good, velocity=np.zeros((2, 2)))
