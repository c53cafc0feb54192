"""Designs: what is changed, what is found, and what is known of the answer."""

import math

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc import design
from srtomo_srtc.design import VARIABLES, changed, cuts, misalignment, optimise
from srtomo_srtc.predict import Prediction, mean_wfe
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.still_sky import best_wfe


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def pair(mini: System) -> System:
    """Two bright 6 x 6 sensors, aligned, on the axis under a ground layer; the mirror is finer than they are."""
    star = mini.guide_stars[0].model_dump() | {"position": {"x": 0.0, "y": 0.0}, "tip_tilt": "seen", "jitter": 0.0}
    sensor = mini.sensors[0].model_dump() | {
        "subapertures": 6,
        "rotation": 0.0,
        "photons": 1e8,
        "shift": (0.0, 0.0),
        "illumination_threshold": 0.3,
    }
    return mini.with_changes(
        {
            "atmosphere.layers": [mini.atmosphere.layers[0].model_dump() | {"fraction": 1.0}],
            "guide_stars": [star | {"name": f"lgs{i}"} for i in range(2)],
            "sensors": [sensor | {"name": f"lgs{i}", "guide_star": f"lgs{i}"} for i in range(2)],
            "science.targets": [mini.science.targets[0].model_dump()],
        }
    )


def test_the_best_reconstructor_is_the_one_that_is_built(mini: System) -> None:
    prediction = Prediction(mini, lag=False)
    built = implicit(mini)[0].R[0].astype(float)
    assert np.linalg.norm(prediction.best() - built) < 1e-6 * np.linalg.norm(built)
    assert best_wfe(mini) == pytest.approx(mean_wfe(prediction.budgets(built)), rel=1e-3)


@pytest.mark.parametrize("kind", sorted(VARIABLES))
def test_variables_at_their_start_change_nothing(mini: System, kind: str) -> None:
    variables = VARIABLES[kind](mini)
    same = changed(mini, variables, [v.start for v in variables])
    assert Layout(same).fingerprint == Layout(mini).fingerprint or kind == "clockings"
    for before, after in zip(mini.sensors, same.sensors):
        assert after.rotation == pytest.approx(before.rotation)
    assert all(v.low <= v.start <= v.high for v in variables)


def test_variables_do_what_they_say(mini: System) -> None:
    shifts = design.shifts(mini)
    assert len(shifts) == 6  # the whole-pupil sensor has none
    moved = changed(mini, shifts, [0.1, 0.2, 0.3, 0.4, -0.1, -0.2])
    assert [s.shift for s in moved.sensors[:3]] == [(0.1, 0.2), (0.3, 0.4), (-0.1, -0.2)]
    turned = changed(mini, design.clockings(mini), [10.0, -20.0, 30.0])
    assert [s.rotation for s in turned.sensors[:3]] == pytest.approx(np.radians([10, -20, 30]).tolist())
    wide = changed(mini, design.asterism(mini), [2.0])
    assert wide.guide_stars[0].position.x == pytest.approx(2 * mini.guide_stars[0].position.x)
    assert wide.guide_stars[3] == mini.guide_stars[3]
    coarse, fine = (Layout(changed(mini, design.pitch(mini), [factor])).mirrors[0] for factor in (2.0, 0.5))
    assert (coarse.pitch, len(coarse.mask)) == (pytest.approx(0.8), 6)
    assert (fine.pitch, len(fine.mask)) == (pytest.approx(0.2), 21)


def test_two_sensors_want_to_be_interlaced(pair: System) -> None:
    """Aligned, two sensors on one star see no more than one; super-resolution needs them apart."""
    variables = design.shifts(pair)[2:]  # of the second sensor
    found = optimise(pair, variables, evaluations=24)
    assert found.evaluations <= 24
    assert found.start_wfe == pytest.approx(best_wfe(pair))
    assert found.wfe < found.start_wfe - 20e-9
    assert np.abs(found.values).max() > 0.25
    lines = cuts(pair, variables, found.values, points=3)
    assert [len(line.wfe) for line in lines] == [3, 3]
    assert min(line.wfe.min() for line in lines) > found.wfe - 0.5e-9
    assert all(v.low <= cut.values.min() and cut.values.max() <= v.high for v, cut in zip(variables, lines))


def test_misalignment_costs_quadratically_at_first(mini: System) -> None:
    amounts = (0.0, 0.05, 0.1)
    errors = misalignment(mini, amounts, draws=2)
    assert errors[0] == pytest.approx(best_wfe(mini), rel=1e-3)
    extra = errors**2 - errors[0] ** 2
    assert extra[2] / extra[1] == pytest.approx(4, rel=0.25)
    assert 0.5e-9 < errors[2] - errors[0] < 5e-9


def test_a_search_for_nothing_is_refused(mini: System) -> None:
    with pytest.raises(ValueError, match="something to vary"):
        optimise(mini, [])
    with pytest.raises(ValueError, match="at least 16 evaluations"):
        optimise(mini, design.shifts(mini), evaluations=10)


def test_what_cannot_be_built_is_passed_over(pair: System) -> None:
    """Where the instrument is refused, a place counts as infinitely bad."""
    bad = design.Variable("r0", 0.0, 1.0, 0.4, lambda now, value: {"atmosphere.r0": 0.16 if value < 0.5 else -1.0})
    found = optimise(pair, [bad], evaluations=8)
    assert math.isfinite(found.wfe)
    assert found.values[0] < 0.5
