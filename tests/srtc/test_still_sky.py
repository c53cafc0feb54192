"""The quick wavefront error against the prediction that forms every covariance of the pupil."""

from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.predict import Prediction, mean_wfe
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.still_sky import best_wfe, wfe_of


@pytest.fixture(scope="module")
def system() -> System:
    """Two mirrors, unequal weights, one of them none, and jitter on a star that is trusted with tip-tilt."""
    mini = load_system("mini")
    ground = mini.mirrors[0].model_dump()
    places = [(0.0, 0.0, 1.0), (2e-5, -1e-5, 0.4), (-3e-5, 1e-5, 0.0)]
    return mini.with_changes(
        {
            "mirrors": [ground, {**ground, "name": "high", "altitude": 6000.0, "actuators": 13, "pitch": 0.5}],
            "science.targets": [{"position": {"x": x, "y": y}, "weight": weight} for x, y, weight in places],
            "guide_stars.3.jitter": 1e-7,
        }
    )


def test_of_the_best_reconstructor(system: System) -> None:
    prediction = Prediction(system, lag=False)
    expected = mean_wfe(prediction.budgets(prediction.best()))
    assert best_wfe(system, threads=2) == pytest.approx(expected, rel=1e-3)


def test_of_a_given_reconstructor_elsewhere(system: System) -> None:
    R = implicit(system)[0].R[0].astype(float)
    nominal = Layout(system)
    moved = nominal.sensors[0]
    layout = Layout(system)
    layout.sensors = (replace(moved, shift=(moved.shift[0] + 0.1, moved.shift[1])), *nominal.sensors[1:])
    wrong = 0.05 * np.random.default_rng(2).standard_normal((len(R), len(R))) / np.sqrt(len(R))
    expected = mean_wfe(Prediction(system, layout, lag=False).budgets(R, wrong))
    assert wfe_of(R, system, layout, wrong) == pytest.approx(expected, rel=1e-3)
    assert expected > 1.02 * best_wfe(system)
