"""Instrument files: read with their units, refused in one line that names the key and what was expected."""

import copy
import math
from importlib import resources

import pytest
import yaml
from pydantic import ValidationError

from srtomo_core.layout import Layout
from srtomo_core.system import InstrumentError, System, describe, load_system, system_names
from srtomo_core.units import ARCSEC, parse

MINI = yaml.safe_load((resources.files("srtomo_core") / "systems" / "mini.yaml").read_text())


def changed(path, value):
    """The content of ``mini.yaml`` with one key replaced, added, or (None) left out."""
    tree = copy.deepcopy(MINI)
    *outer, last = [int(part) if part.isdecimal() else part for part in path.split(".")]
    node = tree
    for part in outer:
        node = node[part]
    if value is None:
        del node[last]
    else:
        node[last] = value
    return tree


LENGTH, ANGLE = "expected a length such as '8 m'", "expected an angle such as '7.5 arcsec'"
REFUSALS = [
    # unknown and missing keys
    ("colour", "red", "colour: unknown key"),
    ("telescope.diametre", "4 m", "telescope.diametre: unknown key"),
    ("sensors.2.gain", 1, "sensors[2].gain: unknown key"),
    ("telescope", None, "telescope: expected this key"),
    ("mirrors.0.coupling", None, "mirrors[0].coupling: expected this key"),
    ("telescope", "big", "telescope: input should be a valid dictionary"),
    # wrong units, none, and no numbers
    ("telescope.diameter", "4 s", f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", "4 furlong", f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", 4.0, f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", 4, f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", "4", f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", True, f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", "four m", f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", "nan m", f"telescope.diameter: {LENGTH}"),
    ("telescope.diameter", "1e999 m", "telescope.diameter: expected a finite length"),
    ("telescope.obscuration", float("nan"), "telescope.obscuration: input should be a finite number"),
    ("telescope.obscuration_centre", ["1 m", 2.0], f"telescope.obscuration_centre[1]: {LENGTH}"),
    ("zenith_angle", 20.0, f"zenith_angle: {ANGLE}"),
    ("atmosphere.layers.0.wind_speed", "3 m", "atmosphere.layers[0].wind_speed: expected a speed such as '5.6 m/s'"),
    ("guide_stars.0.position", {"x": 9.0, "y": "1 arcsec"}, f"guide_stars[0].position.x: {ANGLE}"),
    ("guide_stars.0.position", {"radius": 7.5, "angle": "1 deg"}, f"guide_stars[0].position.radius: {ANGLE}"),
    ("guide_stars.0.position", {"radius": "7 arcsec", "angle": 4.0}, f"guide_stars[0].position.angle: {ANGLE}"),
    ("sensors.0.shift", ["0.1 m", "0.2 m"], "sensors[0].shift[0]: expected a shift such as '0.25 subaperture'"),
    ("sensors.0.photons", "2e6 e", "sensors[0].photons: expected a flux such as '1.16e6 e/m2/s'"),
    ("sensors.0.read_noise", 0.5, "sensors[0].read_noise: expected a charge such as '0.5 e'"),
    ("mirrors.0.pitch", 0.4, f"mirrors[0].pitch: {LENGTH}"),
    ("loop.rate", 200, "loop.rate: expected a frequency such as '500 Hz'"),
    ("loop.delay", 2, "loop.delay: expected a delay such as '2 frames'"),
    # out of range
    ("mirrors.0.pitch", "-0.4 m", "mirrors[0].pitch: input should be greater than 0, got '-0.4 m'"),
    ("telescope.diameter", "0 m", "telescope.diameter: input should be greater than 0"),
    ("telescope.obscuration", 1.0, "telescope.obscuration: input should be less than 1"),
    ("zenith_angle", "81 deg", "zenith_angle: input should be less than or equal to"),
    ("atmosphere.r0", "-16 cm", "atmosphere.r0: input should be greater than 0"),
    ("atmosphere.layers.0.altitude", "-10 m", "atmosphere.layers[0].altitude: input should be greater than or equal"),
    ("sensors.0.subapertures", 0, "sensors[0].subapertures: input should be greater than or equal to 1"),
    ("sensors.0.subapertures", 8.5, "sensors[0].subapertures: input should be a valid integer"),
    ("sensors.0.illumination_threshold", 0, "sensors[0].illumination_threshold: input should be greater than 0"),
    ("mirrors.0.coupling", 1.0, "mirrors[0].coupling: input should be less than 1"),
    ("mirrors.0.stroke", "0 um", "mirrors[0].stroke: input should be greater than 0"),
    ("science.targets.0.weight", -1, "science.targets[0].weight: input should be greater than or equal to 0"),
    ("loop.delay", "0.5 frames", "loop.delay: input should be greater than or equal to 1"),
    ("loop.gain", 1.1, "loop.gain: input should be less than or equal to 1"),
    ("loop.leak", 1, "loop.leak: input should be less than 1"),
    # what does not hang together
    ("atmosphere.layers.0.fraction", 0.5, "atmosphere.layers: expected fractions that sum to 1, got 0.9000"),
    ("atmosphere.layers", [], "atmosphere.layers: tuple should have at least 1 item"),
    ("atmosphere.layers.2.altitude", "95 km", "guide_stars[0].altitude: expected above the top layer (95000 m)"),
    ("guide_stars.2.altitude", "10 km", "guide_stars[2].altitude: expected above the top layer (10000 m), got 10000"),
    ("guide_stars.0.altitude", None, "guide_stars[0].altitude: expected for a laser star, and only there"),
    ("guide_stars.3.altitude", "90 km", "guide_stars[3].altitude: expected for a laser star, and only there"),
    ("guide_stars.0.kind", "lazer", "guide_stars[0].kind: input should be 'laser' or 'natural'"),
    ("guide_stars.1.name", "lgs1", "guide_stars[1].name: expected a name of its own, got 'lgs1' again"),
    ("guide_stars.0.name", "LGS 1", "guide_stars[0].name: string should match pattern"),
    ("sensors.0.guide_star", "lgs9", "sensors[0].guide_star: expected one of lgs1, lgs2, lgs3, ngs1, got 'lgs9'"),
    ("sensors.1.name", "lgs1", "sensors[1].name: expected a name of its own"),
    ("mirrors.0.altitude", "85 km", "mirrors[0].altitude: expected below the guide stars, got 85000 m"),
    ("science.targets", [{"position": {"x": "0 deg"}, "weight": 0}], "science.targets: expected at least one weight"),
]


@pytest.mark.parametrize("path, value, expected", REFUSALS, ids=[f"{path}={value}" for path, value, _ in REFUSALS])
def test_refusals(tmp_path, path, value, expected):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(changed(path, value)))
    with pytest.raises(InstrumentError) as refused:
        load_system(file)
    message = str(refused.value)
    assert message.startswith(f"mine.yaml: {expected}")
    assert "\n" not in message
    assert "more)" not in message or path == "sensors.0.shift" or path == "guide_stars.0.kind"


@pytest.mark.parametrize(
    "content, expected",
    [
        (b"", "expected keys such as telescope"),
        (b"- 1\n", "expected keys such as telescope"),
        (b"a: [", "line 1 not valid YAML"),
        (b"a: 1\nb: c: d", "line 2 not valid YAML"),
        (b"a: !!python/object:os.system {}", "not valid YAML"),
        (b"\xff\xfe\x00", "not a text file"),
    ],
)
def test_files_that_are_no_instrument(tmp_path, content, expected):
    file = tmp_path / "mine.yaml"
    file.write_bytes(content)
    with pytest.raises(InstrumentError, match=expected) as refused:
        load_system(file)
    assert "\n" not in str(refused.value)


def test_a_name_or_a_path(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(changed("description", "mine")))
    assert load_system(file).description == load_system(str(file)).description == "mine"
    with pytest.raises(InstrumentError, match=r"nosuch: expected the path of a .yaml file or one of gnao_ltao,"):
        load_system("nosuch")
    with pytest.raises(InstrumentError, match="No such file"):
        load_system(tmp_path / "absent.yaml")


@pytest.mark.parametrize("name", system_names())
def test_those_that_come_with_it(name):
    system = load_system(name)
    assert system.name == name
    assert all(star.altitude is None or star.altitude > 15e3 for star in system.guide_stars)
    assert all(math.isfinite(value) and value > 0 for value in describe(system).values())
    assert System.model_validate_json(system.model_dump_json()) == system


def test_units():
    system = load_system("mini")
    assert system.telescope.diameter == 4.0
    assert system.atmosphere.r0 == pytest.approx(0.16)
    assert system.zenith_angle == pytest.approx(math.radians(20))
    assert system.guide_stars[0].altitude == 90e3
    assert system.guide_stars[0].position.x == pytest.approx(9 * ARCSEC) == pytest.approx(9 * math.pi / 180 / 3600)
    assert system.sensors[0].shift == (0.1, -0.3)  # sub-apertures
    assert system.mirrors[0].stroke == pytest.approx(10e-6)
    assert system.science.wavelength == pytest.approx(1.65e-6)
    assert (system.loop.rate, system.loop.delay) == (200.0, 2.0)
    assert parse("frequency", "1.5 kHz") == 1500
    assert parse("speed", "36 km/h") == pytest.approx(10)
    assert parse("flux", "1e2 e/cm2/s") == pytest.approx(1e6)
    assert parse("angle", "-60 mas") == pytest.approx(-0.06 * ARCSEC)


def test_polar_positions():
    (star, *_) = load_system("gnao_ltao").guide_stars
    assert (star.position.x, star.position.y) == pytest.approx((7.5 * ARCSEC / math.sqrt(2),) * 2)


def test_defaults_by_the_kind_of_star():
    stars = load_system("mini").guide_stars
    assert [star.tip_tilt for star in stars] == ["blind", "blind", "blind", "seen"]
    assert [star.jitter for star in stars] == pytest.approx([0.5 * ARCSEC] * 3 + [0.0])


def test_the_line_of_sight():
    """r0 cos(z)^0.6; heights and laser distances times sec z."""
    system = load_system("gnao_ltao")
    assert system.airmass == pytest.approx(2 / math.sqrt(3))
    assert system.los_r0 == pytest.approx(0.186 * (math.sqrt(3) / 2) ** 0.6)
    assert system.los_heights[-1] == pytest.approx(16e3 * 2 / math.sqrt(3))
    laser, natural = system.guide_stars[0], system.guide_stars[-1]
    assert system.los_range(laser) == pytest.approx(90e3 * 2 / math.sqrt(3))
    assert system.los_range(natural) == math.inf
    assert system.star_of(system.sensors[2]) is system.guide_stars[2]
    # a single layer: theta0 = 0.314 r0 / h, tau0 = 0.314 r0 / v; seeing is 0.976 lambda / r0
    one = system.with_changes(
        {"atmosphere.layers": (system.atmosphere.layers[-1].model_copy(update={"fraction": 1.0}),)}
    )
    assert one.theta0 == pytest.approx(0.314 * one.los_r0 / one.los_heights[0])
    assert one.tau0 == pytest.approx(0.314 * one.los_r0 / 12.1)
    assert one.seeing == pytest.approx(0.976 * 500e-9 / one.los_r0)


def test_fractions_are_normalised():
    system = load_system("gnao_ltao")
    assert sum(system.atmosphere.fractions) == pytest.approx(1, abs=1e-15)


def test_immutable():
    system = load_system("mini")
    for node, key in ((system, "name"), (system.loop, "gain"), (system.sensors[0], "rotation")):
        with pytest.raises(ValidationError, match="frozen"):
            setattr(node, key, getattr(node, key))
    with pytest.raises(TypeError):
        system.sensors[0] = system.sensors[1]
    assert hash(system) == hash(load_system("mini"))


def test_with_changes():
    system = load_system("mini")
    before = system.model_dump_json()
    faster = system.with_changes({"loop.rate": "1 kHz", "sensors.*.photons": 1e5, "sensors.0.rotation": "3 deg"})
    assert faster.loop.rate == 1000
    assert {sensor.photons for sensor in faster.sensors} == {1e5}
    assert faster.sensors[0].rotation == pytest.approx(math.radians(3))
    assert system.with_changes({"loop.rate": 1000}).loop.rate == 1000.0  # numbers are SI
    moved = system.with_changes({"guide_stars.1.position": {"radius": "1 arcsec", "angle": "90 deg"}})
    assert moved.guide_stars[1].position.y == pytest.approx(ARCSEC)
    assert system.with_changes({}) == system
    assert system.model_dump_json() == before
    assert load_system("mini", {"loop.gain": 0.3}).loop.gain == 0.3


@pytest.mark.parametrize(
    "key, value, expected",
    [
        ("loop.rat", 1.0, "loop.rat: unknown key"),
        ("lop.rate", 1.0, "lop.rate: no such key"),
        ("loop.rate.x", 1.0, "'x' is inside a value"),
        ("loop.rate", "1 s", "loop.rate: expected a frequency"),
        ("loop.rate", -1.0, "loop.rate: input should be greater than 0"),
        ("loop.rate", math.nan, "loop.rate: input should be a finite number"),
        ("loop", 3, "loop: input should be a valid dictionary"),
        ("sensors.4.rotation", 0.1, "sensors.4.rotation: expected an index below 4 or *, got '4'"),
        ("sensors.-1.rotation", 0.1, "expected an index below 4"),
        ("sensors.x.rotation", 0.1, "expected an index below 4"),
        ("sensors.0", {}, "sensors.0: expected a key of the item"),
        ("guide_stars.0.altitude", "5 km", "guide_stars[0].altitude: expected above the top layer"),
        ("atmosphere.layers.0.fraction", 0.9, "atmosphere.layers: expected fractions that sum to 1"),
    ],
)
def test_changes_that_are_refused(key, value, expected):
    with pytest.raises(InstrumentError) as refused:
        load_system("mini").with_changes({key: value})
    assert expected in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"guide_stars.0.launch": (1.0, 0.0)}, "launch: expected together with sodium_thickness"),
        ({"guide_stars.3.launch": (1.0, 0.0), "guide_stars.3.sodium_thickness": 1e4}, "launch: expected for a laser"),
    ],
)
def test_elongation_needs_a_laser_a_place_and_a_thickness(changes, message):
    with pytest.raises(InstrumentError, match=message):
        load_system("mini", changes)


@pytest.mark.parametrize(
    ("own", "reason"),
    [
        ({"rate": "60 Hz"}, "loop.tip_tilt.rate: expected rate (200 Hz) over a whole number, got 60"),
        ({"rate": "400 Hz"}, "loop.tip_tilt.rate: expected rate (200 Hz) over a whole number, got 400"),
        ({"delay": "1.3 frames"}, "loop.tip_tilt.delay: expected 1.2 frames, or whole exposures"),
        ({"delay": "1.1 frames"}, "loop.tip_tilt.delay: expected 1.2 frames, or whole exposures"),
        ({"delay": "3 frames", "gain": 0.7}, "loop.tip_tilt.gain: not stable with a delay of 3 frames, got 0.7"),
    ],
)
def test_tip_tilt_s_own_loop_is_refused(own, reason):
    """Stable at a delay of n frames below a gain of 2 sin(pi / (4n - 2)): 0.618 at 3."""
    with pytest.raises(InstrumentError) as error:
        load_system("mini", {"loop.tip_tilt": {"rate": "40 Hz", "gain": 0.5, **own}})
    assert reason in str(error.value) and "\n" not in str(error.value)


def test_tip_tilt_s_own_loop():
    mini = load_system("mini")
    assert (mini.tip_tilt_sensors, mini.rate_of(mini.sensors[3])) == ((), 200)
    system = mini.with_changes({"loop.tip_tilt": {"rate": "40 Hz", "delay": "1.6 frames", "gain": 0.5}})
    assert (system.loop.tip_tilt_frames, system.loop.tip_tilt_wait) == (5, 2)
    assert (system.tip_tilt_sensors, [system.rate_of(sensor) for sensor in system.sensors]) == ((3,), [200] * 3 + [40])
    assert Layout(system).fingerprint != Layout(mini).fingerprint
    assert (
        mini.with_changes({"loop.tip_tilt": {"rate": 66.666667, "delay": 3.0, "gain": 0.617}}).loop.tip_tilt_frames == 3
    )
    with pytest.raises(InstrumentError, match=r"loop.tip_tilt: expected some sensors on stars that see tip-tilt"):
        system.with_changes({"guide_stars.*.tip_tilt": "seen"})
