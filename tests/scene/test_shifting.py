"""A PSF at any position, against itself elsewhere, a sum of Gaussians and sums over its pixels.

`gaussian_interpolation` (scenes.py) fits the Gaussians and moves them, by matrices, without an FFT.
Tolerances are shares of the largest value, two to three times what was measured.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import gaussian_interpolation, gaussian_variance, make_psfs, worst
from scipy.ndimage import gaussian_filter
from scipy.special import erf, j1

from lnocl.core.scene.shifting import MARGIN, Cutout, MovablePsf, fold, place

GRID = (64, 128)
ROUNDING = 2e-15


def wrapped(psf, grid, x, y):
    """Return a PSF on a grid, its middle at (x, y), as a plain sum over its pixels."""
    laid = np.zeros(grid)
    for (row, column), value in np.ndenumerate(psf):
        to = row + y - psf.shape[0] // 2, column + x - psf.shape[1] // 2
        laid[to[0] % grid[0], to[1] % grid[1]] += value
    return laid


sizes = st.integers(1, 12)
positions = st.floats(-40.0, 40.0, allow_subnormal=False)


@given(
    shape=st.tuples(sizes, sizes),
    grid=st.tuples(sizes, sizes),
    x=st.integers(-40, 40),
    y=st.integers(-40, 40),
)
def test_whole_pixels_move_and_wrap_a_psf(shape, grid, x, y):
    psf = make_psfs(1, shape)[0]
    cutout = place(psf, grid, x, y)
    assert all(k <= n for k, n in zip(cutout.values.shape, grid, strict=True))
    expected = wrapped(psf, grid, x, y)
    if all(k <= n for k, n in zip(shape, grid, strict=True)):
        np.testing.assert_array_equal(cutout.on_grid(grid), expected)
    else:  # wings that wrap round are summed in another order
        assert worst(cutout.on_grid(grid), expected) <= 8e-16  # measured 2.7e-16


@given(shape=st.tuples(sizes, sizes), grid=st.tuples(sizes, sizes), x=positions, y=positions)
def test_small_grids_have_the_interpolant_of_the_whole_grid(shape, grid, x, y):
    """Odd and even, PSFs smaller and larger: no margins fit, so the grid's own period counts."""
    psf = make_psfs(1, shape)[0]
    rows, columns = (
        gaussian_interpolation(n, to, gaussian_variance(psf.sum(axis=1 - axis)))
        for axis, (n, to) in enumerate(zip(grid, (y, x), strict=True))
    )
    expected = rows @ wrapped(psf, grid, 0, 0) @ columns.T
    found = place(psf, grid, x, y).on_grid(grid)
    assert np.abs(found - expected).max() <= 1e-14 * psf.sum()  # measured 4e-15


@pytest.mark.parametrize("shape", [(9, 8), (8, 9), (1, 1), (2, 95), (40, 7)])
@pytest.mark.parametrize(("x", "y"), [(0.5, 0.25), (70.3, 3), (5, -0.49), (127.9, 63.7)])
def test_fractions_are_the_interpolant_of_the_psf_in_its_margins(shape, x, y):
    psf = make_psfs(1, shape)[0]
    cutout = place(psf, GRID, x, y)
    whole = np.floor(y + 0.5), np.floor(x + 0.5)
    laid, matrices = psf, []
    for axis, (n, at) in enumerate(zip(GRID, (y, x), strict=True)):
        fits = shape[axis] + 2 * MARGIN < n
        size = shape[axis] + 2 * MARGIN if fits else n
        assert cutout.values.shape[axis] == size
        before = MARGIN if fits else size // 2 - shape[axis] // 2
        pads = [(0, 0), (0, 0)]
        pads[axis] = before, size - shape[axis] - before
        laid = np.pad(laid, pads)
        variance = gaussian_variance(psf.sum(axis=1 - axis))
        matrices.append(gaussian_interpolation(size, at - whole[axis], variance))
    expected = matrices[0] @ laid @ matrices[1].T
    assert worst(cutout.values, expected) <= 2e-14  # measured 6e-15, the matrices' own rounding
    assert (cutout.y, cutout.x) == tuple(
        at - size // 2 for at, size in zip(whole, expected.shape, strict=True)
    )


def normal(n, at, sigma):
    """Return a Gaussian of unit light integrated over n pixels, `at` from the middle one."""
    edges = (np.arange(n + 1) - n // 2 - 0.5 - at) / (sigma * np.sqrt(2.0))
    return np.diff(erf(edges)) / 2


def pixel_gaussian(n, fwhm, x=0.0, y=0.0):
    sigma = fwhm / np.sqrt(8.0 * np.log(2.0))
    return np.outer(normal(n, y, sigma), normal(n, x, sigma))


def over_pixels(profile, n, x, y):
    """Return a function of the radius integrated over n x n pixels, by Gauss-Legendre."""
    at, weights = np.polynomial.legendre.leggauss(10)
    total = 0.0
    for dy, wy in zip(at / 2, weights / 2, strict=True):
        for dx, wx in zip(at / 2, weights / 2, strict=True):
            k = np.arange(n) - n // 2
            total = total + wx * wy * profile(np.hypot(k[:, None] + dy - y, k + dx - x))
    return total


def moffat(n, fwhm, x=0.0, y=0.0, beta=2.5):
    width = fwhm / 2 / np.sqrt(2 ** (1 / beta) - 1)
    return over_pixels(lambda r: (1 + (r / width) ** 2) ** -beta, n, x, y)


def airy(n, resolution, x=0.0, y=0.0):
    def profile(r):
        r = np.maximum(np.pi * r / resolution, 1e-9)
        return (2 * j1(r) / r) ** 2

    return over_pixels(profile, n, x, y)


@pytest.mark.parametrize("fwhm", [2.0, 3.0, 4.0, 6.0])
@pytest.mark.parametrize("shape", [(41, 41), (40, 42)])
def test_gaussians_go_where_they_are_put(shape, fwhm):
    sigma, grid = fwhm / np.sqrt(8.0 * np.log(2.0)), (128, 128)
    psf = np.outer(*(normal(n, 0, sigma) for n in shape))
    errors = []
    for dx, dy in [(0.5, 0.5), (0.3, -0.2), (0.0, 0.5), (-0.25, 0.01)]:
        found = place(psf, grid, 64 + dx, 64 + dy).on_grid(grid)
        errors.append(worst(found, np.outer(normal(128, dy, sigma), normal(128, dx, sigma))))
    assert max(errors) <= 1.5e-13  # measured 6e-14, for the edges of the widest; else 4e-15


@pytest.mark.parametrize(
    ("make", "width", "error", "darkest"),
    [
        (pixel_gaussian, 1.0, 2.4e-5, 5e-7),
        (pixel_gaussian, 1.5, 7e-10, 2e-11),
        (pixel_gaussian, 2.0, 4e-16, 0.0),
        (pixel_gaussian, 3.0, 4e-16, 0.0),
        (moffat, 1.5, 0.015, 2e-8),
        (airy, 1.0, 0.014, 2e-7),
        (airy, 4 / 3, 0.014, 6e-7),
        (airy, 2.0, 2.4e-4, 6e-6),
        (airy, 2.8, 4e-7, 1e-5),
    ],
)
def test_shift_errors_match_the_documented_values(make, width, error, darkest):
    """In the middle; what of the wings the PSF's edges have cut off is not found by moving it."""
    psf, n = make(61, width), 61
    found = place(psf, (128, 128), 64.5, 64.5).on_grid((128, 128))
    middle = np.s_[10 : n - 10, 10 : n - 10]
    moved = found[64 - n // 2 :, 64 - n // 2 :][:n, :n]
    missed = np.abs(moved - make(n, width, 0.5, 0.5))[middle].max() / psf.max()
    assert missed == pytest.approx(error, rel=0.1, abs=1e-15)
    assert -found.min() / psf.max() == pytest.approx(darkest, rel=0.2, abs=1e-15)


@given(
    shape=st.tuples(sizes, sizes),
    x=positions,
    y=positions,
    dx=st.integers(-70, 70),
    dy=st.integers(-70, 70),
)
def test_whole_pixels_more_roll_the_grid(shape, x, y, dx, dy):
    # The fraction of a sum differs by rounding, and a half may go to either side.
    x, y = np.round(64 * x) / 64, np.round(64 * y) / 64
    psf = make_psfs(1, shape)[0]
    expected = np.roll(place(psf, GRID, x, y).on_grid(GRID), (dy, dx), axis=(0, 1))
    np.testing.assert_array_equal(place(psf, GRID, x + dx, y + dy).on_grid(GRID), expected)


@given(shape=st.tuples(sizes, sizes), grid=st.tuples(sizes, sizes), x=positions, y=positions)
def test_shift_conserves_the_sum(shape, grid, x, y):
    psf = make_psfs(1, shape)[0]
    total = place(psf, grid, x, y).values.sum()
    assert total == pytest.approx(psf.sum(), rel=2e-15)  # measured 6e-16


@pytest.mark.parametrize("shape", [(9, 9), (9, 41), (31, 9)])
def test_a_mirrored_psf_moves_as_its_mirror_image(shape):
    """Along y as along x, and where the size is even, which leaves one frequency without sign."""
    psf = make_psfs(1, shape)[0]
    for grid in [(128, 128), (32, 32), (32, 128)]:
        centre = grid[0] // 2, grid[1] // 2
        found = place(psf, grid, centre[1] + 0.3, centre[0] - 0.2).on_grid(grid)
        turned = place(psf.T, grid[::-1], centre[0] - 0.2, centre[1] + 0.3).on_grid(grid[::-1])
        assert worst(turned.T, found) <= ROUNDING  # measured 7e-16
        for axis, x, y in [(0, 0.3, 0.2), (1, -0.3, -0.2)]:
            mirrored = np.flip(psf, axis)  # the sizes are odd: the middle stays
            mirror = place(mirrored, grid, centre[1] + x, centre[0] + y).on_grid(grid)
            back = np.roll(np.flip(mirror, axis), 1 - grid[axis] % 2, axis)
            assert worst(back, found) <= ROUNDING


def test_a_psf_of_opposite_signs_is_taken_for_one_pixel():
    """It alternates more than its own light, which no Gaussian does."""
    psf = np.array([[-1.0, 4.0, -1.0]])
    row = gaussian_interpolation(64, 0.5, gaussian_variance(np.ones(1)))
    expected = row @ np.pad(psf[0], (31, 30))
    found = place(psf, (1, 64), 32.5, 0).on_grid((1, 64))[0]
    assert worst(found, expected) <= 2e-14


class TestDerivative:
    @pytest.mark.parametrize("grid", [(128, 128), (32, 64), (31, 63)])
    @pytest.mark.parametrize("axis", [0, 1])
    @pytest.mark.parametrize(("x", "y"), [(12.0, 17.0), (12.3, 16.6), (12.45, 17.0)])
    def test_derivative_matches_finite_differences(self, grid, axis, x, y):
        """Of any PSF, sharp ones too: the difference of what `place` returns itself."""
        psf, h = make_psfs(1, (6, 7))[0], 1e-3
        expected = 0.0
        for step, weight in ((-2 * h, 1), (-h, -8), (h, 8), (2 * h, -1)):
            to = (x + step, y) if axis else (x, y + step)
            expected = expected + weight / (12 * h) * place(psf, grid, *to).on_grid(grid)
        assert (
            worst(place(psf, grid, x, y, axis).on_grid(grid), expected) <= 5e-12
        )  # measured 1.8e-12

    @pytest.mark.parametrize("grid", [(128, 128), (32, 64)])
    @pytest.mark.parametrize(("x", "y"), [(12.0, 17.0), (12.3, -0.4)])
    def test_is_made_with_the_psf_and_the_other_one(self, grid, x, y):
        psf = make_psfs(1, (6, 7))[0]
        cutout = MovablePsf(psf, grid).with_slopes(x, y)
        for axis, found in zip((None, 1, 0), cutout.values, strict=True):
            expected = place(psf, grid, x, y, axis).on_grid(grid)
            assert worst(Cutout(found, cutout.y, cutout.x).on_grid(grid), expected) <= 3e-15


class TestStamp:
    @given(
        shape=st.tuples(sizes, sizes),
        more=st.tuples(st.integers(0, 9), st.integers(0, 9)),
        y=st.integers(-60, 60),
        x=st.integers(-60, 60),
    )
    def test_rows_and_columns_are_where_the_values_lie(self, shape, more, y, x):
        grid = shape[0] + more[0], shape[1] + more[1]
        values = 1.0 + np.arange(shape[0] * shape[1], dtype=float).reshape(shape)
        cutout = Cutout(values, y, x)
        on_grid = cutout.on_grid(grid)
        assert on_grid.sum() == values.sum()
        chosen = on_grid[np.ix_(cutout.rows(grid), cutout.columns(grid))]
        np.testing.assert_array_equal(chosen, values)
        assert on_grid[y % grid[0], x % grid[1]] == 1.0
        np.testing.assert_array_equal(on_grid[cutout.window(grid)], values)
        aligned = cutout.aligned(grid)
        np.testing.assert_array_equal(aligned.on_grid(grid), on_grid)
        for axis in (0, 1):
            if shape[axis] == grid[axis]:
                assert aligned[1 + axis] == 0

    @pytest.mark.parametrize("place_of_values", [(0, 0), (2, 3), (5, 6)])
    def test_trimmed_has_all_values_above_the_least(self, place_of_values):
        values = np.full((6, 7), 1e-3)
        values[place_of_values], values[3, 4] = -1.0, 2.0
        cutout = Cutout(values, -2, 30).trimmed(1e-3)
        expected = np.where(abs(values) > 1e-3, values, 0.0)
        found = np.where(abs(cutout.on_grid((16, 40))) > 1e-3, cutout.on_grid((16, 40)), 0.0)
        np.testing.assert_array_equal(found, Cutout(expected, -2, 30).on_grid((16, 40)))
        assert cutout.values.size < values.size
        assert Cutout(values, 1, 1).trimmed(9.0).values.shape == (1, 1)

    @pytest.mark.parametrize("shape", [(5, 7), (12, 9), (12, 15)])
    def test_blurred_goes_round_the_grid(self, shape):
        cutout, grid = Cutout(np.random.default_rng(2).normal(size=shape), 9, -4), (12, 15)
        found = cutout.blurred(1.3, grid)
        assert all(np.array(found.values.shape) <= grid)
        expected = gaussian_filter(cutout.on_grid(grid), 1.3, mode="wrap")
        np.testing.assert_allclose(found.on_grid(grid), expected, atol=2e-15)

    def test_several_functions_are_laid_added_and_trimmed_as_each_is(self):
        values = np.random.default_rng(1).normal(size=(3, 5, 6))
        values[:, 0] = values[:, :, 5] = 0.0
        cutout, grid = Cutout(values, -2, 9), (12, 11)
        parts = [Cutout(each, -2, 9) for each in values]
        expected = np.array([part.on_grid(grid) for part in parts])
        np.testing.assert_array_equal(cutout.on_grid(grid), expected)
        np.testing.assert_array_equal(cutout.trimmed(0.0).on_grid(grid), expected)
        assert cutout.trimmed(0.0).values.shape == (3, 4, 5)
        first, light = (10, 8), np.ones((3, 4, 4))
        added = [part.add_to(np.ones((4, 4)), first, grid, 2.0) for part in parts]
        np.testing.assert_array_equal(cutout.add_to(light, first, grid, 2.0), added)


@given(k=st.integers(1, 40), n=st.integers(1, 12), axis=st.integers(0, 1))
def test_fold_wraps_wings_round(k, n, axis):
    psf = np.random.default_rng(k).integers(-9, 9, (k, 2)).astype(float)
    psf = psf.T if axis else psf
    folded = fold(psf, n, axis)
    expected = np.zeros_like(folded)
    for i in range(k):
        to = (i - k // 2 + n // 2) % n
        np.moveaxis(expected, axis, 0)[to] += np.moveaxis(psf, axis, 0)[i]
    np.testing.assert_array_equal(folded, expected)
