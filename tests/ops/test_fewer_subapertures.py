"""The paper's claim that super-resolution drives a mirror with fewer sub-apertures: 16x16 shifted or 20x20 aligned."""

import numpy as np
import pytest

from srtomo_core.system import System, load_system
from srtomo_ops.reproduce.trials import Trial, measure, with_electrons
from srtomo_srtc.predict import Prediction, mean_wfe
from srtomo_srtc.reconstructors.implicit import implicit

QUARTERS = [(-0.25, -0.25), (-0.25, 0.25), (0.25, 0.25), (0.25, -0.25)]
ELECTRONS = (745, 186, 40)  # a frame, on 0.16 m^2


def system(subapertures: int, shifted: bool, electrons: float) -> System:
    """``gnao_ltao`` at 1 kHz on its own mirror of 21 actuators; the same light on other sub-apertures."""
    changes: dict[str, object] = {f"sensors.{i}.subapertures": subapertures for i in range(4)}
    if shifted:
        changes |= {f"sensors.{i}.shift": shift for i, shift in enumerate(QUARTERS)}
    return with_electrons(load_system("gnao_ltao", {"loop.rate": 1000.0, **changes}), electrons)


def predicted(subapertures: int, shifted: bool, electrons: float) -> float:
    """nm rms."""
    case = system(subapertures, shifted, electrons)
    return 1e9 * mean_wfe(Prediction(case).budgets(implicit(case, fast=True)[0].R[0]))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("electrons", ELECTRONS)
def test_predicted(electrons: float) -> None:
    """Shifts give most of what 16x16 sensors lose to 20x20 ones, with 35 % fewer slopes."""
    cases = [(n, shift) for n in (20, 16) for shift in (False, True)]
    fine, fine_shifted, coarse, shifted = (predicted(*case, electrons) for case in cases)
    print(
        f"{electrons} electrons, nm: 20x20 aligned {fine:.1f}, shifted {fine_shifted:.1f}; "
        f"16x16 aligned {coarse:.1f}, shifted {shifted:.1f}"
    )
    assert coarse > shifted > fine_shifted
    assert shifted == pytest.approx(fine, rel=0.02)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_in_the_loop() -> None:
    cases = {f"{n}x{n} {'shifted' if s else 'aligned'}": (n, s) for n in (20, 16) for s in (False, True)}
    trials = {name: Trial(system(n, shifted, 186)) for name, (n, shifted) in cases.items()}
    found = {name: outcome.rms * 1e9 for name, outcome in measure(trials, range(1, 2), 1000).items()}
    print(", ".join(f"{name} {wfe:.1f} nm" for name, wfe in found.items()))
    expected = [predicted(*case, 186) for case in cases.values()]
    np.testing.assert_allclose(list(found.values()), expected, rtol=0.05)
    assert found["16x16 aligned"] > found["16x16 shifted"]
    assert found["16x16 shifted"] == pytest.approx(found["20x20 aligned"], rel=0.02)
