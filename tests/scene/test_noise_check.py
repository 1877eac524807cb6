"""Images whose noise is not that of their counts."""

import warnings

import numpy as np
import pytest

import lnocl
from lnocl.core.scene.noise_check import _some_rows, measure_noise, warn_of_noise, with_noise_shown

SHAPE, LEVEL = (128, 130), 60.0
Y, X = np.indices(SHAPE) - 64.0
STAR = 4e4 * np.exp(-(X**2 + Y**2) / 20.0) + 900.0 / (1.0 + (X**2 + Y**2) / 50.0) ** 2


def counts(seed=0, level=LEVEL):
    return np.random.default_rng(seed).poisson(STAR + level).astype(float)


def said(images, **given):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        observation = lnocl.Observation(images, np.ones((1, 1)), **given)
        caught.clear()
        warn_of_noise(observation)
    return [str(each.message) for each in caught]


def drizzled(image):
    """Spread each pixel over its neighbours."""
    return (image + np.roll(image, 1, 0) + np.roll(image, 1, 1) + np.roll(image, 1, (0, 1))) / 4


@pytest.mark.parametrize("level", [0.5, 60.0, 5e4])
def test_poisson_noise_gives_no_warning(level):
    heard = {seed: said(counts(seed, level), background=level) for seed in range(20)}
    assert not any(heard.values()), heard


@pytest.mark.parametrize("level", [1e-4, 2.5e-3, 0.02, 0.1])
def test_poisson_noise_of_few_counts_gives_no_warning(level):
    """As of X-rays, where most blocks are empty."""
    for seed in range(20):
        image = np.random.default_rng(seed).poisson(level, SHAPE).astype(float)
        image[60, 60] += 50.0
        assert said(image, background=level) == []


@pytest.mark.parametrize("rows", [1024, 2048, 2100, 5000])
def test_of_large_images_some_rows_of_blocks_say_the_same(rows):
    image = np.random.default_rng(rows).poisson(LEVEL, (rows, 32)).astype(float)
    observation = lnocl.Observation(image, np.ones((1, 1)), background=LEVEL)
    (noise,) = measure_noise(observation)
    assert noise.variance == pytest.approx(LEVEL, rel=0.1)
    assert noise.variance_apart == pytest.approx(LEVEL, rel=0.1)
    assert 0.0 < noise.level - noise.mean < 0.2 * np.sqrt(LEVEL)
    assert len(_some_rows(image[: rows - rows % 8])) // 8 in range(128, 256)


def test_poisson_and_read_noise_give_no_warning():
    image = counts() + np.random.default_rng(1).normal(0.0, 12.0, SHAPE)
    assert said(image, read_noise=12.0) == []


def test_bright_structure_gives_no_warning():
    """The fringes of a star in all of the image."""
    image = np.random.default_rng(3).poisson(5e4 * (2.0 + np.sin(X / 2.0) * np.cos(Y / 3.0)))
    assert said(image.astype(float)) == []


WRONG = {
    "gain of 2": counts() / 2.0,
    "gain of 1 / 2": 2.0 * counts(),
    "gain of 1000": counts() / 1000.0,
    "gain of 1 / 1000": 1000.0 * counts(),
    "sky subtracted": counts() - LEVEL,
    "read noise left out": counts() + np.random.default_rng(1).normal(0.0, 12.0, SHAPE),
}


@pytest.mark.parametrize("case", WRONG)
def test_noise_other_than_poisson_gives_a_warning(case):
    (message,) = said(np.array([counts(5), WRONG[case]]))
    assert message.startswith("the noise of image 1 is not that of its counts: where it is darkest")
    assert "see to gain, background" in message


@pytest.mark.parametrize("n", [40, 128])
def test_excessive_read_noise_gives_a_warning_and_is_corrected(n):
    image = (counts() + np.random.default_rng(1).normal(0.0, 12.0, SHAPE))[:n, :n]
    (message,) = said(image, background=LEVEL, read_noise=24.0)
    assert message.startswith("the noise of image 0 is not that of its counts")
    given = lnocl.Observation(image, np.ones((1, 1)), background=LEVEL, read_noise=24.0)
    shown = with_noise_shown(given)
    assert shown.background[0] == pytest.approx(LEVEL + 12.0**2, rel=0.2)
    np.testing.assert_allclose(
        shown.images - given.images, shown.background[0] - given.background[0], rtol=1e-6
    )
    right = lnocl.Observation(image, np.ones((1, 1)), background=LEVEL, read_noise=12.0)
    assert with_noise_shown(right) is right


@pytest.mark.parametrize("times", [1, 2])
def test_correlated_noise_gives_no_warning(times):
    image = counts()
    for _ in range(times):
        image = drizzled(image)
    assert said(image) == []


@pytest.mark.parametrize("level", [5.0, 60.0, 5e4])
def test_background_too_high_gives_a_warning(level):
    high = level + 0.6 * np.sqrt(level)
    (message,) = said(np.array([counts(3, level)] * 2), background=[level, high])
    assert message.startswith("the background of image 1 is too high: it is ")
    assert said(counts(3, level), background=level) == []


def test_known_structure_of_the_background_is_no_noise():
    """As maps of inverse variance of drizzled images have, row by row."""
    read_noise = np.where(Y % 2 == 0, 70.0, 80.0)
    noise = np.random.default_rng(4).normal(0.0, read_noise)
    assert said(counts(level=0.0) + noise, read_noise=read_noise) == []
    assert said(counts(level=0.0) + noise, read_noise=75.0) == []


def test_bad_pixels_are_left_out():
    image, mask = counts(), np.zeros(SHAPE, bool)
    mask[::16, ::16] = True
    image[mask] = 1e9
    (whole,), (cut,) = (
        list(measure_noise(lnocl.Observation(each, np.ones((1, 1)), mask=mask)))
        for each in (counts(), image)
    )
    assert whole == cut
    mask[::8, ::8] = True
    assert list(measure_noise(lnocl.Observation(image, np.ones((1, 1)), mask=mask))) == [None]


def test_the_variance_is_that_of_the_counts():
    image = np.random.default_rng(2).poisson(40.0, (512, 512)).astype(float)
    (noise,) = measure_noise(lnocl.Observation(image, np.ones((1, 1))))
    assert noise.mean == pytest.approx(40.0, rel=0.03)  # of the darker half
    assert noise.variance == pytest.approx(40.0, rel=0.04)  # a median of blocks
    assert noise.variance_apart == pytest.approx(40.0, rel=0.06)
