from __future__ import annotations

import argparse
import importlib
import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor, load_interaction_matrix
from srtomo_core.system import load_system, system_names
from srtomo_ops import cli
from srtomo_ops.commands.nodes import quoted

COMMANDS = [command for group in cli.GROUPS.values() for command in group]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*words: str | Path) -> int:
    """The exit code, argparse's own included."""
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code


# -- help -------------------------------------------------------------------------------------------------------------


def test_the_overview_shows_every_command_in_its_group(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    text = capsys.readouterr().out
    places = [text.index(f"{group}:") for group in cli.GROUPS]
    assert places == sorted(places)
    for group, commands in cli.GROUPS.items():
        section = text[text.index(f"{group}:") :].split("\n\n")[0]
        for command in commands:
            assert f"  {command.name} " in section and command.help in section
    assert run() == 2


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_help_has_an_example_and_says_every_default(command: cli.Command, capsys) -> None:
    module = importlib.import_module(f"srtomo_ops.commands.{command.module or command.name}")
    assert f"srtomo {command.name} " in module.EXAMPLE.replace("COMMAND", command.name)
    assert run(command.name, "--help") == 0
    text = capsys.readouterr().out
    assert f"usage: srtomo {command.name}" in text
    assert f"srtomo {command.name} " in text[text.index("example") :]
    parser = argparse.ArgumentParser()
    module.configure(parser)
    for action in parser._actions:
        assert action.help, f"{action.dest}: no help"
        if action.default not in (None, False, [], argparse.SUPPRESS):
            assert "default" in action.help, f"{action.dest}: help does not say the default, {action.default!r}"


def test_the_version_is_said(capsys) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("srtomo ")


# -- what works -------------------------------------------------------------------------------------------------------


def test_systems_lists_every_instrument(capsys) -> None:
    assert run("systems", "--json", "all.json") == 0
    listed = json.loads(Path("all.json").read_text())
    assert set(listed) == set(system_names())
    assert {line.split()[0] for line in capsys.readouterr().out.splitlines()} == set(system_names())


def test_systems_prints_one_in_full(capsys) -> None:
    assert run("systems", "mini", "--set", "atmosphere.r0=12 cm", "--json", "mini.json") == 0
    text = capsys.readouterr().out
    for shown in ("outer_scale: 25", "guide_star: lgs3", "theta0_arcsec", "tau0_s", "matrix_bytes", "rate_hz: 200"):
        assert shown in text
    numbers = json.loads(Path("mini.json").read_text())
    layout = Layout(load_system("mini"))
    assert numbers["system"]["atmosphere"]["r0"] == 0.12
    assert numbers["derived"]["slopes"] == layout.n_slopes
    assert numbers["derived"]["commands"] == layout.n_commands
    assert numbers["derived"]["matrix_bytes"] == 4 * layout.n_slopes * layout.n_commands
    assert numbers["derived"]["fingerprint"] == layout.fingerprint.hex()
    # tau0 = 0.314 r0 / vbar, by hand
    vbar = (0.6 * 6 ** (5 / 3) + 0.25 * 12 ** (5 / 3) + 0.15 * 18 ** (5 / 3)) ** (3 / 5)
    assert numbers["derived"]["tau0_s"] == pytest.approx(0.314 * 0.12 * np.cos(np.radians(20)) ** 0.6 / vbar)


def test_reconstruct_lists_every_method_with_its_keywords(capsys) -> None:
    assert run("reconstruct", "--help") == 0
    text = " ".join(capsys.readouterr().out.split("methods, and what --with")[1].split())
    assert "explicit [noise_gain] kappa=0.0001 prior=exact|laplacian [form=covariance|information] solver=" in text
    assert "moao target=0 " in text
    assert "learn_apply [noise_gain] lag=0 kappa=0.0003 split=false least_squares" in text  # and no matrices


def test_reconstruct_writes_R_Q_G_and_where_they_come_from(capsys) -> None:
    assert run("reconstruct", "mini", "-o", "mini.npz", "--prior", "ground", "--json", "mini.json") == 0
    reconstructor = Reconstructor.load("mini.npz")
    numbers = json.loads(Path("mini.json").read_text())
    assert numbers["id"] == f"{reconstructor.id:016x}" in capsys.readouterr().out
    assert reconstructor.fingerprint == Layout(load_system("mini")).fingerprint
    assert reconstructor.provenance["system"] == "mini"
    assert len(reconstructor.provenance["atmosphere"]["layers"]) == 1
    with np.load("mini.npz") as content:
        G = content["G"].astype(np.float64)
    Q = reconstructor.R[0].astype(np.float64) @ G
    assert np.abs(Q - reconstructor.Q[0]).max() < 1e-6 * np.abs(Q).max()


def test_calibrate_writes_the_simulated_instrument_s_response() -> None:
    assert run("calibrate", "mini", "-o", "gcal.npz", "--json", "gcal.json") == 0
    layout = Layout(load_system("mini"))
    G = load_interaction_matrix("gcal.npz", layout.fingerprint)
    numbers = json.loads(Path("gcal.json").read_text())
    assert G.shape == (numbers["slopes"], numbers["commands"]) == (layout.n_slopes, layout.n_commands)


def test_simulate_closes_the_loop(capsys) -> None:
    small = ("--set", "atmosphere.outer_scale=8 m", "--frames", "80")
    assert run("reconstruct", "mini", "-o", "mini.npz", *small[:2]) == 0
    numbers = {}
    for name, words in {
        "built": (),
        "from file": ("--reconstructor", "mini.npz"),
        "open": ("--open",),
        "ground": ("--prior", "ground"),
    }.items():
        assert run("simulate", "mini", *small, *words, "--json", "out.json") == 0
        numbers[name] = json.loads(Path("out.json").read_text())
    assert numbers["built"]["wfe_nm"] == numbers["from file"]["wfe_nm"]
    assert numbers["built"]["fitting_nm"] < numbers["built"]["wfe_nm"] < 0.7 * numbers["open"]["wfe_nm"]
    assert numbers["built"]["wfe_nm"] < numbers["ground"]["wfe_nm"]
    expected = np.exp(-((2 * np.pi * numbers["built"]["wfe_nm"] * 1e-9 / 1650e-9) ** 2))
    assert numbers["built"]["strehl"] == pytest.approx(expected, abs=0.02)
    assert f"{numbers['ground']['wfe_nm']:.1f} nm rms" in capsys.readouterr().out


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "news"),
    [
        ("nonsense", "no command 'nonsense': expected one of demo"),
        ("systems nowhere", "nowhere: expected the path of a .yaml file or one of gnao_ltao"),
        ("systems none.yaml", "none.yaml: No such file"),
        ("systems mini --set loop.rat=3", "loop.rat: unknown key"),
        ("systems mini --set 'loop.rate=3 s'", "loop.rate: expected a frequency such as '500 Hz'"),
        ("systems mini --set 'mirrors.0.pitch=-1 m'", "mirrors[0].pitch: input should be greater than 0"),
        ("systems mini --set loop.rate", "--set loop.rate: expected KEY=VALUE"),
        ("systems mini --json /nowhere/x.json", "/nowhere/x.json: no such folder"),
        ("reconstruct mini", "the following arguments are required: -o/--output"),
        ("reconstruct mini -o nowhere/x.npz", "nowhere/x.npz: no such folder"),
        ("reconstruct mini -o .", ".: is a folder"),
        ("reconstruct mini -o /proc/x.npz", "/proc/x.npz"),
        ("reconstruct mini -o x.npz --prior wrong", "--prior: invalid choice: 'wrong'"),
        ("calibrate mini -o /proc/x.npz", "/proc/x.npz"),
        ("simulate mini --frames 50", "--frames: expected more than 50"),
        ("simulate mini --reconstructor none.npz", "none.npz: No such file"),
        ("simulate mini --reconstructor cut.npz", "cut.npz: not a srtomo file, or cut off"),
        ("simulate mini --reconstructor damaged.npz", "damaged.npz: not a srtomo file, or cut off"),
        ("simulate mini --reconstructor gcal.npz", "gcal.npz: expected format srtomo-reconstructor"),
        ("simulate mini --frames 51 --reconstructor other.npz", "other.npz: made for another instrument than mini"),
        ("reproduce wrong", "invalid choice: 'wrong'"),
        ("reproduce gnao --seeds 0", "--seeds: expected at least 1, got 0"),
        ("reproduce gnao --json /nowhere/x.json", "/nowhere/x.json: no such folder"),
        ("replay none", "none: cannot be read (No such file"),
        ("replay whole.npz", "whole.npz: not an MCAP file"),
        ("bag info none", "none: cannot be read (No such file"),
        ("bag repair none", "repair: expected -o BAG"),
        ("bag repair none -o mended", "none: cannot be read (No such file"),
        ("record nowhere -o bag", "nowhere: expected the path of a .yaml file"),
        ("demo mini --seconds 0", "--seconds: expected at least 1, got 0"),
        ("demo mini -o /proc/demo", "/proc/demo: No such file"),
        ("hrtc nowhere", "nowhere: expected the path of a .yaml file"),
        ("hrtc mini -p leak", "-p leak: expected NAME:=VALUE"),
        ("bench latency mini --fifo-priority 400", "--fifo-priority: expected 0 to 99, got 400"),
        ("bench latency mini --fifo-priority 5 --compute-only", "--fifo-priority: of the whole path, not of --compute"),
        ("bench latency mini_tip_tilt", "mini_tip_tilt: has tip-tilt in a loop of its own"),
        ("ctl commit 12", "commit: expected ID SHA256 after it, got 12"),
        ("ctl roll-back 12 zz", "expected ID and SHA256 in hex, as 'srtomo ctl publish' prints them, got 12 zz"),
        ("ctl wrong", "invalid choice: 'wrong'"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing_behind(words: str, news: str, capsys, tmp_path: Path) -> None:
    if words.split()[0] in ("record", "hrtc", "ctl"):
        pytest.importorskip("rclpy")
    whole = Path("whole.npz")
    if "npz" in words:
        mini = load_system("mini")
        layout = Layout(mini)
        for name, fingerprint in (("whole", layout.fingerprint), ("other", bytes(32))):
            Reconstructor.from_matrices(
                np.zeros((layout.n_commands, layout.n_slopes)),
                np.zeros((layout.n_slopes, layout.n_commands)),
                fingerprint=fingerprint,
                gain=0.5,
                command_limit=layout.stroke,
            ).save(f"{name}.npz")
        content = whole.read_bytes()
        Path("cut.npz").write_bytes(content[: len(content) // 2])
        Path("damaged.npz").write_bytes(content[:5000] + bytes([content[5000] ^ 1]) + content[5001:])
        if "gcal" in words:
            assert run("calibrate", "mini", "-o", "gcal.npz") == 0
            capsys.readouterr()
    before = sorted(tmp_path.iterdir())
    assert run(*shlex.split(words)) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1 and printed.err.startswith("srtomo"), printed.err
    assert news in printed.err
    assert sorted(tmp_path.iterdir()) == before


def _apart(*words: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: a node sets the number of threads before numpy loads, for the whole process."""
    command = [sys.executable, "-m", "srtomo_ops.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_text_with_brackets_stays_text() -> None:
    defaults = {"schedule": "", "frames": 10, "over": 0.0, "priors": ["file"]}
    for given, passed in (
        ('schedule:=[{"at": 5}]', """schedule:='[{"at": 5}]'"""),
        ("schedule:='[]'", "schedule:='[]'"),
        ("schedule:=it's", "schedule:='it''s'"),
        ("frames:=20", "frames:=20"),
        ("over:=20", "over:=20.0"),
        ("over:=2e1", "over:=2e1"),
        ("priors:=[ground]", "priors:=[ground]"),
    ):
        assert quoted(given, defaults) == passed


def test_a_frame_path_of_another_version_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def refuse(name: str) -> None:
        raise ImportError("the compiled frame path: install srtomo again", name="srtomo_rtc.native")

    monkeypatch.setattr(cli.importlib, "import_module", refuse)
    assert cli.main(["systems"]) == 2
    assert capsys.readouterr().err == "srtomo systems: the compiled frame path: install srtomo again\n"


def test_a_node_lists_its_parameters_and_refuses_others() -> None:
    pytest.importorskip("rclpy")
    listed = _apart("hrtc", "mini", "--parameters")
    assert listed.returncode == 0
    names = [line.split()[0] for line in listed.stdout.splitlines()]
    assert {"interaction_matrix", "leak", "polc", "fault_budget"} <= set(names)
    refused = _apart("hrtc", "mini", "-p", "lek:=0.1")
    assert refused.returncode == 2
    assert refused.stderr.startswith("srtomo hrtc: -p lek:=0.1: no such parameter (expected one of system")
    assert len(refused.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("command", "given", "news"),
    [
        ("hrtc", "fifo_priority:=high", "'fifo_priority' to 'high'"),
        ("hrtc", "deadline:=-1", "deadline out of range"),
        ("sim", "seed:=x", "'seed' to 'x'"),
    ],
)
def test_a_parameter_of_a_wrong_type_or_out_of_range_is_one_line(ros_domain, command, given, news) -> None:
    refused = _apart(command, "mini", "-p", given)
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"srtomo {command}: -p: ") and news in refused.stderr
    assert len(refused.stderr.splitlines()) == 1
