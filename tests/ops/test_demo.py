"""``srtomo demo`` with real processes, and what is done with its bag."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader, BagWriter
from srtomo_ops import cli

SECONDS = 4
FRAMES = 800  # of mini, 200 Hz
GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "mini"
KEYS = """system rate_hz seconds frames frames_recorded frames_lost swaps wfe_nm_open wfe_nm_before wfe_nm_after
    strehl_before strehl_after science_wavelength_m latency_us deadline_misses late_commands bag figure""".split()


class DemoRun(NamedTuple):
    code: int
    output: str
    numbers: dict


@pytest.fixture(scope="module")
def demo(start_shared_process, tmp_path_factory) -> DemoRun:
    pytest.importorskip("rclpy")
    folder = tmp_path_factory.mktemp("demo")
    small_sky = ("--set", "atmosphere.outer_scale=8 m")
    words = (
        "demo",
        "mini",
        *small_sky,
        "--seconds",
        str(SECONDS),
        "-o",
        folder / "run",
        "--json",
        folder / "demo.json",
    )
    process = start_shared_process("-m", "srtomo_ops.cli", *words)
    code = process.wait(110)
    assert (folder / "demo.json").exists(), process.output
    return DemoRun(code, process.output, json.loads((folder / "demo.json").read_text()))


def frames_of(bag: Path) -> dict[str, set[int]]:
    """Frame numbers of each sensor's slopes, and of the commands."""
    found: dict[str, set[int]] = {}
    with BagReader(bag) as reader:
        slopes, commands = reader.topic(wire.SLOPES.name), reader.topic(wire.COMMAND.name)
        for message in reader.messages(slopes, commands):
            if message.topic == slopes:
                frame = wire.read_slope_frame(message.data)
                found.setdefault(f"slopes {frame.sensor}", set()).add(frame.frame)
            else:
                found.setdefault("commands", set()).add(wire.read_dm_command(message.data).frame)
    return found


def test_every_frame_is_published_answered_and_recorded(demo: DemoRun) -> None:
    numbers = demo.numbers
    assert demo.code == 0 or numbers["loop_opened_by_faults"] > 0, demo.output  # of a machine that stands still
    assert (numbers["frames"], numbers["frames_recorded"], numbers["frames_lost"]) == (FRAMES, FRAMES, 0)
    found = frames_of(Path(numbers["bag"]))
    assert set(found) == {"slopes 0", "slopes 1", "slopes 2", "slopes 3", "commands"}
    assert all(frames == set(range(FRAMES)) for frames in found.values())


def test_the_numbers_are_those_that_were_agreed(demo: DemoRun) -> None:
    numbers = demo.numbers
    assert set(KEYS) <= set(numbers)
    assert set(numbers["latency_us"]) == {"p50", "p99", "p999", "max"}
    assert (numbers["system"], numbers["seconds"], numbers["science_wavelength_m"]) == ("mini", SECONDS, 1650e-9)
    assert 0 < numbers["rate_hz"] <= 200.0
    assert numbers["swaps"] == 1 and FRAMES / 2 <= numbers["swap_frame"] < FRAMES
    assert numbers["wfe_nm_before"] < numbers["wfe_nm_open"] and numbers["wfe_nm_after"] < numbers["wfe_nm_open"]
    assert 0 < numbers["strehl_before"] < 1 and 0 < numbers["strehl_after"] < 1
    latency = numbers["latency_us"]
    assert 0 < latency["p50"] <= latency["p99"] <= latency["p999"] <= 1.1 * latency["max"]
    assert Path(numbers["figure"]).read_bytes().startswith(b"\x89PNG")
    for shown in ("WFE before the swap", "WFE after the swap", "deadline misses", "all turbulence at the ground"):
        assert shown in demo.output


def test_the_swap_is_in_the_commands(demo: DemoRun) -> None:
    with BagReader(demo.numbers["bag"]) as reader:
        made_by = {}
        for message in reader.messages(reader.topic(wire.COMMAND.name)):
            command = wire.read_dm_command(message.data)
            made_by[command.frame] = command.reconstructor
    swap = demo.numbers["swap_frame"]
    before, after = ({made_by[frame] for frame in part} for part in (range(swap), range(swap, FRAMES)))
    assert len(before) == len(after) == 1 and before != after


def test_its_bag_replays_bit_for_bit(demo: DemoRun, tmp_path: Path, capsys) -> None:
    assert cli.main(["replay", demo.numbers["bag"], "--json", str(tmp_path / "replay.json")]) == 0
    assert f"{FRAMES} frames compared (0 to {FRAMES - 1}" in capsys.readouterr().out
    outcome = json.loads((tmp_path / "replay.json").read_text())
    assert (outcome["compared"], outcome["differing"], outcome["unanswered"]) == (FRAMES, 0, 0)
    assert cli.main(["replay", demo.numbers["bag"], "--from", "600"]) == 0
    assert f"200 frames compared (600 to {FRAMES - 1}" in capsys.readouterr().out


def test_a_bag_with_one_altered_command_gives_exactly_one(demo: DemoRun, tmp_path: Path, capsys) -> None:
    with BagReader(demo.numbers["bag"]) as reader, BagWriter(tmp_path / "altered", reader.metadata) as writer:
        commands = reader.topic(wire.COMMAND.name)
        for message in reader:
            data = message.data
            if message.topic == commands and wire.read_dm_command(data).frame == 500:
                data = data[:-4] + bytes([data[-4] ^ 1]) + data[-3:]  # the lowest bit of one command
            writer.write(message.topic, message.type, data, message.log_time, message.log_time)
    assert cli.main(["replay", str(tmp_path / "altered")]) == 1
    out = capsys.readouterr().out
    assert f"{FRAMES} frames compared" in out and "1 differ" in out and "frame 500: 1 commands" in out


def test_a_bag_is_published_to_a_live_hrtc(start_process, tmp_path: Path) -> None:
    def srtomo(*words: str | Path):
        return start_process("-m", "srtomo_ops.cli", *words)

    def done(*words: str | Path) -> str:
        process = srtomo(*words)
        assert process.wait(60) == 0, process.output
        return process.output

    assert cli.main(["calibrate", "mini", "-o", str(tmp_path / "gcal.npz")]) == 0
    srtomo("hrtc", "mini", "--namespace", "live", "-p", f"interaction_matrix:={tmp_path / 'gcal.npz'}")
    for action in ("configure", "activate"):
        done("ctl", action, "--namespace", "live")
    words = ("replay", GOLDEN, "--publish", "--from", "100", "--namespace", "live")
    assert "published 200 messages" in done(*words)
    done("ctl", "status", "--namespace", "live", "--json", tmp_path / "status.json")
    status = json.loads((tmp_path / "status.json").read_text())
    assert (status["state"], status["commands"], status["frame"]) == ("active", 50, 149)
    assert status["dropped_fingerprint"] == status["dropped_malformed"] == status["dropped_session"] == 0
