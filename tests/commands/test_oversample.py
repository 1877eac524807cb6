"""``lnocl deconvolve --oversample``: a finer sky in the file, on the sky and in pictures."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from matplotlib.figure import Figure
from scipy.special import erf

import lnocl
from lnocl.commands import cli
from lnocl.io.fitsread import wcs_cards
from lnocl.io.headers import finer_cards
from lnocl.io.saved_results import read_result
from lnocl.plotting.result import outline
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
    command += ["--engine", "numpy", "--residuals", "--quiet", "-o", out]
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


PLAIN = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 65.0, "CRVAL2": 19.5,
         "CRPIX1": 12.0, "CRPIX2": -3.5}  # fmt: skip
SYSTEMS = {
    "CDELT": PLAIN | {"CDELT1": -2e-5, "CDELT2": 3e-5},
    "CDELT and CROTA": PLAIN | {"CDELT1": -2e-5, "CDELT2": 2e-5, "CROTA2": 31.0},
    "PC": PLAIN | {"CDELT1": -2e-5, "CDELT2": 2e-5, "PC1_2": 0.1, "PC2_1": -0.1},
    "SIP both ways": COORDINATES | {
        "CRPIX1": 12.0, "CRPIX2": 11.0, "AP_ORDER": 2, "BP_ORDER": 2, "AP_2_0": -1e-4,
    },
    "TPV": PLAIN | {
        "CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "CD1_1": -1e-4, "CD2_2": 1e-4,
        "PV1_0": 0.0, "PV1_1": 1.0, "PV1_4": 0.01, "PV2_0": 0.0, "PV2_1": 1.0, "PV2_4": -0.01,
    },
    "an alternate one": {f"{key}B": value for key, value in PLAIN.items()}
    | {"CDELT1B": -2e-5, "CDELT2B": 2e-5, "PC1_2B": 0.2},
}  # fmt: skip


@pytest.mark.parametrize("q", [2, 4])
@pytest.mark.parametrize("name", SYSTEMS)
def test_finer_cards_name_the_same_places(name, q):
    header, key = fits.Header(SYSTEMS[name]), "B" if name == "an alternate one" else " "
    finer = finer_cards(wcs_cards(header), q)
    coarse, fine = (WCS(each, key=key, naxis=2) for each in (wcs_cards(header), finer))
    for x, y in ((0.0, 0.0), (1500.0, 127.0), (22.0, 1003.5)):
        there = fine.all_pix2world(q * x + (q - 1) / 2, q * y + (q - 1) / 2, 0)
        np.testing.assert_allclose(there, coarse.all_pix2world(x, y, 0), rtol=0, atol=1e-11)


@pytest.mark.filterwarnings("ignore:the PSFs do not fit the stars")
def test_flags_lie_where_the_extended_source_does(tmp_path):
    rng, path = np.random.default_rng(2), tmp_path / "out.fits"
    psf = gaussian(8 * Q + 1, 4, 4, 0.6, 1 / Q)
    mean = 5.0 + FLUX * gaussian(N, *STAR, 0.6)
    observation = lnocl.Observation(
        rng.poisson(mean), psf, background=5.0, oversample=Q, psf_scatter=0.05 * psf / psf.sum()
    )
    result = lnocl.deconvolve(observation, [STAR], engine="numpy", n_iter=3, stop=None)
    result.write(path, header=fits.Header(PLAIN | {"CDELT1": -2e-5, "CDELT2": 2e-5}))
    with fits.open(path) as hdus:
        assert hdus["DOUBTFUL"].data.shape == hdus[0].data.shape
        for card in ("CRPIX1", "CRPIX2", "CDELT1", "PC1_1"):
            assert hdus["DOUBTFUL"].header[card] == hdus[0].header[card]
    axis = Figure().subplots()
    axis.imshow(np.zeros((N, N)))
    outline(axis, result.doubtful, oversample=Q)
    lines = np.concatenate([each.vertices for each in axis.collections[0].get_paths()])
    assert result.doubtful.any()
    flagged = np.argwhere(result.doubtful)
    assert (lines.max(axis=0) <= (flagged.max(axis=0)[::-1] + 1.5) / Q).all()
    assert np.hypot(*(lines - STAR).T).min() < 3


def test_stars_just_outside_are_drawn(result, tmp_path):
    moved = str(tmp_path / "moved.fits")
    with fits.open(result) as hdus:
        hdus["STARS"].data["x"] = -2.9
        hdus.writeto(moved)
        assert cli.main(["report", moved, "-o", str(tmp_path / "page.html")]) == 0


@pytest.mark.parametrize("value", [0.5, 3, -2, 1e9])
def test_a_damaged_oversamp_is_one_line(result, tmp_path, value, capsys):
    damaged = str(tmp_path / "damaged.fits")
    with fits.open(result) as hdus:
        hdus[0].header["OVERSAMP"] = value
        hdus.writeto(damaged)
    assert cli.main(["plot", damaged, "-o", str(tmp_path / "plots")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"OVERSAMP is {value:g}" in line


@pytest.mark.exhaustive
@pytest.mark.usefixtures("quick_figures")
def test_the_file_is_drawn_on_the_images_pixels(result, tmp_path):
    view = view_of(read_result(result))
    assert (view.oversample, view.shape, view.extended.shape) == (Q, (N, N), (Q * N, Q * N))
    assert cli.main(["plot", result, "-o", str(tmp_path / "plots")]) == 0
    assert cli.main(["report", result, "-o", str(tmp_path / "page.html")]) == 0
    assert "its light in each pixel of the images" in (tmp_path / "page.html").read_text("utf-8")


@pytest.mark.exhaustive
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
    said = capsys.readouterr().err
    assert f"--regions in pixels are in those of the extended source, {Q} to one of the" in said
    with fits.open(result) as hdus:
        table = Table(hdus["ERRORS"].data)
    values = {row["name"]: row["value"] for row in table}
    truth = 3000.0 * (1 - np.exp(-(3.0**2) / (2 * 2.0**2)))
    assert values["pixels"] == pytest.approx(truth, rel=0.1)
    assert values["sky"] == pytest.approx(values["pixels"], rel=0.02)
