"""The file of a result is the same from Python and from the shell."""

import contextlib
import dataclasses
import inspect
import re

import numpy as np
import pytest
from astropy.io import fits
from scenes import make_smooth_psfs
from scipy.ndimage import gaussian_filter

import lnocl
from lnocl.commands import cli
from lnocl.commands.deconvolve_options import ALL_OPTIONS
from lnocl.io.saved_results import read_result
from lnocl.result import view_of
from lnocl.result.file import write_file
from lnocl.studies.figures import view_of as view_of_file

NY, NX, LEVEL = 40, 36, 12.0
STARS = [(9.0, 12.0), (25.0, 29.0)]
FLUXES = np.array([[6e3, 2e3, 4e3], [3e3, 9e3, 1e3]])
BRIGHT = [2e4, 4e4]
EXPOSURES = [1.0, 3.0, 0.5]
WORDS = ["--psf-centre", "given", "--background", str(LEVEL), "--smoothing", "0.1", "--stop"]
WORDS += ["none", "--n-iter", "3", "--engine", "numpy", "--pad", "0", "--residuals"]
DECONVOLVE = inspect.signature(lnocl.deconvolve).parameters
OPTIONS = {"smoothing": 0.1, "stop": None, "n_iter": 3, "engine": "numpy", "pad": 0}
# What the command leads to, and what it has said.
OF_SHELL = ("ESTIMATE",)
WCS = {
    "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 65.0, "CRVAL2": 19.5,
    "CRPIX1": 10.0, "CRPIX2": 20.0, "CDELT1": -1e-4, "CDELT2": 1e-4,
}  # fmt: skip
HEADER = fits.Header({"BUNIT": "electron", "OBJECT": "RW Aur", "EXPTIME": 30.0, **WCS})


@pytest.fixture(scope="module", autouse=True)
def files(tmp_path_factory):
    """Work in a folder with three images of two stars that vary, their PSFs, and a halo.

    And with an image, of number 3, that is blurred against its PSF.
    """
    y, x = np.indices((NY, NX))
    halo = 1.0 / (4.0 + np.hypot(x - 9, 1.3 * (y - 12)))
    psfs, rng = make_smooth_psfs(3, (17, 17)), np.random.default_rng(0)
    psfs /= psfs.sum(axis=(1, 2), keepdims=True)
    with contextlib.chdir(tmp_path_factory.mktemp("result_file")):
        for j, psf in enumerate([*psfs, psfs[0]]):
            exposure, fluxes = (EXPOSURES[j], FLUXES[:, j]) if j < 3 else (1.0, BRIGHT)
            means = np.zeros((NY, NX))
            for (sx, sy), flux in zip(STARS, fluxes, strict=True):
                there = np.s_[int(sy) - 8 : int(sy) + 9, int(sx) - 8 : int(sx) + 9]
                means[there] += exposure * flux * psf
            if j < 3:
                means += exposure * 4e3 * halo / halo.sum()
            else:
                means = gaussian_filter(means, 1.0)
            images = rng.poisson(means + LEVEL).astype(float)
            fits.writeto(f"image{j}.fits", images, HEADER)
            fits.writeto(f"psf{j}.fits", psf)
            fits.writeto(f"scatter{j}.fits", 0.02 * psf)
        fits.writeto("halo.fits", halo)
        yield


def both(*more, numbers=(0, 1, 2), **options):
    """Return the result of Python, having written those of Python and of the shell."""
    given = {name: options.pop(name) for name in list(options) if name not in DECONVOLVE}
    names = [[f"{name}{j}.fits" for j in numbers] for name in ("image", "psf")]
    images, psfs = (np.array([fits.getdata(name) for name in each]) for each in names)
    observation = lnocl.Observation(images, psfs, background=LEVEL, psf_centre="given", **given)
    result = lnocl.deconvolve(observation, STARS, **{**OPTIONS, **options})
    result.write("python.fits", header=HEADER, overwrite=True)
    stars = [word for x, y in STARS for word in ("--star", f"{x},{y}")]
    words = [*names[0], "--psf", *names[1], *stars, *WORDS, *more, "-o", "shell.fits"]
    assert cli.main(["deconvolve", *words, "--overwrite", "--quiet"]) == 0
    return result


def epochs_and_halos():
    options = ("--epoch", "each", "--exposure", *map(str, EXPOSURES), "--halo", "halo.fits")
    halo = fits.getdata("halo.fits")
    return both(*options, epochs=[0, 1, 2], exposure=EXPOSURES, halos=halo)


def psf_errors():
    options = ("--psf-errors", "scatter=scatter0.fits", "--refine-psfs", "none", "--refine")
    scatter = fits.getdata("scatter0.fits")
    more = {"refine_psfs": (), "refine_positions": True}
    return both(*options, numbers=[0], psf_scatter=scatter, **more)


def turned():
    middle = NX // 2, NY // 2
    return both(
        "--angle", "10", "25", transforms=lnocl.rotations([-10, -25], middle), numbers=[0, 1]
    )


def mended_and_chosen():
    words = ["--smoothing", "auto", "--stop", "held-out", "--n-iter", "99"]
    options = {"smoothing": "auto", "stop": "held-out", "n_iter": 99, "refine_psfs": ["jitter"]}
    return both(*words, "--refine-psfs", "jitter", numbers=[3], **options)


RUNS = [
    *(epochs_and_halos, pytest.param(psf_errors, marks=pytest.mark.exhaustive)),
    *(pytest.param(turned, marks=pytest.mark.exhaustive), mended_and_chosen),
]


@pytest.fixture(scope="module", params=RUNS)
def case(request, files):
    return request.param, request.param()


def cards(header):
    """Return values and comments, but for those of the time."""
    left_out = "DATE", "CHECKSUM", "DATASUM", "HISTORY"
    return {c.keyword: (c.value, c.comment) for c in header.cards if c.keyword not in left_out}


def test_all_light_is_in_the_unit_of_the_file():
    image, psf = fits.getdata("image3.fits"), fits.getdata("psf3.fits")
    observation = lnocl.Observation(image, psf, background=LEVEL, psf_centre="given")
    result = lnocl.deconvolve(observation, STARS, **OPTIONS)
    write_file(result, "adu.fits", None, True, unit=("adu", 4.0), has_cubes=False)
    with fits.open("adu.fits") as hdus:
        header, stars = hdus[0].header, hdus["STARS"].data
        np.testing.assert_allclose(4.0 * hdus[0].data, result.extended, rtol=1e-6)
    found = header["EXTFLUX"], header["EXTERROR"]
    np.testing.assert_allclose(found, np.divide(result.extended_flux, 4.0), rtol=1e-9)
    np.testing.assert_allclose(4.0 * stars["flux"], result.star_fluxes, rtol=1e-9)
    np.testing.assert_allclose(4.0 * stars["flux_error"], result.star_flux_errors, rtol=1e-9)


def test_python_and_the_shell_write_the_same(case):
    run, _ = case
    words = {each.card[0] for each in ALL_OPTIONS if each.card}
    words |= {each.checksum for each in ALL_OPTIONS if each.checksum}
    with fits.open("python.fits", checksum=True) as one, fits.open("shell.fits") as other:
        names = [hdu.name for hdu in one]
        assert [hdu.name for hdu in other if hdu.name not in OF_SHELL] == names
        for name in names:
            if name == "MESSAGES":  # the shell has more of them, and names options
                continue
            np.testing.assert_equal(one[name].data, other[name].data, name)
            found, expected = cards(other[name].header), cards(one[name].header)
            of_command = {k for k in found if re.sub(r"\d+$", "", k) in words}
            assert {k: found[k] for k in found if k not in of_command - {*expected}} == expected
        assert set(one["STARS"].columns.names) >= {"core_rms", "wings_rms", "halo"}
        assert {"EXTFLUX", "EXTERROR", "VERDICT", "RESIDRMS"} <= set(one[0].header)
        assert ("CRVAL1" in one[0].header) == (run is not turned)
        assert one[0].header["OBJECT"] == "RW Aur"
        assert ("epoch" in one["STARS"].columns.names) == (run is epochs_and_halos)
        assert ("ra" in one["STARS"].columns.names) == (run is not turned)
        of_psfs = {"PSFFIT", "PSFS", "PSFERRORS", "DOUBTFUL"}
        assert of_psfs & {*names} == (of_psfs if run in (psf_errors, mended_and_chosen) else set())
        assert ("HALOS" in names) == (run is epochs_and_halos)
        assert ("HELDOUT" in names) == (run is mended_and_chosen)
        assert one[0].header.get("PSFUSED", False) == (run is mended_and_chosen)


def test_read_back_both_plot_as_the_result_does(case):
    _, result = case
    expected, *found = (
        view_of(result),
        *(view_of_file(read_result(f"{name}.fits")) for name in ("python", "shell")),
    )
    for field in dataclasses.fields(expected):
        one, python, shell = (getattr(each, field.name) for each in (expected, *found))
        np.testing.assert_equal(python, shell, field.name)
        if isinstance(one, dict):
            one, python = (np.ravel([*each.values()]) for each in (one, python))
        if field.name == "light_curves" and one is not None:
            one, python = one[:2], python[:2]
        if one is None or isinstance(one, str):
            assert python == one
        else:
            np.testing.assert_allclose(python, one, rtol=1e-5, atol=1e-5, err_msg=field.name)


def test_table_too_large_for_the_file_is_left_out_and_reported(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("lnocl.result.file.MOST_BYTES", 10_000)
    path = str(tmp_path / "large.fits")
    words = ["deconvolve", "image0.fits", "--psf", "psf0.fits", *WORDS, "-o", path]
    assert cli.main(words) == 0
    assert "the table ESTIMATE is left out" in capsys.readouterr().err
    with fits.open(path) as hdus:
        assert "ESTIMATE" not in [hdu.name for hdu in hdus]
