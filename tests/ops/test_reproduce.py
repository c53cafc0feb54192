from __future__ import annotations

import json

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_ops import cli
from srtomo_ops.reproduce import gnao
from srtomo_ops.reproduce.trials import Outcome, Trial, direct, measure, quadrature, with_electrons
from srtomo_sim.course import Course
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky
from srtomo_srtc.reconstructors.implicit import implicit

NM = 1e-9


@pytest.fixture(scope="module")
def mini() -> System:
    # a small outer scale makes the sky small
    return load_system("mini", {"atmosphere.outer_scale": 8.0})


@pytest.fixture(scope="module")
def outcomes(mini: System) -> dict[str, Outcome]:
    faint = with_electrons(mini, 100, subaperture=0.5)
    trials = {
        "bright": Trial(mini),
        "no jitter": Trial(mini.with_changes({"guide_stars.*.jitter": 0.0})),
        "believed aligned": Trial(mini, aligned=True),
        "faint": Trial(faint),
    }
    return measure(trials, range(1, 3), 200)


def test_brightness_and_belief_are_felt(outcomes: dict[str, Outcome]) -> None:
    bright = outcomes["bright"]
    assert np.all(bright.wfe > bright.fitting)
    assert np.all(bright.strehl > outcomes["faint"].strehl)
    for worse in ("believed aligned", "faint"):
        assert np.all(outcomes[worse].wfe > 1.05 * bright.wfe), worse


def test_the_noise_prior_is_the_trial_s(mini: System) -> None:
    factors = [Trial(mini, gain).build().provenance["noise"]["variance_factor"] for gain in (None, 1.0)]
    assert factors == [pytest.approx(1 / 3), 1.0]


def test_trials_of_a_sky_are_paired(outcomes: dict[str, Outcome]) -> None:
    assert len({tuple(outcome.fitting) for outcome in outcomes.values()}) == 1
    # the lasers' uplink jitter, 0.5 arcsec a laser, reaches nothing that is not tip-tilt
    assert np.all(np.abs(outcomes["no jitter"].wfe - outcomes["bright"].wfe) < 0.1 * NM)


def test_gains() -> None:
    worse, better = (Outcome(np.array(wfe) * NM, np.zeros(2), np.zeros(2)) for wfe in ((130, 50), (120, 30)))
    assert quadrature(worse, better) == pytest.approx((50 + 40) / 2 * NM)
    assert quadrature(better, worse) == pytest.approx(-45 * NM)
    assert direct(worse, better) == pytest.approx(15 * NM)


def test_electrons_are_a_laser_s_sub_aperture_s(mini: System) -> None:
    system = with_electrons(load_system("gnao_ltao_ideal", {"loop.rate": "1 kHz"}), 186)
    assert system.sensors[0].photons == pytest.approx(1.1625e6)
    assert system.sensors[4] == load_system("gnao_ltao_ideal").sensors[4]


@pytest.mark.parametrize("name", ["mini", pytest.param("gnao_ltao_sr", marks=pytest.mark.slow)])
def test_the_plant_s_laser_tip_tilt_makes_no_command(name: str) -> None:
    system = load_system(name)
    layout = Layout(system)
    still = np.zeros((1, layout.n_slopes), np.float32)
    sky = Sky(
        system, layout, 1, still, np.zeros((layout.n_slopes, layout.n_commands), np.float32), 1, (), Course(system)
    )
    quiet = system.with_changes({"guide_stars.*.jitter": 0.0})
    tilt = Plant(system, sky).measure(0).astype(np.float64) - Plant(quiet, sky).measure(0)
    assert np.std(tilt) > 1e-6  # some tenths of an arcsec, along each sensor's own axes
    R = implicit(system)[0].R[0].astype(np.float64)
    assert np.linalg.norm(R @ tilt) < 1e-6 * np.linalg.norm(R, 2) * np.linalg.norm(tilt)


@pytest.fixture
def as_the_reference() -> dict[str, Outcome]:
    """Outcomes that equal the reference figures, the gains of the comparisons included."""

    def of(wfe: float, strehl: float = 0.5, fitting: float = 50.0) -> Outcome:
        return Outcome(np.full(3, wfe) * NM, np.full(3, strehl), np.full(3, fitting) * NM)

    found = {}
    for (name, electrons), wfe in gnao.REFERENCE_WFE.items():
        fitting = gnao.fitting_closed_form(load_system(name)) / NM
        strehl = 0.786 if name == gnao.SHIFTED else 0.75
        found[gnao.cell(name, electrons, gnao.UNSCALED)] = of(wfe, strehl, fitting)
        found[gnao.cell(name, electrons, gnao.SCALED)] = of(wfe * 0.999, strehl, fitting)
    shifted = found[gnao.cell(gnao.SHIFTED, 186, gnao.SCALED)].rms / NM
    found["no jitter"] = of(shifted + 0.05)
    found["believed aligned"] = of(gnao.REFERENCE_BELIEF)
    found["sensors aligned"] = of(np.hypot(shifted, 33.0))
    return found


def test_statements_hold_of_the_reference(as_the_reference: dict[str, Outcome]) -> None:
    assert set(as_the_reference) == set(gnao.trials())
    assert [statement for statement in gnao.statements(as_the_reference) if not statement.holds] == []


@pytest.mark.parametrize(
    ("trial", "factor", "text"),
    [
        (gnao.cell(gnao.IDEAL, 40, gnao.UNSCALED), 1.071, "the reference's figures"),
        (gnao.cell(gnao.PLAIN, 40, gnao.SCALED), 1.002, "scaling the noise prior"),
        (gnao.cell(gnao.IDEAL, 745, gnao.SCALED), 1.06, "order when bright"),
        (gnao.cell(gnao.SHIFTED, 10, gnao.SCALED), 1.005, "order when faint"),
        (gnao.cell(gnao.PLAIN, 186, gnao.SCALED), 0.98, "gain of SR, 186 e"),
        ("sensors aligned", 0.98, "of it from the sensors"),
        ("believed aligned", 0.92, "shifted sensors that the reconstructor takes to be aligned"),
        ("no jitter", 1.001, "0.5 arcsec of uplink jitter"),
    ],
)
def test_a_statement_fails_of_what_is_worse(as_the_reference, trial: str, factor: float, text: str) -> None:
    outcome = as_the_reference[trial]
    as_the_reference[trial] = outcome._replace(wfe=outcome.wfe * factor)
    failed = [statement.text for statement in gnao.statements(as_the_reference) if not statement.holds]
    assert any(line.startswith(text) for line in failed), failed


def test_the_command_s_table_json_and_exit_code(as_the_reference, monkeypatch, capsys, tmp_path) -> None:
    monkeypatch.setattr("srtomo_ops.commands.reproduce.measure", lambda *_: as_the_reference)
    assert cli.main(["reproduce", "gnao", "--json", str(tmp_path / "gnao.json")]) == 0
    out = capsys.readouterr().out
    assert "gnao_ltao_sr           186         99.6 (-0.1%)" in out and "FAILS" not in out
    numbers = json.loads((tmp_path / "gnao.json").read_text())
    assert len(numbers["wfe"]) == 12 and all(statement["holds"] for statement in numbers["statements"])
    as_the_reference["sensors aligned"] = as_the_reference["no jitter"]
    assert cli.main(["reproduce", "gnao"]) == 1
    assert "FAILS  of it from the sensors" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_table_s_statements_hold() -> None:
    failed = [s for s in gnao.statements(measure(gnao.trials(), range(1, 4), 1000)) if not s.holds]
    assert failed == []
