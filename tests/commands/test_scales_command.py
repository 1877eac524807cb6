"""``lnocl deconvolve`` on a sharp image and one of larger pixels, by their coordinates."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from turned_scenes import gaussian

from lnocl.commands import cli
from lnocl.io.saved_results import read_result

SCALE, DEGREES, BRIGHTER = 2.5, 8.0, 4.0
SHARP, COARSE = 56, 24
MIDDLE = np.array([(SHARP - 1) / 2.0] * 2)
BLOB, STAR = np.add(MIDDLE, (8.3, -5.2)), np.add(MIDDLE, (-6.4, 4.1))
# Covariances of the PSFs, pixels of their image.
OF_SHARP, OF_COARSE = 1.6 * np.eye(2), np.array([[2.4, 0.3], [0.3, 1.8]])


def header(side, turn):
    """Return coordinates about the middle of an image, from those of the sharp one."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crpix = [(side + 1) / 2.0] * 2
    wcs.wcs.crval = [80.0, 20.0]
    wcs.wcs.cd = np.diag([-1e-5, 1e-5]) @ np.linalg.inv(turn)
    return wcs.to_header()


@pytest.fixture
def frames(tmp_path, monkeypatch):
    """Write the coarse image, which has four times the light, and then the sharp one."""
    monkeypatch.chdir(tmp_path)
    a = np.radians(DEGREES)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) / SCALE
    rng = np.random.default_rng(8)
    for name, side, linear, psf, light in (
        ("coarse", COARSE, turn, OF_COARSE, BRIGHTER),
        ("sharp", SHARP, np.eye(2), OF_SHARP, 1.0),
    ):
        y, x = np.indices((side, side))
        mean = np.full((side, side), 10.0)
        for at, flux, width in ((STAR, 2e4, 0.0), (BLOB, 6e4, 12.0)):
            u, v = linear @ (at - MIDDLE) + (side - 1) / 2.0
            blurred = psf + width * linear @ linear.T
            mean += light * flux * gaussian(x - u, y - v, blurred)
        given = header(side, linear)
        given.update({"BUNIT": "electron", "LIGHT": light})
        fits.writeto(f"{name}.fits", rng.poisson(mean).astype("f4"), given)
        half = 10 if name == "sharp" else 8
        y, x = np.indices((2 * half + 1, 2 * half + 1)) - half
        fits.writeto(f"{name}_psf.fits", gaussian(x, y, psf))
        bad = np.zeros((side, side), "u1")
        bad[3, 5] = 1
        fits.writeto(f"{name}_bad.fits", bad)
    return ["coarse.fits", "sharp.fits"]


@pytest.mark.exhaustive
def test_images_of_two_scales(frames, capsys):
    command = ["deconvolve", *frames, "--psf", "coarse_psf.fits", "sharp_psf.fits"]
    command += ["--mask", "coarse_bad.fits", "sharp_bad.fits", "--background", "auto"]
    command += ["--exposure", "LIGHT", "--align", "wcs", "--star", f"{STAR[0]},{STAR[1]}"]
    command += ["--residuals", "--engine", "numpy", "-o", "out.fits", "--verbose"]
    assert cli.main(command) == 0
    said = capsys.readouterr().err
    assert "the sky has the pixels of sharp.fits, the smallest: positions are in these" in said
    assert "image 1: turned by 8.000 degrees, pixels 2.5 times as large, from the WCS" in said
    assert "not finite" not in said  # what is beyond the smaller image is no fault
    with fits.open("out.fits") as hdus:
        extended, stars = hdus[0].data, hdus["STARS"].data
        at = WCS(hdus[0].header).pixel_to_world(*BLOB)
        sharp = WCS(fits.getheader("sharp.fits")).pixel_to_world(*BLOB)
        assert at.separation(sharp).arcsec < 1e-3
        assert extended.shape == (SHARP, SHARP)
        y, x = np.indices(extended.shape)
        middle = np.array([(extended * x).sum(), (extended * y).sum()]) / extended.sum()
        np.testing.assert_allclose(middle, BLOB, atol=0.2)
        assert extended.sum() == pytest.approx(6e4, rel=0.01)
        assert abs(stars["flux"] - 2e4) <= 3 * stars["flux_error"]
        assert stars["flux_error"] <= 400
        residuals = hdus["RESIDUALS"].data
        assert abs(np.nanstd(residuals, axis=(1, 2)) - 1.0).max() <= 0.1
        assert np.isnan(residuals[0, COARSE:]).all()
    saved = read_result("out.fits")
    assert np.linalg.det(saved.turns) == pytest.approx([1 / SCALE**2, 1.0], abs=1e-6)


def test_several_shapes_need_coordinates(frames, capsys):
    command = ["deconvolve", *frames, "--psf", "sharp_psf.fits", "-o", "out.fits"]
    assert cli.main(command) == 2
    assert "sharp.fits has the shape (56, 56) and coarse.fits (24, 24)" in capsys.readouterr().err


def test_maps_are_those_of_their_images(frames, capsys):
    command = ["deconvolve", *frames, "--psf", "coarse_psf.fits", "sharp_psf.fits", "--n-iter", "1"]
    command += ["--stop", "none", "--align", "wcs", "--engine", "numpy", "-o", "out.fits"]
    assert cli.main([*command, "--mask", "sharp_bad.fits", "coarse_bad.fits"]) == 2
    assert (
        "--mask sharp_bad.fits has the shape (56, 56) and its image (24, 24); give one that fits"
        in capsys.readouterr().err
    )
    assert cli.main([*command, "--mask", "sharp_bad.fits"]) == 2
    assert "give one map that fits all images, or one for each" in capsys.readouterr().err
    assert cli.main([*command, "--background", "coarse_bad.fits", "10"]) == 0
