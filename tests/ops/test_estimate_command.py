"""``srtomo estimate`` as a user calls it, on the golden bag."""

import cmath
import json
import math
from pathlib import Path

import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader, BagWriter
from srtomo_core.system import load_system
from srtomo_ops.cli import main

BAG = Path(__file__).parents[2] / "bags" / "mini"
SESSION = (0x6D696E69).to_bytes(8, "little")


def with_another_session(path: Path, messages: int) -> Path:
    """The bag, and after it the first slopes and commands once more as of another session."""
    with BagReader(BAG) as reader, BagWriter(path, reader.metadata) as writer:
        writer.declare_as(reader)
        hot = [reader.topic(topic.name) for topic in (wire.SLOPES, wire.COMMAND)]
        again = [message for message in reader if message.topic in hot][:messages]
        for message in reader:
            writer.write(message.topic, message.type, message.data, message.log_time, message.log_time)
        for message in again:
            data = message.data.replace(SESSION, bytes(7) + b"\x01", 1)
            writer.write(message.topic, message.type, data, message.log_time + 10**10, message.log_time + 10**10)
    return path


def test_a_bag_s_sky(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, plot = tmp_path / "sky.json", tmp_path / "sky.png"
    assert (
        main(["estimate", str(BAG), "--altitudes", "0,3000,10000", "--winds", "-o", str(file), "--plot", str(plot)])
        == 0
    )
    sky = json.loads(file.read_text())
    # 0.7 s are worth about seven frames: no more than the order of magnitude is certain
    assert 0.12 < sky["r0_m"] < 0.2
    assert [group["altitudes_m"] for group in sky["groups"]] == [[0], [3000], [10000]]
    assert sum(group["fraction"] for group in sky["groups"]) == pytest.approx(1)
    assert [level["sensor"] for level in sky["noise"]] == ["lgs1", "lgs2", "lgs3"]
    assert 0.7 < min(level["variance_factor"] for level in sky["noise"])
    # the winds that the bag was recorded with
    for wind, layer in zip(sky["winds"], load_system("mini").atmosphere.layers, strict=True):
        assert wind["altitude_m"] == layer.altitude
        off = cmath.rect(wind["speed_mps"], math.radians(wind["direction_deg"]))
        off -= cmath.rect(layer.wind_speed, layer.wind_direction)
        assert abs(off) < 3 * wind["sigma_mps"] < 2
    out = capsys.readouterr().out
    assert "errors suppose that all turbulence is at these altitudes" in out
    assert f"{100 * sky['r0_m']:.2f} +- {100 * sky['r0_sigma_m']:.2f} cm" in out
    assert plot.read_bytes()[:4] == b"\x89PNG"


def test_of_two_sessions_it_says_which(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, few = with_another_session(tmp_path / "whole", 10**6), with_another_session(tmp_path / "few", 5)
    assert main(["estimate", str(whole), "--altitudes", "0,10000"]) == 0
    assert "2 sessions in the bag: of the last one alone, frames 0 to 148\n" in capsys.readouterr().out
    assert main(["estimate", str(few), "--altitudes", "0,10000"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "at least 2 frames to count, got 1 in the last of 2 sessions; since frame 0: nothing came" in line


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
