"""Reconstructors of several exposures: transfer, every check of each part, what the margin foretells, and replay."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagReader, BagWriter
from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_rtc.loop import Loop, Program, Slot, Verdict
from srtomo_rtc.replay import Replay
from srtomo_rtc.swap import Refused, check, spectral_radius, stability
from srtomo_sim.mirror import interaction_matrix

WEIGHTS = (1.5, -0.9, 0.4)  # as of a prediction: the newest counts more than its share


def built(mini, weights=WEIGHTS, fallback=None, G=None, **changes) -> Reconstructor:
    parts = (mini.a.R[0], mini.b.R[0], mini.a.R[0])
    made = Reconstructor.from_matrices(
        np.stack([weight * R for weight, R in zip(weights, parts)]),
        mini.G if G is None else G,
        fingerprint=mini.layout.fingerprint,
        gain=0.5,
        command_limit=mini.layout.stroke,
        fallback=mini.a.R[0] if fallback is None else fallback,
        label="three",
    )
    return replace(made, **changes)


@pytest.fixture(scope="module")
def three(mini):
    return built(mini)


def send(swap, reconstructor, helpers):
    swap.begin(helpers.manifest_of(reconstructor))
    for block in reversed(helpers.blocks_of(reconstructor)):
        if swap.take(block):
            return swap.stage()
    return None


# -- transfer and checks ---------------------------------------------------------------------------------------------


def test_every_part_arrives(bench, mini, helpers, three):
    swap = bench(max_epochs=3).swap
    for reconstructor in (three, mini.a, built(mini, (0.7, 0.3)), three):
        held = send(swap, reconstructor, helpers)
        assert held.reconstructor.sha256 == reconstructor.sha256
        assert held.slot.n_epochs == reconstructor.n_epochs
        columns = [*held.slot.epochs[: reconstructor.n_epochs], held.slot.fallback]
        for one, (R, Q) in zip(columns, reconstructor.parts):
            assert np.array_equal(one.R, R) and np.array_equal(one.Q, Q)
    swap.commit(three.id, three.sha256)


@pytest.mark.parametrize("room", [1, 2])
def test_a_loop_says_how_many_exposures_it_takes(bench, helpers, three, room):
    swap = bench(max_epochs=room).swap
    for refuse in (lambda: send(swap, three, helpers), lambda: swap.stage_whole(three)):
        with pytest.raises(Refused, match=rf"uses 3 exposures; this loop takes {room} \(parameter max_epochs\)"):
            refuse()


def with_part(array, part, change):
    array = array.copy()
    array[part] = change(array[part])
    return array


def wrong(mini, three) -> dict[str, tuple[Reconstructor, str]]:
    a = mini.a
    other = mini.G @ np.roll(np.eye(101), 1, axis=0)
    return {
        "Q of another exposure": (replace(three, Q=three.Q[::-1]), "Q is not R G"),
        "wrong Q of the oldest": (replace(three, Q=with_part(three.Q, 2, lambda Q: 1.1 * Q)), "Q is not R G"),
        "wrong Q of the fallback": (replace(three, fallback_Q=1.1 * three.fallback_Q), "Q is not R G"),
        "no newest exposure": (built(mini, (0, 0.6, 0.4)), "Q is not R G"),
        "NaN in an older R": (replace(three, R=with_part(three.R, 1, lambda R: R * np.nan)), "R: holds values"),
        "NaN in the fallback": (replace(three, fallback_R=three.fallback_R * np.nan), "fallback_R: holds values"),
        "sum too large": (built(mini, (1.0, 0.5, 0.5)), "wrong sign or scale"),
        "newest alone right": (built(mini, (1.0, -0.5, -0.3)), "wrong sign or scale"),
        "fallback truncated": (built(mini, fallback=1.5 * a.R[0]), "wrong sign or scale: .* 1.4"),
        "fallback of the wrong sign": (built(mini, fallback=-a.R[0]), "wrong sign or scale"),
        "built for other mirrors": (built(mini, G=other), "not stable enough"),
    }


def test_every_part_is_checked(bench, mini, three):
    swap = bench(max_epochs=3).swap
    swap.stage_whole(three)
    for name, (reconstructor, reason) in wrong(mini, three).items():
        with pytest.raises(Refused, match=reason):
            swap.stage_whole(reconstructor)
            pytest.fail(name)
        assert swap.staged.slot.id == three.id


# -- stability -------------------------------------------------------------------------------------------------------


def test_stability_is_the_largest_radius_on_the_unit_circle():
    def of(*parts):
        return stability(np.stack([part * np.eye(3) for part in parts]))

    assert of(0.3) == of(-0.3) == pytest.approx(0.3)
    assert of(0.5, 0.4) == of(0.5, -0.4) == pytest.approx(0.9)  # the sum of the second is 0.1
    assert of(0.2, 0.2, 0.2) == of(0.2, -0.2, 0.2) == pytest.approx(0.6)
    # two shapes that turn into each other: nilpotent alone, not together
    up = np.array([[0.0, 1], [0, 0]])
    assert stability(np.stack([0.8 * up, 0.8 * up.T])) == pytest.approx(0.8)
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        E = rng.standard_normal((n, 40, 40))
        dense = [
            spectral_radius(np.tensordot(np.exp(-1j * angle * np.arange(n)), E, 1))
            for angle in np.linspace(0, math.pi, 60)
        ]
        assert 0.93 * max(dense) <= stability(E) <= 1.001 * max(dense)


def moved(mini, pitches: float) -> np.ndarray:
    """Interaction matrix of the mirror moved by a part of a pitch."""
    layout = Layout(mini.system)
    (mirror,) = layout.mirrors
    actuators = mirror.actuators + pitches * mirror.pitch * np.array([0.8, -0.6])
    layout.mirrors = (replace(mirror, actuators=actuators),)
    return interaction_matrix(mini.system, layout)


def slowest_mode(E, gain: float, delay: float) -> float:
    """Growth a frame of ``u[k] = (1-g) u[k-1] + g sum_j E_j ((1-f) u[k-j-n] + f u[k-j-n-1])``, from its transition."""
    n, f, m = math.floor(delay), delay - math.floor(delay), E.shape[1]
    blocks = np.zeros((m, n + len(E), m))
    blocks[:, 0] += (1 - gain) * np.eye(m)
    for j, part in enumerate(E):
        blocks[:, n + j - 1] += gain * (1 - f) * part
        blocks[:, n + j] += gain * f * part
    transition = np.eye(m * (n + len(E)), k=-m)
    transition[:m] = blocks.reshape(m, -1)
    return float(np.abs(np.linalg.eigvals(transition)).max())


def test_below_the_limit_no_delay_or_gain_diverges_and_the_sum_alone_would_not_tell(mini, three):
    margins = {}
    for pitches in (0.1, 0.2, 0.3, 0.5):
        E = three.Q.astype(float) - three.R.astype(float) @ moved(mini, pitches)
        margins[pitches] = stability(E), spectral_radius(E.sum(axis=0))
        growth = [slowest_mode(E, gain, delay) for gain, delay in ((1.0, 1), (1.0, 2), (0.5, 1.6))]
        assert max(growth) < 1 or margins[pitches][0] > 1
    limits = {name: [p for p in margins if margins[p][i] < 1] for i, name in enumerate(("circle", "sum"))}
    assert len(limits["circle"]) < len(limits["sum"])


@pytest.mark.parametrize(("pitches", "delay", "gain"), [(0.3, 2, 0.9), (0.5, 1.6, 0.9), (0.5, 3, 0.5)])
def test_the_loop_grows_as_its_transition_matrix_says(mini, helpers, three, pitches, delay, gain):
    G_true = moved(mini, pitches)
    E = three.Q.astype(float) - three.R.astype(float) @ G_true
    expected = slowest_mode(E, gain, delay)
    slot = Slot(mini.layout, 3)
    slot.fill(replace(three, command_limit=np.full(101, 1e30), gain=gain))
    loop = Loop(mini.layout, delay, 3)
    loop.post(Program(slot, helpers.plain_settings(mini.layout)))
    loop.request(closed=True)
    loop.prepare()
    n, f, flat = math.floor(delay), delay - math.floor(delay), np.zeros(101)
    shown: dict[int, np.ndarray] = {}
    kick = np.random.default_rng(0).standard_normal(mini.layout.n_slopes) * 1e-6
    size = []
    for k in range(160):
        shape = (1 - f) * shown.get(k - n, flat) + f * shown.get(k - n - 1, flat)
        y = (kick if k == 0 else 0) - G_true @ shape
        for w in range(loop.n_sensors):
            loop.add(w, y[mini.layout.slopes_of(w)].astype("f4"))
        newest, before = (frame if frame >= 0 else -1 for frame in (k - n, k - n - 1))
        assert loop.answer(newest, before, 1 - f) is Verdict.OK
        shown[k] = loop.command.astype(float)
        size.append(np.linalg.norm(shown[k]))
        loop.prepare()
    assert (size[-1] / size[79]) ** (1 / 80) == pytest.approx(expected, abs=0.02)


def test_the_margin_against_the_calibrated_mirror_is_refused_where_only_the_swing_is_unstable(mini, three):
    G_cal = moved(mini, 0.2).astype(np.float32)
    total = spectral_radius((three.Q - three.R @ G_cal).sum(axis=0).astype(float))
    assert total < 0.8
    with pytest.raises(Refused, match=r"not stable enough: spectral radius of Q - R G_cal is [01]\.\d+, limit 0.8"):
        check(three, mini.layout, G_cal, tip_tilt=True)
    assert check(three, mini.layout, moved(mini, 0.05).astype(np.float32), tip_tilt=True).stability < 0.8


# -- replay ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def eventful(bench, mini, three, tmp_path_factory):
    """140 frames: a closing, faults, swaps between one, two and three exposures, a session anew, snapshots."""
    path = tmp_path_factory.mktemp("bags") / "several"
    made = bench(bag=path, delay=1.6, max_epochs=3)
    two = built(mini, (1.4, -0.4))
    made.publish(mini.a)
    made.publish(two)
    made.close(three)
    made.run(range(20))
    parts = made.messages(20)  # a sensor is missing
    made.offer(*parts[:2], *parts[3:])
    made.run(range(21, 23))
    made.hrtc.want_snapshot()  # when the loop has but one exposure before
    made.run(range(23, 40))
    slopes = made.sky.slopes(40)
    slopes[17] = np.nan
    made.frame(40, slopes)
    made.run(range(41, 50))
    made.hrtc.want_snapshot()
    made.run(range(50, 60))
    made.offer(*made.messages(60, timing=(55, 55, 1.0)))  # the mirror was held for long
    made.run(range(61, 65))
    made.swap.stage_whole(mini.a)
    made.commit(mini.a)
    made.run(range(65, 75))
    made.swap.stage_whole(two)
    made.commit(two)
    made.run(range(75, 85))
    made.roll_back(mini.a)
    made.run(range(85, 86))
    made.swap.stage_whole(three)
    made.commit(three)
    made.hrtc.want_snapshot()  # just before its first frame
    made.run(range(86, 95))
    made.swap.change_settings(polc=False, leak=0.1)
    made.run(range(95, 100))
    made.swap.change_settings(polc=True)
    made.hrtc.loop.request(closed=False)
    made.run(range(100, 104))
    made.hrtc.loop.request(closed=True)
    made.run(range(104, 120))
    made.hrtc.want_snapshot()
    made.run(range(120, 140))
    made.finish()
    return path, made


def replay(path, start=0):
    with BagReader(path) as reader:
        return Replay(reader).run(start)


def frame_of(topic, data):
    if topic == wire.COMMAND.name:
        return wire.read_dm_command(data).frame
    return wire.read_slope_frame(data).frame if topic == wire.SLOPES.name else None


def rewrite(path, out, keep):
    with BagReader(path) as reader, BagWriter(out, reader.metadata) as writer:
        for message in reader.messages():
            if keep(frame_of(message.topic.lstrip("/"), message.data)):
                writer.write(message.topic, message.type, message.data, message.log_time, message.log_time)
    return out


@pytest.mark.parametrize("start", [0, 24, 25, 51, 88, 121, 139])
def test_bit_exact_from_the_start_and_from_the_middle(eventful, start):
    outcome = replay(eventful[0], start)
    assert (outcome.differing, outcome.skipped, outcome.unanswered, outcome.gaps) == (0, 0, 0, []), asdict(outcome)
    assert (outcome.compared, outcome.first_frame) == (140 - start, start)


def test_the_bag_holds_what_it_is_made_for(eventful):
    made = eventful[1]
    verdicts = [command.verdict for command in made.commands]
    assert verdicts.count(Verdict.HOLD_INCOMPLETE) == verdicts.count(Verdict.HOLD_NONFINITE) == 1
    assert verdicts.count(Verdict.OPEN) == 4
    assert len({command.reconstructor for command in made.commands}) == 3


def test_frames_that_the_fallback_answers_are_counted(eventful, mini, three):
    """Those with the law applied and fewer such frames just before than the reconstructor looks back."""
    made = eventful[1]
    looks_back = {mini.a.id: 0, three.id: 2}
    expected = fine = 0
    for command in made.commands:
        if command.verdict == Verdict.OK:
            expected += fine < looks_back.get(command.reconstructor, 1)
        fine = fine + 1 if command.verdict == Verdict.OK else 0
    assert made.hrtc.counters.fallback == expected == 8


def test_what_a_replay_cannot_start_from(eventful, tmp_path):
    """A bag that begins at a recorded state lacks the exposures before: said, and on it goes at the next state."""
    outcome = replay(rewrite(eventful[0], tmp_path / "late", lambda frame: frame is None or frame > 50), 51)
    assert outcome.gaps == ["Exposures before frame 51, of which a reconstructor uses several, are not in the bag."]
    assert (outcome.differing, outcome.skipped) == (0, 36)  # on from the state after 86
    # with the two before, it starts there
    outcome = replay(rewrite(eventful[0], tmp_path / "just", lambda frame: frame is None or frame > 48), 51)
    assert (outcome.gaps, outcome.differing, outcome.compared) == ([], 0, 89)
