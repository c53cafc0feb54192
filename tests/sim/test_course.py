from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import Direction, InstrumentError, System
from srtomo_sim.course import Change, Course, moved, scheduled, travel
from srtomo_sim.mirror import interaction_matrix
from srtomo_sim.plant import Plant
from srtomo_sim.shack_hartmann import atmospheric_slopes, noise_sigma
from srtomo_sim.sky import Sky, prepare, wavefronts
from srtomo_sim.turbulence import Screens

FRAMES = 60


def layers(system: System, **lists: tuple[float, ...]) -> dict[str, float]:
    return {f"atmosphere.layers.{i}.{key}": value for key, values in lists.items() for i, value in enumerate(values)}


@pytest.fixture(scope="module")
def high(mini: System) -> System:
    """``mini`` with a layer that has no strength at first."""
    empty = {"altitude": 6000.0, "fraction": 0.0, "wind_speed": 10.0, "wind_direction": 0.0}
    kept = [layer.model_dump() for layer in mini.atmosphere.layers]
    return mini.with_changes({"atmosphere.layers": [*kept, empty], "guide_stars.*.jitter": 0.0})


@pytest.fixture(scope="module")
def changes() -> tuple[Change, ...]:
    profile = {f"atmosphere.layers.{i}.fraction": f for i, f in enumerate((0.3, 0.25, 0.05, 0.4))}
    return (
        Change(10, {"atmosphere.r0": "8 cm"}, over=8),
        Change(20, profile, over=6),
        Change(30, {"atmosphere.layers.*.wind_direction": "90 deg", "atmosphere.layers.1.wind_speed": "25 m/s"}),
        Change(35, {"sensors.*.photons": "2e4 e/m2/s"}, over=5),
        Change(45, {"sensors.1.shift": (0.15, -0.1), "sensors.1.rotation": "-5 deg"}),
    )


@pytest.fixture(scope="module")
def sky(high: System, changes) -> Sky:
    return prepare(high, FRAMES, 3, science_every=5, changes=changes)


def quiet(system: System) -> System:
    return system.with_changes({"sensors.*.photons": 1e20})


# -- the course alone ------------------------------------------------------------------------------------------------


def test_cn2_and_wind_go_linearly(high: System, changes) -> None:
    course = Course(high, changes)
    frames = np.arange(FRAMES)
    assert [(s.start, min(s.stop, FRAMES)) for s in course.stretches] == [
        (0, 10), (10, 18), (18, 20), (20, 26), (26, 30), (30, 35), (35, 40), (40, 45), (45, 60)
    ]  # fmt: skip
    cn2 = course.amplitude(frames) ** 2
    whole = (0.16 / 0.08) ** (5 / 3)
    assert cn2[:10] == pytest.approx(1) and cn2[18:] == pytest.approx(whole)
    assert cn2[10:18] == pytest.approx(1 + (whole - 1) * (np.arange(8) + 0.5) / 8)
    fractions = course.weights(frames) ** 2 * course.kept_at
    assert fractions.sum(axis=1) == pytest.approx(1)
    assert fractions[0] == pytest.approx([0.6, 0.25, 0.15, 0]) and fractions[26] == pytest.approx(
        [0.3, 0.25, 0.05, 0.4]
    )
    assert fractions[22] == pytest.approx(fractions[0] + 2.5 / 6 * (fractions[26] - fractions[0]))
    assert course.truth(14).atmosphere.r0 == pytest.approx(0.16 * cn2[14] ** (-3 / 5))
    assert course.truth(50).sensors[1].shift == (0.15, -0.1)
    # harmonic, as photon noise is what goes linearly
    assert 1 / course.truth(37).sensors[0].photons == pytest.approx(0.5 / 2e6 + 0.5 / 2e4)


def test_layers_have_gone_where_their_wind_took_them(high: System) -> None:
    turned = {"atmosphere.layers.1.wind_direction": 0.3, "atmosphere.layers.1.wind_speed": 30.0}
    course = Course(high, (Change(5, turned, over=10), Change(20, {"atmosphere.layers.1.wind_speed": 3.0})))
    fine = np.arange(0, 40, 1e-3) + 5e-4
    before, after = travel(high)[1], travel(high.with_changes(turned))[1]
    share = np.clip((fine - 5) / 10, 0, 1)[:, None]
    speed = (1 - share) * before + share * after
    speed[fine >= 20] *= 3 / 30
    steps = np.cumsum(speed, axis=0) * 1e-3
    frames = np.arange(39)
    assert course.gone(1, frames) == pytest.approx(steps[(frames * 1000 + 500) - 1], abs=1e-3 * np.abs(steps).max())
    wind = course.truth(9).atmosphere.layers[1]
    expected = (before + 0.45 * (after - before)) * high.loop.rate
    assert [wind.wind_speed * np.cos(wind.wind_direction), wind.wind_speed * np.sin(wind.wind_direction)] == (
        pytest.approx(expected)
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Change(3, {"atmosphere.outer_scale": 5.0}), "atmosphere.outer_scale: what may change while the plant runs is"),
        (Change(3, {"loop.rate": 100.0}), "loop.rate: what may change"),
        (Change(3, {"atmosphere.layers.0.altitude": 10.0}), "what may change"),
        (Change(3, {"atmosphere.layers.0.fraction": 0.1}), "fractions that sum to 1"),
        (Change(3, {"atmosphere.r0": "10 miles"}), "expected a length"),
        (Change(3, {"atmosphere.nonsense": 1.0}), "nonsense"),
        (Change(3, {"sensors.0.rotation": 0.1}, over=5), "moves at once"),
        (Change(3, {"sensors.0.shift": (8.0, 0.0)}), "no light"),
        (Change(-3, {"atmosphere.r0": 0.1}), "from frame 0 on"),
    ],
)
def test_refuses_what_cannot_change(high: System, sky: Sky, change: Change, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        replace(sky, course=Course(high)).changed(change)


def test_changes_may_not_overlap(high: System) -> None:
    with pytest.raises(InstrumentError, match="from frame 30 on, when the one before it has ended, got frame 29"):
        Course(high, (Change(10, {"atmosphere.r0": 0.1}, over=20), Change(29, {"atmosphere.r0": 0.2})))


def test_a_change_may_come_before_those_still_to_come(high: System) -> None:
    planned = Course(high, (Change(30, {"sensors.*.photons": 1e5}, over=5),))
    both = planned.extended(Change(10, {"atmosphere.r0": 0.1}, over=20))
    assert [change.frame for change in both.changes] == [10, 30]
    assert both.truth(50).atmosphere.r0 == 0.1 and both.truth(50).sensors[0].photons == 1e5
    with pytest.raises(InstrumentError, match="from frame 31 on"):
        planned.extended(Change(10, {"atmosphere.r0": 0.1}, over=21))


def test_schedule_in_seconds() -> None:
    entries = [{"at": 2.0, "set": {"atmosphere.r0": "10 cm"}, "over": 0.5}, {"at": 3, "set": {"a": 1}}]
    assert scheduled(entries, 200.0) == (Change(400, {"atmosphere.r0": "10 cm"}, 100), Change(600, {"a": 1}))
    for wrong in ({}, {"at": 1}, {"at": 1, "set": {}}, {"at": -1, "set": {"a": 1}}, {"at": 1, "set": {"a": 1}, "x": 1}):
        with pytest.raises(InstrumentError, match="schedule: expected"):
            scheduled([wrong], 200.0)


# -- the sky ----------------------------------------------------------------------------------------------------------


def test_before_the_first_change_nothing_has_changed(high: System, sky: Sky) -> None:
    still = prepare(high, FRAMES, 3, science_every=5)
    assert sky.slopes[:20].tobytes() == still.slopes[:20].tobytes()
    assert sky.turbulence(9).tobytes() == still.turbulence(9).tobytes()
    amplitude = np.sqrt(Course(high, sky.course.changes).amplitude(np.array([15])) ** 2)
    assert sky.turbulence(15) == pytest.approx(amplitude * still.slopes[15], rel=1e-6)
    assert sky.uncorrected(15) == pytest.approx(amplitude * still.uncorrected(15), rel=1e-6)
    assert sky.fitting_error()[3] == pytest.approx(amplitude[0] * still.fitting_error()[3], rel=1e-6)


def test_a_profile_weighs_each_layer(high: System, sky: Sky) -> None:
    """The layers one at a time, each alone in its sky, add up to the changed sky."""
    for frame in (15, 23, 28):
        total = np.zeros_like(sky.slopes[frame])
        for l in range(4):
            alone = high.with_changes(layers(high, fraction=tuple(float(l == i) for i in range(4))))
            mine = atmospheric_slopes(alone, sky.layout, Screens(alone, 3), frame + 1)[frame]
            total += np.sqrt(sky.course.truth(frame).atmosphere.fractions[l]) * mine
        assert sky.slopes[frame] == pytest.approx(total, abs=2e-6 * float(total.std()))


def test_the_wind_turns_without_a_jump(high: System, sky: Sky) -> None:
    """After the turn, a layer's pattern is found where its new wind carries it from where it was."""
    x, y = np.random.default_rng(1).uniform(-1, 1, (2, 50))
    before, after = (sky.course.truth(frame).atmosphere.layers for frame in (29, 44))
    for l in range(4):
        alone = Screens(high, 3, sky.course)
        alone._spectra = [spectrum * float(i == l) for i, spectrum in enumerate(alone._spectra)]
        # from the middle of exposure 29 to its end with one wind, to the middle of exposure 44 with the other
        way = np.zeros(2)
        for frames, wind in ((0.5, before[l]), (14.5, after[l])):
            length = frames / high.loop.rate * wind.wind_speed
            way += length * np.array([np.cos(wind.wind_direction), np.sin(wind.wind_direction)])
        first = wavefronts(alone, np.array([29]), x, y, Direction())[0]
        then = wavefronts(alone, np.array([44]), x + way[0], y + way[1], Direction())[0]
        assert then == pytest.approx(first, abs=1e-4 * float(first.std()))
        assert first.std() > 0


def test_a_moved_sensor_sees_sky_and_mirror_from_its_new_place(high: System, sky: Sky) -> None:
    there = sky.course.truth(50)
    place = sky.place(50)
    assert sky.place(44).layout is sky.layout and place.first == 45
    # the instrument built there from the start, but for sub-apertures that are valid at one place only
    built = Layout(there)
    moved_sensor, other = place.layout.sensors[1], built.sensors[1]
    assert moved_sensor.shift == pytest.approx(other.shift) and moved_sensor.rotation == pytest.approx(other.rotation)
    same = [(i, j) for i, a in enumerate(moved_sensor.local) for j, b in enumerate(other.local) if np.allclose(a, b)]
    assert len(same) > 0.8 * moved_sensor.n_valid
    i, j = np.array(same).T
    mine, theirs = sky.layout.slopes_of(1), built.slopes_of(1)
    G = interaction_matrix(there, built)
    assert place.interaction[mine][i] == pytest.approx(G[theirs][j], abs=2e-2 * np.abs(G).max())
    slopes = atmospheric_slopes(there, built, Screens(high, 3, sky.course), 5, first=50)
    x, expected = sky.slopes[50:55, mine][:, i], slopes[:, theirs][:, j]
    assert np.abs(x - expected).max() < 0.05 * expected.std()
    unmoved = slice(0, sky.layout.slopes_of(1).start)
    assert (place.interaction[unmoved] == sky.interaction[unmoved]).all()


def test_a_place_given_from_outside_moves_by_as_much(high: System) -> None:
    layout = Layout(high)
    after = high.with_changes({"sensors.0.shift": (0.2, -0.3)})
    was, now = layout.sensors[0], moved(layout, high.telescope, high, after).sensors[0]
    assert np.subtract(now.shift, was.shift) == pytest.approx([0.1 * was.size, 0.0])
    assert now.n_valid == was.n_valid and layout.sensors[0] is was


# -- the plant --------------------------------------------------------------------------------------------------------


def test_changing_on_the_way_is_the_same_as_planned(high: System, sky: Sky, changes) -> None:
    planned, plant = Plant(high, sky), Plant(high, prepare(high, FRAMES, 3, science_every=5))
    rng = np.random.default_rng(0)
    waiting = list(changes)
    anew = []
    for k in range(FRAMES):
        # each is called for a few frames ahead
        if waiting and waiting[0].frame - 3 == k:
            anew.append(plant.change(waiting.pop(0)))
        commands = 1e-7 * rng.standard_normal(sky.layout.n_commands)
        slopes = [p.measure(k) for p in (planned, plant)]
        assert slopes[0].tobytes() == slopes[1].tobytes(), k
        if k % 5 == 0:
            assert planned.wfe(k).high_order == pytest.approx(plant.wfe(k).high_order, rel=1e-9)
        for p in (planned, plant):
            p.command(k, commands)
    # r0 and light cost nothing
    assert anew == [False, True, True, False, True]


def test_catching_up_in_pieces(high: System, sky: Sky, changes) -> None:
    plant = Plant(high, prepare(high, FRAMES, 3, science_every=5))
    for change in changes:
        plant.change(change)
    assert plant.ready == 20
    while plant.ready < FRAMES:
        ready = plant.ready
        plant.catch_up(25)
        assert plant.ready == min(ready + 25, FRAMES)
    assert plant.sky.slopes.tobytes() == sky.slopes.tobytes()
    # how many frames a product holds shows in its last bits
    for mine, theirs in zip(plant.sky.targets, sky.targets, strict=True):
        assert mine.projection == pytest.approx(theirs.projection, abs=1e-12 * float(np.abs(theirs.projection).max()))
        assert mine.power == pytest.approx(theirs.power, rel=1e-9)
        assert mine.tip_tilt == pytest.approx(theirs.tip_tilt, rel=1e-9)


def test_too_late_is_refused_and_changes_nothing(high: System) -> None:
    plant = Plant(high, prepare(high, 10, 3))
    before = plant.measure(4)
    with pytest.raises(InstrumentError, match="frame 4: exposures up to 4 are over"):
        plant.change(Change(4, {"atmosphere.r0": 0.1}))
    with pytest.raises(InstrumentError):
        plant.change(Change(7, {"atmosphere.layers.0.fraction": 0.1}))
    assert plant.ready == 10 and plant.sky.course.changes == ()
    assert plant.measure(4).tobytes() == before.tobytes()


def test_flux_drifts_in_the_noises_variance(high: System) -> None:
    system = high.with_changes({"sensors.*.read_noise": 0.0})
    change = Change(100, {"sensors.*.photons": "2e4 e/m2/s"}, over=200)
    sky = prepare(system, 400, 3, science_every=400, changes=(change,))
    plant = Plant(system, sky)
    noise = np.array([plant.measure(k) - sky.turbulence(k) for k in range(400)])
    before = noise_sigma(system, sky.layout)
    after = noise_sigma(system.with_changes(change.values), sky.layout)
    assert (noise[:100] / before).std() == pytest.approx(1, abs=0.02)
    assert (noise[300:] / after).std() == pytest.approx(1, abs=0.02)
    assert (noise[150:250].var(axis=0) / ((before**2 + after**2) / 2)).mean() == pytest.approx(1, abs=0.04)
