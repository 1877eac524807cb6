"""The folder in which the commands run."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commandline import SHAPE
from scenes import make_psfs


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Work in a folder with two images, their PSFs, and files that are no use."""
    monkeypatch.chdir(tmp_path)
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
        "four": images[None],
        "nan": np.full(SHAPE, np.nan),
        "k1": psfs[0],
        "k2": psfs[1],
        "psfs": psfs,
        "three": psfs[[0, 1, 0]],
        "zero": np.zeros((7, 7)),
        "nanpsf": nan_psf,
        "negative": psfs[0] - 1e-3,
    }
    header = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 15.25})
    for name, array in arrays.items():
        fits.writeto(f"{name}.fits", array, header)
    Path("text.fits").write_text("no FITS at all\n" * 400)
    Path("cut.fits").write_bytes(Path("a.fits").read_bytes()[:3000])
    fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])]).writeto("table.fits")
    Path("there.fits").write_bytes(b"old")
    return tmp_path
