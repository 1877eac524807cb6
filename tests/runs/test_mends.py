"""Images are mended before a run: what is masked, told, and what becomes of the star."""

import numpy as np
import pytest
from astropy.io import fits

import lnocl
from lnocl.core.runs.plan import CORES, EXPOSURES
from lnocl.core.runs.preparation import prepare
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
    prepared = prepare(lnocl.plan(given, [STAR], refine_psfs=(), **option))
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

    def test_stars_vary_from_epoch_to_epoch(self):
        plan = lnocl.plan(dimmed(epochs=[0, 1, 2]), [STAR])
        assert plan.why_not(EXPOSURES) == "stars may vary from epoch to epoch"

    def test_what_is_found_comes_back_from_a_result(self):
        given = dimmed(exposure=[2.0, 2.0, 2.0])
        result = lnocl.deconvolve(given, [STAR], engine="numpy", n_iter=5, stop=None)
        outcome = result._outcome
        again = from_parts(to_parts(outcome, given), given, None, "single")
        np.testing.assert_array_equal(again.observation.exposure, outcome.observation.exposure)
        assert outcome.observation.exposure[0] < 1.5
        assert (again.setup.is_rate, outcome.setup.is_rate) == (True, True)
