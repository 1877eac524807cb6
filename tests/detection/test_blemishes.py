"""Cosmic rays are no stars, and flat tops are saturated."""

from contextlib import nullcontext

import numpy as np
import pytest

from lnocl.core.scene.blemishes import cosmic_rays, flat_tops, sharp_pixels

pytest.importorskip("photutils", reason="photutils is not installed")
from lnocl.detection import find_stars

SHAPE = (90, 104)
PLACES = np.array([(22.3, 20.8), (71.6, 25.1), (40.2, 62.7), (84.8, 70.4)])
FLUXES = np.array([9e4, 4e4, 2e4, 1e4])
RAYS = np.random.default_rng(4).uniform(8, 82, (20, 2))
NEAREST = np.hypot(*(PLACES[:, None] - RAYS).T).min(axis=1)
RAYS = RAYS[NEAREST > 8]


def lopsided(x, y, width, shape):
    """Return a PSF of unit sum whose one side is wider than the other."""
    rows, columns = np.indices(shape)
    u, v = columns - x, rows - y
    squares = (u / np.where(u > 0, 1.15, 1.0)) ** 2 + v**2
    light = (1.0 + squares / (width / 2.0) ** 2 * (2.0 ** (1.0 / 3.0) - 1.0)) ** -3.0
    return light / light.sum()


def frame(width, seed=0, with_rays=True):
    light = 100.0 + sum(
        flux * lopsided(*place, width, SHAPE) for place, flux in zip(PLACES, FLUXES, strict=True)
    )
    rng = np.random.default_rng(seed)
    counts = rng.poisson(light) + rng.normal(0.0, 5.0, SHAPE)
    for k, (x, y) in enumerate(RAYS.astype(int) if with_rays else ()):
        dy, dx = ((0, 1), (1, 0), (1, 1), (1, -1))[k % 4]
        for i in range(k % 5 + 1):  # tracks of one to five pixels
            counts[y + i * dy, x + i * dx] += 900.0 * 1.4 ** (k % 9)
    return counts


@pytest.mark.parametrize("width", [2.2, 3.3])
@pytest.mark.parametrize("is_given", [True, False])
def test_stars_are_found_among_cosmic_rays_and_nothing_else(width, is_given):
    psf = lopsided(20, 20, width, (41, 41)) if is_given else None
    stars = find_stars(frame(width), psf)
    assert len(stars) == len(PLACES)
    found = np.array([stars["x"], stars["y"]]).T
    assert np.abs(found - PLACES).max() < 0.3
    assert np.isfinite(stars["width"]).all()
    assert len(RAYS) <= stars.meta["n_sharp"] <= len(RAYS) + 3


def test_rays_in_the_wings_of_a_saturated_star_are_found():
    """Its PSF is of a frame, with noise that is no ring of it."""
    rng, shape = np.random.default_rng(1), (80, 80)
    psf = lopsided(30, 30, 4.0, (61, 61)) + rng.normal(0.0, 3e-5, (61, 61))
    light = 100.0 + 5e6 * lopsided(40.2, 39.7, 4.0, shape)
    counts = np.minimum(rng.poisson(light), 60_000).astype(float)
    rays = (np.array([20, 60, 41]), np.array([40, 52, 63]))
    counts[rays] += 3000.0
    core = counts == 60_000
    found = cosmic_rays(np.where(core, 0.0, counts - 100.0), np.sqrt(light), core, [psf])
    assert core.sum() > 20
    assert found[rays].all()
    assert found.sum() <= 9 * len(rays[0])


@pytest.mark.exhaustive
@pytest.mark.parametrize("width", [1.6, 2.2, 5.0])
@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_stars_are_not_taken_for_cosmic_rays(width, factor):
    """Also where the PSF that is given is too wide."""
    psf = lopsided(25, 25, factor * width, (51, 51))
    with pytest.warns(match="pixels wide and the PSF") if factor > 1 else nullcontext():
        stars = find_stars(frame(width, with_rays=False), psf)
    assert len(stars) >= len(PLACES)
    for place in PLACES:
        assert np.hypot(stars["x"] - place[0], stars["y"] - place[1]).min() < 0.5


def test_single_photons_are_no_cosmic_rays():
    counts = np.random.default_rng(2).poisson(0.05, SHAPE).astype(float)
    psf = lopsided(10, 10, 3.0, (21, 21))
    none = np.zeros(SHAPE, bool)
    noise = np.full(SHAPE, 0.05**0.5)
    assert sharp_pixels(counts, noise, none, [psf]).sum() > 10
    assert not sharp_pixels(counts, noise, none, [psf], are_counts=True).any()


class TestFlatTops:
    def image(self, level):
        return np.round(frame(3.3, with_rays=False)).clip(max=level)

    def test_stars_with_flat_tops_are_saturated_and_reported(self, caplog):
        caplog.set_level("INFO", "lnocl")
        psf = lopsided(20, 20, 3.3, (41, 41))
        flat, given = (find_stars(self.image(1500.0), psf, saturation=s) for s in (None, 1500.0))
        assert flat["saturated"].tolist() == [True, True, False, False]
        np.testing.assert_allclose(flat["x"], given["x"], rtol=0, atol=0)
        n = int((self.image(1500.0) == 1500.0).sum())
        (line,) = (record.getMessage() for record in caplog.records)
        assert line == (
            f"{n} pixels of flat tops at 1500 are taken as saturated, as by saturation 1500"
        )

    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize("level", [0.05, 3.0, 200.0])
    def test_counts_equal_by_chance_are_not_flat_tops(self, seed, level):
        light = level + sum(200.0 * level * lopsided(*at, 9.0, SHAPE) for at in PLACES)
        counts = np.random.default_rng(seed).poisson(light).astype(float)
        none = np.zeros(SHAPE, bool)
        assert not flat_tops(counts, (counts - level) / level**0.5, none).any()

    def test_small_ones_have_the_largest_value_of_the_image(self):
        counts = self.image(1e9)
        counts[30:32, 50:52] = 7e4  # adjoining
        counts[10, 10] = counts[60, 80] = counts[80, 12] = 9e4  # all over the image
        counts[44, 7:9] = 5e4  # two by chance
        flat = flat_tops(counts, (counts - 100.0) / 10.0, np.zeros(SHAPE, bool))
        assert (flat == np.isin(counts, [7e4, 9e4])).all()


@pytest.mark.exhaustive
def test_the_threshold_is_of_the_significance_in_the_table():
    """Four bright stars near each other make the noise seem large as long as they are in it."""
    psf = lopsided(30, 30, 4.0, (61, 61))
    places = [(37.2, 33.4), (46.7, 56.0), (55.2, 36.8), (63.3, 47.9)]
    rows = np.random.default_rng(1).normal(0.0, 0.006, (100, 100))
    for place, flux in zip(places, (230.0, 200.0, 190.0, 40.0), strict=True):
        rows += flux * lopsided(*place, 4.0, rows.shape)
    usual = find_stars(rows, psf)
    assert len(usual) == 4
    for threshold in (20.0, 50.0, 200.0, 1000.0):
        stars = find_stars(rows, psf, threshold=threshold)
        expected = usual[usual["significance"] >= threshold]
        np.testing.assert_array_equal(stars["x"], expected["x"])
