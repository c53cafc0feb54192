"""The control law against closed forms: a wrong sign, order, delay or history fails here."""

import math
import tracemalloc

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import load_system
from srtomo_core.wire import MIRROR_UNKNOWN
from srtomo_rtc.loop import Loop, Program, Settings, Slot, Verdict

LAYOUT = Layout(load_system("mini"))
N, M = LAYOUT.n_slopes, LAYOUT.n_commands
RNG = np.random.default_rng(7)
G = RNG.standard_normal((N, M)) * 3.0
R1 = np.linalg.pinv(G) + RNG.standard_normal((M, N)) * 2e-4
R2 = np.linalg.pinv(G) * 0.9 + RNG.standard_normal((M, N)) * 2e-4
SKY = RNG.standard_normal((200, N)) * 1e-6


def reconstructor(R, gain):
    return Reconstructor.from_matrices(R, G, fingerprint=LAYOUT.fingerprint, gain=gain, command_limit=LAYOUT.stroke)


def program(R, gain, settings=None):
    made = reconstructor(R, gain)
    slot = Slot(LAYOUT)
    slot.fill(made)
    return Program(slot, settings or plain_settings())


def plain_settings(**changes):
    return Settings(**{"id": 1, "offset": np.zeros(M, "f4"), "slope_reference": np.zeros(N, "f4"), **changes})


class Mirror:
    """What an exposure sees, from the definition of the delay: share f of command k-n-1, then 1-f of k-n."""

    def __init__(self, delay):
        self.whole, self.late_share = math.floor(delay), delay - math.floor(delay)
        self.shown = {}

    def during(self, k):
        flat = np.zeros(M)
        newest, before = k - self.whole, k - self.whole - 1
        mean = (1 - self.late_share) * self.shown.get(newest, flat) + self.late_share * self.shown.get(before, flat)
        return mean, (newest if newest >= 0 else -1, before if before >= 0 else -1, 1 - self.late_share)


def feed(loop, y):
    for w in range(loop.n_sensors):
        loop.add(w, y[LAYOUT.slopes_of(w)].astype("f4"))


def close(loop, program):
    loop.post(program)
    loop.request(closed=True)
    loop.prepare()


@pytest.mark.parametrize("delay", [1, 1.3, 1.6, 2, 2.7, 3])
@pytest.mark.parametrize("gain", [0.5, 0.9])
def test_closed_loop_is_the_filter_of_open_loop_estimates(delay, gain):
    """With the exact G, u[k] = (1-g) u[k-1] + g R s_atm[k], through a skipped frame, a clip, an offset and a swap."""
    loop, mirror = Loop(LAYOUT, delay), Mirror(delay)
    offset = RNG.standard_normal(M) * 1e-7
    limit = 1.2e-7
    R, o, clip = R1, np.zeros(M), math.inf
    close(loop, program(R1, gain))
    u = np.zeros(M)
    clipped = 0
    scale = 0.0
    for k in range(120):
        if k == 40:
            o = offset
            pair = {"offset": o.astype("f4"), "slope_reference": (-G @ o).astype("f4")}
            loop.post(program(R1, gain, plain_settings(id=2, **pair)))
            loop.prepare()
        if k == 60:
            R = R2
            loop.post(program(R2, gain, plain_settings(id=2, **pair)))
            loop.prepare()
        if k == 80:
            clip = limit
            loop.post(program(R2, gain, plain_settings(id=3, command_limit=limit, **pair)))
            loop.prepare()
        shape, timing = mirror.during(k)
        if k == 30:
            verdict = loop.hold(Verdict.HOLD_MISSING)
        else:
            feed(loop, SKY[k] - G @ shape)
            verdict = loop.answer(*timing)
            assert verdict is Verdict.OK
            u = (1 - gain) * u + gain * R @ SKY[k]
        m = np.clip(u + o, -clip, clip)
        clipped += int((np.abs(u + o) > clip).sum())
        u = m - o
        mirror.shown[k] = loop.command.astype(float)
        scale = max(scale, np.abs(u).max())
        assert loop.command == pytest.approx(m, abs=2e-5 * scale)
        loop.prepare()
    assert clipped > 100  # the clip was exercised


def test_the_mirror_that_a_sensor_reports_overrides_the_convention():
    """A late command enters the history when it took effect: the filter holds although the mirror was held."""
    loop = Loop(LAYOUT, 2)
    close(loop, program(R1, 0.5))
    shown = {-1: np.zeros(M)}
    u, on = np.zeros(M), -1
    for k in range(40):
        if k % 7 != 3:  # otherwise the command of k-2 came late and the mirror kept what it had
            on = max(k - 2, -1)
        feed(loop, SKY[k] - G @ shown[on])
        assert loop.answer(on, on - 1, 1.0) is Verdict.OK
        u = 0.5 * u + 0.5 * R1 @ SKY[k]
        shown[k] = loop.command.astype(float)
        assert loop.command == pytest.approx(u, abs=1e-5 * np.abs(u).max())
        loop.prepare()


def test_explicit_and_implicit_pseudo_open_loop_agree():
    """(1-g) u + g R (y + G u~) with the large product, in float64, against R y + Q u~."""
    gain, loop, mirror = 0.7, Loop(LAYOUT, 1.6), Mirror(1.6)
    close(loop, program(R1, gain))
    wrong = G * 0.9  # a mirror that is not where G thinks it is
    u = np.zeros(M)
    for k in range(30):
        shape, _ = mirror.during(k)
        y = SKY[k] - wrong @ shape
        u = (1 - gain) * u + gain * R1 @ (y + G @ shape)
        feed(loop, y)
        loop.answer(MIRROR_UNKNOWN, MIRROR_UNKNOWN, 0.0)
        mirror.shown[k] = loop.command.astype(float)
        assert loop.command == pytest.approx(u, abs=1e-5 * np.abs(u).max())
        loop.prepare()


def test_leaky_integrator():
    """Without POLC: u[k] = (1-leak) u[k-1] + g R (y - y_ref)."""
    gain, leak = 0.4, 0.02
    reference = RNG.standard_normal(N).astype("f4") * np.float32(1e-7)
    loop = Loop(LAYOUT, 2)
    close(loop, program(R1, gain, plain_settings(polc=False, leak=leak, slope_reference=reference)))
    u = np.zeros(M)
    for k in range(20):
        feed(loop, SKY[k])
        loop.answer(k - 2, k - 3, 1.0)
        u = (1 - leak) * u + gain * R1 @ (SKY[k] - reference)
        assert loop.command == pytest.approx(u, abs=1e-5 * np.abs(u).max())
        loop.prepare()


def test_offset_alone_is_an_aberration_and_the_pair_is_a_shape():
    """A wanted shape (o, -G o) stays; o alone is corrected away by the loop."""
    o = RNG.standard_normal(M) * 1e-7
    perfect = np.linalg.pinv(G)
    for reference, expected in ((-G @ o, o), (np.zeros(N), np.zeros(M))):
        loop, mirror = Loop(LAYOUT, 2), Mirror(2)
        settings = plain_settings(offset=o.astype("f4"), slope_reference=reference.astype("f4"))
        close(loop, program(perfect, 0.5, settings))
        for k in range(60):
            shape, timing = mirror.during(k)
            feed(loop, -G @ shape)
            loop.answer(*timing)
            mirror.shown[k] = loop.command.astype(float)
            loop.prepare()
        assert loop.command == pytest.approx(expected, abs=1e-4 * np.abs(o).max())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, N // 2, N - 1])
def test_a_slope_that_is_not_finite_holds_the_command(bad, place):
    loop = Loop(LAYOUT, 2)
    close(loop, program(R1, 0.5))
    feed(loop, SKY[0])
    loop.answer(-1, -1, 1.0)
    before = loop.command.copy()
    loop.prepare()
    y = SKY[1].copy()
    y[place] = bad
    feed(loop, y)
    assert loop.answer(-1, -1, 1.0) is Verdict.HOLD_NONFINITE
    assert np.array_equal(loop.command, before)
    loop.prepare()
    feed(loop, SKY[2])
    assert loop.answer(0, -1, 1.0) is Verdict.OK
    assert np.isfinite(loop.command).all()


def test_finite_slopes_whose_product_overflows_hold_too():
    loop = Loop(LAYOUT, 2)
    close(loop, program(R1, 0.5))
    feed(loop, np.full(N, 3e38) * np.sign(RNG.standard_normal(N)))
    verdict = loop.answer(-1, -1, 1.0)
    assert np.isfinite(loop.command).all()
    assert verdict in (Verdict.HOLD_NONFINITE, Verdict.OK)


def test_unknown_history_is_held():
    loop = Loop(LAYOUT, 2)
    loop.start(100)
    close(loop, program(R1, 0.5))
    for k, (mirror, expected) in enumerate([(98, Verdict.HOLD_HISTORY), (99, Verdict.HOLD_HISTORY), (100, Verdict.OK)]):
        feed(loop, SKY[k])
        assert loop.answer(mirror, mirror, 1.0) is expected
        loop.prepare()


def test_fault_budget_opens_the_loop_and_it_relaxes_to_the_offset():
    offset = np.full(M, 2e-8, "f4")
    loop = Loop(LAYOUT, 2)
    close(loop, program(R1, 0.5, plain_settings(fault_budget=5, offset=offset, relaxation=0.2)))
    feed(loop, SKY[0])
    loop.answer(-1, -1, 1.0)
    start = loop.state.astype(float)
    for _ in range(6):
        loop.prepare()
        assert loop.closed
        loop.hold(Verdict.HOLD_MISSING)
    loop.prepare()
    assert not loop.closed and loop.opened_by_faults == 1
    for step in range(1, 100):
        loop.hold(Verdict.HOLD_MISSING)
        assert loop.state == pytest.approx(start * 0.8**step, rel=1e-3, abs=1e-11)
        loop.prepare()
    assert loop.command == pytest.approx(offset, abs=1e-9 * np.abs(start).max() + 1e-14)


def test_a_program_is_taken_up_between_frames_only():
    loop = Loop(LAYOUT, 2)
    first, second = program(R1, 0.5), program(R2, 0.5)
    close(loop, first)
    feed(loop, SKY[0])
    loop.post(second)
    loop.answer(-1, -1, 1.0)
    assert loop.command == pytest.approx(0.5 * R1 @ SKY[0], abs=1e-12)
    assert loop.program is first
    loop.prepare()
    assert loop.program is second


# -- several exposures -------------------------------------------------------------------------------------------------

R_OLDER = RNG.standard_normal((2, M, N)) * 2e-4 - 0.1 * np.linalg.pinv(G)


def several(R, fallback, gain, settings=None, room=3):
    made = Reconstructor.from_matrices(
        R, G, fingerprint=LAYOUT.fingerprint, gain=gain, command_limit=LAYOUT.stroke, fallback=fallback
    )
    slot = Slot(LAYOUT, room)
    slot.fill(made)
    return Program(slot, settings or plain_settings())


THREE = np.concatenate([R1[None], R_OLDER])


@pytest.mark.parametrize("room", [3, 5])
@pytest.mark.parametrize("delay", [1, 1.6, 3])
def test_several_exposures_are_the_filter_of_their_sum_and_a_gap_that_of_the_newest_alone(delay, room):
    """With the exact G, u[k] = (1-g) u[k-1] + g sum_j R_j s_atm[k-j] where the exposures before were all answered OK.

    Through the beginning, a held frame, one that is not finite, an open loop, an offset, and swaps to one exposure and
    to two, which cost no fallback.
    """
    gain = 0.6
    offset = RNG.standard_normal(M) * 1e-7
    pair = {"offset": offset.astype("f4"), "slope_reference": (-G @ offset).astype("f4")}
    programs = {
        0: several(THREE, R2, gain, room=room),
        50: several(THREE, R2, gain, plain_settings(id=2, **pair), room=room),
        60: program(R1, gain, plain_settings(id=2, **pair)),
        70: several(0.9 * THREE[:2], R2, gain, plain_settings(id=2, **pair), room=room),
    }
    laws = {60: (R1[None], R1), 70: (0.9 * THREE[:2], R2)}
    R, fallback = THREE, R2
    loop, mirror = Loop(LAYOUT, delay, room), Mirror(delay)
    u, fine, alone = np.zeros(M), 0, []
    loop.request(closed=True)
    for k in range(90):
        if k in programs:
            loop.post(programs[k])
        if k in (30, 35):
            loop.request(closed=k == 35)
        R, fallback = laws.get(k, (R, fallback))
        loop.prepare()
        shape, timing = mirror.during(k)
        y = SKY[k] - G @ shape
        if k == 20:
            y[7] = np.nan
        feed(loop, y)
        verdict = loop.hold(Verdict.HOLD_MISSING) if k == 10 else loop.answer(*timing)
        if verdict is Verdict.OK:
            several_used = fine >= len(R) - 1
            terms = [R[j] @ SKY[k - j] for j in range(len(R))] if several_used else [fallback @ SKY[k]]
            u = (1 - gain) * u + gain * np.sum(terms, axis=0)
            fine += 1
            if not several_used:
                alone.append(k)
        else:
            fine = 0
            u = u * 0.9 if verdict is Verdict.OPEN else u
        mirror.shown[k] = loop.command.astype(float)
        m = u + (offset if k >= 50 else 0)
        assert loop.command == pytest.approx(m, abs=3e-5 * np.abs(m).max()), k
    assert alone == [0, 1, 11, 12, 21, 22, 35, 36]


def test_only_the_newest_exposure_waits_for_its_slopes():
    """What older exposures make is formed before the slopes come: their matrices are not looked at any more."""
    commands = []
    for spoilt in (False, True):
        loop = Loop(LAYOUT, 2, 3)
        made = several(THREE, R2, 0.5)
        close(loop, made)
        for k in range(6):
            if spoilt and k == 5:
                for columns in (*made.slot.epochs[1:], made.slot.fallback):
                    for matrix in (*columns.R, columns.Q):
                        matrix[:] = np.nan
            feed(loop, SKY[k])
            loop.answer(*((k - 2, k - 3, 1.0) if k > 2 else (-1, -1, 1.0)))
            if k < 5:
                loop.prepare()
        commands.append(loop.command.copy())
    assert np.array_equal(*commands)


def test_older_exposures_were_under_the_mirror_that_their_sensors_reported():
    loop, gain = Loop(LAYOUT, 2, 3), 0.5
    close(loop, several(THREE, R2, gain))
    shown = {-1: np.zeros(M)}
    u, on, held = np.zeros(M), -1, {}
    for k in range(40):
        if k % 7 != 3:  # otherwise the command of k-2 came late and the mirror kept what it had
            on = max(k - 2, -1)
        held[k] = SKY[k] - G @ shown[on]
        feed(loop, held[k])
        assert loop.answer(on, on - 1, 1.0) is Verdict.OK
        u = (1 - gain) * u + gain * (np.einsum("jmn,jn->m", THREE, SKY[k - 2 : k + 1][::-1]) if k > 1 else R2 @ SKY[k])
        shown[k] = loop.command.astype(float)
        assert loop.command == pytest.approx(u, abs=2e-5 * np.abs(u).max())
        loop.prepare()


def test_an_integrator_of_several_exposures():
    """Without POLC: u[k] = (1-leak) u[k-1] + g sum_j R_j (y[k-j] - y_ref)."""
    gain, leak = 0.4, 0.02
    reference = RNG.standard_normal(N).astype("f4") * np.float32(1e-7)
    loop = Loop(LAYOUT, 2, 3)
    close(loop, several(THREE, R2, gain, plain_settings(polc=False, leak=leak, slope_reference=reference)))
    u = np.zeros(M)
    for k in range(20):
        feed(loop, SKY[k])
        loop.answer(k - 2, k - 3, 1.0)
        seen = [R2 @ (SKY[k] - reference)] if k < 2 else [THREE[j] @ (SKY[k - j] - reference) for j in range(3)]
        u = (1 - leak) * u + gain * np.sum(seen, axis=0)
        assert loop.command == pytest.approx(u, abs=2e-5 * np.abs(u).max())
        loop.prepare()


def test_more_exposures_than_there_is_room_for():
    with pytest.raises(ValueError, match="uses 3 exposures; there is room for 2"):
        several(THREE, R2, 0.5, room=2)
    loop = Loop(LAYOUT, 2, 2)
    with pytest.raises(ValueError, match="uses 3 exposures; this loop takes 2"):
        loop.post(several(THREE, R2, 0.5))
    for epochs in (0, 9):
        with pytest.raises(ValueError, match="epochs: expected 1 to 8"):
            Loop(LAYOUT, 2, epochs)


@pytest.mark.parametrize("epochs", [1, 3])
def test_a_frame_allocates_nothing(epochs):
    """No array, buffer or object that outlives a frame; and nothing as large as a vector even within one."""
    layout = Layout(load_system("gnao_ltao"))
    slot = Slot(layout, epochs)
    slot.gain, slot.command_limit[:], slot.n_epochs = 0.5, 1.0, epochs
    n, m = layout.n_slopes, layout.n_commands
    loop = Loop(layout, 2, epochs)
    close(loop, Program(slot, Settings(id=1, offset=np.zeros(m, "f4"), slope_reference=np.zeros(n, "f4"))))
    slopes = [np.ones(s.n_slopes, "f4") for s in layout.sensors]

    def frame(k):
        for w, own in enumerate(slopes):
            loop.add(w, own)
        loop.answer(k - 2 if k > 1 else -1, k - 3 if k > 2 else -1, 1.0)
        loop.prepare()

    for k in range(100):
        frame(k)
    tracemalloc.start()
    try:
        frame(100)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        for k in range(101, 301):
            frame(k)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 512  # counters' integers
    assert peak - before < 4 * m
