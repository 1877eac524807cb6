"""PSFs from several stars of a frame: the error of lnocl's, and of photutils' where it is there.

    python benchmarks/effective.py [--seeds N]

Four stars of 6e4 to 2e5 electrons on a background of 50, Gaussian PSFs integrated over pixels;
each column is the median over the seeds of the largest error, as a share of the PSF's peak:
lnocl.psf.make_psf of the brightest star, of one with a neighbour a fifth as bright, of all four,
of all four with that neighbour, which is not given; `photutils.psf.EPSFBuilder` without the
neighbour, with the best of the oversamplings 1, 2, 4.
"""

import argparse
import warnings

import numpy as np
from scipy.special import erf

from lnocl.psf import make_psf

SHAPE, SIZE = (120, 140), 21
PLACES = np.array([(30.3, 30.8), (100.45, 40.1), (45.7, 90.25), (96.6, 88.5)])
FLUXES = 2e5 * np.array([1.0, 0.5, 0.8, 0.3])
NEIGHBOUR, LEVEL = (38.2, 33.4), 50.0


def gaussian(fwhm, x, y, shape):
    """Return a Gaussian of unit sum, integrated over pixels."""
    scale = fwhm / np.sqrt(4.0 * np.log(2.0))
    rows, columns = (
        np.diff(erf((np.arange(n + 1) - 0.5 - c) / scale)) / 2.0
        for n, c in zip(shape, (y, x), strict=True)
    )
    return np.outer(rows, columns)


def by_photutils(counts):
    """Yield a PSF for each oversampling."""
    from astropy.nddata import NDData
    from astropy.table import Table
    from photutils.psf import EPSFBuilder, extract_stars

    table = Table(PLACES, names=("x", "y"))
    y, x = np.indices((SIZE, SIZE)).astype(float)
    for finer in (1, 2, 4):
        stars = extract_stars(NDData(counts), table, size=SIZE + 4)
        psf, _ = EPSFBuilder(oversampling=finer, maxiters=10, progress_bar=False)(stars)
        values = psf.evaluate(x, y, 1.0, SIZE // 2, SIZE // 2)
        yield values / values.sum()


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=7)
    n_seeds = parser.parse_args().seeds
    print("FWHM  brightest  with neighbour  all four  with neighbour  photutils")
    for fwhm in (1.5, 2.0, 2.5, 4.0):
        truth = gaussian(fwhm, SIZE // 2, SIZE // 2, (SIZE, SIZE))
        sky = sum(c * gaussian(fwhm, *p, SHAPE) for c, p in zip(FLUXES, PLACES, strict=True))
        light = FLUXES[0] / 5.0 * gaussian(fwhm, *NEIGHBOUR, SHAPE)
        rows = []
        for seed in range(n_seeds):
            draw = np.random.default_rng(seed).poisson
            frames = [draw(each + LEVEL) - LEVEL for each in (sky, sky + light)]
            found = [
                make_psf(frame, places, SIZE, background=0.0).psf
                for places in (PLACES[0], PLACES)
                for frame in frames
            ]
            errors = [abs(psf - truth).max() / truth.max() for psf in found]
            try:
                others = [abs(psf - truth).max() / truth.max() for psf in by_photutils(frames[0])]
            except ImportError:
                others = [np.nan]
            rows.append([*errors, min(others)])
        print(f"{fwhm:4.1f}" + "".join(f"{each:14.4f}" for each in np.median(rows, axis=0)))


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        main()
