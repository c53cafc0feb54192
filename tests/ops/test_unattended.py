"""The SRTC node left to itself over ROS: the sky changes, it learns, commits, and regains what the change cost."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader
from srtomo_core.messages import decode
from srtomo_core.system import System, load_system
from srtomo_ops.commands.calibrate import calibrate
from srtomo_ops.simulate import program_of, run
from srtomo_sim.course import scheduled
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare
from srtomo_srtc.reconstructors import implicit

pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

import rclpy

from srtomo_ops.operator import Operator

RATE, WINDOW, AT, SECONDS = 250, 8.0, 14.0, 46.0
SETTINGS: dict[str, Any] = {"loop.rate": f"{RATE} Hz", "atmosphere.outer_scale": "8 m"}
FAINT = [2e5, 1.5e5, 2e5, 8e4]  # e/m2/s, of the four sensors
FRAMES = round(SECONDS * RATE)


def on_faint_stars() -> tuple[dict[str, Any], dict[str, Any]]:
    """``--set`` of mini, and what is set when it has a fifth of the flux."""
    lasers = {f"sensors.{w}.photons": f"{photons:g} e/m2/s" for w, photons in enumerate(FAINT)}
    return SETTINGS | lasers, {f"sensors.{w}.photons": 0.2 * photons for w, photons in enumerate(FAINT)}


def on_wide_stars() -> tuple[dict[str, Any], dict[str, Any]]:
    """``--set`` of mini with its stars three times as far apart, and what is set when 30 % have moved to its top."""
    mini = load_system("mini")
    places = {
        f"guide_stars.{i}.position.{axis}": f"{3 * getattr(star.position, axis):.9g} rad"
        for i, star in enumerate(mini.guide_stars)
        for axis in "xy"
    }
    fractions = 0.7 * np.array(mini.atmosphere.fractions)
    fractions[-1] += 0.3
    moved = {f"atmosphere.layers.{l}.fraction": float(fraction) for l, fraction in enumerate(fractions)}
    return SETTINGS | places | {"atmosphere.r0": "10 cm"}, moved


def in_lockstep(system: System, schedule: list[dict[str, Any]], told: System | None) -> tuple[np.ndarray, np.ndarray]:
    """Science frames and the first target's residual, m, without the SRTC; ``told``: of the change, as it happens."""
    sky = prepare(system, FRAMES, 1, science_every=5, changes=scheduled(schedule, RATE))
    programs = {0: program_of(sky.layout, implicit(system)[0])}
    if told is not None:
        programs[round(AT * RATE)] = program_of(sky.layout, implicit(told)[0])
    result = run(Plant(system, sky), programs)
    return result.frames, result.high_order[:, 0]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("case", [on_faint_stars, on_wide_stars])
def test_it_regains_what_a_change_costs(case: Any, start_process: Any, tmp_path: Path) -> None:
    """80 % of the difference between never learning and being told, from two windows after the change."""
    settings, change = case()
    before = load_system("mini", settings)
    after = before.with_changes(change)
    sets = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    schedule = [{"at": AT, "set": change}]
    matrix = tmp_path / "G.npz"
    calibrate(before, matrix)
    command = "-m", "srtomo_ops.cli"
    start_process(
        *command, "sim", "mini", *sets, "-p", f"frames:={FRAMES}", "-p", f"schedule:='{json.dumps(schedule)}'",
        "-p", f"result:={tmp_path / 'wfe.npz'}",
    )  # fmt: skip
    srtc = start_process(
        *command, "srtc", "mini", *sets, "-p", "learn:=true", "-p", "auto_commit:=true", "-p", f"window:={WINDOW}",
        "-p", f"interaction_matrix:={matrix}",
    )  # fmt: skip
    start_process(
        *command, "hrtc", "mini", *sets, "-p", f"interaction_matrix:={matrix}", "-p", f"fault_budget:={10 * RATE}"
    )
    recorder = start_process(*command, "record", "mini", *sets, "-o", tmp_path / "bag")
    rclpy.init()
    operator = Operator(patience=600.0)
    try:
        operator.transition("configure")
        operator.transition("activate")
        identity, sha256 = operator.publish("file")
        operator.wait_staged(identity)
        operator.commit(identity, sha256)
        operator.close_loop(True)
        while operator.recorder is None or operator.recorder.slope_publishers == 0:
            operator.spin(0.1)
        operator.start_sim()
        patience = time.monotonic() + 1200
        while not (tmp_path / "wfe.npz").exists():
            operator.spin(0.5)
            assert time.monotonic() < patience, srtc.output
    finally:
        operator.destroy_node()
        rclpy.shutdown()
    assert recorder.interrupt() == 0

    with np.load(tmp_path / "wfe.npz") as result:
        frames, learns = result["frame"], result["high_order"][:, 0]
    from_here = round((AT + 2 * WINDOW) * RATE)

    def rms(numbers: np.ndarray, wfe: np.ndarray) -> float:
        return float(np.sqrt(np.mean(wfe[numbers >= from_here] ** 2))) * 1e9

    never, told = (rms(*in_lockstep(before, schedule, system)) for system in (None, after))
    regained = (never - rms(frames, learns)) / (never - told)
    print(f"never {never:.1f}, told {told:.1f}, learns {rms(frames, learns):.1f} nm, regained {100 * regained:.0f} %")
    print(srtc.output)
    assert never - told >= 10
    assert regained >= 0.8

    with BagReader(tmp_path / "bag") as bag:
        judged = [decode("msgs_schema/msg/ModelHealth", m.data) for m in bag.messages(bag.topic(wire.HEALTH.name))]
        profiles = [
            decode("msgs_schema/msg/AtmosphereProfile", m.data) for m in bag.messages(bag.topic(wire.PROFILE.name))
        ]
    swaps = [message for message in judged if message.decision == 1]
    assert swaps and all(message.text and message.candidate for message in swaps)
    assert min(message.last_frame for message in swaps) >= AT * RATE
    assert {profile.source for profile in profiles} >= {"file", "learned"}


@pytest.mark.parametrize(
    ("parameters", "why"),
    [
        (["window:=0.0"], "parameter window: expected at least 0.1, got 0"),
        (["method:=magic"], "parameter method: expected one of implicit, predictive, got 'magic'"),
        (["learn:=true", "interaction_matrix:=nowhere.npz"], "parameter interaction_matrix: nowhere.npz: No such file"),
        (["learn:=true", "window:=0.1"], "window: 0.1 s in 8 blocks leaves fewer than 2 counted frames a block"),
    ],
)
def test_wrong_parameters_are_refused_in_one_line(start_process: Any, parameters: list[str], why: str) -> None:
    words = [word for parameter in parameters for word in ("-p", parameter)]
    srtc = start_process("-m", "srtomo_ops.cli", "srtc", "mini", *words)
    assert srtc.wait(110) == 2, srtc.output
    assert why in srtc.output
    assert "Traceback" not in srtc.output
