"""The reconstructor: immutable, with a checksum of all that makes a command; its files, and damaged ones."""

import hashlib
import struct
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from srtomo_core.reconstructor import (
    Reconstructor,
    ReconstructorError,
    block_table,
    load_interaction_matrix,
    save_interaction_matrix,
)

M, N = 130, 70  # blocks of 64, 64 and 2 rows
RNG = np.random.default_rng(5)
R = RNG.standard_normal((M, N))
G = RNG.standard_normal((N, M))
FINGERPRINT = bytes(range(32))


@pytest.fixture(scope="module")
def made() -> Reconstructor:
    return Reconstructor.from_matrices(
        R,
        G,
        fingerprint=FINGERPRINT,
        gain=0.3,
        command_limit=np.full(M, 1e-5),
        label="one",
        provenance={"method": "none", "numbers": [1, 2.5]},
    )


def test_q_is_r_as_applied_times_g(made):
    assert made.R.dtype == made.Q.dtype == np.float32
    applied = R.astype("f4").astype(float)
    assert np.array_equal(made.Q[0], (applied @ G).astype("f4"))
    assert (made.n_epochs, made.n_commands, made.n_slopes) == (1, M, N)
    probes = made.probe_commands.astype(float)
    assert made.probe_slopes == pytest.approx(probes @ G.T, rel=1e-6)
    assert np.linalg.matrix_rank(probes) == len(probes) >= 2
    assert not made.slope_reference.any()


def test_immutable(made):
    with pytest.raises(FrozenInstanceError):
        made.gain = 0.5
    for name in ("R", "Q", "slope_reference", "command_limit", "probe_commands", "probe_slopes"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(made, name)[...] = 0
    source = np.ones((1, 2, 3), "f4")
    other = Reconstructor(FINGERPRINT, source, np.ones((1, 2, 2)), 0.5, np.zeros(3), np.ones(2), [[1, 1]], [[1, 1, 1]])
    source[:] = 5
    assert other.R.max() == 1  # a copy


def test_the_digest_by_its_definition(made):
    """SHA-256 of format, fingerprint, shape, gain, reference, limits, R and Q: little-endian, in this order."""
    content = b"srtomo-reconstructor-1" + FINGERPRINT + struct.pack("<III", 1, M, N) + struct.pack("<f", 0.3)
    for array in (made.slope_reference, made.command_limit, made.R, made.Q):
        content += array.astype("<f4").tobytes()
    assert made.sha256 == hashlib.sha256(content).digest()
    assert made.id == int.from_bytes(made.sha256[:8], "big")


@pytest.mark.parametrize("name", ["R", "Q", "slope_reference", "command_limit"])
def test_the_digest_changes_with_every_bit(made, name):
    array = getattr(made, name).copy()
    array.reshape(-1).view(np.uint32)[-1] ^= 1
    assert replace(made, **{name: array}).sha256 != made.sha256


def test_the_digest_is_of_what_makes_a_command(made):
    assert replace(made, gain=0.31).sha256 != made.sha256
    assert replace(made, fingerprint=bytes(32)).sha256 != made.sha256
    assert replace(made, label="two", provenance={}).sha256 == made.sha256


def test_blocks_are_all_rows(made):
    blocks = list(made.blocks())
    table = block_table(M, 1)
    assert [(b.epoch, b.matrix, b.first_row, len(b.rows)) for b in blocks] == table
    assert [len(b.rows) for b in blocks] == [64, 64, 2, 64, 64, 2]
    assert np.array_equal(np.concatenate([b.rows for b in blocks if b.matrix == 0]), made.R[0])
    assert np.array_equal(np.concatenate([b.rows for b in blocks if b.matrix == 1]), made.Q[0])
    assert len(block_table(M, 3)) == 24  # and a fallback


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"R": np.zeros((M, N))}, r"R: expected \(epochs, commands, slopes\)"),
        ({"Q": np.zeros((1, M, N))}, "Q: expected shape"),
        ({"slope_reference": np.zeros(N - 1)}, "slope_reference: expected shape"),
        ({"command_limit": np.zeros(M + 1)}, "command_limit: expected shape"),
        ({"probe_commands": np.zeros((4, N))}, "probe_commands: expected shape"),
        ({"probe_slopes": np.zeros((3, N))}, "probe_slopes: expected shape"),
        ({"fingerprint": b"short"}, "fingerprint: expected 32 bytes, got 5"),
    ],
)
def test_shapes_that_do_not_fit(made, changes, reason):
    with pytest.raises(ReconstructorError, match=reason):
        replace(made, **changes)


def test_matrices_that_do_not_fit():
    with pytest.raises(ReconstructorError, match="G: expected shape"):
        Reconstructor.from_matrices(R, G.T, fingerprint=FINGERPRINT, gain=0.5, command_limit=np.ones(M))


# -- several epochs --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two() -> Reconstructor:
    return Reconstructor.from_matrices(
        np.stack([1.5 * R, -0.5 * R]), G, fingerprint=FINGERPRINT, gain=0.3, command_limit=np.ones(M), fallback=0.9 * R
    )


def test_every_part_has_its_q(two):
    assert (two.n_epochs, two.n_commands, two.n_slopes) == (2, M, N)
    assert len(two.parts) == 3
    for factor, (part, q) in zip((1.5, -0.5, 0.9), two.parts):
        assert part == pytest.approx(factor * R, rel=1e-6)
        assert np.array_equal(q, (part.astype(float) @ G).astype("f4"))


def test_the_fallback_is_part_of_the_digest(two):
    content = b"srtomo-reconstructor-1" + FINGERPRINT + struct.pack("<III", 2, M, N) + struct.pack("<f", 0.3)
    for array in (two.slope_reference, two.command_limit, two.R, two.Q, two.fallback_R, two.fallback_Q):
        content += array.astype("<f4").tobytes()
    assert two.sha256 == hashlib.sha256(content).digest()


def test_blocks_of_all_parts_make_it_again(two):
    R_parts, Q_parts = np.zeros((3, M, N)), np.zeros((3, M, M))
    blocks = list(two.blocks())
    assert [(b.epoch, b.matrix, b.first_row, len(b.rows)) for b in blocks] == block_table(M, 2)
    for block in blocks:
        (R_parts, Q_parts)[block.matrix][block.epoch, block.first_row : block.first_row + len(block.rows)] = block.rows
    names = ("fingerprint", "gain", "slope_reference", "command_limit", "probe_commands", "probe_slopes")
    again = Reconstructor.from_parts(2, R_parts, Q_parts, **{name: getattr(two, name) for name in names})
    assert again.sha256 == two.sha256


def test_a_fallback_belongs_to_several_epochs(made, two):
    for name in ("fallback_R", "fallback_Q"):
        with pytest.raises(ReconstructorError, match=f"{name}: expected with several epochs, and only then"):
            replace(two, **{name: None})
        with pytest.raises(ReconstructorError, match=f"{name}: expected shape"):
            replace(two, **{name: np.ones((M, 3))})
    with pytest.raises(ReconstructorError, match="fallback_R: expected with several epochs, and only then"):
        replace(made, fallback_R=R, fallback_Q=made.Q[0])


def test_a_file_of_several_epochs(two, tmp_path):
    two.save(tmp_path / "two.npz", G)
    again = Reconstructor.load(tmp_path / "two.npz")
    assert again.sha256 == two.sha256 and np.array_equal(again.fallback_Q, two.fallback_Q)


# -- files -----------------------------------------------------------------------------------------------------------


def test_a_file_and_back(made, tmp_path):
    path = tmp_path / "one.npz"
    made.save(path, G)
    again = Reconstructor.load(path)
    assert (again.sha256, again.label, again.provenance, again.gain) == (
        made.sha256,
        "one",
        {"method": "none", "numbers": [1, 2.5]},
        made.gain,
    )
    for name in ("R", "Q", "probe_commands", "probe_slopes"):
        assert np.array_equal(getattr(again, name), getattr(made, name))
    with np.load(path) as content:
        assert np.array_equal(content["G"], G.astype("f4"))
    assert [entry.name for entry in tmp_path.iterdir()] == ["one.npz"]


def test_a_file_is_replaced_whole_or_not_at_all(made, tmp_path):
    path = tmp_path / "one.npz"
    made.save(path)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        made.save(path, interaction_matrix=[["not", "numbers"]])
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["one.npz"]


def test_damaged_files(made, tmp_path):
    path = tmp_path / "one.npz"
    made.save(path)
    whole = path.read_bytes()
    at = whole.index(made.R.tobytes()[:64]) + 11
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(ReconstructorError, match=r"one.npz: (damaged|not a srtomo file)"):
        Reconstructor.load(path)
    for content in (whole[: len(whole) // 2], whole[:-30], b"", b"PK", b"\x93NUMPY", b"hello"):
        path.write_bytes(content)
        with pytest.raises(ReconstructorError, match=r"one.npz") as refused:
            Reconstructor.load(path)
        assert "\n" not in str(refused.value)
    with pytest.raises(ReconstructorError, match="No such file"):
        Reconstructor.load(tmp_path / "absent.npz")
    np.savez(path, x=1)
    with pytest.raises(ReconstructorError, match="not a srtomo file"):
        Reconstructor.load(path)


def test_an_interaction_matrix_and_back(tmp_path):
    path = tmp_path / "g.npz"
    save_interaction_matrix(path, G, FINGERPRINT, {"how": "measured"})
    again = load_interaction_matrix(path, FINGERPRINT)
    assert np.array_equal(again, G.astype("f4")) and not again.flags.writeable
    assert np.array_equal(load_interaction_matrix(path), again)
    with pytest.raises(ReconstructorError, match="made for another instrument"):
        load_interaction_matrix(path, bytes(32))


def test_one_kind_of_file_is_not_the_other(made, tmp_path):
    made.save(tmp_path / "r.npz", G)
    save_interaction_matrix(tmp_path / "g.npz", G, FINGERPRINT, {})
    with pytest.raises(ReconstructorError, match="expected format srtomo-interaction-matrix-1"):
        load_interaction_matrix(tmp_path / "r.npz")
    with pytest.raises(ReconstructorError, match="expected format srtomo-reconstructor-1"):
        Reconstructor.load(tmp_path / "g.npz")
