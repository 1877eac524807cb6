"""The transforms on the device against numpy.fft in float64, and against identities."""

import functools

import numpy as np
import pyopencl as cl
import pytest
from transform import Transform

from lnocl.core.opencl.device import choose

POWERS = [(n, n) for n in (2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048)]
# Each odd factor with one, two and three passes within.
ODD = [(n, n) for n in (48, 80, 112, 144, 192, 320, 448, 576, 1536, 1280, 1792, 1152)]
OBLONGS = [
    (4096, 2),
    (8192, 4),
    (6144, 2),
    (5120, 2),
    (4608, 4),
    (2, 4096),
    (4, 8192),
    (128, 64),
    (8, 1024),
    (1024, 128),
    (7168, 2),
    (16, 4608),
    (256, 1792),
    (2560, 144),
]
GRIDS = POWERS + ODD + OBLONGS  # every power of two from 2 to 8192 along an axis
# One and two passes, in single; tests/kernels has double.
FEW = [(128, 64)]
# In double, whose sources are the same: what every path has once, the longest and the odd.
IN_DOUBLE = [(2, 2), (64, 64), (512, 512), (2048, 2048), (144, 144), (1792, 1792), (128, 64)]
IN_DOUBLE += [(8192, 4), (2, 4096), (5120, 2), (16, 4608)]
DTYPES = (np.float32, np.float64)
ACCURATE_L2 = {np.float32: 5e-7, np.float64: 1e-15}


def accurate_worst(dtype, n):
    """Bound on the worst element over the largest, for n points (DESIGN, section 6)."""
    per_point = {np.float32: (2e-6, 5e-7), np.float64: (5e-15, 5e-16)}[dtype]
    return per_point[0] + per_point[1] * np.log10(n)


@functools.cache
def transform(grid, dtype):
    return Transform(cl.Context([choose().device]), grid, np.dtype(dtype))


def runs(grids):
    """Return each grid in single, and some in double, most of them for CI alone."""
    return [
        pytest.param(
            grid,
            dtype,
            marks=[] if grid in FEW and dtype is np.float32 else [pytest.mark.exhaustive],
        )
        for grid in grids
        for dtype in (DTYPES if grid in IN_DOUBLE else DTYPES[:1])
    ]


def rounded(values, dtype):
    if np.iscomplexobj(values):
        return rounded(values.real, dtype) + 1j * rounded(values.imag, dtype)
    return values.astype(dtype).astype(np.float64)


def l2(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def assert_accurate(found, expected, dtype, n):
    assert l2(found, expected) < ACCURATE_L2[dtype]
    assert np.abs(found - expected).max() < accurate_worst(dtype, n) * np.abs(expected).max()


@functools.cache
def columns_of(grid, dtype):
    """Random complex columns, no more than a few, for the transform in one dimension."""
    rng = np.random.default_rng(grid[0])
    shape = grid[0], grid[1] // 2
    return rounded(rng.normal(size=shape) + 1j * rng.normal(size=shape), dtype)


@pytest.mark.parametrize(("grid", "dtype"), runs(GRIDS))
def test_one_and_two_dimensions(grid, dtype):
    """In one test, as a program takes seconds to compile."""
    t, n = transform(grid, dtype), grid[0] * grid[1]
    pixels = rounded(np.random.default_rng(n).normal(size=grid), dtype)
    spectrum = np.fft.rfft2(pixels)
    assert_accurate(t.rfft2(pixels), spectrum, dtype, n)
    assert_accurate(t.irfft2(rounded(spectrum, dtype)), pixels, dtype, n)
    assert_accurate(t.irfft2(t.rfft2(pixels)), pixels, dtype, n)
    columns, n = columns_of(grid, dtype), grid[0]
    before = columns.copy()
    spectrum = np.fft.fft(columns, axis=0)
    assert_accurate(t.fft(columns), spectrum, dtype, n)
    assert_accurate(t.ifft(columns), np.fft.ifft(columns, axis=0), dtype, n)
    assert np.array_equal(columns, before)


@pytest.mark.parametrize(("grid", "dtype"), runs(FEW))
def test_impulse_is_flat_and_exact(grid, dtype):
    pixels = np.zeros(grid)
    pixels[0, 0] = 1.0
    assert (transform(grid, dtype).rfft2(pixels) == 1.0).all()


@pytest.mark.parametrize(
    ("rows", "count"),
    [([0], 1), ([127], 1), ([15, 16], 2), ([100, 5], 3), ([40, 60, 70], 3), (range(128), 8)],
)
def test_window_is_the_shortest_run_of_blocks_round_the_edge(rows, count):
    layout = transform((128, 64), np.float32).layout
    assert layout.pixels_shape[0] == 8
    held = np.zeros(128, bool)
    held[list(rows)] = True
    first, found = layout.window(held)
    assert found == count
    assert held[layout.rows_of(first, count)].sum() == held.sum()
