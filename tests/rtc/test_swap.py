"""Swaps: every refusal with its reason and the loop untouched, no command of a mixture, what the margin foretells."""

import math
import random
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from srtomo_core.layout import Layout
from srtomo_core.reconstructor import Reconstructor
from srtomo_rtc import swap as swap_module
from srtomo_rtc.loop import Loop, Program, Slot, Verdict
from srtomo_rtc.swap import Refused, Swap, check, smooth_shapes, spectral_radius
from srtomo_sim.mirror import interaction_matrix


@pytest.fixture
def bench_with_a(bench, mini):
    """A loop that runs reconstructor a, after 10 frames."""
    made = bench()
    made.close(mini.a)
    made.run(range(10))
    return made


def send(swap, reconstructor, helpers, manifest=None, blocks=None):
    """Manifest and blocks as they come over the wire; staged when the last one is in."""
    swap.begin(manifest or helpers.manifest_of(reconstructor))
    for block in helpers.blocks_of(reconstructor) if blocks is None else blocks:
        if swap.take(block):
            return swap.stage()
    return None


def assert_untouched(bench, mini) -> None:
    """The loop runs on, on reconstructor a, exactly as one that was never asked."""
    swap = bench.swap
    assert swap.active.slot.id == mini.a.id
    assert bench.hrtc.loop.program.slot.id == mini.a.id
    assert not bench.hrtc.loop.pending
    reference = type(bench)(mini)
    reference.close(mini.a)
    reference.run(range(20))
    bench.run(range(10, 20))
    assert [c.commands.tobytes() for c in bench.commands] == [c.commands.tobytes() for c in reference.commands]
    assert {c.reconstructor for c in bench.commands} == {mini.a.id}


# -- transfer --------------------------------------------------------------------------------------------------------


def test_blocks_in_any_order_and_repeated(bench_with_a, mini, helpers):
    swap = bench_with_a.swap
    blocks = helpers.blocks_of(mini.b) + helpers.blocks_of(mini.b)[:2]
    random.Random(1).shuffle(blocks)
    held = send(swap, mini.b, helpers, blocks=blocks)
    assert held is swap.staged
    assert (held.slot.id, held.label) == (mini.b.id, "b")
    R = held.slot.epochs[0].R
    assert np.array_equal(R, mini.b.R[0]) and np.array_equal(held.slot.epochs[0].Q, mini.b.Q[0])
    assert held.check.stability < 1e-3
    assert_untouched(bench_with_a, mini)


def test_a_transfer_that_is_cut_is_not_staged(bench_with_a, mini, helpers):
    swap = bench_with_a.swap
    blocks = helpers.blocks_of(mini.b)
    assert send(swap, mini.b, helpers, blocks=blocks[:2]) is None
    assert swap.missing == (mini.b.id, list(range(2, len(blocks))))
    with pytest.raises(Refused, match="no whole reconstructor"):
        swap.stage()
    with pytest.raises(Refused, match="no reconstructor is staged"):
        swap.commit(mini.b.id, mini.b.sha256)
    assert swap.missing is None
    assert_untouched(bench_with_a, mini)


def test_a_new_manifest_during_a_transfer_takes_over(bench_with_a, mini, helpers):
    swap = bench_with_a.swap
    old = replace(mini.b, gain=0.4)
    send(swap, old, helpers, blocks=helpers.blocks_of(old)[:3])
    swap.begin(helpers.manifest_of(mini.b))
    done = [swap.take(block) for pair in zip(helpers.blocks_of(old), helpers.blocks_of(mini.b)) for block in pair]
    assert sum(done) == 1
    assert swap.stage().slot.id == mini.b.id
    assert np.array_equal(swap.staged.slot.epochs[0].R, mini.b.R[0])


def test_blocks_without_a_manifest_are_ignored(bench_with_a, mini, helpers):
    assert not any(bench_with_a.swap.take(block) for block in helpers.blocks_of(mini.b))
    bench_with_a.swap.begin(helpers.manifest_of(mini.b))
    bench_with_a.swap.forget()
    assert not any(bench_with_a.swap.take(block) for block in helpers.blocks_of(mini.b))
    assert bench_with_a.swap.missing is None


MANIFESTS = {
    "wrong instrument": ({"fingerprint": bytes(32)}, "made for another instrument"),
    "too few commands": ({"n_commands": 100}, "expected 101 commands x 286 slopes, got 100 x 286"),
    "too many commands": ({"n_commands": 2**31}, "expected 101 commands x 286 slopes"),
    "wrong number of slopes": ({"n_slopes": 285}, "got 101 x 285"),
    "two epochs": ({"n_epochs": 2}, "uses 2 exposures; this loop takes 1"),
    "no epoch": ({"n_epochs": 0}, "uses 0 exposures"),
    "missing blocks": ({"n_blocks": 3}, "expected 4 blocks, got 3"),
    "part of a probe": ({"probe_commands": np.zeros(102, "f4")}, "expected whole vectors"),
}


@pytest.mark.parametrize("changes, reason", MANIFESTS.values(), ids=MANIFESTS)
def test_a_manifest_that_does_not_fit(bench_with_a, mini, helpers, changes, reason):
    swap = bench_with_a.swap
    with pytest.raises(Refused, match=reason):
        send(swap, mini.b, helpers, helpers.manifest_of(mini.b, **changes))
    assert swap.missing is None
    assert not any(swap.take(block) for block in helpers.blocks_of(mini.b))
    assert_untouched(bench_with_a, mini)


BLOCKS = {
    "short row": lambda block: block._replace(rows=block.rows[:, :-1]),
    "missing row": lambda block: block._replace(rows=block.rows[:-1]),
    "shifted": lambda block: block._replace(first_row=block.first_row + 1),
    "other matrix": lambda block: block._replace(matrix=1 - block.matrix),
    "no such matrix": lambda block: block._replace(matrix=2),
    "other epoch": lambda block: block._replace(epoch=1),
    "far away": lambda block: block._replace(first_row=2**32 - 1),
}


@pytest.mark.parametrize("change", BLOCKS.values(), ids=BLOCKS)
@pytest.mark.parametrize("number", [0, 3])
def test_a_block_of_the_wrong_shape(bench_with_a, mini, helpers, change, number):
    swap = bench_with_a.swap
    blocks = helpers.blocks_of(mini.b)
    blocks[number] = change(blocks[number])
    with pytest.raises(Refused, match=f"block {number}: expected"):
        send(swap, mini.b, helpers, blocks=blocks)
    assert swap.missing is None
    assert_untouched(bench_with_a, mini)


def test_a_block_that_does_not_exist_is_ignored(bench_with_a, mini, helpers):
    blocks = [helpers.blocks_of(mini.b)[0]._replace(number=4)]
    assert send(bench_with_a.swap, mini.b, helpers, blocks=blocks) is None
    assert len(bench_with_a.swap.missing[1]) == 4


def test_one_flipped_bit_is_a_bad_checksum(bench_with_a, mini, helpers):
    blocks = helpers.blocks_of(mini.b)
    rows = blocks[1].rows.copy()
    rows.view(np.uint32)[5, 7] ^= 1
    blocks[1] = blocks[1]._replace(rows=rows)
    with pytest.raises(Refused, match="checksum: content gives"):
        send(bench_with_a.swap, mini.b, helpers, blocks=blocks)
    assert bench_with_a.swap.staged is None
    assert_untouched(bench_with_a, mini)


@pytest.mark.parametrize(
    "changes",
    [{"gain": 0.4}, {"slope_reference": np.full(286, 1e-9, "f4")}, {"command_limit": np.full(101, 1.0, "f4")}],
    ids=["gain", "slope_reference", "command_limit"],
)
def test_the_checksum_covers_all_that_makes_a_command(bench_with_a, mini, helpers, changes):
    with pytest.raises(Refused, match="checksum"):
        send(bench_with_a.swap, mini.b, helpers, helpers.manifest_of(mini.b, **changes))


def test_a_manifest_whose_vectors_have_the_wrong_length(bench_with_a, mini, helpers):
    for changes in (
        {"slope_reference": np.zeros(285, "f4")},
        {"command_limit": np.ones(1, "f4")},
        {"probe_commands": np.zeros(3 * 101, "f4")},
    ):
        with pytest.raises(Refused, match="expected shape"):
            send(bench_with_a.swap, mini.b, helpers, helpers.manifest_of(mini.b, **changes))
    assert_untouched(bench_with_a, mini)


# -- checks ----------------------------------------------------------------------------------------------------------


def built(mini, R=None, G=None, **changes) -> Reconstructor:
    """Reconstructor a with other matrices, as an SRTC in error might build it: Q fits to R."""
    R = mini.a.R[0] if R is None else R
    made = Reconstructor.from_matrices(
        R,
        mini.G if G is None else G,
        fingerprint=mini.layout.fingerprint,
        gain=0.5,
        command_limit=mini.layout.stroke,
        label="bad",
    )
    return replace(made, **changes)


def poisoned(array, value=np.nan):
    array = array.copy()
    array[(0,) * array.ndim] = value
    return array


def wrong(mini) -> dict[str, tuple[Reconstructor, str]]:
    a = mini.a
    M, N = a.n_commands, a.n_slopes
    shuffled = np.random.default_rng(1).permutation(N)
    far = np.zeros((M, N), np.float32)
    far[:, 0] = a.R[0][:, 0]
    return {
        "other instrument": (replace(a, fingerprint=bytes(32)), "made for another instrument"),
        "too few commands": (
            Reconstructor.from_matrices(
                a.R[0][1:], mini.G[:, 1:], fingerprint=a.fingerprint, gain=0.5, command_limit=np.ones(M - 1)
            ),
            "expected R of shape",
        ),
        "gain 0": (replace(a, gain=0.0), "gain: expected above 0"),
        "gain above 1": (replace(a, gain=1.01), "gain: expected"),
        "gain below 0": (replace(a, gain=-0.5), "gain: expected"),
        "gain NaN": (replace(a, gain=math.nan), "gain: expected"),
        "NaN in R": (replace(a, R=poisoned(a.R)), "R: holds values that are not finite"),
        "infinity in Q": (replace(a, Q=poisoned(a.Q, np.inf)), "Q: holds values that are not finite"),
        "NaN in the reference": (replace(a, slope_reference=poisoned(a.slope_reference)), "slope_reference: holds"),
        "NaN in a probe": (replace(a, probe_slopes=poisoned(a.probe_slopes)), "probe_slopes: holds"),
        "no stroke": (replace(a, command_limit=poisoned(a.command_limit, 0.0)), "command_limit: expected every"),
        "NaN stroke": (replace(a, command_limit=poisoned(a.command_limit)), "command_limit: expected every"),
        "no probes": (replace(a, probe_commands=np.zeros((0, M)), probe_slopes=np.zeros((0, N))), "at least one"),
        "wrong sign": (built(mini, -a.R[0]), "wrong sign or scale"),
        "twice as much": (built(mini, 2 * a.R[0]), "wrong sign or scale"),
        "arcseconds for radians": (built(mini, a.R[0] * 4.85e-6), "wrong sign or scale"),
        "other order of slopes": (built(mini, a.R[0][:, shuffled]), "wrong sign or scale|Q is not R G"),
        "nothing": (built(mini, 0 * a.R[0]), "Q is not R G"),
        "almost nothing": (built(mini, far), "wrong sign or scale"),
        "Q of another R": (replace(a, Q=mini.b.Q), "Q is not R G"),
        "one wrong row of Q": (
            replace(a, Q=np.concatenate([a.Q[:, :50], 0 * a.Q[:, 50:51], a.Q[:, 51:]], axis=1)),
            "Q is not R G",
        ),
        "other order of commands": (replace(a, Q=a.Q[:, ::-1]), "Q is not R G"),
    }


def test_every_refusal_of_a_check(bench_with_a, mini):
    """Staging says why, leaves what was staged before, and does not touch the loop."""
    swap = bench_with_a.swap
    swap.stage_whole(mini.b)
    for name, (reconstructor, reason) in wrong(mini).items():
        with pytest.raises(Refused, match=reason):
            swap.stage_whole(reconstructor)
            pytest.fail(name)
        assert swap.staged.slot.id == mini.b.id
        assert np.array_equal(swap.staged.slot.epochs[0].Q, mini.b.Q[0])
    assert_untouched(bench_with_a, mini)


@pytest.fixture(scope="module")
def moved_mirror(mini):
    """Interaction matrix of the mirror moved by a part of a pitch."""

    @cache
    def matrix(pitches: float) -> np.ndarray:
        layout = Layout(mini.system)
        (mirror,) = layout.mirrors
        moved = mirror.actuators + pitches * mirror.pitch * np.array([0.8, -0.6])
        layout.mirrors = (replace(mirror, actuators=moved),)
        return interaction_matrix(mini.system, layout)

    return matrix


def test_the_margin_is_the_spectral_radius_against_the_calibrated_mirror(mini, moved_mirror):
    G_cal = moved_mirror(0.2).astype(np.float32)
    passed = check(mini.a, mini.layout, G_cal, tip_tilt=True)
    mismatch = mini.a.Q[0].astype(float) - mini.a.R[0].astype(float) @ G_cal
    assert passed.stability == pytest.approx(np.abs(np.linalg.eigvals(mismatch)).max(), rel=1e-3)
    assert 0.3 < passed.stability < 0.8


@pytest.mark.parametrize("pitches", [0.4, 0.5])
def test_a_mirror_that_is_far_from_where_the_reconstructor_thinks_is_refused(mini, moved_mirror, pitches):
    with pytest.raises(Refused, match=r"not stable enough: spectral radius of Q - R G_cal is 1\.\d+, limit 0.8"):
        check(mini.a, mini.layout, moved_mirror(pitches).astype(np.float32), tip_tilt=True)


@pytest.mark.parametrize("delay", [1, 1.6, 2, 3])
@pytest.mark.parametrize("pitches, gain", [(0.3, 0.9), (0.5, 0.5), (0.5, 0.9), (0.7, 0.5), (0.7, 0.9)])
def test_the_margin_foretells_which_loops_diverge(mini, moved_mirror, helpers, delay, pitches, gain):
    """Below 1 a loop is stable at every delay and gain. How fast it dies or grows is the largest root of the law.

    With a mirror at G' the homogeneous loop is ``u[k] = (1-g) u[k-1] + g E u~[k]``, ``E = Q - R G'``: for each
    eigenvalue e of E its roots z solve ``1 = (1-g)/z + g e ((1-f)/z^n + f/z^(n+1))``.
    """
    G_true = moved_mirror(pitches)
    E = mini.a.Q[0].astype(float) - mini.a.R[0].astype(float) @ G_true
    n, f = math.floor(delay), delay - math.floor(delay)
    largest = 0.0
    for e in np.linalg.eigvals(E):
        law = np.zeros(n + 2, complex)
        law[0], law[1] = 1, -(1 - gain)
        law[n] -= gain * e * (1 - f)
        law[n + 1] -= gain * e * f
        largest = max(largest, np.abs(np.roots(law)).max())
    assert largest < 1 or spectral_radius(E) > 1  # the promise

    slot = Slot(mini.layout)
    slot.fill(replace(mini.a, command_limit=np.full(101, 1e30), gain=gain))
    loop = Loop(mini.layout, delay)
    loop.post(Program(slot, helpers.plain_settings(mini.layout)))
    loop.request(closed=True)
    loop.prepare()
    shown: dict[int, np.ndarray] = {}
    flat = np.zeros(101)
    kick = np.random.default_rng(0).standard_normal(mini.layout.n_slopes) * 1e-6
    size = []
    for k in range(200):
        shape = (1 - f) * shown.get(k - n, flat) + f * shown.get(k - n - 1, flat)
        y = (kick if k == 0 else 0) - G_true @ shape
        for w in range(loop.n_sensors):
            loop.add(w, y[mini.layout.slopes_of(w)].astype("f4"))
        newest, before = (frame if frame >= 0 else -1 for frame in (k - n, k - n - 1))
        assert loop.answer(newest, before, 1 - f) is Verdict.OK
        shown[k] = loop.command.astype(float)
        size.append(np.linalg.norm(shown[k]))
        loop.prepare()
    growth = (size[-1] / size[99]) ** (1 / 100)
    assert growth == pytest.approx(largest, abs=0.02)
    assert (growth > 1) == (largest > 1) or abs(largest - 1) < 0.005


# -- spectral radius -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [2, 30, 31, 80, 200])
@pytest.mark.parametrize("seed", range(4))
def test_spectral_radius_of_any_matrix(size, seed):
    """Real random matrices: their largest eigenvalues are mostly complex pairs."""
    matrix = np.random.default_rng(seed).standard_normal((size, size)) / math.sqrt(size)
    assert spectral_radius(matrix) == pytest.approx(np.abs(np.linalg.eigvals(matrix)).max(), rel=1e-4)


def test_spectral_radius_of_complex_pairs_of_equal_size():
    """Rotations by many angles at one radius: power iteration never settles on these."""
    blocks = np.zeros((120, 120))
    for i, angle in enumerate(np.linspace(0.1, 3.0, 60)):
        c, s = math.cos(angle), math.sin(angle)
        blocks[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = 0.7 * np.array([[c, -s], [s, c]])
    q, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((120, 120)))
    assert spectral_radius(q @ blocks @ q.T) == pytest.approx(0.7, rel=1e-5)


@pytest.mark.parametrize("size", [5, 50])
def test_spectral_radius_of_special_matrices(size):
    assert spectral_radius(np.zeros((size, size))) == 0
    assert spectral_radius(-0.3 * np.eye(size)) == pytest.approx(0.3)
    assert spectral_radius(np.diag([*np.linspace(0, 0.5, size - 1), -0.9])) == pytest.approx(0.9)


def test_smooth_shapes_are_orthonormal_and_smooth(mini):
    with_tilt = smooth_shapes(mini.layout, tip_tilt=True)
    without = smooth_shapes(mini.layout, tip_tilt=False)
    assert with_tilt.shape == without.shape == (20, mini.layout.n_commands)
    for shapes in (with_tilt, without):
        assert shapes @ shapes.T == pytest.approx(np.eye(20), abs=1e-10)
        assert shapes.sum(axis=1) == pytest.approx(0, abs=1e-10)
    positions = mini.layout.mirrors[0].actuators
    assert without @ positions == pytest.approx(0, abs=1e-10)
    slopes = np.linalg.norm(mini.G @ with_tilt.T, axis=0)
    assert slopes.min() > 0.05 * np.linalg.norm(mini.G, 2)  # all are seen


# -- commit and roll back --------------------------------------------------------------------------------------------


def test_refusals_of_a_commit_and_of_a_roll_back(bench_with_a, mini):
    swap = bench_with_a.swap
    b, other = mini.b, bytes([1]) * 32
    with pytest.raises(Refused, match="no reconstructor is staged"):
        swap.commit(b.id, b.sha256)
    with pytest.raises(Refused, match="no reconstructor is kept"):
        swap.roll_back(b.id, b.sha256)
    swap.stage_whole(b)
    for act, where in ((swap.commit, "staged"), (swap.roll_back, "kept as the previous one")):
        with pytest.raises(Refused, match=f"is not {where}|no reconstructor is {where}"):
            act(mini.a.id, mini.a.sha256)
    with pytest.raises(Refused, match=f"reconstructor {b.id:016x} has SHA-256 {b.sha256.hex()}, got {other.hex()}"):
        swap.commit(b.id, other)
    assert swap.staged.slot.id == b.id and swap.previous is None
    swap.commit(b.id, b.sha256)
    with pytest.raises(Refused, match="no reconstructor is staged"):
        swap.commit(b.id, b.sha256)
    with pytest.raises(Refused, match=f"reconstructor {b.id:016x} is not kept as the previous one: that is"):
        swap.roll_back(b.id, b.sha256)
    with pytest.raises(Refused, match="has SHA-256"):
        swap.roll_back(mini.a.id, other)
    swap.roll_back(mini.a.id, mini.a.sha256)


def test_roll_back_and_forth(bench_with_a, mini):
    swap = bench_with_a.swap
    swap.stage_whole(mini.b)
    swap.commit(mini.b.id, mini.b.sha256)
    bench_with_a.run(range(10, 13))
    swap.roll_back(mini.a.id, mini.a.sha256)
    bench_with_a.run(range(13, 16))
    swap.roll_back(mini.b.id, mini.b.sha256)
    bench_with_a.run(range(16, 19))
    made_by = [c.reconstructor for c in bench_with_a.commands]
    # what is posted within a frame is taken up after it
    a, b = mini.a.id, mini.b.id
    assert made_by == [a] * 11 + [b] * 3 + [a] * 3 + [b] * 2


def test_no_command_mixes_two_reconstructors(bench, mini):
    """A new reconstructor is staged and committed in the middle of every frame; each command is of the one it names."""
    made = bench()
    made.close(mini.a)
    variants = [
        built(mini, R * factor, label=f"{i}{j}")
        for i, R in enumerate((mini.a.R[0], mini.b.R[0]))
        for j, factor in enumerate((0.9, 1.0, 1.1))
    ]
    by_id = {one.id: one for one in (mini.a, *variants)}
    made.run(range(5))
    state = made.hrtc.loop.state.astype(float)
    changes = 0
    for k in range(5, 120):
        parts, slopes = made.messages(k), made.sky.slopes(k)
        shown = made.sky.shown[k - 2]
        for w, part in enumerate(parts):
            made.offer(part)
            if w == k % 4:
                one = variants[k % len(variants)]
                made.swap.stage_whole(one)
                made.commit(one)
        command = made.commands[-1]
        one = by_id[command.reconstructor]
        changes += command.reconstructor != made.commands[-2].reconstructor
        expected = 0.5 * state + 0.5 * (one.Q[0].astype(float) @ shown + one.R[0].astype(float) @ slopes)
        assert command.commands == pytest.approx(expected, abs=3e-5 * np.abs(expected).max())
        state = command.commands.astype(float)
    assert changes > 80


def test_staging_never_touches_a_slot_in_use(bench_with_a, mini):
    swap = bench_with_a.swap
    swap.stage_whole(mini.b)
    swap.commit(mini.b.id, mini.b.sha256)
    bench_with_a.run(range(10, 12))
    for factor in (0.9, 1.1, 1.05):
        swap.stage_whole(built(mini, mini.a.R[0] * factor))
        assert len({id(held.slot) for held in (swap.active, swap.staged, swap.previous)}) == 3
        assert np.array_equal(swap.active.slot.epochs[0].Q, mini.b.Q[0])
        assert np.array_equal(swap.previous.slot.epochs[0].Q, mini.a.Q[0])


@contextmanager
def staging(swap, reconstructor):
    """Stages on another thread meanwhile; the result is there at the end."""
    with ThreadPoolExecutor(1) as worker:
        staged = worker.submit(swap.stage_whole, reconstructor)
        yield staged
        assert staged.result(timeout=30).reconstructor is reconstructor


@pytest.fixture
def held_up(monkeypatch):
    """Holds a function up: (it was entered, it may go on)."""

    @contextmanager
    def hold(owner, name):
        entered, go_on, whole = threading.Event(), threading.Event(), getattr(owner, name)

        def held(*args, **options):
            entered.set()
            assert go_on.wait(30)
            return whole(*args, **options)

        with monkeypatch.context() as patch:
            patch.setattr(owner, name, held)
            yield entered, go_on

    return hold


def test_what_runs_changes_while_a_check_takes_its_time(bench_with_a, mini, held_up):
    """A commit, a roll-back and settings; then it is staged beside what is active and previous by then."""
    made, swap = bench_with_a, bench_with_a.swap
    swap.stage_whole(mini.b)
    other = built(mini, mini.a.R[0] * 1.1)
    with held_up(swap_module, "check") as (entered, go_on), staging(swap, other):
        try:
            assert entered.wait(30)
            swap.commit(mini.b.id, mini.b.sha256)
            made.run(range(10, 12))
            swap.roll_back(mini.a.id, mini.a.sha256)
            made.run(range(12, 14))
            swap.change_settings(leak=0.25)
            assert swap.staged is None and swap.holds(mini.a.sha256) and not swap.holds(other.sha256)
        finally:
            go_on.set()
    assert [held.slot.id for held in (swap.active, swap.previous, swap.staged)] == [mini.a.id, mini.b.id, other.id]
    assert len({id(held.slot) for held in (swap.active, swap.previous, swap.staged)}) == 3
    assert np.array_equal(swap.previous.slot.epochs[0].Q, mini.b.Q[0])
    made.run(range(14, 16))
    assert swap.commit(other.id, other.sha256).settings.leak == 0.25


def test_a_slot_that_is_being_filled_is_in_nobodys_hands(bench_with_a, mini, held_up):
    """What was staged in it cannot be committed any more; all else can be done."""
    made, swap = bench_with_a, bench_with_a.swap
    swap.stage_whole(mini.b)
    swap.commit(mini.b.id, mini.b.sha256)
    made.run(range(10, 12))
    old, new = (built(mini, mini.a.R[0] * factor) for factor in (0.9, 1.1))
    swap.stage_whole(old)
    with held_up(Slot, "fill") as (entered, go_on), staging(swap, new):
        try:
            assert entered.wait(30)
            with pytest.raises(Refused, match="no reconstructor is staged"):
                swap.commit(old.id, old.sha256)
            swap.roll_back(mini.a.id, mini.a.sha256)
            made.run(range(12, 14))
        finally:
            go_on.set()
    assert [held.slot.id for held in (swap.active, swap.previous, swap.staged)] == [mini.a.id, mini.b.id, new.id]
    assert np.array_equal(swap.staged.slot.epochs[0].Q, new.Q[0])


def test_one_thread_stages_while_another_swaps(bench, mini):
    """As fast as both go; no command is of a mixture, and whatever is in a slot is whole."""
    made = bench()
    made.close(mini.a)
    variants = [built(mini, mini.a.R[0] * (0.9 + 0.02 * i), label=str(i)) for i in range(8)]
    by_id = {one.id: one for one in (mini.a, *variants)}
    stop, n_staged, choices = threading.Event(), 0, random.Random(3)

    def stage() -> None:
        nonlocal n_staged
        while not stop.is_set():
            made.swap.stage_whole(variants[n_staged % len(variants)])
            n_staged += 1

    made.run(range(5))
    state, swaps = made.hrtc.loop.state.astype(float), 0
    with ThreadPoolExecutor(1) as worker:
        stager = worker.submit(stage)
        try:
            for k in range(5, 200):
                slopes, shown = made.sky.slopes(k), made.sky.shown[k - 2]
                parts = made.messages(k)
                made.offer(*parts[:2])
                held = choices.choice((made.swap.staged, made.swap.staged, made.swap.previous))
                act = made.swap.roll_back if held is made.swap.previous else made.swap.commit
                if held is not None:
                    with suppress(Refused):  # not any more
                        act(held.reconstructor.id, held.reconstructor.sha256)
                        swaps += 1
                one = made.swap.active
                assert np.array_equal(one.slot.epochs[0].R, one.reconstructor.R[0])
                assert np.array_equal(one.slot.epochs[0].Q, one.reconstructor.Q[0])
                made.offer(*parts[2:])
                command = made.commands[-1]
                one = by_id[command.reconstructor]
                expected = 0.5 * state + 0.5 * (one.Q[0].astype(float) @ shown + one.R[0].astype(float) @ slopes)
                assert command.commands == pytest.approx(expected, abs=3e-5 * np.abs(expected).max())
                state = command.commands.astype(float)
        finally:
            stop.set()
        stager.result(timeout=30)
    assert swaps > 20 and n_staged > 5


def test_settings_go_with_whatever_is_active(bench_with_a, mini):
    swap = bench_with_a.swap
    first = swap.settings
    program = swap.change_settings(leak=0.25)
    assert (swap.settings.id, swap.settings.leak, program.slot.id) == (first.id + 1, 0.25, mini.a.id)
    swap.stage_whole(mini.b)
    assert swap.commit(mini.b.id, mini.b.sha256).settings is swap.settings
    assert first.leak == 0


def test_settings_without_a_reconstructor_wait(bench, mini):
    swap = bench().swap
    assert swap.change_settings(leak=0.25) is None
    swap.stage_whole(mini.a)
    assert swap.commit(mini.a.id, mini.a.sha256).settings.leak == 0.25


def test_an_interaction_matrix_of_another_shape(mini, helpers):
    with pytest.raises(ValueError, match="G_cal: expected shape"):
        Swap(mini.system, mini.layout, mini.G[:-1], helpers.plain_settings(mini.layout), lambda program: None)
