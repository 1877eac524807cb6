"""Images are mended before a run: what is masked, told, and what becomes of the star."""

import numpy as np
import pytest

import lnocl
from lnocl.core.runs.plan import CORES
from lnocl.core.runs.preparation import prepare

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
