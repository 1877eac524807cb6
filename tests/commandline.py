"""Runs of the command line in a folder of files for it."""

import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits
from scenes import Recipe, make_psfs

from lnocl.commands import cli

SHAPE = (16, 12)
NUMPY = ("--engine", "numpy")
# The paper's iteration, whatever the defaults.
PAPER = ("--solver", "sgm", "--stop", "none", "--smoothing", "0", "--pad", "0")
# PSFs of the tests have no symmetry.
GIVEN = ("--psf-centre", "given")


@pytest.fixture
def command_folder(command_files, tmp_path, monkeypatch):
    """Work in a folder of copies of the files, which a test may change."""
    shutil.copytree(command_files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def command_files(tmp_path_factory):
    """Return a folder with two images, their PSFs, and files that are no use."""
    folder = tmp_path_factory.mktemp("command_files")
    chance = np.random.default_rng(1)
    images = chance.poisson(20.0, (2, *SHAPE)).astype(float)
    images[:, 5, 7] += 400.0
    psfs = make_psfs(2, (7, 7))
    nan_psf = psfs[0].copy()
    nan_psf[0, 0] = np.nan
    arrays = {
        "a": images[0],
        "b": images[1],
        "cube": images,
        "oblong": images[0].T,
        "line": images[0, 0],
        "four": images[:, None],
        "nan": np.full(SHAPE, np.nan),
        "k1": psfs[0],
        "k2": psfs[1],
        "psfs": psfs,
        "three": psfs[[0, 1, 0]],
        "zero": np.zeros((7, 7)),
        "nanpsf": nan_psf,
        "negative": psfs[0] - 0.15,
    }
    header = fits.Header(
        {"BUNIT": "electron", "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 15.25}
    )
    for name, array in arrays.items():
        fits.writeto(folder / f"{name}.fits", array, header)
    (folder / "text.fits").write_text("no FITS at all\n" * 400)
    (folder / "cut.fits").write_bytes((folder / "a.fits").read_bytes()[:3000])
    table = fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])])
    table.writeto(folder / "table.fits")
    (folder / "there.fits").write_bytes(b"old")
    return folder


@pytest.fixture
def small_command(tmp_path, monkeypatch):
    """Work in a folder with images and PSFs; return the words that deconvolve them."""
    made = Recipe((64, 64), 2, 1, smoothing=1e-3, background="scalar").make()
    for name in ("images", "psfs"):
        fits.writeto(tmp_path / f"{name}.fits", getattr(made, name))
    monkeypatch.chdir(tmp_path)
    (x, y) = made.stars[0]
    return [
        *("deconvolve", "images.fits", "--psf", "psfs.fits", "--background", "8"),
        *("--star", f"{x},{y}", "--quiet", "--overwrite", *PAPER, *GIVEN),
    ]


def gaussian(n, x, y, sigma=1.5):
    """Return a Gaussian of unit sum on n x n pixels."""
    rows, columns = np.indices((n, n))
    light = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2.0 * sigma**2))
    return light / light.sum()


def run(*arguments, image="a.fits", psf="k1.fits", engine=NUMPY, output="out.fits"):
    """Deconvolve for one iteration unless the arguments say otherwise."""
    images = [image] if isinstance(image, str) else image
    return cli.main(
        [
            *("deconvolve", *images, "--psf", psf, "--n-iter", "1", "-o", output),
            *(*PAPER, *GIVEN, *engine, *arguments),
        ]
    )


def one_complaint(captured):
    """Return the message of the one error on stderr; lines before it may only be warnings."""
    assert captured.out == ""
    *warned, error = captured.err.splitlines()
    assert all(line.startswith("lnocl: warning: ") for line in warned)
    assert error.startswith("lnocl: error: ")
    return error.removeprefix("lnocl: error: ")


def outside(*arguments, stdout=subprocess.PIPE, **environment):
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "lnocl", *arguments],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        env=os.environ | {"PYTHONUNBUFFERED": ""} | environment,
    )


def outcome(path):
    """Return everything in a result that a run computes."""
    with fits.open(path, checksum=True) as hdus:
        return {
            hdu.name: hdu.data if hdu.is_image else {n: hdu.data[n] for n in hdu.columns.names}
            for hdu in hdus
        }


def without_progress(text):
    """Return stderr without lines on progress, of which slow machines have more."""
    return re.sub(r"(?m)^lnocl: [^:]*: ([^:]*, )?\d+ (s|min)\n", "", text)
