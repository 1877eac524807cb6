"""Whether models fit: residuals in all pixels, at stars, and the light that lies round these."""

import tracemalloc
from functools import reduce

import numpy as np
import pytest
from scenes import Recipe, make_smooth_psfs, paper

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.shifting import place
from lnocl.errors import InputError
from lnocl.residuals import CORE, WINGS, Fit, _halo, judge, judge_stars, residuals, sharp_sources

# The PSFs are cut off.
pytestmark = pytest.mark.filterwarnings("ignore:psf . is undersampled")

SHAPE = (24, 32)
STARS = np.array([(20.3, 9.8), (1.0, 22.0)])
FLUXES = np.array([2e3, 2e3])
OFFSETS = [(0.0, 0.0), (3.4, -1.0)]
LEVEL = 4.0


@pytest.fixture
def known():
    """Return an observation, its scene, and the means that its counts follow."""
    chance = np.random.default_rng(5)
    psfs = make_smooth_psfs(2, (9, 10))
    psfs /= psfs.sum(axis=(1, 2), keepdims=True)
    grid = (32, 64)
    models = np.full((2, *grid), LEVEL)
    for model, psf, offset in zip(models, psfs, OFFSETS, strict=True):
        for (x, y), flux in zip(STARS + offset, FLUXES, strict=True):
            model += flux * np.maximum(place(psf, grid, x, y).on_grid(grid), 0.0)
    models = models[:, : SHAPE[0], : SHAPE[1]]
    mask = chance.random(models.shape) < 0.05
    observation = lnocl.Observation(
        chance.poisson(models), psfs, mask=mask, offsets=OFFSETS, background=LEVEL
    )
    return observation, Scene(observation, STARS, pad=4), models


def no_sky(scene):
    return np.zeros(scene.grid)


def test_noise_gives_one(known):
    *_, models = known
    chance, found = np.random.default_rng(6), []
    for _ in range(60):
        images = chance.poisson(models).astype(float)
        values = residuals(images, np.zeros(models.shape, bool), models)
        found.append(Fit.of(values, models))
    rms = np.array([fit.rms for fit in found])
    assert abs(rms.mean() - 1.0) < 3 * found[0].error / np.sqrt(len(rms))
    assert 0.75 < rms.std() / found[0].error < 1.25
    assert not any(fit.is_misfit for fit in found)


@pytest.mark.parametrize("level", [1e-9, 0.002, 0.3])
def test_few_counts_have_their_moments_too(level):
    """Most pixels are empty, where 1 / m is beyond measure."""
    models = np.where(np.random.default_rng(1).random((60, 60)) < 0.2, 0.05, level)
    chance, mask = np.random.default_rng(6), np.zeros(models.shape, bool)
    draws = chance.poisson(models, (200, *models.shape)).astype(float)
    found = [Fit.of(residuals(each, mask, models), models) for each in draws]
    squares = np.array([fit.square_sum for fit in found])
    expected, variance = found[0].variance / 2.0, found[0].variance
    assert abs(squares.mean() - expected) < 3.0 * np.sqrt(variance / len(squares))
    assert 0.8 < squares.var() / variance < 1.25
    assert not any(fit.is_misfit or fit.is_overfit for fit in found)
    assert all(fit.error < 0.1 for fit in found)


@pytest.mark.filterwarnings("error::lnocl.errors.MisfitWarning")
def test_fitting_model_of_few_counts_has_a_good_verdict():
    y, x = np.indices((40, 40))
    psf = np.exp(-((x[:21, :21] - 10) ** 2 + 1.4 * (y[:21, :21] - 9.7) ** 2) / 3.0)
    light = 0.02 + 3.0 * np.exp(-((x - 25) ** 2 + (y - 18) ** 2) / 30.0)
    image = np.random.default_rng(0).poisson(light)
    observation = lnocl.Observation(image, psf, background=0.02)
    result = lnocl.deconvolve(observation, engine="numpy")
    assert result.verdict() == ["the model fits"]
    assert 0.8 < result.fit().rms < 1.1


def test_pixels_are_those_of_the_images(known):
    observation, scene, models = known
    of_images, at_stars = (
        judge(observation, models),
        judge_stars(Estimate(scene, no_sky(scene), FLUXES)),
    )
    overall = reduce(Fit.plus, of_images)
    good = ~observation.mask
    squares = (observation.images - models) ** 2 / (models + 0.5)
    assert overall.n_pixels == good.sum()
    np.testing.assert_allclose(overall.square_sum, squares[good].sum(), rtol=1e-12)
    variance = 2.0 * models / (models + 0.5)
    np.testing.assert_allclose(overall.variance, variance[good].sum(), rtol=1e-12)
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
        excess = max(found.core.square_sum - found.core.variance / 2.0, 0.0)
        error = np.sqrt(excess / models[core & good].sum())
        np.testing.assert_allclose(found.core_error, error, rtol=1e-7)
        for fit, there in ((found.core, core & good), (found.wings, wings & good)):
            assert fit.n_pixels == there.sum() > 5
            np.testing.assert_allclose(fit.square_sum, squares[there].sum(), rtol=3e-6)


@pytest.mark.parametrize("wrong", ["core", "wings"])
def test_a_misfit_is_found_where_it_is(known, wrong):
    observation, _, models = known
    (x, y), psf = np.round(STARS[0]).astype(int), observation.psfs[0]
    share = psf / psf.max()
    part = share > CORE if wrong == "core" else (share > WINGS) & (share <= CORE)
    images = np.where(observation.mask, 0.0, observation.images)
    images[0][y - 4 : y + 5, x - 5 : x + 5][part] *= 3.0
    changed = lnocl.Observation(
        images, observation.psfs, mask=observation.mask, offsets=OFFSETS, background=LEVEL
    )
    scene = Scene(changed, STARS, pad=4)
    at_stars = judge_stars(Estimate(scene, no_sky(scene), FLUXES))
    assert (at_stars[0].core.is_misfit, at_stars[0].wings.is_misfit) == (
        wrong == "core",
        wrong == "wings",
    )
    assert (at_stars[0].core_error > 0.1) == (wrong == "core")
    assert not at_stars[1].core.is_misfit
    assert not at_stars[1].wings.is_misfit
    assert judge(changed, models)[0].rms > 1.0


def test_a_star_without_good_pixels_has_no_rms():
    mask = np.zeros((2, 16, 16), bool)
    mask[0, 3:10, 3:10] = True
    psf = make_smooth_psfs(1, (5, 5))
    for images in (1, 2):
        observation = lnocl.Observation(np.ones((2, 16, 16)), psf, mask=mask)
        scene = Scene(observation, [(6, 6)])
        ((core, wings, *_),) = judge_stars(Estimate(scene, no_sky(scene), np.ones(1)))
        assert core.n_pixels > 0
        if images == 1:
            alone = Fit()
            assert np.isnan(alone.rms)
            assert np.isnan(alone.error)
            assert not alone.is_misfit
    assert wings.n_pixels < 25


def test_a_star_may_be_beyond_one_of_the_images():
    images, psf = np.ones((2, 16, 16)), make_smooth_psfs(1, (5, 5))
    both = Scene(lnocl.Observation(images, psf, offsets=[(0, 0), (15, 15)]), [(8, 8)], pad=16)
    first = Scene(lnocl.Observation(images[:1], psf), [(8, 8)])
    found, expected = (
        judge_stars(Estimate(each, no_sky(each), np.ones(1))) for each in (both, first)
    )
    assert found[0].core.n_pixels == expected[0].core.n_pixels > 0
    assert found[0].wings.n_pixels == expected[0].wings.n_pixels


@pytest.mark.parametrize("exposure", ["none", "each", "map"])
@pytest.mark.parametrize("pad", [4, 9])
def test_windows_hold_the_models_of_a_result(exposure, pad):
    """At every star, near the edges too, where light wraps round."""
    recipe = Recipe((24, 30), 3, 3, background="map", exposure=exposure, fractions=True,
                    smooth=True, masked=0.05, psf_shape=(15, 16))  # fmt: skip
    made = recipe.make()
    observation = made.observation()
    with np.errstate(all="ignore"):
        result = paper(observation, made.stars, n_iter=4, pad=pad, engine="numpy")
    models = result.models()
    good = ~observation.mask
    squares = np.divide(
        (observation.images - models) ** 2, models + 0.5, out=np.zeros_like(models), where=good
    )
    for (x, y), found in zip(result.star_positions, result.star_residuals(), strict=True):
        total, n = 0.0, 0
        for j, (dx, dy) in enumerate(observation.offsets):
            psf = observation.psfs[j]
            share = np.zeros(observation.shape)
            rows, columns = np.indices(psf.shape)
            rows = rows - psf.shape[0] // 2 + round(y + dy)
            columns = columns - psf.shape[1] // 2 + round(x + dx)
            inside = (rows >= 0) & (columns >= 0)
            inside &= (rows < share.shape[0]) & (columns < share.shape[1])
            share[rows[inside], columns[inside]] = psf[inside] / psf.max()
            there = (share > CORE) & good[j]
            total, n = total + squares[j][there].sum(), n + there.sum()
        assert found.core.n_pixels == n
        np.testing.assert_allclose(found.core.square_sum, total, rtol=1e-9)


class TestHalo:
    WIDTH = 3.0
    Y, X = np.indices((96, 96)) - 48.0
    PSF = np.exp(-4 * np.log(2) * (X**2 + Y**2) / WIDTH**2)[32:65, 32:65]

    def halo(self, sky, flux=1e3, at=(48.0, 48.0)):
        scene = Scene(lnocl.Observation(np.ones(sky.shape), self.PSF), [at])
        laid = np.zeros(scene.grid)
        laid[: sky.shape[0], : sky.shape[1]] = sky
        return judge_stars(Estimate(scene, laid, np.array([flux])))[0].halo

    def test_light_all_round_is_found_whole(self):
        halo = np.exp(-(self.X**2 + self.Y**2) / 50.0)
        assert self.halo(5.0 + halo, halo.sum()) == pytest.approx(1.0, abs=0.1)

    @pytest.mark.parametrize(
        "sky",
        [
            np.full((96, 96), 7.0),
            np.where(Y > 2, 9.0, 0.0),  # on one side
            np.where((abs(Y) < 3) & (X > 0), 9.0, 0.0),  # a jet
            np.where(abs(np.hypot(X, Y) - 20) < 3, 9.0, 0.0),  # a ring
        ],
        ids=["flat", "side", "jet", "ring"],
    )
    def test_other_light_is_not(self, sky):
        assert abs(self.halo(sky)) < 0.05

    def test_a_star_at_the_edge(self):
        assert self.halo(np.ones((96, 96)), at=(0.0, 48.0)) == 0.0

    @pytest.mark.parametrize("factor", [0.8, 1.0])
    def test_a_psf_that_is_too_narrow_leaves_some(self, factor):
        """And one that is right does not."""
        narrow = np.exp(-4 * np.log(2) * (self.X**2 + self.Y**2) / (factor * self.WIDTH) ** 2)
        image = np.full((96, 96), 20.0)
        image[32:65, 32:65] += 900.0 * self.PSF
        image = np.random.default_rng(3).poisson(image)
        observation = lnocl.Observation(image, narrow[32:65, 32:65], background=20.0)
        given = {"solver": "sgp", "n_iter": 60, "engine": "numpy"}
        (found,) = paper(observation, [(48, 48)], **given).star_residuals()
        assert found.has_halo == (factor < 1.0)


def test_a_result_has_the_residuals():
    made = Recipe((8, 16), 2, 1).make()
    result = made.deconvolve(n_iter=3, engine="numpy")
    observation = made.observation()
    assert result.fit() == reduce(Fit.plus, judge(observation, result.models()))
    expected = (observation.images - result.models()) / np.sqrt(result.models())
    np.testing.assert_allclose(result.residuals(), expected, rtol=1e-12, atol=1e-12)


def test_a_result_has_the_fit_of_each_epoch():
    made = Recipe((8, 16), 3, 1).make()
    observation = made.observation().replace(epochs=[57000.5, 57001, 57000.5])
    result = paper(observation, made.stars, n_iter=2, engine="numpy")
    first, second, third = judge(observation, result.models())
    assert result.fit(57000.5) == first.plus(third)
    assert result.fit("57001") == second
    with pytest.raises(InputError, match=r"epoch is 'May'; give one of 57000.5, 57001"):
        result.fit("May")


@pytest.mark.parametrize("finer", [1, 2])
def test_unnamed_stars_are_sharp_sources_and_knots_are_not(finer):
    y, x = np.indices((64, 64))
    sky = 5.0 + 300 * np.exp(-((x - 40) ** 2 + (y - 12) ** 2) / 8.0)  # a knot 4.7 pixels wide
    sky += 1e3 * np.exp(-((x - 52) ** 2 + (y - 30) ** 2) / 4.0)  # one of 3.3, and brighter
    sky += 100 * np.exp(-np.hypot(x - 20, y - 44) / 4.0)  # a cusp
    sky[30, 10], sky[30, 11], sky[50, 50] = 6000.0, 3000.0, 4000.0
    found = sharp_sources(sky, 5.0, finer)
    middle = (finer - 1) / 2.0
    np.testing.assert_allclose(finer * found[:, :2] + middle, [(10, 30), (50, 50)])
    np.testing.assert_allclose(found[:, 2], [9000.0, 4000.0], rtol=0.01)
    assert len(sharp_sources(sky / 100.0, 5.0, finer)) == 0  # told from noise
    assert len(sharp_sources(np.zeros((8, 8)), 0.0)) == 0


def test_flat_parts_of_the_sky_take_no_memory_for_sharp_sources():
    """All their pixels are maxima, and 9 x 9 pixels round each would be 81 frames."""
    sky = np.full((512, 512), 20.0)
    sky[200, 100] = 5000.0
    tracemalloc.start()
    found = sharp_sources(sky, 5.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(found[:, :2], [(100, 200)])
    assert peak < 6 * sky.nbytes


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", [(-9.0, 5.0), (4.0, 30.0), (-1.7, 3.0)])
def test_a_star_beyond_the_sky_has_no_halo(place):
    """Turned images show more than the sky's frame; rings without pixels hold no light."""
    halo, light = _halo(np.ones((12, 14)), np.array(place), 2.5)
    assert halo == 0.0
    assert np.isfinite(light)
