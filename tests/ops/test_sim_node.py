"""``sim/change``: the plant's process changes while it runs, and what it publishes is what it says it is."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.system import load_system
from srtomo_ops import cli
from srtomo_sim.course import Change
from srtomo_sim.plant import Plant
from srtomo_sim.sky import prepare

rclpy = pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

from msgs_schema.msg import AtmosphereProfile, SlopeFrame, TelescopeStatus
from rclpy.qos import QoSProfile

from srtomo_ops.operator import Operator, OperatorError

FRAMES = 1000
CHANGES = {"atmosphere.outer_scale": "8 m"}
R0 = {"atmosphere.r0": "8 cm"}
WIND = {"atmosphere.layers.*.wind_direction": "160 deg"}
PLANNED = {"at": 0.5, "set": {"sensors.0.photons": "1e5 e/m2/s"}}


@pytest.mark.timeout(300)
def test_a_running_plant_changes_as_it_says(start_process) -> None:
    sim = start_process(
        *("-m", "srtomo_ops.cli", "sim", "mini", "--set", "atmosphere.outer_scale=8 m"),
        *("-p", f"frames:={FRAMES}", "-p", f"schedule:='{json.dumps([PLANNED])}'"),
    )
    rclpy.init()
    operator = Operator(patience=150.0)
    slopes: list[bytes] = []
    truths: list[AtmosphereProfile] = []
    telescope: list[TelescopeStatus] = []
    for kind, topic, store in (
        (SlopeFrame, wire.SLOPES, slopes),
        (AtmosphereProfile, wire.SIM_PROFILE, truths),
        (TelescopeStatus, wire.TELESCOPE, telescope),
    ):
        depth = 8 * FRAMES if kind is SlopeFrame else None
        operator.create_subscription(
            kind, topic.name, store.append, QoSProfile(**topic.qos(depth)), raw=kind is SlopeFrame
        )
    try:
        with pytest.raises(OperatorError, match="what may change while the plant runs is"):
            operator.change_sky({"loop.rate": "100 Hz"})
        operator.start_sim()
        while operator.sim is None or operator.sim.frame < 120:
            operator.spin(0.05)
        first = operator.change_sky(R0, over=0.5)
        with pytest.raises(OperatorError, match="when the one before it has ended"):
            operator.change_sky(R0)
        second = operator.change_sky(WIND, after=1.0)
        ctl = start_process(
            *("-m", "srtomo_ops.cli", "ctl", "sky", "--set", "sensors.0.rotation=2 deg", "--over", "1s"),
        )
        while operator.sim.frame < FRAMES - 1:
            operator.spin(0.05)
        operator.spin(0.3)
        assert ctl.wait() != 0 and "a sensor moves at once" in ctl.output
        last = operator.sim
    finally:
        operator.destroy_node()
        rclpy.shutdown()
    # nothing waits for what is at hand; what has to be computed anew begins some seconds later
    assert 120 <= first < 300 and first + 350 <= second < FRAMES - 100
    system = load_system("mini", CHANGES)
    changes = (Change(100, PLANNED["set"]), Change(first, R0, over=100), Change(second, WIND))
    plant = Plant(system, prepare(system, FRAMES, 1, science_every=FRAMES, changes=changes))
    frames = [wire.read_slope_frame(data) for data in slopes]
    assert len(frames) == 4 * FRAMES
    for frame in frames[:: 4 * 23]:
        expected = plant.measure(frame.frame)[plant.sky.layout.slopes_of(frame.sensor)]
        assert frame.slopes.tobytes() == expected.tobytes(), frame.frame
    assert last.changes == 3 and last.photons[:2] == pytest.approx([1e5, 1.5e6])
    assert truths[0].r0 == pytest.approx(0.16) and truths[-1].r0 == pytest.approx(0.08)
    # the truth is its own interval
    assert {(t.outer_scale_low, t.outer_scale, t.outer_scale_high) for t in truths} == {(8.0, 8.0, 8.0)}
    assert truths[-1].wind_direction == pytest.approx([math.radians(160)] * 3)
    assert len(truths) >= 5  # the drift shows
    assert telescope[0].elevation == pytest.approx(math.radians(70)) and telescope[0].sodium_height == 90e3
    assert sim.interrupt() == 0, sim.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("ctl", "sky"), "--set: expected with sky"),
        (("ctl", "close", "--set", "a=1"), "--set: expected with sky, and only there"),
        (("ctl", "sky", "--set", "r0"), "--set r0: expected KEY=VALUE"),
        (("simulate", "mini", "--at", "1", "over=2"), "--at 1: expected KEY=VALUE after it"),
        (("simulate", "mini", "--at", "x", "atmosphere.r0=1 m"), "expected a time such as '10 s'"),
        (("simulate", "mini", "--at", "1", "loop.rate=1 Hz"), "what may change while the plant runs"),
    ],
)
def test_bad_words_are_refused_in_a_line(words, message: str, capsys) -> None:
    assert cli.main(list(words)) != 0
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error


def test_simulate_shows_what_a_change_does(tmp_path: Path) -> None:
    small = ("simulate", "mini", "--set", "atmosphere.outer_scale=8 m", "--frames", "400")
    assert cli.main([*small, "--at", "1 s", "atmosphere.r0=6 cm", "--json", str(tmp_path / "run.json")]) == 0
    numbers = json.loads((tmp_path / "run.json").read_text())
    assert numbers["changes"] == [{"frame": 200, "over": 0, "set": {"atmosphere.r0": "6 cm"}}]
    before, after = (stretch["wfe_nm"] for stretch in numbers["stretches"])
    # everything but noise scales with the strength
    assert 1.5 < after / before < np.sqrt((0.16 / 0.06) ** (5 / 3))
