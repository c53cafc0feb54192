"""``srtomo predict`` and ``srtomo design`` as a user calls them."""

import json
from pathlib import Path

import pytest

from srtomo_core.system import load_system
from srtomo_ops.cli import main
from srtomo_srtc.predict import Prediction
from srtomo_srtc.reconstructors.implicit import implicit


def test_predict_writes_what_it_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "numbers.json"
    assert main(["predict", "mini", "--set", "loop.rate=500 Hz", "--json", str(file)]) == 0
    numbers = json.loads(file.read_text())
    system = load_system("mini", {"loop.rate": "500 Hz"})
    budgets = Prediction(system).budgets(implicit(system)[0].R[0])
    assert [row["total_nm"] for row in numbers["targets"]] == pytest.approx([b.wfe * 1e9 for b in budgets])
    squares = sum(numbers["targets"][0][f"{term}_nm"] ** 2 for term in ("fitting", "tomography", "noise", "lag"))
    assert squares == pytest.approx(numbers["targets"][0]["total_nm"] ** 2)
    assert f"WFE {numbers['wfe_nm']:.1f} nm" in capsys.readouterr().out


def test_predict_of_a_file_with_margins_and_age(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    matrix, file = tmp_path / "r.npz", tmp_path / "numbers.json"
    reconstructor, G = implicit(load_system("mini"))
    reconstructor.save(matrix, G)
    drift = ["--becomes", "atmosphere.layers.2.altitude=14 km", "--over", "20", "--ages", "2"]
    assert main(["predict", "mini", "--reconstructor", str(matrix), "--stability", *drift, "--json", str(file)]) == 0
    numbers = json.loads(file.read_text())
    assert numbers["reconstructor"] == f"{reconstructor.id:016x}"
    assert 0.3 < numbers["stability"]["shift_limit_any_delay"] <= numbers["stability"]["shift_limit_subaperture"] < 0.6
    assert [row["age_min"] for row in numbers["age"]] == [0, 20]
    assert numbers["age"][0]["old_nm"] == pytest.approx(numbers["wfe_nm"])
    assert numbers["age"][1]["old_nm"] > numbers["age"][0]["old_nm"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--becomes", "loop.rate=1 kHz"], "expected a key of atmosphere"),
        (["--becomes", "atmosphere.r0=12 cm", "--ages", "1"], "at least 2 ages"),
        (["--reconstructor", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_bad_requests_are_refused_in_a_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["predict", "mini", *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_design_writes_numbers_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    numbers, figure = tmp_path / "design.json", tmp_path / "design.png"
    words = ["--vary", "asterism", "--evaluations", "10", "--points", "3", "-o", str(figure), "--json", str(numbers)]
    assert main(["design", "mini", *words]) == 0
    content = json.loads(numbers.read_text())
    assert content["best_wfe_nm"] <= content["start_wfe_nm"]
    assert len(content["cuts"][0]["wfe_nm"]) == 3
    assert content["misalignment"][0]["shift_subaperture"] == 0
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert "best" in capsys.readouterr().out


def test_reconstruct_and_predict_with_several_exposures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, built, loaded = tmp_path / "two.npz", tmp_path / "built.json", tmp_path / "loaded.json"
    keywords = ["--method", "predictive", "--with", "epochs=2", "--with", "wind_uncertainty=[1,1,2]"]
    assert main(["reconstruct", "mini", *keywords, "-o", str(file)]) == 0
    assert "286 slopes of 2 exposures" in capsys.readouterr().out
    assert main(["predict", "mini", *keywords, "--json", str(built)]) == 0
    assert main(["predict", "mini", "--reconstructor", str(file), "--stability", "--json", str(loaded)]) == 0
    one, other = (json.loads(path.read_text()) for path in (built, loaded))
    assert one["epochs"] == other["epochs"] == 2
    assert one["wfe_nm"] == pytest.approx(other["wfe_nm"], rel=1e-6)
    assert 0.05 < other["stability"]["shift_limit_any_delay"] <= other["stability"]["shift_limit_subaperture"] < 1
    assert main(["predict", "mini", "--method", "predictive", "--with", "epochs=2.5"]) != 0
    assert "--with epochs: expected a value such as in epochs=1, got 2.5" in capsys.readouterr().err
