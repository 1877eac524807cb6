"""``lnocl deconvolve --star-psf``: the PSF of a star behind a mask, in a file."""

import numpy as np
import pytest
from astropy.io import fits

import lnocl
from lnocl.commands import cli
from lnocl.io.saved_results import read_result

N = 48
STAR, PLANET = (22.0, 25.0), (33.0, 18.0)
Y, X = np.indices((N, N), float)
V, U = np.indices((33, 33)) - 16


def beside(x, y):
    """Return the PSF beside the mask, lopsided."""
    return np.exp(-(x**2 + 1.3 * y**2) / 8) + 0.2 * np.exp(-((x - 2) ** 2 + (y + 1) ** 2) / 6)


def behind(x, y):
    """Return that behind it, speckles of a twentieth of the light."""
    light = np.exp(-(x**2 + y**2) / 50) * (1 + 0.8 * np.cos(x + 0.5) * np.cos(1.2 * y))
    return light / 20 / (np.exp(-(U**2 + V**2) / 50)).sum()


def observation():
    means = 20 + 3e6 * behind(X - STAR[0], Y - STAR[1]) + 500 * beside(X - PLANET[0], Y - PLANET[1])
    counts = np.random.default_rng(3).poisson(means).astype(float)
    return lnocl.Observation(
        counts, beside(U, V), background=20, star_psfs=behind(U, V), star_places=STAR
    )


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Write the image and the PSFs; return the beginning of a command."""
    monkeypatch.chdir(tmp_path)
    given = observation()
    for name, array in (
        ("image", given.images[0]),
        ("psf", given.psfs[0]),
        ("behind", given.star_psfs[0, 0]),
        ("three", np.ones((3, 5, 5)) / 99),
    ):
        fits.writeto(f"{name}.fits", array)
    words = ["deconvolve", "image.fits", "--psf", "psf.fits", "--background", "20"]
    words += ["--star", "22,25", "--star", "33,18", "--n-iter", "12", "--stop", "none"]
    return [*words, "--engine", "numpy", "-o", "out.fits"]


@pytest.mark.exhaustive
def test_star_psf_command_matches_the_function_and_is_repeated(command, capsys):
    assert cli.main([*command, "--star-psf", "22,25=behind.fits"]) == 0
    found = lnocl.deconvolve(observation(), [STAR, PLANET], n_iter=12, stop=None, engine="numpy")
    saved = read_result("out.fits")
    np.testing.assert_allclose(saved.star_fluxes, found.star_fluxes, rtol=1e-9)
    assert " --star-psf 22,25=behind.fits" in " ".join(saved.commands().replace("\\\n", "").split())
    assert saved.header["QSUM1"]
    assert cli.main(["detect", "out.fits", "--quiet"]) == 0
    assert cli.main(["errors", "out.fits", "--bootstrap", "10", "--quiet"]) == 0
    assert "again" not in capsys.readouterr().err


WRONG = {
    "--star-psf 22,25=nothing.fits": "nothing.fits",
    "--star-psf 22,25=three.fits": "3 star_psfs for 1 image; give one",
    "--star-psf behind.fits": "'behind.fits' is not X,Y in pixels",
    "--star-psf 22,25": "'22,25' is not X,Y=FILE",
    "--star-psf 22,26=behind.fits": "no star is within 0.5 pixels of (22, 26)",
    "--star-psf 22,25=psf.fits --star-psf 22,25=behind.fits": "has (22, 25) twice",
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_uses_are_one_clear_line(command, words, capsys):
    try:
        code = cli.main([*command, *words.split()])
    except SystemExit as error:
        code = error.code
    assert code in (1, 2)
    errors = [each for each in capsys.readouterr().err.splitlines() if "error: " in each]
    assert len(errors) == 1
    assert WRONG[words] in errors[0]
