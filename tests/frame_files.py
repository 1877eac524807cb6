"""Images in files, and observations that are read from them."""

import logging

import numpy as np
import pytest
from astropy.io import fits

from lnocl.io.calibration import Calibration
from lnocl.io.frames import read_frames

SHAPE = (10, 12)
IMAGES = np.random.default_rng(3).poisson(50.0, (2, *SHAPE)).astype(float)
MAP = np.linspace(1.0, 2.0, IMAGES[0].size).reshape(SHAPE)
NONE = np.zeros((2, *SHAPE), bool)


def save(path, data, **cards):
    fits.writeto(path, np.asarray(data), fits.Header(cards), overwrite=True)
    return path


def save_images(images=IMAGES, **cards):
    return [save(f"{j}.fits", image, **cards) for j, image in enumerate(images, 1)]


def read(*paths, psf="psf.fits", **known):
    return read_frames(paths or ("1.fits", "2.fits"), [psf], Calibration(**known))


def observe(*paths, **known):
    return read(*paths, **known).observation


def notes(caplog):
    """Return what was said, but for the unit that these files do not have."""
    said = [record.getMessage() for record in caplog.records]
    return [line for line in said if "has no BUNIT" not in line]


@pytest.fixture
def frame_folder(tmp_path, monkeypatch):
    """Work in a folder of its own, with a PSF."""
    monkeypatch.chdir(tmp_path)
    save("psf.fits", np.ones((3, 3)))


@pytest.fixture
def log(caplog):
    caplog.set_level(logging.DEBUG, "lnocl")
    return caplog
