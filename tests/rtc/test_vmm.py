"""The kernels: right, and the same bits everywhere."""

import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from srtomo_rtc import native
from srtomo_rtc.native import lib
from srtomo_rtc.vmm import (
    KERNELS,
    accumulate,
    huge_zeros,
    instructions,
    multiply,
    multiply_int16,
    quantise,
    rows_of,
    tiled,
    untiled,
)

SHAPES = [(1, 1), (3, 5), (4, 8), (5, 7), (94, 101), (286, 101), (313, 128), (101, 733)]
SHAPES += [(9, 32), (9, 64), (30, 128), (30, 129), (30, 31), (30, 63), (30, 96)]


def problem(n_columns, n_rows, seed=0):
    rng = np.random.default_rng([seed, n_columns, n_rows])
    matrix = rng.standard_normal((n_columns, n_rows)).astype("f4").T
    return matrix, rng.standard_normal(n_columns).astype("f4")


def product(matrix, vector):
    out = np.full(rows_of(len(matrix)), np.nan, "f4")
    multiply(tiled(matrix), vector, out)
    assert not out[len(matrix) :].any() or not np.isfinite(vector).all()
    return out[: len(matrix)]


def rounded_in_order(matrix, vector):
    """The stated order, with NumPy's float32: each product and each sum is rounded, column after column."""
    out = np.zeros(len(matrix), np.float32)
    for column, value in zip(matrix.T, vector, strict=True):
        out = out + column * value
    return out


@pytest.mark.parametrize("shape", SHAPES)
def test_against_float64(shape):
    matrix, vector = problem(*shape)
    exact = matrix.astype(float) @ vector.astype(float)
    size = np.abs(matrix.astype(float)) @ np.abs(vector.astype(float))
    assert np.all(np.abs(product(matrix, vector) - exact) <= len(vector) * 2**-24 * size)


@pytest.mark.parametrize("shape", SHAPES)
def test_bit_for_bit_the_stated_order(shape):
    matrix, vector = problem(*shape)
    assert np.array_equal(product(matrix, vector), rounded_in_order(matrix, vector))


def test_single_products_are_rounded_before_they_are_added():
    """Where a fused multiply-add would keep what rounding drops: (1 + e)^2 - (1 + 2e) is 0, and e^2 fused."""
    e = np.float32(2**-12)
    matrix = np.full((64, 2), np.float32(1) + e)
    matrix[:, 0] = -(np.float32(1) + 2 * e)
    assert not product(matrix, np.array([1, 1 + e], "f4")).any()


FUSED = re.compile(r"\b(v?fn?m(add|sub)\d*[ps][sd]|fn?m(la|ls|add|sub))\b")  # x86, ARM


def test_no_multiply_add_is_fused_anywhere():
    """Not in the kernels, in none of their instruction sets, and not in the control law."""
    if shutil.which("objdump") is None:
        pytest.skip("no objdump here")
    text = subprocess.run(["objdump", "-d", lib._name], capture_output=True, text=True, check=True).stdout
    assert "srt_accumulate" in text and "srt_loop_answer" in text
    assert not FUSED.search(text)
    assert FUSED.search("vfmadd231ps %zmm0,%zmm1,%zmm2")


@pytest.mark.parametrize("rows", [1, 3, 7, 8, 9, 15, 16, 17, 31, 33, 63, 100])
def test_a_row_does_not_depend_on_its_neighbours(rows):
    """Tiles and remainders decide nothing: any rows alone have the same bits as within the matrix."""
    matrix, vector = problem(37, 128)
    whole = product(matrix, vector)
    for start in (0, 1, 5, 28):
        assert np.array_equal(product(matrix[start : start + rows], vector), whole[start : start + rows])


@pytest.mark.parametrize("offset", range(8))
@pytest.mark.parametrize("kind", ["f4", "i2"])
def test_memory_alignment_decides_nothing(offset, kind):
    matrix, vector = problem(37, 101)
    tiles = tiled((matrix * 1000).astype(kind))
    memory = np.zeros(tiles.size + 8, kind)
    shifted = memory[offset : offset + tiles.size].reshape(tiles.shape)
    shifted[:] = tiles
    sums, expected = np.zeros(128 + 8, "f4")[offset:][:128], np.zeros(128, "f4")
    accumulate(shifted, vector, sums)
    accumulate(tiles, vector, expected)
    assert np.array_equal(sums, expected) and expected.any()


@pytest.mark.parametrize("kind", ["f4", "i2"])
def test_a_product_in_parts_has_the_same_bits(kind):
    """As packets come: a run of columns after the other."""
    matrix, vector = problem(94, 101)
    tiles = tiled((matrix * 1000).astype(kind))
    whole, parts = np.zeros(128, "f4"), np.zeros(128, "f4")
    accumulate(tiles, vector, whole)
    for first, last in ((0, 1), (1, 1), (1, 40), (40, 93), (93, 94)):
        accumulate(tiles, vector, parts, first, last)
    assert np.array_equal(parts, whole)


def test_what_is_not_finite_comes_out():
    matrix, vector = problem(5, 4)
    for bad in (np.nan, np.inf):
        vector[2] = bad
        assert not np.isfinite(product(matrix, vector)).any()


def test_the_kernels_have_names():
    """Bags say which kernel made them: change the name with the arithmetic, and keep the bits with the name."""
    matrix, vector = problem(9, 5)
    assert KERNELS == {
        "float32": "subapertures-float32-1thread",
        "int16": "subapertures-int16-rowscale-1thread",
        "tlr": "zones-int16-lowrank",
    }
    assert np.array_equal(product(matrix, vector), rounded_in_order(matrix, vector))
    assert instructions() in ("AVX-512", "AVX2", "SSE2", "baseline")


def test_tiles_are_the_matrix_s_rows():
    for kind, rows in (("f4", 32), ("i2", 64)):
        matrix = np.arange(3 * (rows + 2)).reshape(rows + 2, 3).astype(kind)
        tiles = tiled(matrix)
        assert tiles.shape == (2, 3, rows) and tiles.flags.c_contiguous and tiles.dtype == kind
        assert np.array_equal(tiles[0].T, matrix[:rows])
        assert np.array_equal(tiles[1, :, :2].T, matrix[rows:]) and not tiles[1, :, 2:].any()
        assert np.array_equal(untiled(tiles, rows + 2), matrix)


@pytest.mark.parametrize("shape", [(1,), (3, 5, 64), (9, 4000, 64)])
def test_huge_pages_hold_zeros_that_can_be_written(shape):
    made = huge_zeros(shape, np.float32)
    assert made.shape == shape and not made.any()
    assert made.nbytes < 2 << 20 or made.ctypes.data % (2 << 20) == 0
    made[:] = 1
    assert made.sum() == np.prod(shape)


def int16_product(matrix, vector):
    integers, scales = quantise(matrix)
    out = np.full(rows_of(len(matrix)), np.nan, "f4")
    multiply_int16(tiled(integers), scales, vector, out)
    return out[: len(matrix)]


@pytest.mark.parametrize("shape", SHAPES)
def test_int16_against_float64(shape):
    """Of the quantised matrix to float32's rounding, and of the matrix itself within the stated error."""
    matrix, vector = problem(*shape)
    matrix = matrix * np.logspace(-9, 2, shape[1], dtype="f4")[:, None]
    steps, scales = quantise(matrix)
    assert steps.dtype == np.int16 and steps.shape == matrix.shape
    assert np.array_equal(np.abs(steps.astype(int)).max(axis=1), np.full(shape[1], 32767))
    decoded = steps * scales.astype(float)[:, None]
    step = scales.astype(float) * (0.5 + 2**-9)
    assert np.all(np.abs(decoded - matrix) <= step[:, None])
    found, y = int16_product(matrix, vector), vector.astype(float)
    rounding = (len(vector) + 1) * 2**-24 * (np.abs(decoded) @ np.abs(y))
    assert np.all(np.abs(found - decoded @ y) <= rounding)
    assert np.all(np.abs(found - matrix.astype(float) @ y) <= rounding + step * np.abs(y).sum())


@pytest.mark.parametrize("shape", SHAPES)
def test_int16_bit_for_bit_the_stated_order(shape):
    matrix, vector = problem(*shape)
    steps, scales = quantise(matrix)
    expected = rounded_in_order(steps.astype("f4"), vector) * scales
    assert np.array_equal(int16_product(matrix, vector), expected)


def test_int16_errs_as_uniform_rounding_does():
    rng = np.random.default_rng(5)
    matrix = rng.standard_normal((200, 400))
    vectors = rng.standard_normal((50, 400)).astype("f4")
    _, scales = quantise(matrix)
    errors = np.array([int16_product(matrix, y) - matrix @ y for y in vectors]) / scales
    expected = np.sqrt(np.mean(np.sum(vectors.astype(float) ** 2, axis=1)) / 12)
    # float32 sums of 400 add a little
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(expected, rel=0.05)


def test_quantise_keeps_zeros_and_refuses_what_it_cannot_hold():
    matrix = np.zeros((3, 4))
    matrix[1] = [0, -2, 1, 0]
    integers, scales = quantise(matrix)
    assert np.array_equal(integers[1], [0, -32767, 16384, 0]) and scales[1] == np.float32(2 / 32767)
    assert not integers[[0, 2]].any() and scales[0] == scales[2] == 1
    for bad in (np.nan, np.inf, 1e-36):
        with pytest.raises(ValueError, match="matrix: "):
            quantise(np.full((2, 2), bad))


def test_a_library_of_another_version_is_refused():
    code = "from srtomo_rtc import native; native._must_agree(native.lib.srt_abi() + 8, native.lib.srt_abi())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "install srtomo again" in done.stderr
    with pytest.raises(ImportError, match="install srtomo again"):
        native._load("libsrtomo_frame.so", {"srt_no_such_function": (None, ())})
