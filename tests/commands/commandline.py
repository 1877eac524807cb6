"""Runs of the command line, and what they leave."""

import os
import subprocess
import sys

from astropy.io import fits

from lnocl.commands import cli

SHAPE = (16, 12)
NUMPY = ("--engine", "numpy")


def run(*arguments, image="a.fits", psf="k1.fits", engine=NUMPY, output="out.fits"):
    """Deconvolve for one iteration unless the arguments say otherwise."""
    images = [image] if isinstance(image, str) else image
    return cli.main(
        ["deconvolve", *images, "--psf", psf, "--n-iter", "1", "-o", output, *engine, *arguments]
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
