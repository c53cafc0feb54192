"""A laser goes away: the command does without its sensor from the next frame on, and has it back when it returns."""

from dataclasses import replace

import numpy as np
import pytest

from srtomo_core.reconstructor import LowOrder, Reconstructor
from srtomo_rtc.loop import Verdict
from srtomo_rtc.swap import MAX_CLOSURES, Refused, Swap

LASERS = (0, 1, 2)


@pytest.fixture
def running(bench, mini):
    """A closed loop, of a reconstructor that can do without each laser, after frames 0 to 9."""
    made = bench()
    made.close(mini.c)
    made.run(range(10))
    return made


def trouble(bench) -> dict[str, int]:
    """Counters of what went wrong."""
    counters = vars(bench.hrtc.counters)
    return {name: n for name, n in counters.items() if n and name.startswith(("held", "dropped"))}


def verdicts(bench, first: int) -> set[Verdict]:
    return {Verdict(command.verdict) for command in bench.commands if command.frame >= first}


@pytest.mark.parametrize("gap", ["nothing comes", "what comes is no number", "late", "ahead"])
def test_the_commands_are_those_of_a_loop_that_never_had_the_sensor(running, mini, gap) -> None:
    """``u[k] = (1-g) u[k-1] + g (R' y + Q' u~)`` in float64, whatever the closed sensor sends, and no frame is lost."""
    first, last, closed = 10, 40, 1
    running.close_sensors(closed)
    own = {closure.sensors: closure for closure in mini.c.closures}[1 << closed]
    u = {command.frame: command.commands.astype(float) for command in running.commands}
    late: list[bytes] = []
    for k in range(first, last):
        slopes = running.sky.slopes(k)
        messages = running.messages(k, running.dark(k, closed))
        dark = messages.pop(closed)
        if gap == "what comes is no number":
            messages.insert(0, dark)
        if gap == "ahead":
            messages.insert(0, running.messages(k + 1, running.dark(k + 1, closed))[closed])
        for message in messages:
            running.offer(message)
        running.offer(*late)
        late = [dark] if gap == "late" else []
        seen = own.R.astype(float) @ np.where(np.isfinite(slopes), slopes, 0) + own.Q.astype(float) @ u[k - 2]
        u[k] = 0.5 * u[k - 1] + 0.5 * seen
        assert running.commands[-1].frame == k
        assert running.commands[-1].commands == pytest.approx(u[k], abs=1e-5 * np.abs(u[k]).max())
    assert trouble(running) == {} and verdicts(running, first) == {Verdict.OK}
    assert {command.sensors for command in running.commands[10:]} == {0b1101}
    running.close_sensors()
    running.run(range(running.hrtc.loop.frame, 60))
    assert [command.frame for command in running.commands] == list(range(60))
    assert running.commands[-1].sensors == 0b1111 and verdicts(running, last) == {Verdict.OK}


def test_open_it_is_the_loop_without_any_closures(running, bench, mini) -> None:
    plain = bench()
    plain.close(replace(mini.c, closures=(), low_order=None))
    plain.run(range(10))
    assert [one.commands.tobytes() for one in running.commands] == [one.commands.tobytes() for one in plain.commands]


def test_closing_takes_effect_at_the_next_frame_boundary(running) -> None:
    """In the middle of a frame the sensors that came count still; the frame after that does without the closed one."""
    for message in running.messages(10)[:2]:
        running.offer(message)
    running.close_sensors(1)
    for message in running.messages(10)[2:]:
        running.offer(message)
    running.frame(11, running.dark(11, 1))
    assert [command.sensors for command in running.commands[-2:]] == [0b1111, 0b1101]
    assert trouble(running) == {}


def test_a_sensor_that_died_first_costs_the_frames_until_it_is_closed(running) -> None:
    for k in range(10, 13):
        running.offer(*(message for w, message in enumerate(running.messages(k)) if w != 1))
    running.close_sensors(1)
    for k in range(13, 30):
        running.offer(*(message for w, message in enumerate(running.messages(k)) if w != 1))
    assert trouble(running) == {"held_incomplete": 2}  # 10 and 11; what was waiting of 12 is enough without it
    assert [command.frame for command in running.commands] == list(range(30))


def test_all_lasers_closed_holds_the_high_orders_and_keeps_tip_tilt(running, mini) -> None:
    """The step of a static tilt is corrected within 0.1 %; no other shape moves, whatever the lasers send."""
    before = running.commands[-1].commands.astype(float)
    running.close_sensors(*LASERS)
    tilt = mini.c.low_order.commands[0].astype(float)
    disturbance = mini.G.astype(float) @ tilt
    for k in range(10, 60):
        newest = running.sky.timing(k)[0]
        shown = running.sky.shown[newest]
        slopes = (disturbance - mini.G @ (shown - before)).astype(np.float32)
        for w in LASERS:
            slopes[running.layout.slopes_of(w)] = np.nan
        running.frame(k, slopes)
    moved = running.commands[-1].commands - before
    assert moved == pytest.approx(tilt, abs=1e-3 * np.abs(tilt).max())
    modes = mini.c.low_order.commands.astype(float)
    for command in running.commands[10:]:
        change = command.commands - before
        share = np.linalg.lstsq(modes.T, change, rcond=None)[0]
        assert np.abs(change - share @ modes).max() < 1e-6 * np.abs(before).max()
    assert trouble(running) == {} and verdicts(running, 10) == {Verdict.OK}
    assert {command.sensors for command in running.commands[10:]} == {0b1000}


@pytest.mark.parametrize("closed", [(0, 1, 2), (3,), (1,), (0, 1, 2, 3)])
def test_without_anything_to_go_on_with_commands_are_held_and_the_loop_stays_closed(bench, mini, closed) -> None:
    """For longer than the fault budget, which these frames are no part of."""
    made = bench()
    made.close(mini.a)
    made.swap.change_settings(fault_budget=5)
    made.run(range(10))
    made.close_sensors(*closed)
    made.run(range(10, 40))
    assert verdicts(made, 10) == {Verdict.HOLD_CLOSED}
    assert {command.commands.tobytes() for command in made.commands[10:]} == {made.commands[9].commands.tobytes()}
    assert trouble(made) == {"held_closed": 30} and made.hrtc.loop.closed
    made.close_sensors()
    made.run(range(40, 50))
    assert verdicts(made, 40) == {Verdict.OK}
    assert [command.frame for command in made.commands] == list(range(50))


def test_an_older_exposure_with_a_closed_sensor_is_not_used_again(bench, mini) -> None:
    """Of two exposures the first frame after opening has only one that is whole: the fallback answers it."""
    system, c = mini.system, mini.c
    several = Reconstructor.from_matrices(
        np.stack([1.5 * c.R[0], -0.5 * c.R[0]]), mini.G, fingerprint=c.fingerprint, gain=0.5,
        command_limit=c.command_limit, fallback=c.R[0], closures={1: c.closures[0].R}, low_order=c.low_order,
    )  # fmt: skip
    made = bench(system=system, max_epochs=2)
    made.publish(several)
    made.commit(several)
    made.hrtc.loop.request(closed=True)
    made.run(range(10))
    made.close_sensors(0)
    for k in range(10, 20):
        made.frame(k, made.dark(k, 0))
    made.close_sensors()
    for k in (20, 21):
        u = [made.commands[k - age].commands.astype(float) for age in (1, 2, 3)]
        slopes = [made.sky.slopes(k).astype(float), made.sky.slopes(k - 1).astype(float)]
        made.frame(k)
        parts = [several.parts[2]] if k == 20 else several.parts[:2]
        seen = sum(R.astype(float) @ y + Q.astype(float) @ on for (R, Q), y, on in zip(parts, slopes, u[1:]))
        wanted = 0.5 * u[0] + 0.5 * seen
        assert made.commands[-1].commands == pytest.approx(wanted, abs=1e-5 * np.abs(wanted).max()), k
    assert trouble(made) == {}


def test_int16_does_without_a_sensor_too(bench, mini) -> None:
    """Its integers are scaled sensor by sensor, and the closed one has none."""
    made, plain = bench(kernel="int16"), bench()
    for one in (made, plain):
        one.close(mini.c)
        one.run(range(10))
        one.close_sensors(2)
        for k in range(10, 30):
            one.frame(k, one.dark(k, 2))
        one.close_sensors(0, 2)
        for k in range(30, 40):
            one.frame(k, one.dark(k, 0, 2))
    wanted = plain.commands[-1].commands
    assert made.commands[-1].commands == pytest.approx(wanted, abs=1e-3 * float(np.abs(wanted).max()))
    assert trouble(made) == {}


# -- what a swap brings ----------------------------------------------------------------------------------------------


@pytest.fixture
def swap(mini, helpers):
    return Swap(mini.system, mini.layout, mini.G, helpers.plain_settings(mini.layout), lambda program: None)


def test_closures_come_in_the_blocks_of_their_reconstructor(swap, mini, helpers) -> None:
    swap.begin(helpers.manifest_of(mini.c))
    blocks = helpers.blocks_of(mini.c)
    assert len(blocks) == 16 and [swap.take(block) for block in blocks[::-1]] == [False] * 15 + [True]
    held = swap.stage()
    assert held.reconstructor.sha256 == mini.c.sha256
    assert np.array_equal(held.slot.epochs[0].R, mini.c.R[0])  # theirs are not in its place
    for closure in mini.c.closures:
        matrices = held.slot.closures[closure.sensors]
        assert np.array_equal(matrices.R, closure.R) and np.array_equal(matrices.Q, closure.Q)
    assert np.array_equal(held.slot.low_order.R, mini.c.low_order.R)
    # in the slot of one with closures, one without them has none
    slot = held.slot
    slot.fill(mini.a)
    assert slot.closures == {} and slot.low_order is None


def changed(mini, i: int, **changes) -> Reconstructor:
    closures = list(mini.c.closures)
    closures[i] = replace(closures[i], **changes)
    return replace(mini.c, closures=tuple(closures))


def test_every_refusal(swap, mini, helpers) -> None:
    c = mini.c
    first = c.closures[0]
    nan = np.array(first.R)
    nan[3, -1] = np.nan
    low = c.low_order
    wrong_mirror = np.roll(np.eye(mini.layout.n_commands), 1, axis=0)
    for reconstructor, reason in (
        (changed(mini, 0, R=c.R[0], Q=c.Q[0]), "the one for sensors 0b1 uses some of them"),
        (changed(mini, 1, sensors=1), "expected distinct sets of some sensors"),
        (changed(mini, 1, sensors=0), "expected distinct sets of some sensors"),
        (changed(mini, 1, sensors=0b11111), "expected distinct sets of some sensors"),
        (changed(mini, 0, R=nan), "closures: hold values that are not finite"),
        (changed(mini, 0, Q=0.9 * first.Q), "Q is not R G"),
        (changed(mini, 0, R=-first.R, Q=-first.Q), "wrong sign or scale"),
        *((changed(mini, 0, R=f * first.R, Q=f * first.Q), "wrong sign or scale: without lgs1, ") for f in (0.4, 1.3)),
        (changed(mini, 0, R=wrong_mirror @ first.R, Q=wrong_mirror @ first.Q), "wrong sign or scale|not stable"),
        (replace(c, low_order=LowOrder(-low.commands, low.slopes)), "low_order: an integrator of gain 0.5 times -1"),
        (replace(c, low_order=LowOrder(1.5 * low.commands, low.slopes)), "is not stable enough"),
        (replace(c, low_order=LowOrder(np.nan * low.commands, low.slopes)), "low_order: holds values"),
    ):
        with pytest.raises(Refused, match=reason):
            swap.stage_whole(reconstructor)
    with pytest.raises(Refused, match="low_order: expected modes of 101 commands"):
        swap.begin(helpers.manifest_of(c, low_order_commands=np.zeros(7, np.float32)))
    with pytest.raises(Refused, match=f"for {MAX_CLOSURES + 1} sets of closed sensors; this loop takes {MAX_CLOSURES}"):
        swap.begin(helpers.manifest_of(c, closed_sensors=tuple(range(1, MAX_CLOSURES + 2))))
    assert swap.staged is None
