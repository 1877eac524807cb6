"""Cosmic rays are sharper than PSFs; stars, knots, rings and noise are not."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import j1
from test_saturation import lopsided

from lnocl.core.scene.blemishes import cosmic_rays

SHAPE, LEVEL = (80, 88), 60.0
NONE = np.zeros(SHAPE, bool)


def airy(x, y, shape):
    """Return the rings of a telescope with a hole of 0.3, dark between them."""
    rows, columns = np.indices(shape)
    d = np.hypot(columns - x, 1.1 * (rows - y)) + 1e-9
    amplitude = 2.0 * j1(d) / d - 0.09 * 2.0 * j1(0.3 * d) / (0.3 * d)
    return amplitude**2 / 40.0


def narrow(x, y, shape):
    return lopsided(x, y, shape, width=1.0)


# Of clear rays, those that are found at least: few are sharper than a PSF of one pixel.
WIDTHS = {"airy": 3.2, "wide": 3.5, "undersampled": 1.0}
FOUND = {"airy": 0.9, "wide": 0.9, "undersampled": 0.5}
PSFS = {"airy": airy, "wide": lopsided, "undersampled": narrow}


def sky(make, seed):
    """Return light of stars, of a chain of knots and of a disc."""
    chance = np.random.default_rng(seed)
    light = np.full(SHAPE, LEVEL)
    for flux in 10.0 ** chance.uniform(2.0, 6.0, 10):
        light += flux * make(*chance.uniform(4.0, 76.0, 2), SHAPE)
    for k in range(12):
        light += 3e3 * make(20.0 + 1.7 * k, 60.0 - 0.8 * k, SHAPE)
    y, x = np.indices(SHAPE)
    return light + 300.0 * np.exp(-np.hypot(x - 50.0, y - 30.0) / 9.0), chance


def find(image, make, level=LEVEL, mask=NONE):
    psf = make(30, 30, (61, 61))
    noise = np.sqrt(np.maximum(image, level))
    return cosmic_rays(np.where(mask, 0.0, image - level), noise, mask, [psf])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", PSFS)
def test_rays_are_found_and_nothing_else(name, seed):
    light, chance = sky(PSFS[name], seed)
    clean, rays = chance.poisson(light).astype(float), np.zeros(SHAPE)
    assert not find(clean, PSFS[name]).any()
    for k in range(10):  # tracks of one to four pixels, in all directions
        x, y = chance.integers(4, 76, 2)
        dy, dx = ((0, 1), (1, 0), (1, 1), (1, -1))[k % 4]
        for i in range(1 + k % 4):
            rays[y + i * dy, x + i * dx] = 10.0 ** chance.uniform(2.0, 4.5)
    found = find(clean + rays, PSFS[name])
    clear = rays > 10.0 * np.sqrt(light) + 3.0 * light
    assert (found & clear).sum() >= FOUND[name] * clear.sum() > 4
    spread = np.zeros(SHAPE, bool)
    for y, x in np.argwhere(rays > 0):
        spread[y - 1 : y + 2, x - 1 : x + 2] = True
    assert not (found & ~spread).any()


@pytest.mark.parametrize("name", PSFS)
def test_psf_a_fifth_too_wide_gives_no_cosmic_rays(name):
    """Sources are sharper than that makes them."""
    for seed in range(4):
        light, chance = sky(PSFS[name], seed)
        wide = gaussian_filter(PSFS[name](30, 30, (61, 61)), 0.6 * WIDTHS[name] / 2.35)
        image = chance.poisson(light).astype(float)
        noise = np.sqrt(np.maximum(image, LEVEL))
        assert not cosmic_rays(image - LEVEL, noise, NONE, [wide]).any()


@pytest.mark.parametrize("level", [0.003, 0.1, 3.0, 1e3])
@pytest.mark.parametrize("name", PSFS)
def test_noise_gives_at_most_one_cosmic_ray_in_many_pixels(name, level):
    images = np.random.default_rng(7).poisson(level, (15, *SHAPE)).astype(float)
    assert sum(find(image, PSFS[name], level).sum() for image in images) <= 1


def test_diffraction_rings_around_bad_pixels_are_not_cosmic_rays():
    light = LEVEL + 1e6 * airy(40.3, 41.8, SHAPE)
    y, x = np.indices(SHAPE)
    mask = np.hypot(x - 40.3, y - 41.8) < 3.0
    image = np.random.default_rng(1).poisson(light).astype(float)
    assert not find(image, airy, mask=mask).any()
