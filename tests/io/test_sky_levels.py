"""The level of a sky: on simulated frames, for few counts, and beside bad pixels."""

import numpy as np
import pytest
from astropy.stats import sigma_clipped_stats

from lnocl.errors import InputError
from lnocl.io.levels import block_means, mode, sky_level

Y, X = np.indices((128, 112), float)


def a_frame(seed, sky):
    """Return a frame of 40 stars and two exponential discs on a flat sky."""
    rng = np.random.default_rng([6, seed])
    noise, light = np.sqrt(sky), np.zeros(X.shape)
    for flux, x, y in rng.uniform((10, 4, 4), (60, 107, 123), (40, 3)):
        along, across = X - x + 0.4 * (Y - y), Y - y
        light += noise * flux / (1.0 + (along**2 + across**2 / 0.7) / 4.0) ** 2.5
    for peak, x, y in rng.uniform((2, 30, 30), (10, 80, 90), (2, 3)):
        light += noise * peak * np.exp(-np.hypot(X - x, (Y - y) / 0.6) / 5.0)
    return rng.poisson(sky + light).astype(float)


@pytest.mark.parametrize("sky", [0.05, 84.0], ids=["few counts", "many"])
def test_levels_are_within_their_errors_and_medians_are_not(sky):
    frames = [a_frame(seed, sky) for seed in range(8)]
    found = np.array([sky_level(0, each, np.zeros(each.shape, bool)) for each in frames])
    in_errors = (found[:, 0] - sky) / found[:, 1]
    assert np.sqrt(np.mean(in_errors**2)) < 1.4
    medians = np.array([sigma_clipped_stats(each)[1] for each in frames])
    assert abs(np.mean(medians) - sky) > 3.0 * abs(np.mean(found[:, 0]) - sky)


def test_the_mode_of_values_that_are_symmetric_is_their_mean():
    assert mode(np.array([1.0, 2.0, 3.0]))[0] == 2.0


def test_values_that_are_skew_have_their_median():
    values = np.array([0.0] * 5 + [1.0] * 4)
    assert mode(values)[0] == 0.0


def test_blocks_have_the_means_of_good_pixels_and_need_half_of_them():
    counts, bad = np.arange(32.0).reshape(4, 8), np.zeros((4, 8), bool)
    bad[:2, :4], bad[3, 7] = True, True
    bad[0, 0] = False
    expected = [np.delete(counts[:, 4:].ravel(), 15).mean()]
    np.testing.assert_allclose(block_means(counts, bad, 4)[-1:], expected)
    assert len(block_means(counts, bad, 4)) == 2
    bad[2, 0] = True
    assert len(block_means(counts, bad, 4)) == 1


def test_an_image_without_a_good_pixel_is_refused():
    with pytest.raises(InputError, match=r"image 1 has no good pixel to measure its sky"):
        sky_level(1, np.ones((4, 4)), np.ones((4, 4), bool))
