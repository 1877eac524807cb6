"""Python that leaves assertions out."""

import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits


@pytest.mark.system
def test_an_image_without_sky_coordinates_is_reconstructed(tmp_path):
    fits.writeto(tmp_path / "image.fits", np.full((8, 8), 5.0))
    fits.writeto(tmp_path / "psf.fits", np.ones((3, 3)))
    command = [sys.executable, "-O", "-m", "lnocl", "deconvolve", "image.fits", "--psf", "psf.fits"]
    command += ["--star", "4,4", "--engine", "numpy", "--solver", "sgp", "--n-iter", "3"]
    command += ["--stop", "none"]
    done = subprocess.run(
        [*command, "-o", "out.fits", "--quiet"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert fits.getdata(tmp_path / "out.fits", "STARS").names[:3] == ["x", "y", "flux"]
