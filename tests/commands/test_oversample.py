"""``lnocl deconvolve --oversample``: a finer sky in the file, on the sky and in pictures."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from scipy.special import erf

from lnocl.commands import cli
from lnocl.io.headers import finer_cards
from lnocl.io.saved_results import read_result
from lnocl.studies.figures import view_of

N, Q = 24, 2
STAR, FLUX = (9.3, 12.7), 20000.0
OFFSETS = [(0.0, 0.0), (0.5, -0.25)]
COORDINATES = {
    "CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRVAL1": 65.0, "CRVAL2": 19.5,
    "CD1_1": -2e-5, "CD1_2": 3e-6, "CD2_1": 3e-6, "CD2_2": 2e-5,
    "A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-4, "A_1_1": 3e-5, "B_0_2": -2e-4,
}  # fmt: skip


def gaussian(n, x, y, sigma, step=1.0):
    edges = (np.arange(n + 1) - 0.5) * step
    along = [np.diff(erf((edges - at) / (sigma * 2**0.5))) / 2 for at in (y, x)]
    return np.outer(*along)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("finer"), np.random.default_rng(8)
    images = []
    for j, (dx, dy) in enumerate(OFFSETS):
        mean = 5.0 + FLUX * gaussian(N, STAR[0] + dx, STAR[1] + dy, 0.6)
        mean += 3000.0 * gaussian(N, 16 + dx, 7 + dy, 2.0)
        cards = COORDINATES | {"CRPIX1": 12.0 + dx, "CRPIX2": 12.0 + dy, "BUNIT": "electron"}
        images.append(str(folder / f"image_{j}.fits"))
        fits.writeto(images[-1], rng.poisson(mean).astype("f4"), fits.Header(cards))
    psf, out = str(folder / "psf.fits"), str(folder / "out.fits")
    fits.writeto(psf, gaussian(8 * Q + 1, 4, 4, 0.6, 1 / Q), fits.Header({"OVERSAMP": Q}))
    command = ["deconvolve", *images, "--psf", psf, "--oversample", str(Q), "--background", "5"]
    command += ["--align", "wcs", "--star", "9,13", "--refine", "--n-iter", "20", "--stop", "none"]
    command += ["--engine", "numpy", "--models", "--residuals", "--quiet", "-o", out]
    assert cli.main(command) == 0
    return out


def test_the_extended_source_is_finer_and_all_else_as_the_images(result):
    with fits.open(result) as hdus:
        assert hdus[0].data.shape == (Q * N, Q * N)
        assert hdus[0].header["OVERSAMP"] == Q
        assert hdus["MODELS"].data.shape == hdus["RESIDUALS"].data.shape == (2, N, N)
        (star,) = Table(hdus["STARS"].data)
        assert np.hypot(star["x"] - STAR[0], star["y"] - STAR[1]) < 0.02
        assert star["flux"] == pytest.approx(FLUX, rel=0.03)
        y, x = np.unravel_index(hdus[0].data.argmax(), hdus[0].data.shape)
        assert np.hypot(x - (16 * Q + 0.5), y - (7 * Q + 0.5)) < 4


def test_pixels_of_both_lie_at_one_place_of_the_sky(result):
    finer, coarse = (
        WCS(fits.getheader(path)) for path in (result, result.replace("out", "image_0"))
    )
    for x, y in ((0.0, 0.0), (9.3, 12.7), (22.0, 3.5)):
        there = finer.pixel_to_world(Q * x + (Q - 1) / 2, Q * y + (Q - 1) / 2)
        assert there.separation(coarse.pixel_to_world(x, y)).arcsec < 1e-7


@pytest.mark.parametrize("key", ["", "B"])
def test_cards_of_other_systems_are_scaled(key):
    cards = {f"CRPIX1{key}": 3.0, f"CRPIX2{key}": -1.5, f"CDELT1{key}": -0.4, f"CDELT2{key}": 0.2}
    found = finer_cards(fits.Header(cards | {f"CRVAL1{key}": 5.0, f"PC1_2{key}": 0.1}), 4)
    assert [found[f"CRPIX{axis}{key}"] for axis in "12"] == [10.5, -7.5]
    assert [found[f"CDELT{axis}{key}"] for axis in "12"] == [-0.1, 0.05]
    assert (found[f"CRVAL1{key}"], found[f"PC1_2{key}"]) == (5.0, 0.1)


def test_the_file_is_drawn_on_the_images_pixels(result, tmp_path):
    view = view_of(read_result(result))
    assert (view.oversample, view.shape, view.extended.shape) == (Q, (N, N), (Q * N, Q * N))
    assert cli.main(["plot", result, "-o", str(tmp_path / "plots")]) == 0
    assert cli.main(["report", result, "-o", str(tmp_path / "page.html")]) == 0
    assert "its light in each pixel of the images" in (tmp_path / "page.html").read_text("utf-8")


def test_regions_are_measured_on_the_finer_sky(result, tmp_path, capsys):
    """In pixels of the extended source, and on the sky: one circle, 3 pixels of the images."""
    there = WCS(fits.getheader(result)).pixel_to_world(16 * Q + 0.5, 7 * Q + 0.5)
    regions = tmp_path / "both.reg"
    regions.write_text(
        f"image\ncircle({16 * Q + 1.5},{7 * Q + 1.5},{3 * Q}) # text={{pixels}}\n"
        f'icrs\ncircle({there.ra.deg:.9f},{there.dec.deg:.9f},{3 * 0.0728}") # text={{sky}}\n'
    )
    command = ["errors", result, "--bootstrap", "10", "--regions", str(regions)]
    assert cli.main(command) == 0
    with fits.open(result) as hdus:
        table = Table(hdus["ERRORS"].data)
    values = {row["name"]: row["value"] for row in table}
    truth = 3000.0 * (1 - np.exp(-(3.0**2) / (2 * 2.0**2)))
    assert values["pixels"] == pytest.approx(truth, rel=0.1)
    assert values["sky"] == pytest.approx(values["pixels"], rel=0.02)
