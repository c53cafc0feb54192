"""Influence functions from a file: the model and the plant read them alike, each in its own way."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

import srtomo_sim.mirror
import srtomo_srtc.mirrors
from srtomo_core.layout import Layout
from srtomo_core.system import Direction, load_system


def test_model_and_plant_agree(tmp_path: Path) -> None:
    system = load_system("mini", {"mirrors.0.actuators": 7, "mirrors.0.altitude": 4000.0})
    mirror = Layout(system).mirrors[0]
    step = mirror.pitch / 8
    u, v = np.meshgrid(*2 * [np.arange(-32, 33) / 8])
    functions = [
        (1 + 0.3 * math.cos(a) * u + 0.2 * u * v) * np.exp(-1.2 * u * u - 0.9 * v * v)
        for a in range(mirror.n_actuators)
    ]
    np.savez(tmp_path / "dm.npz", step=step, functions=functions)
    system = system.with_changes({"mirrors.0.influence": str(tmp_path / "dm.npz")})
    layout = Layout(system)
    layout.mirrors = (replace(layout.mirrors[0], rotation=0.3),)
    x, y = np.random.default_rng(0).uniform(-2, 2, (2, 300))
    towards = Direction(x=2e-5, y=-4e-5)
    np.testing.assert_allclose(
        srtomo_sim.mirror.mirror_phase(layout, x, y, towards),
        srtomo_srtc.mirrors.mirror_wavefronts(layout, x, y, towards),
        atol=1e-3,
    )
    model = srtomo_srtc.mirrors.interaction_matrix(system, layout)
    plant = srtomo_sim.mirror.interaction_matrix(system, layout)
    for w, place in enumerate(layout.sensors):
        own = layout.slopes_of(w)
        difference = np.abs(plant[own] - model[own]).max(axis=1) / np.abs(model[own]).max()
        # at the pupil's edge each weighs the light in cells of its own
        assert difference[np.tile(place.illumination > 0.9999, 2)].max(initial=0) < 3e-3
        assert difference.max() < 2e-2
