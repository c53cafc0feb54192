"""Interpolated reconstructors against rebuilt ones."""

import time

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import System, load_system
from srtomo_srtc.bank import Bank, _lagrange
from srtomo_srtc.reconstructors.implicit import implicit
from srtomo_srtc.reconstructors.predictive import predictive

R0 = (0.16 * 10**-0.6, 0.16 * 10**0.6)  # r0^(-5/3) over two decades


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini")


@pytest.fixture(scope="module")
def bank(mini: System) -> Bank:
    return Bank.build(mini, R0)


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def test_two_decades_take_eleven_nodes(bank: Bank) -> None:
    assert bank.high - bank.low == pytest.approx(np.log(100))
    assert len(bank.matrices) == 11


@pytest.mark.parametrize("exponent", [-0.6, -0.57, -0.4, -0.11, 0.05, 0.3, 0.52, 0.6])
def test_any_seeing_is_as_if_rebuilt(mini: System, bank: Bank, exponent: float) -> None:
    r0 = 0.16 * 10**exponent
    rebuilt = implicit(mini.with_changes({"atmosphere.r0": r0}))[0]
    found = bank.at(r0)
    assert _difference(found.R, rebuilt.R) < 3e-4
    assert _difference(found.Q, rebuilt.Q) < 3e-4
    assert found.fingerprint == rebuilt.fingerprint
    # Q belongs to R
    np.testing.assert_allclose(found.R[0] @ found.probe_slopes[0], found.Q[0] @ found.probe_commands[0], atol=1e-12)


def test_noise_counts_as_seeing(mini: System, bank: Bank) -> None:
    """Without read noise, four times the photons are a quarter of every variance."""
    elongated = {"guide_stars.0.launch": (2.5, 0.0), "guide_stars.0.sodium_thickness": 40e3}
    quiet = mini.with_changes({"sensors.*.read_noise": 0.0, **elongated})
    brighter = quiet.with_changes({f"sensors.{i}.photons": 4 * s.photons for i, s in enumerate(quiet.sensors)})
    own = Bank.build(quiet, (0.05, 0.4))
    rebuilt = implicit(brighter.with_changes({"atmosphere.r0": 0.14}))[0]
    assert _difference(own.at(0.14, 0.25).R, rebuilt.R) < 3e-4
    assert _difference(own.of(brighter.with_changes({"atmosphere.r0": 0.14})).R, rebuilt.R) < 3e-4


def test_other_methods_go_into_a_bank_too(mini: System) -> None:
    own = Bank.build(mini, (0.12, 0.2), method=predictive, lag=0.01)
    assert _difference(own.at(0.15).R, predictive(mini.with_changes({"atmosphere.r0": 0.15}), lag=0.01)[0].R) < 3e-4
    assert own.at(0.15).provenance["method"] == "predictive"


def test_what_a_bank_does_not_hold_is_refused(mini: System, bank: Bank) -> None:
    with pytest.raises(ValueError, match=r"outside 0\.0401\d+ to 0\.636\d+ m"):
        bank.at(0.03)
    with pytest.raises(ValueError, match="rising order"):
        Bank.build(mini, (0.2, 0.1))
    with pytest.raises(ValueError, match="expected the system that it was built for"):
        bank.of(mini.with_changes({"atmosphere.outer_scale": 30.0}))
    with pytest.raises(ValueError, match="expected one for all"):
        bank.of(mini.with_changes({"sensors.0.photons": 1e6}))


def test_lagrange_weights_are_exact_for_polynomials() -> None:
    nodes = np.cos((2 * np.arange(5) + 1) * np.pi / 10)
    for t in (-0.93, 0.0, 0.4, nodes[1]):
        assert _lagrange(5, t) @ nodes**4 == pytest.approx(t**4, abs=1e-13)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_full_size_takes_a_twentieth_of_a_rebuild() -> None:
    system = load_system("gnao_ltao_sr")
    own = Bank.build(system, (0.186 * 10**-0.6, 0.186 * 10**0.6))
    for r0 in (0.06, 0.21, 0.6):
        changed = system.with_changes({"atmosphere.r0": r0})
        start = time.perf_counter()
        rebuilt = implicit(changed, Layout(changed))[0]
        rebuilding = time.perf_counter() - start
        passes = []
        for _ in range(3):
            start = time.perf_counter()
            found = own.at(r0)
            passes.append(time.perf_counter() - start)
        print(f"r0 {r0}: {_difference(found.R, rebuilt.R):.1e}, {min(passes):.3f} s of {rebuilding:.2f} s")
        assert _difference(found.R, rebuilt.R) < 3e-4
        assert min(passes) < 0.05 * rebuilding
