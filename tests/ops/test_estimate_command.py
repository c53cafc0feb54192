"""``srtomo estimate`` as a user calls it, on the golden bag."""

import json
from pathlib import Path

import pytest

from srtomo_ops.cli import main

BAG = Path(__file__).parents[2] / "bags" / "mini"


def test_a_bag_s_sky(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, plot = tmp_path / "sky.json", tmp_path / "sky.png"
    assert main(["estimate", str(BAG), "--altitudes", "0,3000,10000", "-o", str(file), "--plot", str(plot)]) == 0
    sky = json.loads(file.read_text())
    # 0.7 s are worth about seven frames: no more than the order of magnitude is certain
    assert 0.12 < sky["r0_m"] < 0.2
    assert [group["altitudes_m"] for group in sky["groups"]] == [[0], [3000], [10000]]
    assert sum(group["fraction"] for group in sky["groups"]) == pytest.approx(1)
    assert [level["sensor"] for level in sky["noise"]] == ["lgs1", "lgs2", "lgs3"]
    assert 0.7 < min(level["variance_factor"] for level in sky["noise"])
    out = capsys.readouterr().out
    assert f"{100 * sky['r0_m']:.2f} +- {100 * sky['r0_sigma_m']:.2f} cm" in out
    assert plot.read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["no_such_bag"], "no_such_bag"),
        ([str(BAG), "--altitudes", "0,9000,3000"], "altitudes: expected ascending"),
        ([str(BAG), "--altitudes", "low"], "--altitudes"),
        ([str(BAG), "--slopes", "3"], "too few slopes to work with: expected at least 120"),
        ([str(BAG), "--slopes", "-1"], "too few slopes to work with: expected at least 120"),
        ([str(BAG), "--registration", "no_such_file.json"], "no_such_file.json"),
        ([str(BAG), "-o", "/no/such/folder/sky.json"], "no such folder"),
    ],
)
def test_bad_input_is_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = main(["estimate", *words])
    except SystemExit as stop:  # from the parser
        code = int(str(stop.code))
    assert code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and message in lines[0], lines
