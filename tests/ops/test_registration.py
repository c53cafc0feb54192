"""Where sensors sit, found again on the plant: from its interaction matrix, from commands and slopes, from a loop."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, load_interaction_matrix, save_interaction_matrix
from srtomo_core.system import System, load_system
from srtomo_ops.cli import main
from srtomo_ops.simulate import Run, program_of, run
from srtomo_rtc.loop import Program, Settings, Slot
from srtomo_sim.mirror import interaction_matrix, mirror_phase
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare, pupil_points
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.register import (
    RegisterError,
    Registration,
    Stretches,
    dither_pattern,
    from_interaction_matrix,
    from_telemetry,
    moved_sensors,
)

DEGREE = math.radians(1)
MOVES = {0: (0.1, 0, 0, 0), 1: (0, 0, DEGREE, 0), 2: (0.05, -0.08, -0.4 * DEGREE, 0.004)}
"""Of some sensors: shift in sub-apertures, rotation in rad, magnification less 1."""


def _moved(system: System, layout: Layout, moves: dict[int, tuple[float, float, float, float]]) -> Layout:
    table = np.zeros((len(layout.sensors), 4))
    for w, move in moves.items():
        size = layout.sensors[w].size
        table[w] = np.array(move) * [size, size, 1, 1]
    return moved_sensors(system, layout, table)


def _errors(layout: Layout, found: Registration, moves: dict[int, tuple[float, float, float, float]]) -> np.ndarray:
    """(n, 4) found less true: shift in sub-apertures, rotation in degrees, magnification."""
    rows = []
    for place in found.places:
        size = layout.sensors[place.sensor].size
        truth = np.array(moves.get(place.sensor, (0, 0, 0, 0)))
        rows.append(np.array([*place.shift, place.rotation, place.magnification]) / [size, size, 1, 1] - truth)
    return np.array(rows) / [1, 1, DEGREE, 1]


def _sigmas(layout: Layout, found: Registration) -> np.ndarray:
    """(n, 4) as stated, in the same units."""
    sizes = [layout.sensors[place.sensor].size for place in found.places]
    return np.array(
        [place.sigma[:4] / [size, size, DEGREE, 1] for place, size in zip(found.places, sizes, strict=True)]
    )


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def true_response(mini: System) -> np.ndarray:
    return interaction_matrix(mini, _moved(mini, Layout(mini), MOVES))


def test_from_a_measured_interaction_matrix(mini: System, true_response: np.ndarray) -> None:
    layout = Layout(mini)
    rng = np.random.default_rng(1)
    sigma = 0.01 * np.abs(true_response).max()
    found = from_interaction_matrix(mini, 0.9 * true_response + sigma * rng.standard_normal(true_response.shape))
    errors = _errors(layout, found, MOVES)
    assert [place.name for place in found.places] == ["lgs1", "lgs2", "lgs3"]
    assert np.abs(errors[:, :2]).max() < 0.003
    assert np.abs(errors[:, 2]).max() < 0.03
    assert np.abs(errors[:, 3]).max() < 0.001
    assert np.abs(errors / _sigmas(layout, found)).max() < 4.5
    for place in found.places:
        # the plant's slopes answer its mirrors with 0.4 % less than the model's
        assert place.gain == pytest.approx(0.9, rel=0.006)
    assert [note.split()[1] for note in found.notes(0.08)] == ["lgs1", "lgs3"]


def test_the_layout_that_was_found_responds_as_the_plant_does(mini: System, true_response: np.ndarray) -> None:
    layout = Layout(mini)
    again = interaction_matrix(mini, from_interaction_matrix(mini, true_response).layout(mini, layout))
    left, before = (
        np.linalg.norm(again - true_response),
        np.linalg.norm(interaction_matrix(mini, layout) - true_response),
    )
    assert left < 0.02 * before


@pytest.mark.parametrize("dithered", [True, False])
def test_from_slopes_and_commands(mini: System, true_response: np.ndarray, dithered: bool) -> None:
    # a late mirror: what is on it is where the turbulence was, and goes with where it is
    layout, rng = Layout(mini), np.random.default_rng(2)
    response = true_response.astype(np.float32)
    n, half, late = 8 * 400, 5, 2
    # smooth over some ten frames
    slow = gaussian_filter1d(rng.standard_normal((n + late, layout.n_commands)), 10, axis=0)
    slow *= (30e-9 if dithered else 300e-9) / slow.std()
    sky = interaction_matrix(mini, _moved(mini, layout, {0: (-0.4, 0, 0, 0), 1: (0, 0.3, 0, 0)}))
    dither = np.outer(np.where(np.arange(n) // half % 2, -1, 1), dither_pattern(mini, layout, 5e-9)).astype(np.float32)
    shake = dither if dithered else 30e-9 * rng.standard_normal((n, layout.n_commands))
    mirror = (slow[:-late] + shake).astype(np.float32)
    noise = 2e-8 * rng.standard_normal((n, layout.n_slopes))
    slopes = (slow[late:] @ sky.T - mirror @ response.T + noise).astype(np.float32)
    stretches = Stretches(mini, half_period=half if dithered else None)
    for part in (slice(first, first + 400) for first in range(0, n, 400)):
        stretches.add(slopes[part], mirror[part], dither[part] if dithered else None)
    errors = _errors(layout, from_telemetry(stretches), MOVES)
    assert np.abs(errors[:, :2]).max() < 0.01, errors
    assert np.abs(errors[:, 2]).max() < 0.1, errors


def test_a_dither_is_as_strong_as_was_asked(mini: System) -> None:
    layout = Layout(mini)
    x, y = pupil_points(mini.telescope)
    wavefront = mirror_phase(layout, x, y, mini.science.targets[0].position) @ dither_pattern(mini, layout, 5e-9)
    assert wavefront.std() == pytest.approx(5e-9, rel=0.02)


def test_refusals(mini: System) -> None:
    layout = Layout(mini)
    stretches = Stretches(mini)
    slopes = np.ones((20, layout.n_slopes), np.float32) * np.arange(20, dtype=np.float32)[:, None]
    flat = np.zeros((20, layout.n_commands), np.float32)
    for _ in range(7):
        stretches.add(slopes, flat)
    with pytest.raises(RegisterError, match="at least 8 stretches"):
        from_telemetry(stretches)
    stretches.add(slopes, flat)
    with pytest.raises(RegisterError, match="nothing on the mirrors"):
        from_telemetry(stretches)
    with pytest.raises(ValueError, match="more than 3 successive frames"):
        stretches.add(slopes[:2], flat[:2])
    with pytest.raises(ValueError, match="together with half_period"):
        stretches.add(slopes, flat, flat)
    with pytest.raises(RegisterError, match="expected finite values of shape"):
        from_interaction_matrix(mini, np.zeros((3, 3)))


def test_the_command(
    mini: System, true_response: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "measured.npz", tmp_path / "out.json"
    save_interaction_matrix(path, true_response, Layout(mini).fingerprint, {})
    assert main(["register", str(path), "--system", "mini", "--tolerance", "0.08", "--json", str(out)]) == 1
    assert "sensor lgs1 is 0.10 sub-aperture rms from its place" in capsys.readouterr().out
    rows = json.loads(out.read_text())["sensors"]
    assert rows[0]["shift_x_subaperture"] == pytest.approx(0.1, abs=0.003)
    assert rows[1]["rotation_deg"] == pytest.approx(1.0, abs=0.03)
    assert main(["register", str(path)]) == 2
    assert "needs --system" in capsys.readouterr().err


def test_what_is_made_at_the_registered_places(
    mini: System, true_response: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout, places = Layout(mini), str(tmp_path / "places.json")
    measured, made, calibrated = (tmp_path / f"{name}.npz" for name in ("measured", "made", "calibrated"))
    save_interaction_matrix(measured, true_response, layout.fingerprint, {})
    assert main(["register", str(measured), "--system", "mini", "--tolerance", "1", "--json", places]) == 0
    method = ["--method", "least_squares", "-o", str(made)]
    assert main(["reconstruct", "mini", "--registration", places, *method]) == 0
    assert main(["calibrate", "mini", "--registration", places, "-o", str(calibrated)]) == 0
    reconstructor = Reconstructor.load(made)
    assert reconstructor.fingerprint == layout.fingerprint
    assert reconstructor.provenance["registration"]["sensors"][0]["sensor"] == "lgs1"
    far = np.linalg.norm(interaction_matrix(mini, layout) - true_response)
    for path, share in ((made, 0.05), (calibrated, 0.005)):
        with np.load(path) as content:
            assert np.linalg.norm(content["G"] - true_response) < share * far, path
    load_interaction_matrix(calibrated, layout.fingerprint)
    assert _moved(mini, Layout(mini), MOVES).fingerprint == layout.fingerprint
    # of a loop whose sensors were not moved, what a wrong place does not explain is taken for noise
    bag, noise = Path(__file__).parents[2] / "bags" / "mini", []
    for believed in ([], ["--registration", places]):
        words = ["estimate", str(bag), "--altitudes", "0,3000,10000", *believed, "-o", str(tmp_path / "sky.json")]
        assert main(words) == 0
        levels = json.loads((tmp_path / "sky.json").read_text())["noise"]
        noise.append([level["variance_factor"] for level in levels])
    assert np.all(np.subtract(*noise[::-1]) > 0.01)
    capsys.readouterr()
    assert main(["reconstruct", "gnao_ltao", "--registration", places, *method]) == 2
    assert "of another instrument (fingerprint" in capsys.readouterr().err
    for text, reason in (("{", "not JSON"), ("{}", "expected what 'srtomo register --json' writes")):
        Path(places).write_text(text)
        assert main(["calibrate", "mini", "--registration", places, "-o", str(calibrated)]) == 2
        assert reason in capsys.readouterr().err


class _Recording(Plant):
    """Remembers slopes and what was on the mirrors."""

    def record(self, frame: int) -> None:
        self.seen = getattr(self, "seen", [])
        self.seen.append((self._slopes, self._line.shape(frame).copy()))

    def measure(self, frame: int) -> np.ndarray:
        self._slopes = super().measure(frame)
        return self._slopes


def _wfe(run: Run, first: int, last: int) -> float:
    """Of frames from ``first`` to ``last``, m."""
    return float(np.sqrt(np.mean(run.high_order[(run.frames >= first) & (run.frames < last), 0] ** 2)))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("seed", "direction", "worth"), [(5, 0.0, 1.05), (6, 90 * DEGREE, 1.05), (7, 215 * DEGREE, 1.02)]
)
def test_registration_from_30_s_of_closed_loop(seed: int, direction: float, worth: float) -> None:
    # every layer goes the same way at 10 m/s: there the lag looks most like a shift
    system = load_system(
        "gnao_ltao_sr",
        {"atmosphere.layers.*.wind_speed": 10.0, "atmosphere.layers.*.wind_direction": direction},
    )
    moves = MOVES | {3: (0.2, 0.2, -1.5 * DEGREE, 0)}  # that is worth a swap
    layout, seconds = Layout(system), 30
    n = round(seconds * system.loop.rate)
    truth = _moved(system, layout, moves)
    sky = prepare(system, n, seed, layout=truth, science_every=20)
    believed, G = implicit(system)
    pattern, half = dither_pattern(system, layout, 5e-9), 10
    slot = Slot(layout)
    slot.fill(believed)
    signs = [
        Program(slot, Settings(1 + i, (s * pattern).astype(np.float32), (-s * G @ pattern).astype(np.float32)))
        for i, s in enumerate((1, -1))
    ]
    swap, end = 2000, 6000
    told = run(Plant(system, sky), {0: program_of(layout, implicit(system, truth)[0])}, frames=end)
    best = _wfe(told, swap + 100, end)
    for dithered, limit in ((False, 0.03), (True, 0.01)):
        programs = (
            {k: signs[k // half % 2] for k in range(0, n, half)} if dithered else {0: program_of(layout, believed)}
        )
        plant = _Recording(system, sky)
        stretches = Stretches(system, half_period=half if dithered else None)

        def each(
            frame: int, plant: _Recording = plant, stretches: Stretches = stretches, dithered: bool = dithered
        ) -> None:
            plant.record(frame)
            if len(plant.seen) < 1000:
                return
            slopes, mirror = (np.array(rows) for rows in zip(*plant.seen, strict=True))
            plant.seen.clear()
            if frame < 1000:
                return  # the loop settles
            # the delay is 2 frames
            sign = 1 - 2 * ((np.arange(frame - 999, frame + 1) - 2) // half % 2)
            stretches.add(slopes, mirror, np.outer(sign, pattern).astype(np.float32) if dithered else None)

        before = _wfe(run(plant, programs, each=each), swap + 100, end)
        found = from_telemetry(stretches)
        errors = _errors(layout, found, moves)
        pulls = errors / _sigmas(layout, found)
        print(f"dither: {dithered}; errors (sub-aperture, sub-aperture, degree, -), then in sigmas:")
        print(np.hstack([errors, pulls]).round(4))
        assert np.abs(errors[:, :2]).max() < limit
        assert np.abs(errors[:, 2]).max() < 0.05
        assert np.sqrt(np.mean(pulls**2)) < 2
        registered, _ = implicit(system, found.layout(system, layout))
        swapped = run(
            Plant(system, sky),
            {0: program_of(layout, believed), swap: program_of(layout, registered)},
            frames=end,
        )
        after = _wfe(swapped, swap + 100, end)
        print(f"WFE {1e9 * before:.2f} nm before, {1e9 * after:.2f} after the swap, {1e9 * best:.2f} told the truth")
        assert before > worth * best  # there is something to win back
        assert after < 1.02 * best
