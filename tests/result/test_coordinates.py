"""Coordinates that come with images come back with the result, and in its file."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData, NDData
from astropy.wcs import WCS
from astropy.wcs.wcsapi import HighLevelWCSWrapper, SlicedLowLevelWCS

import lnocl

Y, X = np.indices((24, 32))
OPTIONS = {"engine": "numpy", "n_iter": 3, "stop": None, "smoothing": 0.0, "mend_images": False}
PSF = np.exp(-((np.indices((9, 9)) - 4) ** 2).sum(axis=0) / 3.0)


def wcs(right_ascension):
    found = WCS(naxis=2)
    found.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    found.wcs.crval, found.wcs.crpix = (right_ascension, 19.5), (3.0, 4.0)
    found.wcs.cdelt = -1e-5, 1e-5
    return found


def solve(images, solver=lnocl.deconvolve, **more):
    observation = lnocl.Observation(images, PSF, background=20.0, psf_error=0.0, **more)
    return solver(observation, [(12.0, 9.0)], **OPTIONS)


@pytest.fixture(scope="module")
def image():
    means = 20.0 + 5e3 * np.exp(-((X - 12) ** 2 + (Y - 9) ** 2) / 3.0)
    return np.random.default_rng(0).poisson(means).astype(float)


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize("oversample", [1, 2])
def test_a_star_is_where_the_images_have_it(image, oversample, tmp_path):
    result = solve(CCDData(image, unit="electron", wcs=wcs(65.0)), oversample=oversample)
    sky, expected = result.to_ccddata(), wcs(65.0).pixel_to_world_values(12.0, 9.0)
    fine = oversample * (np.array([12.0, 9.0]) + 0.5) - 0.5
    np.testing.assert_allclose(sky.wcs.pixel_to_world_values(*fine), expected, rtol=1e-12)
    np.testing.assert_array_equal(sky.data, result.extended)
    result.write(tmp_path / "sky.fits")
    with fits.open(tmp_path / "sky.fits") as hdus:
        (star,) = hdus["STARS"].data
        assert [star["ra"], star["dec"]] == pytest.approx([*map(float, expected)], rel=1e-12)
        written = WCS(hdus[0].header).pixel_to_world_values(*fine)
    np.testing.assert_allclose(written, expected, rtol=1e-12)


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_they_are_those_of_the_image_that_is_not_moved(image):
    images = [NDData(image, unit="electron", wcs=wcs(each)) for each in (65.0, 66.0)]
    result = solve(images, offsets=[(0.5, 0.0), (0.0, 0.0)])
    assert result.to_ccddata().wcs.wcs.crval[0] == 66.0
    assert solve(images, offsets=[(0.5, 0.0), (0.0, 1.0)]).to_ccddata().wcs is None
    assert solve(image).to_ccddata().wcs is None


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_tiles_have_those_of_the_whole(image):
    given = CCDData(np.tile(image, (3, 3)), unit="electron", wcs=wcs(65.0))
    tiled = solve(given, lambda *args, **more: lnocl.deconvolve_tiles(*args, tile=48, **more))
    assert tiled.to_ccddata().wcs.wcs.crval[0] == 65.0


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_those_that_a_header_cannot_hold_are_left_out(image, tmp_path):
    """As of gwcs, or of axes that are not those of the sky."""
    other = HighLevelWCSWrapper(SlicedLowLevelWCS(wcs(65.0), (slice(1, None), slice(None))))
    for each in (other, WCS(naxis=2)):
        result = solve(NDData(image, unit="electron", wcs=each))
        assert result.to_ccddata().wcs is None
        result.write(tmp_path / "sky.fits", overwrite=True)
