"""Counts and exposures of images, whose bad pixels do not count."""

import numpy as np

import lnocl
from lnocl.core.scene.counts import means
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers import levels

BAD = np.arange(2 * 16 * 16).reshape(2, 16, 16) % 3 == 0


def test_means_are_those_of_good_pixels():
    values = np.where(BAD, 1.0, 7.0) * np.array([1.0, 2.0])[:, None, None]
    np.testing.assert_allclose(means(values, BAD), [7.0, 14.0], rtol=1e-15)
    np.testing.assert_array_equal(means(np.array([3.0, 4.0]), BAD), [3.0, 4.0])
    nothing = BAD | [[[False]], [[True]]]
    np.testing.assert_allclose(means(values, nothing), [7.0, 0.0], rtol=1e-15)


def test_levels_weigh_images_by_the_exposure_of_their_good_pixels():
    images, each, psf = np.full((2, 16, 16), 90.0), np.array([5.0, 50.0]), np.ones((3, 3))
    numbers = lnocl.Observation(images, psf, background=[4.0, 9.0], exposure=each, mask=BAD)
    maps = numbers.replace(
        exposure=np.broadcast_to(each[:, None, None], images.shape),
        background=np.broadcast_to(numbers.background[:, None, None], images.shape),
    )
    found = [levels._depths(Scene(observation, pad=0)) for observation in (numbers, maps)]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-14)
