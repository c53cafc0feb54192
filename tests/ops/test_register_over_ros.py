"""``srtomo register`` on bags that the nodes made, of a plant whose sensors are not where the file has them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from srtomo_core.system import load_system
from srtomo_ops.cli import main
from srtomo_ops.commands.calibrate import calibrate

pytest.importorskip("rclpy", reason="needs rclpy: pip install '.[ros]', or source ROS 2 Jazzy")

import rclpy

from srtomo_ops.dither import Dither
from srtomo_ops.operator import Operator

RATE, SECONDS = 250, 24
MOVED = {"sensors.0.shift": ["0.2 subaperture", "-0.3 subaperture"], "sensors.1.rotation": "-6 deg"}
"""By 0.1 sub-aperture along x, and by 1 degree."""
LIMITS = 0.03, 0.03, 0.4
"""Of the errors that are stated, sub-apertures and degrees."""


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("dithered", [False, True])
def test_what_the_nodes_recorded(
    start_process: Any, close_on_the_file: Callable[[Operator], None], tmp_path: Path, dithered: bool
) -> None:
    sets = ["--set", f"loop.rate={RATE} Hz"]
    system = load_system("mini", {"loop.rate": f"{RATE} Hz"})
    matrix, bag, places = tmp_path / "G.npz", tmp_path / "bag", tmp_path / "places.json"
    calibrate(system, matrix)
    command = "-m", "srtomo_ops.cli"
    start_process(
        *command, "sim", "mini", *sets, "-p", f"frames:={(SECONDS + 6) * RATE}",
        "-p", f"schedule:='{json.dumps([{'at': 0, 'set': MOVED}])}'",
    )  # fmt: skip
    start_process(*command, "srtc", "mini", *sets)
    start_process(*command, "hrtc", "mini", *sets, "-p", f"interaction_matrix:={matrix}")
    recorder = start_process(*command, "record", "mini", *sets, "-o", bag)
    rclpy.init()
    operator = Operator(patience=600.0)
    try:
        close_on_the_file(operator)
        operator.spin(2.0)
        if dithered:
            print("changes of sign:", Dither(system, 5e-9).run(operator, SECONDS))
        else:
            operator.spin(SECONDS)
    finally:
        operator.destroy_node()
        rclpy.shutdown()
    assert recorder.interrupt() == 0

    assert main(["register", str(bag), "--json", str(places), "--tolerance", "0.05"]) == 1
    content = json.loads(places.read_text())
    assert content["from"].endswith(", dither") == dithered
    for row, *truth in zip(content["sensors"], (0.1, 0, 0), (0, 0, 0), (0, 1, 0), strict=True):
        for name, true, limit in zip(("shift_x_subaperture", "shift_y_subaperture", "rotation_deg"), truth, LIMITS,
                                     strict=True):  # fmt: skip
            assert row[f"{name}_sigma"] < limit
            assert abs(row[name] - true) < 4 * row[f"{name}_sigma"], (row["sensor"], name)
