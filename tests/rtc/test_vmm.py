"""The kernel: right, and the same bits everywhere."""

import re

import numba
import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features

from srtomo_rtc import loop, vmm
from srtomo_rtc.vmm import KERNEL, TILE, all_finite, multiply, multiply_int16, multiply_tiled, quantise, tiled

SHAPES = [(1, 1), (3, 5), (4, 8), (5, 7), (94, 101), (286, 101), (313, 128), (101, 733)]


def problem(n_columns, n_rows, seed=0):
    rng = np.random.default_rng([seed, n_columns, n_rows])
    columns = rng.standard_normal((n_columns, n_rows)).astype("f4")
    return columns, rng.standard_normal(n_columns).astype("f4")


def product(columns, vector):
    out = np.full(columns.shape[1], np.nan, "f4")
    multiply(columns, vector, out)
    return out


def rounded_in_order(columns, vector):
    """The stated order, with NumPy's float32: each product and each sum is rounded, column after column."""
    out = np.zeros(columns.shape[1], np.float32)
    for column, value in zip(columns, vector, strict=True):
        out = out + column * value
    return out


@pytest.mark.parametrize("shape", SHAPES)
def test_against_float64(shape):
    columns, vector = problem(*shape)
    exact = vector.astype(float) @ columns.astype(float)
    size = np.abs(vector.astype(float)) @ np.abs(columns.astype(float))
    assert np.all(np.abs(product(columns, vector) - exact) <= len(vector) * 2**-24 * size)


@pytest.mark.parametrize("shape", SHAPES)
def test_bit_for_bit_the_stated_order(shape):
    columns, vector = problem(*shape)
    assert np.array_equal(product(columns, vector), rounded_in_order(columns, vector))


def test_single_products_are_rounded_before_they_are_added():
    """Where a fused multiply-add would keep what rounding drops: (1 + e)^2 - (1 + 2e) is 0, and e^2 fused."""
    e = np.float32(2**-12)
    columns = np.full((2, 64), np.float32(1) + e)
    columns[0] = -(np.float32(1) + 2 * e)
    assert not product(columns, np.array([1, 1 + e], "f4")).any()


@pytest.mark.parametrize("rows", [1, 3, 7, 8, 9, 15, 16, 17, 31, 33, 63, 100])
def test_a_row_does_not_depend_on_its_neighbours(rows):
    """Vector width, alignment and remainders decide nothing: any rows alone have the same bits as within the matrix."""
    columns, vector = problem(37, 128)
    whole = product(columns, vector)
    for start in (0, 1, 5, 28):
        part = np.ascontiguousarray(columns[:, start : start + rows])
        assert np.array_equal(product(part, vector), whole[start : start + rows])


@pytest.mark.parametrize("offset", range(8))
def test_memory_alignment_decides_nothing(offset):
    columns, vector = problem(37, 101)
    memory = np.zeros(columns.size + 8, np.float32)
    shifted = memory[offset : offset + columns.size].reshape(columns.shape)
    shifted[:] = columns
    place = np.zeros(101 + 8, np.float32)
    out = place[offset : offset + 101]
    multiply(shifted, vector, out)
    assert np.array_equal(out, product(columns, vector))


def test_what_is_not_finite_comes_out():
    columns, vector = problem(5, 4)
    for bad in (np.nan, np.inf):
        vector[2] = bad
        assert not np.isfinite(product(columns, vector)).any()


def assembly_of(function, **changes) -> str:
    """What a kernel compiles to here; compiled anew, because cached code cannot be inspected."""
    options = {**function.targetoptions, **changes}
    (text,) = numba.jit(function.signatures[0], **options)(function.py_func).inspect_asm().values()
    return text


FUSED = re.compile(r"\b(v?fn?m(add|sub)\d*[ps][sd]|fn?m(la|ls|add|sub))\b")  # x86, ARM


@pytest.mark.parametrize(
    "function",
    [
        vmm.multiply,
        vmm.multiply_int16,
        loop._state_on_mirror,
        loop._prepared,
        loop._next_state,
        loop._clip,
        loop._relax,
    ],
)
def test_no_multiply_add_is_fused(function):
    """A fused one keeps more bits, and not every processor has it: replays would differ between machines."""
    assembly = assembly_of(function)
    assert function.py_func.__name__ in assembly
    assert not FUSED.search(assembly)


def test_a_fused_multiply_add_would_be_found():
    if not get_host_cpu_features().get("fma"):
        pytest.skip("LLVM says that this processor has no fused multiply-add")
    assert FUSED.search(assembly_of(vmm.multiply, fastmath={"contract"}))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 8, 100])
def test_all_finite(bad, place):
    """With fastmath isfinite would always be true."""
    vector = np.full(101, np.finfo("f4").max)
    assert all_finite(vector)
    vector[place] = bad
    assert not all_finite(vector)
    assert all_finite(np.zeros(0, "f4"))


def test_the_kernel_has_a_name():
    """Bags say which kernel made them: change the name with the arithmetic, and keep the bits with the name."""
    columns, vector = problem(9, 5)
    assert KERNEL == "columns-float32-1thread"
    assert np.array_equal(product(columns, vector), rounded_in_order(columns, vector))


@pytest.mark.parametrize("shape", [*SHAPES, (9, TILE), (30, 2 * TILE), (30, 2 * TILE + 1), (30, TILE - 1)])
def test_tiles_give_the_same_bits(shape):
    columns, vector = problem(*shape)
    out = np.full(shape[1], np.nan, "f4")
    multiply_tiled(tiled(columns.T), vector, out)
    assert np.array_equal(out, product(columns, vector))


def test_tiles_are_the_matrix_s_rows():
    matrix = np.arange(3 * (TILE + 2)).reshape(TILE + 2, 3).astype("f4")
    tiles = tiled(matrix)
    assert tiles.shape == (2, 3, TILE) and tiles.flags.c_contiguous and tiles.dtype == np.float32
    assert np.array_equal(tiles[0].T, matrix[:TILE])
    assert np.array_equal(tiles[1, :, :2].T, matrix[TILE:]) and not tiles[1, :, 2:].any()


def int16_product(matrix, vector):
    integers, scales = quantise(matrix)
    out = np.full(len(matrix), np.nan, "f4")
    multiply_int16(tiled(integers), scales, vector, out)
    return out


@pytest.mark.parametrize("shape", SHAPES)
def test_int16_against_float64(shape):
    """Of the quantised matrix to float32's rounding, and of the matrix itself within the stated error."""
    columns, vector = problem(*shape)
    matrix = columns.T * np.logspace(-9, 2, shape[1], dtype="f4")[:, None]
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
    columns, vector = problem(*shape)
    steps, scales = quantise(columns.T)
    expected = rounded_in_order(steps.T.astype("f4"), vector) * scales
    assert np.array_equal(int16_product(columns.T, vector), expected)


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
