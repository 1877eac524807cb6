"""The lines of a run on its result: unnamed stars, errors of backgrounds, halos of a batch."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits

from lnocl.commands import cli
from lnocl.commands.batch import _summarise

Y, X = np.indices((48, 48))
NAMED, UNNAMED = (16, 20), (34, 30)


def gaussian(x, y):
    return np.exp(-((X - x) ** 2 + (Y - y) ** 2) / 5.0)


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    means = 100.0 + 5000.0 * gaussian(*NAMED) + 3000.0 * gaussian(*UNNAMED)
    image = np.random.default_rng(0).poisson(means).astype(float)
    fits.writeto("image.fits", image, fits.Header({"BUNIT": "electron"}))
    fits.writeto("psf.fits", gaussian(24, 24))


def run(*options):
    words = ["image.fits", "--psf", "psf.fits", "--engine", "numpy", "--n-iter", "60"]
    words += ["--stop", "none", "--smoothing", "0", "--pad", "0", "--overwrite", "-o", "out.fits"]
    assert cli.main(["deconvolve", *words, *options]) == 0
    return fits.getheader("out.fits")


def test_unnamed_star_is_reported_and_a_named_one_is_not(capsys):
    run("--background", "100", "--star", "16,20")
    said = capsys.readouterr().out
    assert "1 source in the extended source is as sharp as stars, the brightest at (34, 30)" in said
    run("--background", "100", "--star", "16,20", "--star", "34,30")
    assert "as sharp as stars" not in capsys.readouterr().out


def test_the_error_of_a_measured_background_is_in_that_of_the_extended_source(capsys):
    measured = run("--background", "auto", "--star", "16,20", "--verbose")
    line = next(line for line in capsys.readouterr().err.splitlines() if "background" in line)
    level, error = (float(line.split()[k]) for k in (4, 6))
    given = run("--background", repr(float(measured["BKG1"])), "--star", "16,20")
    assert measured["BKG1"] == pytest.approx(level, rel=1e-5)
    expected = np.hypot(given["EXTERROR"], X.size * error)
    assert measured["EXTERROR"] == pytest.approx(expected, rel=0.05)
    assert measured["EXTERROR"] > 1.1 * given["EXTERROR"]


def test_halos_of_a_batch_are_counted():
    from astropy.table import Table

    names = ("name", "status", "verdict", "star_flux", "star_flux_error", "star_halo")
    names += ("extended_flux", "extended_flux_error", "unit")
    rows = [(*"ab", "the model fits", 9.0, 1.0, halo, 5.0, 1.0, "adu") for halo in (0.0, 0.5)]
    table = Table(rows=rows, names=names)
    table["status"] = ["done", "done"]
    lines = _summarise(table, 0, SimpleNamespace(path="."))
    assert any(line.startswith("in 1 target light lies all round the star") for line in lines)
