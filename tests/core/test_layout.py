"""Where sub-apertures and actuators are, in which order, and what the fingerprint stands for."""

import math
from fnmatch import fnmatch
from functools import cache

import numpy as np
import pytest

from srtomo_core.layout import Layout, is_lit_around, transmission
from srtomo_core.system import System, load_system


@pytest.mark.parametrize(
    "name, subapertures, actuators",
    [("gnao_ltao", 312, 365), ("gnao_ltao_sr", None, 732), ("gnao_ltao_ideal", 704, 777)],
)
def test_counts(name, subapertures, actuators):
    """Sub-apertures lit to half or more, actuators within D/2 + 0.8 pitch: as an independent implementation found."""
    system = load_system(name)
    layout = Layout(system)
    assert layout.n_commands == actuators
    if subapertures is not None:
        assert [sensor.n_valid for sensor in layout.sensors[:4]] == [subapertures] * 4
    assert layout.n_slopes == 2 * sum(sensor.n_valid for sensor in layout.sensors)
    assert layout.sensors[4].n_valid == 1
    unshifted = Layout(system.with_changes({"sensors.*.shift": (0.0, 0.0)}))
    assert unshifted.sensors[0].n_valid == (704 if name.endswith("ideal") else 312)


def test_valid_subapertures_against_a_fine_count():
    """Light over a sub-aperture, counted on an independent fine grid turned and moved with the sensor."""
    system = load_system("mini")
    layout = Layout(system)
    across = 100
    for sensor, own in zip(system.sensors, layout.sensors, strict=True):
        n, size = sensor.subapertures, system.telescope.diameter / sensor.subapertures
        c, s = math.cos(sensor.rotation), math.sin(sensor.rotation)
        light = np.zeros((n, n))
        for row in range(n):
            for column in range(n):
                steps = (np.arange(across) + 0.5) / across
                x = (column - n / 2 + steps[None, :]) * size
                y = (row - n / 2 + steps[:, None]) * size
                px = c * x - s * y + sensor.shift[0] * size
                py = s * x + c * y + sensor.shift[1] * size
                lit = (px**2 + py**2 <= 4) & ((px - 0.35) ** 2 + (py + 0.2) ** 2 > 0.25)
                light[row, column] = lit.mean()
        clear = abs(light - 0.5) > 0.01
        assert np.array_equal(own.mask[clear], light[clear] >= 0.5)
        assert own.illumination == pytest.approx(light[own.mask], abs=0.01)
        assert own.n_slopes == 2 * own.mask.sum()


def test_c_order_of_the_mask():
    """``[y, x]``: x runs fastest, y upwards."""
    layout = Layout(load_system("mini"))
    for sensor in layout.sensors[:3]:
        rows, columns = np.nonzero(sensor.mask)
        assert sensor.local[:, 0] == pytest.approx((columns - 3.5) * 0.5)
        assert sensor.local[:, 1] == pytest.approx((rows - 3.5) * 0.5)
        assert not np.array_equal(sensor.mask, sensor.mask.T)  # or this would prove nothing
    (mirror,) = layout.mirrors
    rows, columns = np.nonzero(mirror.mask)
    assert mirror.actuators == pytest.approx(np.stack([(columns - 5) * 0.4, (rows - 5) * 0.4], axis=1))


def test_rotated_about_the_pupil_then_shifted():
    """Eq. 33-34: a point of the sensor is turned counter-clockwise, then moved by +shift, not the reverse."""
    system = load_system("mini").with_changes(
        {"sensors.0.rotation": math.pi / 2, "sensors.0.shift": (0.5, -0.25), "sensors.0.illumination_threshold": 0.1}
    )
    sensor = Layout(system).sensors[0]
    assert sensor.shift == pytest.approx((0.25, -0.125))  # m: sub-apertures of half a metre
    x, y = sensor.to_pupil(np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    assert x == pytest.approx([0.25, -0.75])
    assert y == pytest.approx([0.875, -0.125])


def test_points_cover_each_subaperture():
    sensor = Layout(load_system("mini")).sensors[1]
    x, y = sensor.points(10)
    assert x.shape == y.shape == (sensor.n_valid, 10, 10)
    assert np.stack([x.mean(axis=(1, 2)), y.mean(axis=(1, 2))]) == pytest.approx(
        np.stack(sensor.to_pupil(sensor.local[:, 0], sensor.local[:, 1]))
    )
    step = np.hypot(x[:, 0, 1] - x[:, 0, 0], y[:, 0, 1] - y[:, 0, 0])  # the last index runs along the sensor's x
    assert step == pytest.approx(sensor.size / 10)
    along = np.stack([x[0, 0, 1] - x[0, 0, 0], y[0, 0, 1] - y[0, 0, 0]]) / step[0]
    assert along == pytest.approx([math.cos(math.radians(-7)), math.sin(math.radians(-7))])


def test_slices():
    layout = Layout(load_system("mini"))
    assert [layout.slopes_of(w).stop - layout.slopes_of(w).start for w in range(4)] == [
        sensor.n_slopes for sensor in layout.sensors
    ]
    assert layout.slopes_of(0).start == 0 and layout.slopes_of(3).stop == layout.n_slopes
    assert layout.commands_of(0) == slice(0, layout.n_commands)
    assert layout.stroke == pytest.approx(np.full(layout.n_commands, 10e-6))


def test_a_mirror_at_a_height_covers_the_field():
    """The footprint of every star and target, and the margin, are within the actuators."""
    system = load_system("mini").with_changes({"mirrors.0.altitude": 5e3, "mirrors.0.actuators": 31})
    mirror = Layout(system).mirrors[0]
    height = 5e3 / math.cos(math.radians(20))
    assert mirror.altitude == pytest.approx(height)
    field = max(math.hypot(star.position.x, star.position.y) for star in system.guide_stars)
    reach = 2.0 + height * field + 0.8 * mirror.pitch
    distance = np.hypot(*mirror.actuators.T)
    assert distance.max() <= reach + 1e-9 and distance.max() > reach - mirror.pitch


def test_transmission():
    telescope = load_system("mini").telescope
    x = np.array([0.0, 0.35, 1.99, 2.01, 0.35 + 0.51, 0.0])
    y = np.array([0.0, -0.2, 0.0, 0.0, -0.2, -2.0])
    assert transmission(telescope, x, y).tolist() == [0, 0, 1, 0, 1, 1]


def test_lit_around_is_lit_at_every_point_around():
    spiders = [{"angle": "20 deg", "width": "5 cm"}, {"angle": "200 deg", "width": "5 cm"}]
    telescope = load_system("mini", {"telescope.spiders": spiders}).telescope
    draw = np.random.default_rng(2)
    x, y = draw.uniform(-2.2, 2.2, (2, 4000))
    reach = 0.2
    radius, angle = reach * np.sqrt(draw.uniform(0, 1, (400, 1))), draw.uniform(0, 2 * np.pi, (400, 1))
    light = transmission(telescope, x + radius * np.cos(angle), y + radius * np.sin(angle)).min(axis=0)
    around = is_lit_around(telescope, x, y, reach)
    assert not around[light == 0].any()
    # where it only just is, 400 points miss the edge, and a spider's end is not looked at closely
    assert around.sum() > 0.9 * light.sum() > 500


def test_a_sensor_without_light_is_refused():
    with pytest.raises(ValueError, match="sensor ngs1: no sub-aperture is lit"):
        Layout(load_system("mini", {"sensors.3.illumination_threshold": 1.0}))


# -- the fingerprint -------------------------------------------------------------------------------------------------

MATTERS = {
    "telescope.diameter": 4.1,
    "telescope.obscuration": 0.3,
    "telescope.obscuration_centre": (0.36, -0.2),
    "telescope.spiders": [{"width": 0.01, "angle": 0.3}],
    "zenith_angle": 0.36,
    "guide_stars.0.position.x": 4e-5,
    "guide_stars.0.position.y": 4e-5,
    "guide_stars.0.altitude": 91e3,
    "guide_stars.0.tip_tilt": "seen",
    "guide_stars.0.focus": "blind",
    "sensors.0.guide_star": "lgs2",
    "sensors.0.subapertures": 9,
    "sensors.0.illumination_threshold": 0.7,
    "sensors.0.shift": (0.1, -0.31),
    "sensors.0.rotation": 0.071,
    "mirrors.0.altitude": 100.0,
    "mirrors.0.actuators": 12,
    "mirrors.0.pitch": 0.41,
    "mirrors.0.coupling": 0.31,
    "mirrors.0.margin": 1.5,
    "mirrors.0.grid": "hexagonal",
    "loop.tip_tilt": {"rate": 40.0, "gain": 0.5},
}
"""What slopes and commands depend on, with another value."""

DOES_NOT_MATTER = {
    "name": "other",
    "description": "other",
    "telescope.altitude": 100.0,
    "atmosphere.r0": 0.1,
    "atmosphere.outer_scale": 10.0,
    "atmosphere.layers": load_system("gnao_ltao").atmosphere.layers,
    "guide_stars.0.jitter": 0.0,
    "sensors.0.name": "other",
    "sensors.0.photons": 1e3,
    "sensors.0.spot_fwhm": 1e-5,
    "sensors.0.excess_noise": 1.0,
    "sensors.0.read_noise": 3.0,
    "sensors.0.pixels": 8,
    "sensors.0.pixel_scale": 1e-6,
    "sensors.0.field_stop": 2e-5,
    "sensors.0.noise_covariance": "noise.npz",
    "mirrors.0.name": "other",
    "mirrors.0.stroke": 5e-6,
    "science.wavelength": 1e-6,
    "science.targets.0.weight": 0.1,
    "science.targets.0.position.x": 1e-5,
    "science.targets.0.position.y": 1e-5,
    "loop.rate": 100.0,
    "loop.delay": 3.0,
    "loop.gain": 0.1,
    "loop.leak": 0.1,
}
"""What changes the quality of a reconstructor, but not its meaning."""

ELONGATED = {"guide_stars.0.launch": (4.0, 0.0), "guide_stars.0.sodium_thickness": 1e4}

SPECIAL = ("guide_stars.0.name", "guide_stars.0.kind", "mirrors.0.influence", *ELONGATED)  # have tests of their own


def keys_of(node, path="") -> set[str]:
    if isinstance(node, dict):
        return set().union(*(keys_of(value, f"{path}.{key}" if path else key) for key, value in node.items()))
    if isinstance(node, list | tuple) and node and isinstance(node[0], dict):
        return keys_of(node[0], f"{path}.0")
    return {path}


def test_every_key_of_an_instrument_is_known_to_matter_or_not():
    keys = keys_of(load_system("mini").model_dump())
    known = {*MATTERS, *DOES_NOT_MATTER, *SPECIAL}
    unknown = {key for key in keys if key not in known and not fnmatch(key, "atmosphere.layers.*")}
    assert not unknown, "decide whether the fingerprint depends on it"


@cache
def fingerprint(system: System) -> bytes:
    return Layout(system).fingerprint


@pytest.mark.parametrize("key", MATTERS)
def test_the_fingerprint_changes_with_what_matters(key):
    system = load_system("mini")
    assert fingerprint(system.with_changes({key: MATTERS[key]})) != fingerprint(system)


@pytest.mark.parametrize("key", DOES_NOT_MATTER)
def test_the_fingerprint_does_not_change_with_anything_else(key):
    system = load_system("mini")
    assert fingerprint(system.with_changes({key: DOES_NOT_MATTER[key]})) == fingerprint(system)


def test_the_fingerprint_does_not_change_with_the_spots():
    system = load_system("mini")
    assert fingerprint(system.with_changes(ELONGATED)) == fingerprint(system)


def test_the_fingerprint_knows_influence_functions_by_what_they_are(tmp_path):
    functions = np.pad(np.ones((1, 1)), 3)
    np.savez(tmp_path / "a.npz", step=0.1, functions=functions)
    np.savez(tmp_path / "b.npz", step=0.1, functions=functions[None])
    np.savez(tmp_path / "c.npz", step=0.1, functions=1.01 * functions)
    np.savez(tmp_path / "d.npz", step=0.11, functions=functions)
    a, b, c, d = (fingerprint(load_system("mini", {"mirrors.0.influence": str(tmp_path / f"{n}.npz")})) for n in "abcd")
    assert a == b and len({a, c, d, fingerprint(load_system("mini"))}) == 4


def test_fingerprints_of_instruments_with_square_gaussian_mirrors_stay():
    """Bags and reconstructors on disk depend on it."""
    assert fingerprint(load_system("mini")).hex().startswith("536a7be36c9d6c8e")


def test_a_hexagonal_mirror_is_of_equilateral_triangles():
    mirror = Layout(load_system("mini", {"mirrors.0.grid": "hexagonal"})).mirrors[0]
    distance = np.hypot(*(mirror.actuators[:, None, i] - mirror.actuators[None, :, i] for i in range(2)))
    neighbours = np.abs(distance - mirror.pitch) < 1e-9
    assert neighbours.sum(axis=1).max() == 6
    assert np.all(neighbours.sum(axis=1)[np.hypot(*mirror.actuators.T) < 1.5] == 6)
    assert distance[distance > 0].min() == pytest.approx(mirror.pitch)
    # a point grid turned by 60 degrees is itself
    c, s = math.cos(math.pi / 3), math.sin(math.pi / 3)
    turned = mirror.actuators @ np.array([[c, s], [-s, c]])
    inner = np.hypot(*turned.T) < 1.6
    there = np.hypot(*(turned[inner][:, None, i] - mirror.actuators[None, :, i] for i in range(2)))
    assert there.min(axis=1) == pytest.approx(0, abs=1e-9)
    assert np.hypot(*mirror.actuators.T).max() <= 2.0 + 0.8 * mirror.pitch
    # its density: one to every half sqrt(3) pitches squared
    assert mirror.n_actuators == pytest.approx(math.pi * 2.2**2 / (math.sqrt(3) / 2 * mirror.pitch**2), rel=0.1)
    order = np.lexsort(mirror.actuators.T)
    assert np.array_equal(order, np.arange(mirror.n_actuators))


def test_the_fingerprint_knows_the_order():
    system = load_system("mini")
    tree = system.model_dump()
    tree["sensors"] = (tree["sensors"][1], tree["sensors"][0], *tree["sensors"][2:])
    assert fingerprint(System.model_validate(tree)) != fingerprint(system)
    tree = system.model_dump()
    tree["guide_stars"] = tuple(reversed(tree["guide_stars"]))  # sensors name their stars
    assert fingerprint(System.model_validate(tree)) == fingerprint(system)


def test_the_fingerprint_is_the_same_every_time():
    """Also of an instrument that came out of a bag."""
    names = ("mini", "gnao_ltao", "gnao_ltao_sr", "gnao_ltao_ideal")
    first = [fingerprint(load_system(name)) for name in names]
    assert len(set(first)) == len(names)
    assert all(len(one) == 32 for one in first)
    again = System.model_validate_json(load_system("mini").model_dump_json())
    assert Layout(again).fingerprint == first[0]


def test_a_spider_is_a_dark_strip_on_one_side():
    telescope = load_system(
        "mini", {"telescope.spiders": [{"width": "20 cm", "angle": "90 deg"}, {"width": "10 cm", "angle": "200 deg"}]}
    ).telescope
    bare = telescope.model_copy(update={"spiders": ()})
    x, y = np.meshgrid(np.linspace(-2, 2, 800), np.linspace(-2, 2, 800))
    dark = (transmission(bare, x, y) == 1) & (transmission(telescope, x, y) == 0)
    up = (np.abs(x) < 0.1) & (y >= 0)
    angle = np.arctan2(y, x) - np.deg2rad(200)
    other = (np.abs(np.hypot(x, y) * np.sin(angle)) < 0.05) & (np.cos(angle) >= 0)
    assert np.array_equal(dark, (up | other) & (transmission(bare, x, y) == 1))
    assert dark.sum() > 4000
