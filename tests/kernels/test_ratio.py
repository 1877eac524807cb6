"""Model, ratio and data term against their twin; the division guard; compensated sums."""

import numpy as np
import pytest
from kernel_cases import agree_with_twins, harness_of, in_each_precision
from kernel_harness import rounded

from lnocl.core import reference
from lnocl.core.opencl.windows import stars_near
from lnocl.core.scene.scene import MIN_MODEL

test_kernels_agree_with_their_twins = agree_with_twins("ratio.cl")


def launch_ratio_rows(harness, model, images, star_image):
    """Return the ratio's row spectra, and the pairs of sums of an image whose model is exact."""
    blocks = harness.program.row_blocks
    spectra = harness.put_spectra(np.fft.rfft(model - 1.0)[None] / harness.grid[1])
    sums, star_sums = (harness.put(np.zeros((blocks, 2))) for _ in range(2))
    harness.launch(
        "ratio_rows",
        spectra=spectra,
        ratio_sums=sums,
        star_sums=star_sums,
        images=harness.put_pixels(images[None]),
        background=harness.put_points(1.0),
        exposure=harness.put_points(1.0),
        star_images=harness.put_pixels(star_image[None]),
        star_corners=harness.put([0, 0], np.int32),
        star_near=harness.put(stars_near(np.zeros((1, 1, 2), int), blocks, blocks), np.int32),
        star_fluxes=harness.put([0.0]),
        n_images=1,
        star_blocks=blocks,
        star_columns=harness.grid[1],
    )
    pairs = (harness.take(each, (-1, 2)).astype(float) for each in (sums, star_sums))
    return harness.take_spectra(spectra)[0], *pairs


@in_each_precision
def test_division_guard(dtype):
    """Where the model is not positive the ratio is 0, and J's term that of the least model."""
    harness = harness_of("radices 8, 8 and 4, 8, 4", dtype)
    images, model = np.ones(harness.grid), np.ones(harness.grid)
    # One pixel of the model is negative, all others are as the images.
    model[3, :] = 1.0 - 2.0 * (np.arange(harness.grid[1]) == 7)
    dark, sums, _ = launch_ratio_rows(harness, model, images, np.zeros(harness.grid))
    expected = np.zeros(harness.grid)
    expected[3, 7] = -1.0
    assert np.abs(dark - reference.rfft_rows(expected)).max() < 1e3 * np.finfo(dtype).eps
    term = -np.log(MIN_MODEL) - 1.0 + MIN_MODEL
    eps = float(np.finfo(dtype).eps)
    assert sums.sum() == pytest.approx(term, rel=4 * eps)
    images[3, 7] = 0.0
    _, sums, _ = launch_ratio_rows(harness, model, images, np.zeros(harness.grid))
    assert abs(sums.sum()) < MIN_MODEL + 1e3 * eps**2 * images.size


def test_sums_over_pixels_are_compensated():
    """Sums of exact ratios in single precision are right to a double's digits, nearly."""
    harness = harness_of("radices 8, 8 and 4, 8, 4", np.float32)
    images = rounded(np.random.default_rng(11).uniform(0.5, 2.0, harness.grid), np.float32)
    ones = np.ones(harness.grid)
    _, _, star_sums = launch_ratio_rows(harness, ones, images, ones)
    expected = (images - 1.0).sum()
    assert star_sums.sum() == pytest.approx(expected, rel=3e-9)
    assert star_sums[:, 0].sum() != pytest.approx(expected, rel=3e-9)


@in_each_precision
def test_images_of_next_to_nothing(dtype):
    """Counts of 0 with a variance of 1e-20: their ratio is lost in that less 1."""
    harness = harness_of("radices 8, 8 and 4, 8, 4", dtype)
    images, ones = np.full(harness.grid, 1e-20), np.ones(harness.grid)
    _, sums, _ = launch_ratio_rows(harness, ones, images, np.zeros(harness.grid))
    zero = np.zeros((1, 1, *harness.grid))
    _, expected, _ = reference.ratio_rows(
        np.fft.rfft(ones)[None] / harness.grid[1],
        images[None],
        None,
        np.zeros((1, 1, 1)),
        zero,
        np.zeros(1),
    )
    assert expected == pytest.approx(images.size, rel=1e-12)
    assert sums.sum() == pytest.approx(expected, rel=4 * float(np.finfo(dtype).eps))
