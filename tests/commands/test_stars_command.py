"""Stars found from the command line, and taken by ``lnocl deconvolve``."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commandline import gaussian

from lnocl.commands import cli

pytest.importorskip("photutils", reason="photutils is not installed")

N = 64
WCS = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 15.25, "CRVAL2": -3.0,
       "CRPIX1": 32.0, "CRPIX2": 32.0, "CDELT1": -1e-4, "CDELT2": 1e-4}  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    light = 50.0 + 3e4 * gaussian(N, 20.3, 40.1) + 8e3 * gaussian(N, 45.0, 18.6)
    counts = np.random.default_rng(1).poisson(light).astype(float)
    fits.writeto("image.fits", counts, fits.Header(WCS))
    fits.writeto("psf.fits", gaussian(25, 12, 12))
    return tmp_path


@pytest.mark.exhaustive
@pytest.mark.parametrize("output", ["stars.ecsv", "stars.csv", "stars.fits"])
def test_the_table_is_taken_by_deconvolve(output, capsys):
    assert cli.main(["stars", "image.fits", "--psf", "psf.fits", "-o", output]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("2 stars found, the brightest at (20.")
    assert said[1:] == [f"written to {output}"]
    stars = Table.read(output)
    assert stars["star"].tolist() == [1, 2]
    command = ["deconvolve", "image.fits", "--psf", "psf.fits", "--background", "50"]
    command += ["--stars", output, "--n-iter", "3", "--stop", "none", "--engine", "numpy"]
    assert cli.main([*command, "-o", "out.fits"]) == 0
    found = fits.getdata("out.fits", "STARS")
    np.testing.assert_allclose(found["x"], stars["x"], atol=1e-9)
    np.testing.assert_allclose(found["y"], stars["y"], atol=1e-9)
    np.testing.assert_allclose(found["flux"], [3e4, 8e3], rtol=0.1)


@pytest.mark.exhaustive
def test_the_picture_has_the_stars_and_their_numbers(capsys):
    pytest.importorskip("matplotlib")
    from lnocl.plotting.stars import draw_stars

    assert cli.main(["stars", "image.fits", "-o", "stars.ecsv", "--plot", "stars.png"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "drew stars.png"
    assert Path("stars.png").read_bytes().startswith(b"\x89PNG")
    stars = Table.read("stars.ecsv")
    stars["saturated"][1] = True
    (axis,) = draw_stars(fits.getdata("image.fits"), stars).axes
    places = [line.get_data()[0].tolist() for line in axis.lines]
    assert places == [[stars["x"][0]], [stars["x"][1]]]
    assert [text.get_text() for text in axis.texts] == ["1", "2"]
    edges = [effect._gc["foreground"] for text in axis.texts for effect in text.get_path_effects()]
    assert edges == ["white", "white"]  # round dark letters, on dark stars
    assert axis.get_title() == "2 stars; orange: saturated"


def test_saturated_stars_are_named(capsys):
    counts = fits.getdata("image.fits").clip(max=1500.0)
    fits.writeto("image.fits", counts, overwrite=True)
    command = ["stars", "image.fits", "--saturation", "1500", "-o", "stars.ecsv"]
    assert cli.main(command) == 0
    assert (
        "1 star saturated: 1; lnocl psf and lnocl deconvolve take their wings"
        in capsys.readouterr().out
    )
    stars = Table.read("stars.ecsv")
    assert stars["saturated"].tolist() == [True, False]
    assert "ra" not in stars.colnames


def test_cosmic_rays_and_flat_tops_are_reported(capsys):
    counts = fits.getdata("image.fits").clip(max=1500.0)
    counts[8, 50:54] = counts[50:54, 50] = 900.0, 930.0, 870.0, 910.0
    fits.writeto("image.fits", counts, overwrite=True)
    assert cli.main(["stars", "image.fits", "--psf", "psf.fits", "-o", "stars.ecsv"]) == 0
    told = capsys.readouterr()
    assert "2 sources sharper than the PSF left out, as cosmic rays and bad pixels" in told.out
    assert "1 star saturated: 1; lnocl psf" in told.out
    assert "of flat tops at 1500 are taken as saturated, as by --saturation 1500\n" in told.err
    assert len(Table.read("stars.ecsv")) == 2


@pytest.mark.exhaustive
@pytest.mark.parametrize("word", ["given", "default"])
def test_flags_and_weights_of_the_file_are_heeded(word, capsys):
    counts = fits.getdata("image.fits")
    flags, weights = np.zeros((2, N, N), "i2")
    flags[17:21, 43:48], weights[:] = 4096, 1  # on the second star
    weights[30:50, 10:30] = 0  # on the first
    for name, values in (("dq", flags), ("wht", weights)):
        primary = fits.PrimaryHDU(header=fits.Header({"TELESCOP": "HST", "INSTRUME": "ACS"}))
        hdus = [fits.ImageHDU(counts, name="SCI"), fits.ImageHDU(values, name=name.upper())]
        fits.HDUList([primary, *hdus]).writeto(f"{name}.fits")
        chosen = ["--mask", name] if word == "given" else []
        assert cli.main(["stars", f"{name}.fits", *chosen, "-o", f"{name}.csv"]) == 0
    by_flags, by_weights = Table.read("dq.csv"), Table.read("wht.csv")
    is_second = np.hypot(by_flags["x"] - 45.0, by_flags["y"] - 18.6) < 5
    assert is_second.any()
    assert ((by_flags["saturated"] == "True") == is_second).all()
    assert np.hypot(by_weights["x"] - 20.3, by_weights["y"] - 40.1).min() > 5
    assert cli.main(["stars", "dq.fits", "--mask", "dq:4096", "-o", "all.csv"]) == 0
    assert "True" not in Table.read("all.csv")["saturated"].astype(str)
    assert cli.main(["stars", "image.fits", "--mask", "dq", "-o", "a.csv"]) == 2
    assert "image.fits has no extension DQ; give --mask as a file" in capsys.readouterr().err


def test_image_without_stars_gets_advice_and_an_empty_table(capsys):
    noise = np.random.default_rng(2).normal(50.0, 5.0, (N, N))
    fits.writeto("noise.fits", noise)
    assert cli.main(["stars", "noise.fits", "-o", "stars.ecsv"]) == 0
    assert "no star is found: give --psf" in capsys.readouterr().out
    assert len(Table.read("stars.ecsv")) == 0


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["image.fits", "-o", "stars.txt"], 2, "a name ending in .ecsv, .csv or .fits, not stars"),
        (["image.fits", "-o", "image.fits", "--overwrite"], 2, "is one of the inputs"),
        (["image.fits", "-o", "there.csv"], 1, "the output there.csv exists"),
        (["no.fits", "-o", "a.csv"], 1, "no.fits cannot be opened"),
        (["image.fits", "-o", "a.csv", "--threshold", "0"], 2, "--threshold must be more than 0"),
        (["image.fits", "-o", "a.csv", "--mask", "psf.fits"], 2, "--mask psf.fits has the shape"),
        (["image.fits", "-o", "a.csv", "--plot", "a.jpg"], 2, "a name ending in .png"),
        (["cube.fits", "-o", "a.csv"], 2, "cube.fits holds 2 images"),
    ],
)
def test_refusals(arguments, status, message, capsys):
    Path("there.csv").write_text("kept")
    fits.writeto("cube.fits", np.ones((2, 9, 9)))
    before = sorted(os.listdir())
    assert cli.main(["stars", *arguments]) == status
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert sorted(os.listdir()) == before
    assert Path("there.csv").read_text() == "kept"


def test_missing_photutils_is_reported_with_its_install_command(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "photutils.background", None)
    assert cli.main(["stars", "image.fits", "-o", "stars.ecsv"]) == 1
    assert "pip install photutils" in capsys.readouterr().err
