"""Whether models fit: residuals in all pixels, in the cores of stars and in their wings."""

import numpy as np
import pytest
from scenes import Recipe, make_smooth_psfs

import lnocl
from lnocl.residuals import CORE, WINGS, Fit, judge, residuals
from lnocl.scene.shifting import place

SHAPE = (24, 32)
STARS = np.array([(20.3, 9.8), (1.0, 22.0)])
OFFSETS = [(0.0, 0.0), (3.4, -1.0)]


@pytest.fixture
def known():
    """Return an observation and the means that its counts follow."""
    chance = np.random.default_rng(5)
    psfs = make_smooth_psfs(2, (9, 10))
    psfs /= psfs.sum(axis=(1, 2), keepdims=True)
    models = np.full((2, *SHAPE), 4.0)
    for model, psf, offset in zip(models, psfs, OFFSETS, strict=True):
        for x, y in STARS + offset:
            model += 2e3 * np.maximum(place(psf, SHAPE, x, y).on_grid(SHAPE), 0.0)
    mask = chance.random(models.shape) < 0.05
    return lnocl.Observation(chance.poisson(models), psfs, mask=mask, offsets=OFFSETS), models


def test_noise_gives_one(known):
    _, models = known
    chance, found = np.random.default_rng(6), []
    for _ in range(60):
        images = chance.poisson(models).astype(float)
        values = residuals(images, np.zeros(models.shape, bool), models)
        found.append(Fit.of(values, models))
    rms = np.array([fit.rms for fit in found])
    assert abs(rms.mean() - 1.0) < 3 * found[0].error / np.sqrt(len(rms))
    assert 0.75 < rms.std() / found[0].error < 1.25
    assert not any(fit.is_misfit for fit in found)


def test_pixels_are_those_of_the_images(known):
    observation, models = known
    overall, at_stars = judge(observation, models, STARS)
    good = ~observation.mask
    squares = (observation.images - models) ** 2 / models
    assert overall.n_pixels == good.sum()
    np.testing.assert_allclose(overall.square_sum, squares[good].sum(), rtol=1e-12)
    np.testing.assert_allclose(overall.variance, (2.0 + 1.0 / models[good]).sum(), rtol=1e-12)
    for (x, y), found in zip(STARS, at_stars, strict=True):
        core, wings = np.zeros((2, *good.shape), bool)
        for j, (dx, dy) in enumerate(OFFSETS):
            psf = observation.psfs[j]
            for row, column in np.ndindex(SHAPE):  # the slow way
                at = row - round(y + dy) + 4, column - round(x + dx) + 5
                if all(0 <= i < k for i, k in zip(at, psf.shape, strict=True)):
                    share = psf[at] / psf.max()
                    core[j, row, column] = share > CORE
                    wings[j, row, column] = WINGS < share <= CORE
        for fit, there in ((found.core, core & good), (found.wings, wings & good)):
            assert fit.n_pixels == there.sum() > 5
            np.testing.assert_allclose(fit.square_sum, squares[there].sum(), rtol=1e-12)


@pytest.mark.parametrize("wrong", ["core", "wings"])
def test_a_misfit_is_found_where_it_is(known, wrong):
    observation, models = known
    (x, y), psf = np.round(STARS[0]).astype(int), observation.psfs[0]
    share = psf / psf.max()
    part = share > CORE if wrong == "core" else (share > WINGS) & (share <= CORE)
    models[0][y - 4 : y + 5, x - 5 : x + 5][part] *= 0.3
    overall, at_stars = judge(observation, models, STARS)
    assert (at_stars[0].core.is_misfit, at_stars[0].wings.is_misfit) == (
        wrong == "core",
        wrong == "wings",
    )
    assert not any(fit.is_misfit for fit in at_stars[1])
    assert overall.rms > 1.0


def test_a_star_without_good_pixels_has_no_rms():
    mask = np.zeros((16, 16), bool)
    mask[3:10, 3:10] = True
    observation = lnocl.Observation(np.ones((16, 16)), make_smooth_psfs(1, (5, 5)), mask=mask)
    _, ((core, wings),) = judge(observation, np.ones((1, 16, 16)), np.array([(6, 6)]))
    for fit in (core, wings):
        assert np.isnan(fit.rms)
        assert np.isnan(fit.error)
        assert not fit.is_misfit


def test_a_star_may_be_beyond_one_of_the_images():
    images, psf = np.ones((2, 16, 16)), make_smooth_psfs(1, (5, 5))
    observation = lnocl.Observation(images, psf, offsets=[(0, 0), (15, 15)])
    _, (both,) = judge(observation, images, np.array([(8, 8)]))
    _, (first,) = judge(observation, images[:1], np.array([(8, 8)]))
    assert both == first
    assert first.core.n_pixels > 0


def test_a_result_has_them():
    made = Recipe((8, 16), 2, 1).make()
    result = made.deconvolve(n_iter=3, engine="numpy")
    observation = made.observation()
    assert result.fits() == judge(observation, result.models(), result.star_positions)
    expected = (observation.images - result.models()) / np.sqrt(result.models())
    np.testing.assert_allclose(result.residuals(), expected, rtol=1e-12, atol=1e-12)
