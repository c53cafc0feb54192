"""What is built for closed lasers against reconstructors of systems that never had them."""

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.system import load_system
from srtomo_srtc.closures import sets_of_lasers
from srtomo_srtc.reconstructors import implicit, predictive

SYSTEM = load_system("mini")
LAYOUT = Layout(SYSTEM)


def rest(closed: int) -> list[int]:
    return [w for w in range(len(SYSTEM.sensors)) if not closed >> w & 1]


def columns(sensors) -> np.ndarray:
    return np.concatenate([np.arange(LAYOUT.n_slopes)[LAYOUT.slopes_of(w)] for w in sensors])


def system_without(closed: int):
    return SYSTEM.model_copy(update={"sensors": tuple(SYSTEM.sensors[w] for w in rest(closed))})


def norm(a) -> float:
    return float(np.linalg.norm(a))


@pytest.mark.parametrize(
    ("method", "options", "tolerance"),
    [
        (implicit, {}, 1e-6),
        (implicit, {"fast": True}, 5e-3),  # what tables of another extent interpolate
        (predictive, {"epochs": 2}, 1e-6),
    ],
)
def test_each_is_that_of_a_system_without_these_lasers(method, options, tolerance) -> None:
    """Built from scratch, with its own covariances, factors and interaction matrix."""
    made, _ = method(SYSTEM, closures="pairs", **options)
    assert [closure.sensors for closure in made.closures] == [0b1, 0b10, 0b100, 0b11, 0b101, 0b110]
    whole = made.R[0] if made.fallback_R is None else made.fallback_R
    for closure in made.closures[1::2]:
        own, G = method(system_without(closure.sensors), **{k: v for k, v in options.items() if k != "epochs"})
        mine = closure.R[:, columns(rest(closure.sensors))]
        assert norm(mine - own.R[0]) < tolerance * norm(own.R[0])
        assert norm(closure.Q - own.Q[0]) < tolerance * norm(own.Q[0])
        assert norm(whole - closure.R) > 0.3 * norm(whole)  # it matters
        left = np.delete(closure.R, columns(rest(closure.sensors)), axis=1)
        assert not left.any()
        assert norm(mine @ G - closure.Q) < 1e-5 * norm(closure.Q)


def test_the_low_order_is_tip_tilt_of_the_natural_star() -> None:
    made, G = implicit(SYSTEM, closures="low_order")
    assert made.closures == () and made.low_order is not None
    slopes, commands = made.low_order.slopes, made.low_order.commands
    assert np.flatnonzero(slopes.any(axis=0)).tolist() == columns([3]).tolist()
    assert slopes @ G @ commands.T == pytest.approx(np.eye(2), abs=1e-5)
    # what it makes is seen as a tilt of the same size by every lenslet in the middle of a mirror
    tilt = (G @ commands[0])[LAYOUT.slopes_of(0)].reshape(2, -1)
    turned = SYSTEM.sensors[0].rotation
    assert np.median(tilt, axis=1) == pytest.approx([np.cos(turned) / 2, -np.sin(turned) / 2], rel=0.01)


def test_a_long_delay_makes_the_low_order_s_gain_half_of_what_is_stable() -> None:
    """``u[k] = u[k-1] - g u[k-4]`` is stable up to g = 2 sin(pi / 14)."""
    slow = SYSTEM.with_changes({"loop.delay": "4 frames", "loop.gain": 0.8})
    made, G = implicit(slow, closures="low_order")
    gains = 0.8 * np.linalg.eigvals(made.low_order.slopes @ G @ made.low_order.commands.T)
    assert gains == pytest.approx(np.full(2, np.sin(np.pi / 14)), rel=1e-4)


def test_which_are_built() -> None:
    assert sets_of_lasers(SYSTEM, "singles") == [(0,), (1,), (2,)]
    assert sets_of_lasers(load_system("gnao_ltao_sr"), "singles") == [(0,), (1,), (2,), (3,)]
    one_laser = system_without(0b110)
    assert sets_of_lasers(one_laser, "pairs") == []
    made, _ = implicit(one_laser, closures="pairs")
    assert made.closures == () and made.low_order is not None
    no_star = system_without(0b1000)
    made, _ = implicit(no_star, closures="singles")
    assert len(made.closures) == 3 and made.low_order is None
    with pytest.raises(ValueError, match="closures: expected without split"):
        implicit(SYSTEM, closures="singles", split=True)
