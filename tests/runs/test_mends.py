"""Images are mended before a run: what is masked, told, and what becomes of the star."""

import numpy as np
import pytest
from astropy.io import fits

import lnocl
from lnocl.core.runs.plan import CORES, EXPOSURES, RAYS
from lnocl.core.runs.preparation import prepare
from lnocl.core.scene.saturation import rays_on_stars
from lnocl.core.scene.scene import Scene
from lnocl.result.kept import from_parts, to_parts

SIZE, STAR, FLUX, LEVEL = 40, (20.3, 18.8), 1e6, 100.0


def lopsided(x, y, size):
    """Return a Moffat function whose one side is wider than the other."""
    rows, columns = np.indices((size, size))
    u, v = columns - x, rows - y
    squares = (u / np.where(u > 0, 1.15, 1.0)) ** 2 + v**2
    return (1.0 + squares / 11.8) ** -3.0


PSF = lopsided(20, 20, 41) / lopsided(20, 20, 41).sum()


def clipped(at=8000.0):
    light = LEVEL + FLUX * lopsided(*STAR, SIZE) / lopsided(20, 20, 41).sum()
    image = np.minimum(np.random.default_rng(2).poisson(light), at)
    return lnocl.Observation(image, PSF, background=LEVEL)


@pytest.mark.filterwarnings("ignore:the star at .* lies on bad pixels")
def test_a_star_whose_core_is_clipped_has_its_flux_within_its_error(caplog):
    caplog.set_level("INFO", "lnocl")
    given = clipped()
    result = lnocl.deconvolve(given, [STAR], engine="numpy", n_iter=300)
    (flux,), (error,) = result.star_fluxes, result.star_flux_errors
    assert abs(flux - FLUX) < 2.0 * error
    assert error < 0.01 * FLUX
    assert result.verdict() == ["the model fits"]
    lost = given.images == 8000.0
    words = f"{lost.sum()} pixels of `images[0]` at (20.3, 18.8), flat at 8000 electrons"
    assert f"{CORES}: yes, {words}\n" in result.plan
    (line,) = (each.getMessage() for each in caplog.records if "saturated" in each.getMessage())
    assert line.startswith("saturated pixels masked: " + words.replace("`images[0]`", "image 0"))


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize("option", [{"mend_images": False}, {"smoothing": 0.1}])
def test_nothing_is_mended_where_that_is_not_wanted(option):
    given = clipped()
    prepared = prepare(lnocl.plan(given, [STAR], engine="numpy", refine_psfs=(), **option))
    assert not prepared.setup.observation.mask.any()
    assert not prepared.found


def dimmed(factors=(0.7, 1.0, 1.05), **known):
    light = FLUX / 30.0 * lopsided(*STAR, SIZE) / lopsided(20, 20, 41).sum()
    means = LEVEL + np.multiply.outer(factors, light)
    image = np.random.default_rng(4).poisson(means)
    return lnocl.Observation(image, PSF, background=LEVEL, **known)


class TestExposures:
    def test_the_flux_is_that_of_the_image_in_the_middle_and_its_unit_stays(self, caplog, tmp_path):
        caplog.set_level("INFO", "lnocl")
        given = dimmed()
        result = lnocl.deconvolve(given, [STAR], engine="numpy", n_iter=300)
        (flux,), (error,) = result.star_fluxes, result.star_flux_errors
        assert abs(flux - FLUX / 30.0) < 3.0 * error
        assert error < 0.01 * flux
        assert result.verdict() == ["the model fits"]
        (line,) = (each.message for each in caplog.records if "exposures" in each.message)
        assert line.startswith("exposures fitted: times image 0 0.70")
        assert f"{EXPOSURES}: yes, times `images[0]` 0.70" in result.plan
        result.write(str(tmp_path / "result.fits"))
        assert fits.getheader(tmp_path / "result.fits")["ONEUNIT"] == "1.0 electron"

    def test_fewer_than_three_stars_may_vary_from_epoch_to_epoch(self):
        given, stars = dimmed(epochs=[0, 1, 2]), [STAR, (8, 9), (20, 11)]
        why = "fewer than three stars may vary from epoch to epoch"
        assert lnocl.plan(given, stars[:2]).why_not(EXPOSURES) == why
        assert lnocl.plan(given, stars).does(EXPOSURES)

    def test_filters_of_one_image_each_tell_no_exposures(self):
        """A star has a flux in each filter, as it has in each epoch, but does not vary in one."""
        weights = {"line": [1, 0, 0], "continuum": [1, 1, 0.7]}
        alone = lnocl.plan(dimmed(components=weights), [STAR])
        assert alone.why_not(EXPOSURES) == "there is one image of each filter"
        weights["continuum"][2] = 1
        assert lnocl.plan(dimmed(components=weights), [STAR]).does(EXPOSURES)

    def test_halos_may_be_taken_for_the_light_of_stars(self):
        halo = lopsided(*STAR, SIZE)
        plan = lnocl.plan(dimmed(halos=[halo]), [STAR])
        assert plan.why_not(EXPOSURES) == "halos may be as bright beside stars"

    def test_fitted_exposures_are_restored_from_a_result(self):
        given = dimmed(exposure=[2.0, 2.0, 2.0])
        result = lnocl.deconvolve(given, [STAR], engine="numpy", n_iter=5, stop=None)
        outcome = result._outcome
        again = from_parts(to_parts(outcome, given), given, None, "single")
        np.testing.assert_array_equal(again.observation.exposure, outcome.observation.exposure)
        assert outcome.observation.exposure[0] < 1.5
        assert (again.setup.is_rate, outcome.setup.is_rate) == (True, True)


class TestRays:
    def image(self):
        """Return counts of a star, and the same with a track beside it."""
        light = LEVEL + 3e4 * lopsided(*STAR, SIZE) / lopsided(20, 20, 41).sum()
        image = np.random.default_rng(6).poisson(light).astype(float)
        rays = np.zeros_like(image)
        rays[26, 22:25] = 4e3, 9e3, 2e3
        return image, rays

    @pytest.mark.parametrize("oversample", [1, 2])
    def test_cosmic_rays_are_masked_and_reported_by_image(self, oversample):
        image, rays = self.image()
        psf = PSF if oversample == 1 else np.repeat(np.repeat(PSF, 2, 0), 2, 1)
        given = lnocl.Observation([image, image + rays], psf, background=LEVEL,
                                  oversample=oversample)  # fmt: skip
        prepared = prepare(lnocl.plan(given, engine="numpy", refine_psfs=()))
        mask = prepared.setup.observation.mask
        assert mask[1][rays > 0].all()
        assert not mask[0].any()
        assert prepared.found[RAYS] == f"{mask.sum()} pixels of `images[1]`"

    @pytest.mark.parametrize("strength", [1e3, 4e3])
    def test_those_on_the_star_are_found_beside_its_model(self, strength):
        image, _ = self.image()
        rays = np.zeros_like(image)
        rays[17, 21] = strength
        given = lnocl.Observation([image + rays, image], PSF, background=LEVEL)
        mask = prepare(
            lnocl.plan(given, [STAR], engine="numpy", refine_psfs=())
        ).setup.observation.mask
        assert mask[0, 17, 21]
        assert mask[0].sum() == mask[0, 16:19, 20:23].sum()  # with what the ray spreads to
        assert not mask[1].any()

    @pytest.mark.parametrize("half", [0, 2])
    def test_sharp_pixels_of_a_larger_patch_on_the_star_are_no_rays(self, half, monkeypatch):
        """As a wrong PSF leaves it."""
        image, _ = self.image()
        image[17 - half : 18 + half, 21 - half : 22 + half] += 2e3
        brightest = lambda left, *_: left == left.max()  # noqa: E731
        monkeypatch.setattr("lnocl.core.scene.saturation.cosmic_rays", brightest)
        scene = Scene(lnocl.Observation(image, PSF, background=LEVEL), np.array([STAR]))
        assert rays_on_stars(scene, np.zeros((1, SIZE, SIZE), bool)).any() == (half == 0)

    def test_the_star_has_its_flux(self):
        image, rays = self.image()
        given = lnocl.Observation(image + rays, PSF, background=LEVEL)
        result = lnocl.deconvolve(given, [STAR], engine="numpy", n_iter=300)
        (flux,), (error,) = result.star_fluxes, result.star_flux_errors
        assert abs(flux - 3e4) < 3.0 * error < 1e3
        assert result.verdict() == ["the model fits"]

    def test_stars_sharper_than_a_wrong_psf_are_not_cosmic_rays(self):
        image, _ = self.image()
        y, x = np.indices((41, 41)) - 20
        given = lnocl.Observation(image, np.exp(-(x**2 + y**2) / 1e3), background=LEVEL)
        assert not prepare(lnocl.plan(given, [STAR], engine="numpy", refine_psfs=())).found[RAYS]

    def test_noise_above_that_of_counts_is_not_cosmic_rays(self):
        """As in images whose unit is not electrons."""
        counts = np.random.default_rng(3).normal(LEVEL, 5.0 * LEVEL**0.5, (64, 64))
        given = lnocl.Observation(counts.clip(0.0), PSF, background=LEVEL)
        assert not prepare(lnocl.plan(given, engine="numpy")).setup.observation.mask.any()
