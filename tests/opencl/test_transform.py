"""The transforms on the device against numpy.fft in float64, and against identities."""

import functools

import numpy as np
import pyopencl as cl
import pytest
import scipy.fft

from lnocl.opencl.device import choose
from lnocl.opencl.launch import roots
from lnocl.opencl.layout import reversed_order
from lnocl.opencl.program import radices
from lnocl.opencl.transform import Transform

POWERS = [(n, n) for n in (2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048)]
# Each odd factor with one, two and three passes within.
ODD = [(n, n) for n in (48, 80, 112, 144, 192, 320, 448, 576, 1536, 1280, 1792, 1152)]
SQUARES = POWERS + ODD
OBLONGS = [
    (4096, 2),
    (8192, 4),
    (6144, 2),
    (5120, 2),
    (4608, 4),
    (2, 4096),
    (4, 8192),
    (16, 2),
    (64, 8),
    (8, 1024),
    (512, 32),
    (32, 256),
    (1024, 128),
    (7168, 2),
    (2, 7168),
    (16, 4608),
    (48, 256),
    (256, 1792),
    (2560, 144),
    (80, 144),
]
GRIDS = SQUARES + OBLONGS
# Columns are the transform in one dimension; these grids have every power of two from 2 to 8192.
COLUMNS = sorted({ny: (ny, nx) for ny, nx in SQUARES + OBLONGS[:5]}.values())
DTYPES = (np.float32, np.float64)
# One and two passes, in single; tests/kernels has double. CI runs all.
FEW = [(64, 8), (128, 128)]
ACCURATE_L2 = {np.float32: 5e-7, np.float64: 1e-15}


def accurate_worst(dtype, n):
    """Bound on the worst element over the largest, for n points (DESIGN, section 6)."""
    per_point = {np.float32: (2e-6, 5e-7), np.float64: (5e-15, 5e-16)}[dtype]
    return per_point[0] + per_point[1] * np.log10(n)


@functools.cache
def transform(grid, dtype):
    return Transform(cl.Context([choose().device]), grid, np.dtype(dtype))


def runs(grids):
    """Return each grid in each precision, most of them for CI alone."""
    return [
        pytest.param(
            grid,
            dtype,
            marks=[] if grid in FEW and dtype is np.float32 else [pytest.mark.exhaustive],
        )
        for grid in grids
        for dtype in DTYPES
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


@pytest.mark.parametrize(("grid", "dtype"), runs(COLUMNS))
def test_one_dimension(grid, dtype):
    t, columns, n = transform(grid, dtype), columns_of(grid, dtype), grid[0]
    before = columns.copy()
    spectrum = np.fft.fft(columns, axis=0)
    assert_accurate(t.fft(columns), spectrum, dtype, n)
    assert_accurate(t.ifft(columns), np.fft.ifft(columns, axis=0), dtype, n)
    assert np.array_equal(columns, before)


@pytest.mark.parametrize(("grid", "dtype"), runs(GRIDS))
def test_two_dimensions(grid, dtype):
    t, n = transform(grid, dtype), grid[0] * grid[1]
    pixels = rounded(np.random.default_rng(n).normal(size=grid), dtype)
    spectrum = np.fft.rfft2(pixels)
    assert_accurate(t.rfft2(pixels), spectrum, dtype, n)
    assert_accurate(t.irfft2(rounded(spectrum, dtype)), pixels, dtype, n)
    assert_accurate(t.irfft2(t.rfft2(pixels)), pixels, dtype, n)


@pytest.mark.parametrize(("grid", "dtype"), runs(FEW))
class TestIdentities:
    def test_impulse_is_flat_and_exact(self, grid, dtype):
        pixels = np.zeros(grid)
        pixels[0, 0] = 1.0
        assert (transform(grid, dtype).rfft2(pixels) == 1.0).all()

    def test_impulse_anywhere(self, grid, dtype):
        pixels = np.zeros(grid)
        pixels[grid[0] - 1, grid[1] // 2] = 1.0
        assert_accurate(
            transform(grid, dtype).rfft2(pixels), np.fft.rfft2(pixels), dtype, pixels.size
        )

    def test_linearity(self, grid, dtype):
        t = transform(grid, dtype)
        a, b = rounded(np.random.default_rng(5).normal(size=(2, *grid)), dtype)
        combined = rounded(2.0 * a - 0.5 * b, dtype)
        expected = 2.0 * t.rfft2(a) - 0.5 * t.rfft2(b)
        assert l2(t.rfft2(combined), expected) < ACCURATE_L2[dtype]

    @pytest.mark.parametrize("axis", [0, 1])
    def test_shift_is_a_phase(self, grid, dtype, axis):
        t = transform(grid, dtype)
        pixels = rounded(np.random.default_rng(6).normal(size=grid), dtype)
        frequency = np.fft.fftfreq(grid[0])[:, None] if axis == 0 else np.fft.rfftfreq(grid[1])
        expected = t.rfft2(pixels) * np.exp(-2j * np.pi * frequency)
        assert l2(t.rfft2(np.roll(pixels, 1, axis)), expected) < ACCURATE_L2[dtype]

    def test_parseval(self, grid, dtype):
        pixels = rounded(np.random.default_rng(7).normal(size=grid), dtype)
        power = np.abs(transform(grid, dtype).rfft2(pixels)) ** 2
        power[:, 1:-1] *= 2.0
        energy = (pixels**2).sum() * pixels.size
        assert power.sum() == pytest.approx(energy, rel=2 * ACCURATE_L2[dtype])


@pytest.mark.exhaustive
@pytest.mark.parametrize("dtype", DTYPES)
def test_error_grows_as_the_root_of_the_logarithm(dtype, record_property):
    """RMS error = c (log2 N)^power against long double; the power is reported, about 1/2."""
    grids = [grid for grid in COLUMNS if grid[0] >= 32]
    exact = [scipy.fft.fft(columns_of(g, dtype).astype(np.clongdouble), axis=0) for g in grids]
    errors = [
        float(l2(transform(g, dtype).fft(columns_of(g, dtype)), e))
        for g, e in zip(grids, exact, strict=True)
    ]
    logs = np.log2([grid[0] for grid in grids])
    power, constant = np.polyfit(np.log(logs), np.log(errors), 1)
    record_property("error", f"{np.exp(constant):.2g} (log2 N)^{power:.2f}")
    assert 0.4 < power < 0.65
    assert errors[-1] < 1.3 * np.finfo(dtype).eps


@pytest.mark.parametrize(
    ("rows", "count"),
    [([0], 1), ([127], 1), ([15, 16], 2), ([100, 5], 3), ([40, 60, 70], 3), (range(128), 8)],
)
def test_window_is_the_shortest_run_of_blocks_round_the_edge(rows, count):
    layout = transform((128, 128), np.float32).layout
    assert layout.pixels_shape[0] == 8
    held = np.zeros(128, bool)
    held[list(rows)] = True
    first, found = layout.window(held)
    assert found == count
    assert held[layout.rows_of(first, count)].sum() == held.sum()


@pytest.mark.parametrize(
    ("n", "order"),
    [
        (8, [0, 4, 2, 6, 1, 5, 3, 7]),
        (12, [0, 6, 3, 9, 1, 7, 4, 10, 2, 8, 5, 11]),
        (5, [0, 1, 2, 3, 4]),
    ],
)
def test_reversed_order(n, order):
    assert reversed_order(n).tolist() == order


@pytest.mark.parametrize(
    ("n", "passes"),
    [
        (2, (1, 2, 1)),
        (4, (1, 4, 1)),
        (16, (1, 4, 4)),
        (32, (1, 8, 4)),
        (512, (1, 8, 8)),
        (1024, (1, 4, 4)),
        (48, (3, 3, 2)),
        (160, (5, 5, 4)),
        (1152, (9, 9, 2)),
        (7168, (7, 7, 2)),
    ],
)
def test_radices_and_their_roots(n, passes):
    assert radices(n) == passes
    odd, outer, last = passes
    table = roots(n, *passes).reshape(-1, 2)
    count, length = n // outer * (outer - 1) + (odd if odd > 1 else 0), n // outer
    while length > last:
        count, length = count + length // 8 * 7, length // 8
    assert len(table) == count
    np.testing.assert_allclose(np.hypot(*table.T), 1.0, rtol=1e-15)
