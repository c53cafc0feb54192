"""Super-resolution itself, without noise or seed: waves above a sensor's Nyquist frequency."""

import numpy as np
import pytest

from srtomo_core.layout import Layout, SensorLayout
from srtomo_core.system import System, load_system
from srtomo_srtc.geometry import pupil_grid
from srtomo_srtc.mirrors import mirror_wavefronts
from srtomo_srtc.reconstructors.implicit import implicit

NYQUIST = 1.25  # cycles/m, of sub-apertures of 0.4 m


def _four_metres(shifts: list[list[float]]) -> System:
    """Four 10 x 10 sensors on the axis under a ground layer, on a mirror that can make 1.6 cycles/m."""
    mini = load_system("mini")
    star = mini.guide_stars[0].model_dump() | {"position": {"x": 0.0, "y": 0.0}, "tip_tilt": "seen", "jitter": 0.0}
    sensor = mini.sensors[0].model_dump() | {"subapertures": 10, "rotation": 0.0, "photons": 1e9}
    return mini.with_changes(
        {
            "atmosphere.layers": [mini.atmosphere.layers[0].model_dump() | {"fraction": 1.0}],
            "guide_stars": [star | {"name": f"lgs{i}"} for i in range(4)],
            "sensors": [
                sensor | {"name": f"lgs{i}", "guide_star": f"lgs{i}", "shift": shift} for i, shift in enumerate(shifts)
            ],
            "mirrors.0.actuators": 21,
            "science.targets": [mini.science.targets[0].model_dump()],
        }
    )


SHIFTED = _four_metres([[-0.25, -0.25], [-0.25, 0.25], [0.25, 0.25], [0.25, -0.25]])
ALIGNED = _four_metres([[0.0, 0.0]] * 4)


def _slopes_of_wave(place: SensorLayout, frequency: float, phase: float) -> np.ndarray:
    """x and y slopes of sin(2 pi f x + phase), averaged over the whole of each sub-aperture in closed form."""
    x, _ = place.to_pupil(*place.local.T)
    k = 2 * np.pi * frequency
    slope = k * np.sinc(frequency * place.size) * np.cos(k * x + phase)
    return np.concatenate([slope, np.zeros_like(slope)])


def _rebuilt(system: System, frequency: float, phase: float) -> float:
    """Share of the wave's variance over the inner pupil that is left after correction."""
    layout = Layout(system)
    slopes = np.concatenate([_slopes_of_wave(place, frequency, phase) for place in layout.sensors])
    commands = implicit(system)[0].R[0].astype(float) @ slopes
    grid = pupil_grid(system.telescope, 0.05)
    inner = (np.hypot(grid.x, grid.y) < 1.6) & (np.hypot(grid.x - 0.35, grid.y + 0.2) > 0.9)
    wave = np.sin(2 * np.pi * frequency * grid.x + phase)[inner]
    left = wave - (mirror_wavefronts(layout, grid.x, grid.y, system.science.targets[0].position) @ commands)[inner]
    return float(left.var() / wave.var())


@pytest.mark.parametrize("frequency", [1.4, 1.6])
@pytest.mark.parametrize("phase", [0.0, 1.3])
def test_waves_above_nyquist_are_rebuilt_by_shifted_sensors_only(frequency: float, phase: float) -> None:
    assert frequency > NYQUIST
    assert _rebuilt(SHIFTED, frequency, phase) < 0.1
    # aligned sensors take it for its alias at 2 x 1.25 - f
    assert _rebuilt(ALIGNED, frequency, phase) > 0.9


@pytest.mark.parametrize("system", [SHIFTED, ALIGNED], ids=["shifted", "aligned"])
def test_waves_below_nyquist_are_rebuilt_by_both(system: System) -> None:
    assert _rebuilt(system, 0.6, 0.4) < 0.02
