"""Users without a home, Python that leaves assertions out, and systems with fewer functions."""

import os
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits
from commandline import without_progress

pytestmark = pytest.mark.system

# As for a user whom the system does not know.
UNKNOWN = """
import os, pwd, sys
def unknown(uid):
    raise KeyError(uid)
pwd.getpwuid = unknown
from lnocl.commands import cli
sys.exit(cli.main())
"""
LIKE_WINDOWS = """
import os, sys
del os.fork, os.register_at_fork, os.sysconf
from lnocl.commands import cli
sys.exit(cli.main())
"""
DECONVOLVE = ["deconvolve", "image.fits", "--psf", "psf.fits", "--star", "4,4", "--n-iter", "3",
              "--engine", "numpy", "--stop", "none", "--quiet", "-o", "out.fits"]  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fits.writeto("image.fits", np.full((8, 8), 5.0))
    fits.writeto("psf.fits", np.ones((3, 3)))


def complaints(*words, env=None):
    done = subprocess.run([sys.executable, *words], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    of_frame = "no positive", "no light is left for 1 star", "far less than noise"  # it is flat
    lines = without_progress(done.stderr).splitlines()
    return [line for line in lines if not any(words in line for words in of_frame)]


@pytest.mark.parametrize("home", [None, "/proc/nobody"], ids=["no home", "not writable"])
def test_no_package_complains_of_a_home(home):
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("HOME", "MPLCONFIGDIR") and not name.startswith("XDG_")
    }
    environment |= {} if home is None else {"HOME": home}
    for words in (DECONVOLVE, ["plot", "out.fits", "-o", "figures"]):
        assert complaints("-c", UNKNOWN, *words, env=environment) == []


@pytest.mark.parametrize(
    "python",
    [["-O", "-m", "lnocl"], ["-c", LIKE_WINDOWS]],
    ids=["without assertions", "without what Windows lacks"],
)
def test_it_runs(python):
    assert complaints(*python, *DECONVOLVE) == []
    assert fits.getdata("out.fits").shape == (8, 8)
    assert fits.getdata("out.fits", "STARS").names[:3] == ["x", "y", "flux"]
