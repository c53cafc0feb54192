"""The predictive reconstructor against the static one, and against the wind."""

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.predict import Prediction
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.reconstructors.predictive import predictive
from srtomo_srtc.wind import effective_lag, winds


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


def _turned(system: System, angle: float) -> System:
    return system.with_changes(
        {
            f"atmosphere.layers.{l}.wind_direction": layer.wind_direction + angle
            for l, layer in enumerate(system.atmosphere.layers)
        }
    )


def test_winds_go_where_they_blow(mini: System) -> None:
    np.testing.assert_allclose(winds(mini)[1], [12 * np.cos(np.radians(100)), 12 * np.sin(np.radians(100))])
    dark = mini.with_changes({"atmosphere.layers.0.fraction": 0.0, "atmosphere.layers.1.fraction": 0.85})
    np.testing.assert_allclose(winds(dark), winds(mini)[1:])


def test_lag_is_delay_and_filter(mini: System) -> None:
    assert effective_lag(mini.loop) == pytest.approx((2 + 1) / 200)
    assert effective_lag(mini.with_changes({"loop.gain": 1.0}).loop) == pytest.approx(2 / 200)


def test_without_wind_or_delay_it_is_the_static_one(mini: System) -> None:
    static = implicit(mini)[0]
    assert np.array_equal(predictive(mini, lag=0.0)[0].R, static.R)
    calm = mini.with_changes({"atmosphere.layers.*.wind_speed": 0.0})
    np.testing.assert_allclose(predictive(calm)[0].R, static.R, atol=1e-6 * np.abs(static.R).max())


def test_a_uniform_wind_shifts_the_estimate(mini: System) -> None:
    """All layers gone by d: what is estimated at x is what the static reconstructor estimates at x - d."""
    wind = {"atmosphere.layers.*.wind_speed": 10.0, "atmosphere.layers.*.wind_direction": 0.0}
    step = 0.4  # one actuator along x
    later = predictive(mini.with_changes(wind), lag=step / 10)[0].R[0].astype(float)
    now = implicit(mini)[0].R[0].astype(float)
    # a smooth wavefront that every sensor sees alike: x^2 - y^2 as slopes
    layout = Layout(mini)
    slopes = []
    for place in layout.sensors[:3]:
        x, y = place.to_pupil(*place.local.T)
        c, s = np.cos(place.rotation), np.sin(place.rotation)
        gx, gy = 2 * x, -2 * y
        slopes += [c * gx + s * gy, c * gy - s * gx]
    slopes = np.concatenate([*slopes, np.zeros(2)]) * 1e-7
    ax, ay = layout.mirrors[0].actuators.T
    inner = np.hypot(ax, ay) < 1.3
    for R, moved in ((now, 0.0), (later, step)):
        got = (R @ slopes)[inner]
        wanted = 1e-7 * ((ax - moved) ** 2 - ay**2)[inner]
        basis = np.stack([np.ones(inner.sum()), ax[inner], ay[inner]], axis=1)
        # commands of a smooth shape are the shape over the sum of influence functions; piston and tip-tilt are free
        got, wanted = (v - basis @ np.linalg.lstsq(basis, v, rcond=None)[0] for v in (got, wanted))
        assert got @ wanted / np.sqrt((got @ got) * (wanted @ wanted)) > 0.98


def test_prediction_gains_and_a_reversed_wind_costs(mini: System) -> None:
    prediction = Prediction(mini)
    static, right, wrong = (
        [b.wfe for b in prediction.budgets(R.R[0])]
        for R in (implicit(mini)[0], predictive(mini)[0], predictive(_turned(mini, np.pi))[0])
    )
    for a, b, c in zip(static, right, wrong):
        assert b < a - 15e-9
        assert c > a + 15e-9


def test_provenance_says_what_it_is(mini: System) -> None:
    provenance = predictive(mini)[0].provenance
    assert provenance["method"] == "predictive"
    assert provenance["lag_s"] == effective_lag(mini.loop)
