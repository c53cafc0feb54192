"""Tile low-rank matrices: what the factors are, how far they are off, and that the loop and a replay run them."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from srtomo_core import wire
from srtomo_core.bag import BagError, BagReader
from srtomo_core.layout import Layout
from srtomo_core.messages import decode
from srtomo_core.reconstructor import Reconstructor
from srtomo_core.system import load_system
from srtomo_rtc import replay, swap
from srtomo_rtc.compression import LIMIT, SlopeStatistics, error_to_noise
from srtomo_rtc.crew import Crew
from srtomo_rtc.lowrank import TOLERANCE, factorise, hilbert
from srtomo_rtc.swap import Refused
from srtomo_sim.mirror import interaction_matrix


@pytest.fixture(scope="module")
def fine():
    """``mini`` with four times as many actuators and six times the sub-apertures: large enough for low rank to win."""
    system = load_system("mini", {"sensors.*.subapertures": 20, "mirrors.*.actuators": 21})
    layout = Layout(system)
    G = interaction_matrix(system, layout)
    R = np.linalg.solve(G.T @ G + 3e-3 * np.linalg.norm(G, 2) ** 2 * np.eye(layout.n_commands), G.T)
    a = Reconstructor.from_matrices(
        R, G, fingerprint=layout.fingerprint, gain=0.5, command_limit=layout.stroke, label="a"
    )
    return SimpleNamespace(system=system, layout=layout, G=G.astype(np.float32), a=a)


@pytest.fixture(scope="module")
def factors(fine):
    return factorise(fine.system, fine.layout, fine.a.R[0])


def test_a_hilbert_curve_visits_every_point_and_steps_to_a_neighbour():
    y, x = np.divmod(np.arange(64**2), 64)
    along = hilbert(x, y)
    order = np.argsort(along)
    assert np.array_equal(np.sort(along), np.arange(64**2))
    assert np.all(np.abs(np.diff(x[order])) + np.abs(np.diff(y[order])) == 1)


def test_slopes_of_a_row_add_up_to_a_phase_difference(fine):
    """In closed form: n slopes along a row see the phase between its ends, across it that between its long sides."""
    statistics, own = SlopeStatistics(fine.system, fine.layout), fine.layout.sensors[1]
    y, x = np.nonzero(own.mask)
    row = np.flatnonzero(y == 17)
    assert np.all(np.diff(x[row]) == 1)
    covariance = statistics.covariance(1, row) - np.diag(np.repeat(statistics.photons(1)[row], 2))
    d, n = own.size, len(row)
    scale = (500e-9 / (2 * np.pi * d)) ** 2
    assert covariance[::2, ::2].sum() == pytest.approx(scale * 6.88388 * (n * d / fine.system.los_r0) ** (5 / 3))
    assert np.diag(covariance) == pytest.approx(scale * 6.88388 * (d / fine.system.los_r0) ** (5 / 3))
    # slopes across the way from one to the other are more alike than slopes along it
    along, across = covariance[::2, ::2][0], covariance[1::2, 1::2][0]
    assert across[1] > along[1] > 0
    assert np.allclose(covariance[::2, 1::2], 0, atol=1e-12 * scale)  # x with y, in one row


def test_the_stated_error_is_that_of_correlated_slopes(fine):
    """An error that is the same all along a row does not average out: one row of R and of the sensor, closed form."""
    layout, R = fine.layout, fine.a.R[0]
    own = layout.sensors[0]
    y, _ = np.nonzero(own.mask)
    row = np.flatnonzero(y == 17)
    wrong = R.copy()
    wrong[5, row] += 1e-3  # x slopes of sensor 0
    photons = np.concatenate([np.tile(SlopeStatistics(fine.system, layout).photons(w), 2) for w in range(4)])
    noise = np.sum(R.astype(float) ** 2 @ photons)
    tilt = (500e-9 / (2 * np.pi * own.size)) ** 2 * 6.88388 * (len(row) * own.size / fine.system.los_r0) ** (5 / 3)
    expected = 1e-6 * (tilt + photons[row].sum())
    found = error_to_noise(fine.system, layout, R, wrong)
    assert found == pytest.approx(np.sqrt(expected / noise), rel=1e-3)


def test_factors_meet_their_tolerance_with_a_quarter_of_the_bytes(fine, factors):
    R = fine.a.R[0]
    assert factors.nbytes < 0.3 * R.nbytes and factors.mean_rank < 20 and factors.whole < 0.3
    error = error_to_noise(fine.system, fine.layout, R, factors.applied())
    assert error == pytest.approx(TOLERANCE, rel=0.02) and error < LIMIT
    better = factorise(fine.system, fine.layout, R, 0.03)
    assert better.nbytes > factors.nbytes
    assert error_to_noise(fine.system, fine.layout, R, better.applied()) == pytest.approx(0.03, rel=0.03)


def test_a_matrix_of_low_rank_is_held_by_that_rank(fine):
    """Three outer products: every block that any of them reaches has rank 3, and next to no error."""
    rng = np.random.default_rng(4)
    layout = fine.layout
    R = (rng.standard_normal((layout.n_commands, 3)) @ rng.standard_normal((3, layout.n_slopes))).astype("f4")
    found = factorise(fine.system, layout, R, 1e-3)
    ranks = np.concatenate([one.ranks for one in found.sensors])
    assert set(ranks) == {3}
    assert np.abs(found.applied() - R).max() < 1e-3 * np.abs(R).max()


def test_a_product_is_that_of_the_matrix_it_states(fine, factors):
    slopes = np.random.default_rng(2).standard_normal((5, fine.layout.n_slopes)).astype("f4")
    for y in slopes:
        found = factors.times(y)
        exact = factors.applied().astype(float) @ y
        assert np.abs(found[: len(exact)] - exact).max() < 1e-5 * np.abs(exact).max()
        assert not found[len(exact) :].any()


def commands_of(made, fine, seed: int, crew: Crew | None) -> bytes:
    """Twelve frames in packets that are cut and shuffled by a seed."""
    made.hrtc.loop.use(crew)
    made.swap.stage_whole(fine.a)
    made.commit(fine.a)
    made.hrtc.loop.request(closed=True)
    rng = np.random.default_rng(seed)
    for k in range(12):
        packets = []
        for w, sensor in enumerate(fine.layout.sensors):
            cuts = np.unique(rng.integers(1, sensor.n_valid, 4 if seed and sensor.n_valid > 1 else 0))
            ends = [0, *cuts.tolist(), sensor.n_valid]
            packets += [made.packet(k, w, a, b - a) for a, b in pairwise(ends)]
        made.offer(*(packets[i] for i in rng.permutation(len(packets))))
    made.hrtc.loop.use(None)
    assert [command.verdict for command in made.commands] == [0] * 12
    return b"".join(command.commands.tobytes() for command in made.commands)


def test_packets_and_threads_decide_no_bit(bench, fine):
    expected = commands_of(bench(fine, kernel="tlr"), fine, 0, None)
    for seed, threads in ((1, 1), (2, 2), (3, 3)):
        with Crew(threads, least_bytes=0) as crew:
            assert commands_of(bench(fine, kernel="tlr"), fine, seed, crew) == expected
    assert commands_of(bench(fine, kernel="float32"), fine, 0, None) != expected


def test_commands_agree_with_the_dense_kernel_s_within_the_tolerance(bench, fine):
    both = [
        np.frombuffer(commands_of(bench(fine, kernel=kernel), fine, 0, None), "f4") for kernel in ("float32", "tlr")
    ]
    difference = np.linalg.norm(both[0] - both[1]) / np.linalg.norm(both[0])
    assert 1e-5 < difference < 0.05


def test_it_is_refused_where_it_does_not_win(bench, mini, fine, monkeypatch):
    with pytest.raises(Refused, match=r"low rank would take 0\.75 of float32's memory, where 16 bits take 0\.5"):
        bench(kernel="tlr").swap.stage_whole(mini.a)
    made = bench(fine, kernel="tlr").swap
    check = str(made.stage_whole(fine.a).check)
    assert check.endswith("; low rank takes 0.26 of float32's memory and errs by 0.09 of photon noise")
    monkeypatch.setattr(swap, "LIMIT", 0.05)
    with pytest.raises(Refused, match=r"low rank would err by 0\.09 of what photon noise leaves"):
        made.stage_whole(fine.a)
    assert made.staged is not None and made.staged.reconstructor is fine.a  # what was there before stays


def test_a_recording_replays_where_its_factors_come_out_the_same(bench, fine, tmp_path, monkeypatch):
    made = bench(fine, bag=tmp_path / "bag", kernel="tlr")
    made.close(fine.a)
    made.run(range(20))
    made.finish()
    with BagReader(tmp_path / "bag") as reader:
        kernels = {decode(wire.EVENT.type, message.data).kernel for message in reader.messages(f"/{wire.EVENT.name}")}
        outcome = replay.Replay(reader).run()
    digest = factorise(fine.system, fine.layout, fine.a.R[0]).digest().hex()[:16]
    assert kernels - {""} == {f"zones-int16-lowrank-{digest}"}
    assert (outcome.compared, outcome.differing, outcome.skipped) == (20, 0, 0)

    # as if LAPACK were another
    monkeypatch.setattr(replay, "factorise", lambda *of: factorise(*of, tolerance=0.08))
    with (
        BagReader(tmp_path / "bag") as reader,
        pytest.raises(BagError, match=rf"{digest}; the factors of .* come out as"),
    ):
        replay.Replay(reader).run()
