"""Cores of stars that are clipped, zero or wrapped round are found, and right ones are not."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

import lnocl
from lnocl.core.scene.saturation import lost_cores
from lnocl.core.scene.scene import Scene

SHAPE, STAR, LEVEL = (56, 60), (30.3, 26.8), 100.0


def lopsided(x, y, shape=SHAPE, width=3.5, beta=3.0):
    """Return a Moffat function whose one side is wider than the other."""
    rows, columns = np.indices(shape)
    u, v = columns - x, rows - y
    squares = (u / np.where(u > 0, 1.15, 1.0)) ** 2 + v**2
    light = (1.0 + squares / (width / 2.0) ** 2 * (2.0 ** (1.0 / beta) - 1.0)) ** -beta
    return light / light.sum()


PSF = lopsided(24, 24, (49, 49))


def frame(flux=1e6, seed=0, host=0.0):
    light = LEVEL + flux * lopsided(*STAR)
    light += host * lopsided(STAR[0] + 1.5, STAR[1], width=14.0)
    return np.random.default_rng(seed).poisson(light).astype(float)


def find(images, psfs=PSF, place=STAR, **known):
    observation = lnocl.Observation(images, psfs, background=LEVEL, **known)
    found = np.zeros(observation.mask.shape, bool)
    for each in lost_cores(Scene(observation, np.array([place]))):
        found[each.image, each.rows, each.columns] |= each.lost
    return found


SPOILT = {
    "clipped": lambda counts: np.minimum(counts, 8000.0),
    "clipped at three pixels": lambda counts: np.minimum(counts, np.sort(counts.ravel())[-3]),
    "zero": lambda counts: np.where(counts > 8000.0, 0.0, counts),
    "wrapped": lambda counts: np.where(counts > 32767.0, counts - 65536.0, counts),
}


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.parametrize("host", [0.0, 3e5])
@pytest.mark.filterwarnings("ignore:.*negative")
def test_lost_pixels_are_found_to_the_last_and_in_their_image_alone(name, host):
    """The place that is given is a little off."""
    right, other = frame(host=host), frame(seed=1, host=host)
    spoilt = SPOILT[name](right)
    is_lost = spoilt != right
    is_lost |= (spoilt == spoilt.max()) & ("clipped" in name)
    found = find([other, spoilt], place=(STAR[0] + 0.1, STAR[1] - 0.1))
    np.testing.assert_array_equal(found, [np.zeros(SHAPE, bool), is_lost])


def test_values_are_alike_before_read_noise_is_added_and_after_other_pixels_are_masked():
    right = frame()
    spoilt, bad = np.minimum(right, 8000.0), np.zeros(SHAPE, bool)
    bad[26, 30] = True
    noise = np.random.default_rng(0).uniform(3.0, 5.0, SHAPE)
    found = find(spoilt, read_noise=noise[None], mask=bad)
    np.testing.assert_array_equal(found[0], (spoilt == 8000.0) & ~bad)


@pytest.mark.parametrize("oversample", [1, 2])
def test_turned_and_finer_skies_are_looked_at_on_the_pixels_of_the_image(oversample):
    turned = lnocl.rotations([0.0, 25.0], (30.0, 27.0))
    at = turned[1] @ (*STAR, 1.0)
    # The second image shows the star through the PSF as it is in that image.
    light = LEVEL + 1e6 * lopsided(*at)
    spoilt = np.minimum(np.random.default_rng(3).poisson(light), 8000.0)
    q = oversample
    fine = lopsided(24 * q, 24 * q, (48 * q + 1, 48 * q + 1), width=3.5 * q)
    found = find([frame(), spoilt], fine, transforms=turned, oversample=q)
    np.testing.assert_array_equal(found, [np.zeros(SHAPE, bool), spoilt == 8000.0])


RIGHT = {
    "bright": {"flux": 3e7},
    "faint": {"flux": 300.0},
    "few counts": {"flux": 30.0},
    "a host": {"host": 1e6},
}


@pytest.mark.parametrize("name", RIGHT)
@pytest.mark.parametrize("width", [0.6, 1.0, 1.5])
def test_right_cores_are_not_lost_whatever_the_width_of_the_psf(name, width):
    psf = lopsided(24, 24, (49, 49), width=3.5 * width)
    assert not find(frame(**RIGHT[name]), psf).any()


@pytest.mark.parametrize("unit", [0.0, 1.0])
def test_scenes_without_noise_are_alike_by_symmetry(unit):
    """Rounded to whole counts or not, a Gaussian between four pixels, its PSF too narrow."""
    y, x = np.indices((40, 40)) - 19.5
    light = LEVEL + 1e4 * np.exp(-(x**2 + y**2) / 60.0)
    light = np.round(light) if unit else light
    v, u = np.indices((41, 41)) - 20
    assert not find(light, np.exp(-(u**2 + v**2) / 40.0), (19.5, 19.5)).any()


def test_a_star_inside_a_bright_ring_is_no_hole():
    y, x = np.indices(SHAPE)
    ring = np.abs(np.hypot(x - STAR[0], y - STAR[1]) - 8.0) < 1.5
    light = LEVEL + 3000.0 * fftconvolve(ring, PSF, "same") + 200.0 * lopsided(*STAR)
    assert not find(np.random.default_rng(1).poisson(light)).any()
