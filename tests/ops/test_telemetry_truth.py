"""Pseudo-open-loop slopes from a loop's messages are the plant's turbulence and noise, whatever the loop does."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import srtomo_srtc.telemetry
from srtomo_core.bag import BagReader
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import System, load_system
from srtomo_core.wire import MIRROR_UNKNOWN, DmCommandWriter, SlopeFrameWriter, read_dm_command
from srtomo_ops.simulate import plain_settings, program_of
from srtomo_rtc.loop import Loop, Program, Settings, Slot
from srtomo_sim.mirror import interaction_matrix
from srtomo_sim.plant import Plant
from srtomo_sim.sky import Sky, prepare
from srtomo_srtc.matching import HORIZON, Matched, Matcher
from srtomo_srtc.model import blind_modes
from srtomo_srtc.telemetry import NoWindow, Telemetry

BAG = Path(__file__).resolve().parents[2] / "bags" / "mini"
FRAMES = 400
LATE, OFFSET, SWAP, CLIP, OPEN, CLOSED, BROKEN = 60, 90, 150, 200, 260, 320, 350
"""Frames from which something happens; each lasts for some frames, or from there on."""


@pytest.fixture(scope="module")
def mini() -> System:
    return load_system("mini", {"atmosphere.outer_scale": 8.0, "loop.delay": 1.6})


@pytest.fixture(scope="module")
def sky(mini: System) -> Sky:
    return prepare(mini, FRAMES, 5, science_every=FRAMES)


@pytest.fixture(scope="module")
def messages(mini: System, sky: Sky) -> list[tuple[bool, bytes]]:
    """What the loop publishes: (is it slopes, serialised), in order of time."""
    return list(_run(mini, sky))


def _reconstructor(layout: Layout, G: np.ndarray, share: float) -> Reconstructor:
    weight = share * np.linalg.norm(G, 2) ** 2
    R = np.linalg.solve(G.T @ G + weight * np.eye(layout.n_commands), G.T)
    return Reconstructor.from_matrices(
        R, G, fingerprint=layout.fingerprint, gain=0.5, command_limit=layout.stroke, label=str(share)
    )


def _run(system: System, sky: Sky, told: bool = True):
    layout, plant = sky.layout, Plant(system, sky)
    G = interaction_matrix(system, layout)
    offset = 40e-9 * np.sin(np.arange(layout.n_commands)).astype(np.float32)
    plain = plain_settings(layout)
    shaped = Settings(2, offset, plain.slope_reference)
    first, second = _reconstructor(layout, G, 3e-3), _reconstructor(layout, G, 1e-2)
    slot = Slot(layout)
    slot.fill(second)
    tight = Settings(3, offset, plain.slope_reference, command_limit=150e-9)
    programs = {
        OFFSET: program_of(layout, first, shaped),
        SWAP: program_of(layout, second, shaped),
        CLIP: Program(slot, tight),
        CLIP + 40: Program(slot, shaped),
    }
    loop = Loop(layout, system.loop.delay)
    loop.post(program_of(layout, first))
    loop.prepare()
    writers = [
        SlopeFrameWriter(place.name, 7, layout.fingerprint, w, 1, place.n_valid)
        for w, place in enumerate(layout.sensors)
    ]
    answers = DmCommandWriter("hrtc", layout.n_commands)
    for k in range(FRAMES):
        if k in programs:
            loop.post(programs[k])
        loop.request(20 <= k < OPEN or k >= CLOSED)
        loop.prepare()
        slopes, on = plant.measure(k), plant.on_mirror(k)
        if k == BROKEN:
            slopes[11] = np.nan
        mirror = (on.frame, on.before, on.fraction) if told else (MIRROR_UNKNOWN, -1, 0.0)
        for w, writer in enumerate(writers):
            writer.values[:] = slopes[layout.slopes_of(w)]
            loop.add(w, writer.values)
            yield True, writer.write(k, k, *mirror)
        loop.answer(*mirror)
        slot_id = loop.program.slot.id
        fields = (7, k, slot_id, 1, 15, loop.verdict, loop.closed, loop.n_clipped, 0.5, -1)
        answers.values[:] = loop.command
        yield False, answers.write(0, k, *fields, loop.mirror_frame, loop.mirror_frame_before, loop.mirror_fraction, 0)
        # due at k + 1.6, when the mirrors move; the loop can know of a late one only where it is told
        plant.command(k, loop.command, k + 3.2 if told and LATE <= k < LATE + 10 and k % 3 == 0 else k + 1.0)
    assert (plant.late_commands > 0) == told


def _put(target: Matcher | Telemetry, messages) -> None:
    for is_slopes, data in messages:
        (target.add_slopes if is_slopes else target.add_command)(data)


def _matched(matcher: Matcher, messages) -> list[Matched]:
    found = []
    for i, message in enumerate(messages):
        _put(matcher, [message])
        if i % 17 == 0:
            found += matcher.take()
    return found + matcher.take(final=True)


def test_pseudo_open_loop_slopes_are_turbulence_and_noise(mini: System, sky: Sky, messages) -> None:
    matcher = Matcher(sky.layout)
    # nothing has ever moved this plant's mirrors
    untouched = Plant(mini, sky)
    found = _matched(matcher, messages)
    assert [exposure.frame for exposure in found] == [k for k in range(FRAMES) if k != BROKEN]
    G = sky.interaction.astype(float)
    worst = max(
        np.abs(exposure.slopes + G @ exposure.mirror - untouched.measure(exposure.frame)).max() for exposure in found
    )
    closed = np.std([exposure.slopes for exposure in found[30:250]])
    assert worst < 1e-5 * sky.slopes.std() and closed > 1e3 * worst
    tally = matcher.tally
    assert (tally.matched, tally.nonfinite, tally.left_out) == (FRAMES - 1, 1, 1)
    assert tally.open == 20 + CLOSED - OPEN
    # frame BROKEN was held, and is left out for its own reason
    assert tally.held == 0 and 0 < tally.clipped <= 60
    assert len({exposure.reconstructor for exposure in found}) == 2
    # the test would see a mirror that is a frame off
    shifted = found[100].slopes + G @ found[101].mirror - untouched.measure(found[100].frame)
    assert np.abs(shifted).max() > 100 * worst


def test_a_sensor_that_does_not_know_the_mirror_leaves_it_to_the_command(mini: System, sky: Sky) -> None:
    matcher, untouched = Matcher(sky.layout), Plant(mini, sky)
    found = _matched(matcher, _run(mini, sky, told=False))
    G = sky.interaction.astype(float)
    assert len(found) == FRAMES - 1
    for exposure in found[::7]:
        slopes = exposure.slopes + G @ exposure.mirror
        assert slopes == pytest.approx(untouched.measure(exposure.frame), abs=1e-5 * float(sky.slopes.std()))


def test_any_interleaving_gives_the_same(sky: Sky, messages) -> None:
    matcher = Matcher(sky.layout)
    # a message is up to 30 frames behind the others
    per_frame = len(sky.layout.sensors) + 1
    delays = np.random.default_rng(0).uniform(0, 30 * per_frame, len(messages))
    shuffled = _matched(matcher, [messages[i] for i in np.argsort(np.arange(len(messages)) + delays)])
    for found, expected in zip(shuffled, _matched(Matcher(sky.layout), messages), strict=True):
        assert found.frame == expected.frame
        assert (found.slopes == expected.slopes).all() and (found.mirror == expected.mirror).all()
    assert matcher.tally.late == matcher.tally.duplicate == 0


def test_statistics_are_those_of_the_untouched_sky(mini: System, sky: Sky, messages) -> None:
    telemetry = Telemetry(mini, sky.interaction, window=2.0, blocks=4, every=2, lags=(3,), held_out=0.2)
    _put(telemetry, messages)
    statistics = telemetry.statistics()
    M = blind_modes(mini, sky.layout)
    untouched = Plant(mini, sky)
    truth = np.array([untouched.measure(k) for k in range(FRAMES)], float)
    truth -= (truth @ M) @ M.T
    # 50 counted frames a block, the last five of each half held out; the end of the run waits behind no missing frame
    fit = [k for k in range(0, FRAMES, 2) if k // 2 % 25 < 20 and k != BROKEN]
    rows = truth[fit]
    scale = np.abs(np.cov(rows.T)).max()
    assert statistics.n_frames == len(fit)
    assert statistics.mean == pytest.approx(rows.mean(axis=0), abs=1e-4 * np.sqrt(scale))
    assert statistics.covariance == pytest.approx(np.cov(rows.T, bias=True), abs=1e-5 * scale)
    pairs = [k for k in fit if k >= 3 and (k - 3) // 2 % 25 < 20 and k - 3 != BROKEN]
    lagged = truth[pairs].T @ truth[np.array(pairs) - 3] / len(pairs) - np.outer(rows.mean(axis=0), rows.mean(axis=0))
    assert statistics.lagged_frames == {3: len(pairs)}
    assert statistics.lagged[3] == pytest.approx(lagged, abs=1e-5 * scale)
    held = [k for k in range(0, FRAMES, 2) if k // 2 % 25 >= 20]
    assert statistics.held_out.frames.tolist() == held
    assert statistics.held_out.slopes == pytest.approx(truth[held], abs=1e-4 * np.sqrt(scale))
    assert statistics.held_out.block.tolist() == np.repeat(range(4), 10).tolist()
    answered = [k for k in held if not OPEN <= k < CLOSED]
    assert statistics.held_out.frames[statistics.held_out.reconstructor > 0].tolist() == answered
    assert len(set(statistics.held_out.reconstructor)) == 3
    assert (statistics.first_frame, statistics.last_frame) == (fit[0], fit[-1])
    # the latest ones: of as many stretches as there are blocks
    recent = telemetry.recent()
    assert recent.held_out.frames.tolist() == held[-20:]
    assert recent.held_out.block.tolist() == np.repeat(range(4), 5).tolist()
    assert (recent.held_out.slopes == statistics.held_out.slopes[-20:]).all()
    assert (recent.session, recent.first_frame, recent.last_frame) == (statistics.session, held[-20], held[-1])


def test_the_window_forgets(mini: System, sky: Sky, messages) -> None:
    telemetry = Telemetry(mini, sky.interaction, window=0.5, blocks=2, every=1, held_out=0.0)
    _put(telemetry, messages)
    statistics = telemetry.statistics()
    # two whole blocks of 50 frames, and the one that is being filled: the run ends with a whole one
    assert (statistics.first_frame, statistics.last_frame) == (FRAMES - 150, FRAMES - 1)
    assert len(statistics.held_out.frames) == 0


def _with_closed(messages, said: dict[int, tuple[int, int]]):
    """The same, where some frames' answers say another verdict and set of sensors."""
    writer = None
    for is_slopes, data in messages:
        if not is_slopes and (answer := read_dm_command(data)).frame in said:
            verdict, sensors = said[answer.frame]
            writer = writer or DmCommandWriter("hrtc", len(answer.commands))
            writer.values[:] = answer.commands
            data = writer.write(*answer._replace(verdict=verdict, sensors=sensors)[:-1])
        yield is_slopes, data


def test_the_window_ages_while_no_frame_counts(mini: System, sky: Sky, messages) -> None:
    """With a sensor closed, and with nothing at all."""
    per_frame, options = len(sky.layout.sensors) + 1, {"window": 0.5, "blocks": 2, "every": 1, "held_out": 0.0}
    closed = list(_with_closed(messages, {k: (0, 0b1101) for k in range(200, FRAMES)}))
    telemetry = Telemetry(mini, sky.interaction, **options)
    _put(telemetry, closed[: 280 * per_frame])
    # the block of 50 frames being filled is the one of frame 279, and two whole ones are before it
    assert telemetry.statistics().first_frame == 150
    _put(telemetry, closed[280 * per_frame :])
    with pytest.raises(NoWindow, match=r"2 frames to count, got 0; since frame 199: sensor closed 200$") as told:
        telemetry.statistics()
    assert (told.value.session, told.value.frame) == (7, FRAMES - 1)

    telemetry = Telemetry(mini, sky.interaction, **options)
    _put(telemetry, messages[: 200 * per_frame])
    telemetry.age(0.4)
    assert telemetry.statistics().first_frame == 150
    _put(telemetry, messages[200 * per_frame : 210 * per_frame])
    telemetry.age(1.0)
    with pytest.raises(NoWindow, match=r"got 0; since frame 209: nothing came$"):
        telemetry.statistics()


def test_it_needs_the_memory_that_it_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not less, and not much more: with as many slopes as make matrices count."""
    system = load_system("mini", {f"sensors.{w}.subapertures": 18 for w in range(3)})
    layout, stated = Layout(system), []
    monkeypatch.setattr(srtomo_srtc.telemetry, "require", lambda n_bytes, _: stated.append(n_bytes))
    G = np.zeros((layout.n_slopes, layout.n_commands), np.float32)
    writers = [
        SlopeFrameWriter(place.name, 7, layout.fingerprint, w, 1, place.n_valid)
        for w, place in enumerate(layout.sensors)
    ]
    answers = DmCommandWriter("hrtc", layout.n_commands)
    tracemalloc.start()
    telemetry = Telemetry(system, G, window=0.2, blocks=4, every=1, lags=(2,))
    for k in range(45):
        for writer in writers:
            telemetry.add_slopes(writer.write(k, k, -1, -1, 1.0))
        telemetry.add_command(answers.write(0, k, 7, k, 1, 1, 15, 0, True, 0, 0.5, -1, -1, -1, 1.0, 0.0))
    statistics = telemetry.statistics()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    print(layout.n_slopes, peak / stated[0])
    assert statistics.n_frames == 36 and len(statistics.held_out.frames) == 9
    assert 0.7 * stated[0] < peak < 1.1 * stated[0]


def test_gaps_are_left_out_and_counted(sky: Sky, messages) -> None:
    per_frame = len(sky.layout.sensors) + 1

    def lost(index: int) -> bool:
        frame, part = divmod(index, per_frame)
        return (
            frame in (100, 101)  # everything
            or (frame == 110 and part == 1)  # one sensor
            or (frame == 120 and part == per_frame - 1)  # the answer, which was on the mirrors later
        )

    matcher = Matcher(sky.layout)
    found = _matched(matcher, [message for i, message in enumerate(messages) if not lost(i)])
    frames = {exposure.frame for exposure in found}
    tally = matcher.tally
    # with a delay of 1.6 frames a command is on the mirrors in two exposures
    missing = {100, 101, 102, 103, 110, 120, 121, 122, BROKEN}
    assert set(range(FRAMES)) - frames == missing
    assert (tally.absent, tally.incomplete, tally.unanswered) == (2, 1, 1)
    assert (tally.unknown_mirror, tally.nonfinite) == (4, 1)
    assert tally.matched + tally.left_out == FRAMES


def test_sessions_do_not_mix(mini: System, sky: Sky, messages) -> None:
    other = [(is_slopes, _in_session(data, 9)) for is_slopes, data in messages]
    per_frame = len(sky.layout.sensors) + 1
    telemetry = Telemetry(mini, sky.interaction, window=2.0, blocks=4, every=1)
    _put(telemetry, messages[: 200 * per_frame] + other[: 100 * per_frame] + messages[200 * per_frame :])
    statistics = telemetry.statistics()
    assert (statistics.session, statistics.first_frame) == (9, 0)
    assert statistics.last_frame < 100
    tally = telemetry.tally
    assert tally.sessions == 2 and tally.foreign == len(messages) - 200 * per_frame
    assert 250 < tally.matched <= 300


def _in_session(data: bytes, session: int) -> bytes:
    where = data.index((7).to_bytes(8, "little"), 16)
    return data[:where] + session.to_bytes(8, "little") + data[where + 8 :]


def test_odd_messages_are_counted_and_do_no_harm(sky: Sky, messages) -> None:
    matcher = Matcher(sky.layout)
    _put(matcher, messages[:50])
    matcher.add_slopes(messages[0][1])
    matcher.add_slopes(messages[0][1][:40])
    matcher.add_command(b"")
    foreign = bytearray(messages[0][1])
    foreign[foreign.index(sky.layout.fingerprint)] ^= 1
    matcher.add_slopes(bytes(foreign))
    assert (matcher.tally.duplicate, matcher.tally.malformed, matcher.tally.foreign) == (1, 2, 1)
    assert len(matcher.take()) == 10
    matcher.add_slopes(messages[0][1])
    assert matcher.tally.late == 1


def test_memory_is_bounded_without_answers(sky: Sky) -> None:
    matcher = Matcher(sky.layout)
    writer = SlopeFrameWriter("lgs1", 7, sky.layout.fingerprint, 0, 1, sky.layout.sensors[0].n_valid)
    for k in range(3 * HORIZON):
        matcher.add_slopes(writer.write(0, k, -1, -1, 1.0))
    assert matcher.tally.unanswered == HORIZON
    assert matcher.take(final=True) == []


def test_a_bag_is_read_like_live_messages() -> None:
    system = load_system("mini")
    telemetry = Telemetry(system, interaction_matrix(system, Layout(system)), window=1.0, blocks=2, every=1)
    with BagReader(BAG) as bag:
        telemetry.feed(bag)
    tally = telemetry.tally
    # one frame with a slope that is no number, one without a sensor
    assert (tally.matched, tally.nonfinite, tally.incomplete, tally.left_out) == (148, 1, 1, 2)
    assert telemetry.statistics().session == 0x6D696E69


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": 0.01}, "fewer than 2 counted frames"),
        ({"blocks": 0}, "at least 1"),
        ({"lags": (0,)}, "at least 1"),
        ({"held_out": 1.0}, "0 to less than 1"),
    ],
)
def test_refuses_a_window_that_cannot_be(mini: System, sky: Sky, options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Telemetry(mini, sky.interaction, **options)


def test_refuses_another_instruments_interaction_matrix_and_too_few_frames(mini: System, sky: Sky) -> None:
    with pytest.raises(ValueError, match="G: expected shape"):
        Telemetry(mini, sky.interaction[:-1])
    with pytest.raises(NoWindow, match="at least 2 frames to count, got 0; so far: nothing came"):
        Telemetry(mini, sky.interaction).statistics()


def test_frames_with_a_closed_sensor_are_left_out(sky: Sky, messages) -> None:
    """What it sent is no sky. A frame held because a sensor was late is good, as long as none was closed."""
    matcher = Matcher(sky.layout)
    said = {k: (0, 0b1101) for k in range(100, 120)} | {110: (3, 0b0101), 130: (3, 0b1011), 140: (7, 0b1101)}
    frames = {matched.frame for matched in _matched(matcher, list(_with_closed(messages, said)))}
    assert matcher.tally.sensor_closed == 21
    assert set(range(90, 150)) - frames == {*range(100, 120), 140}
