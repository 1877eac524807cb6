"""Users without a home, or with one that cannot be written to."""

import os
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits

# As for a user whom the system does not know.
UNKNOWN = """
import os, pwd, sys
def unknown(uid):
    raise KeyError(uid)
pwd.getpwuid = unknown
from lnocl.commands import cli
sys.exit(cli.main())
"""


@pytest.mark.system
@pytest.mark.parametrize("home", [None, "/proc/nobody"], ids=["no home", "not writable"])
def test_no_package_complains(home, tmp_path):
    fits.writeto(tmp_path / "image.fits", np.full((8, 8), 5.0))
    fits.writeto(tmp_path / "psf.fits", np.ones((3, 3)))
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("HOME", "MPLCONFIGDIR") and not name.startswith("XDG_")
    }
    environment |= {} if home is None else {"HOME": home}
    deconvolve = ["deconvolve", "image.fits", "--psf", "psf.fits", "--engine", "numpy"]
    deconvolve += ["--n-iter", "2", "--quiet", "-o", "out.fits"]
    for words in (deconvolve, ["plot", "out.fits", "-o", "figures"]):
        done = subprocess.run(
            [sys.executable, "-c", UNKNOWN, *words],
            cwd=tmp_path, env=environment, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        complaints = [line for line in done.stderr.splitlines() if "no positive" not in line]
        assert complaints == []
