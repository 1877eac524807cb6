"""Frames of stars whose PSFs are known, and PSFs made from them without warnings."""

import functools
import math
import warnings

import numpy as np
from astropy import units as u
from scipy import special
from scipy.ndimage import fourier_shift

from lnocl.errors import LnoclWarning
from lnocl.psf.make import make_psf
from lnocl.simulation import fizeau_psf


@functools.cache
def fizeau(angle=0.0, n=256, scale=9.0, strehl=1.0):
    """Return a Fizeau PSF; fringes are 30.4 / scale pixels apart."""
    psf = fizeau_psf((n, n), angle * u.deg, 2.12 * u.um, scale * u.mas, strehl)
    psf.flags.writeable = False
    return psf


def shifted(image, x, y):
    return np.fft.ifft2(fourier_shift(np.fft.fft2(image), (y, x))).real


def gaussian(fwhm, x=32.0, y=32.0, shape=(65, 65)):
    """Return a Gaussian of unit sum, integrated over pixels."""
    width = fwhm / math.sqrt(8 * math.log(2)) * math.sqrt(2)
    edges = [(np.arange(n + 1) - 0.5 - c) / width for n, c in zip(shape, (y, x), strict=True)]
    rows, columns = (np.diff(special.erf(e)) / 2 for e in edges)
    return np.outer(rows, columns)


def airy(fwhm, x, y, n=65):
    iy, ix = np.mgrid[:n, :n]
    r = np.maximum(np.hypot(iy - y, ix - x) * np.pi / fwhm * 1.029, 1e-8)
    return (2 * special.j1(r) / r) ** 2


def quiet(*args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LnoclWarning)
        return make_psf(*args, **options)


def line(star, name):
    (found,) = (step for step in star.steps if step.startswith(name + ":"))
    return found


STAR = 40 + 9000 * gaussian(4.0, 30.3, 28.8, (61, 70))


FRACTIONS = [(0.5, 0.5), (0.3, -0.2), (-0.45, 0.1), (0.25, 0.4)]
