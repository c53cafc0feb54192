"""Explicit and implicit reconstructors on the plant: two ways to one correction (section 2.7 of the paper)."""

import pytest

from srtomo_core.system import System, load_system
from srtomo_ops.simulate import program_of, run
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky, prepare
from srtomo_srtc.reconstructors.explicit import explicit
from srtomo_srtc.reconstructors.implicit import implicit


def _wfe(system: System, sky: Sky, method: object, **options: object) -> float:
    """m rms, piston and tip-tilt removed."""
    reconstructor, _ = method(system, **options)  # type: ignore[operator]
    return run(Plant(system, sky), {0: program_of(sky.layout, reconstructor)}).wfe()


def test_explicit_is_as_good_as_implicit_on_mini() -> None:
    system = load_system("mini")
    sky = prepare(system, 400, 1, science_every=4)
    expected = _wfe(system, sky, implicit)
    assert _wfe(system, sky, explicit) == pytest.approx(expected, rel=0.02)
    assert _wfe(system, sky, explicit, prior="laplacian") == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_explicit_is_as_good_as_implicit_on_gnao_ltao_sr() -> None:
    system = load_system("gnao_ltao_sr", {"loop.rate": 1000.0})
    sky = prepare(system, 1000, 1, science_every=5)
    expected = _wfe(system, sky, implicit)
    assert _wfe(system, sky, explicit) == pytest.approx(expected, rel=0.02)
    assert _wfe(system, sky, explicit, prior="laplacian") == pytest.approx(expected, rel=0.03)
