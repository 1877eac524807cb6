"""Steps of lnocl beside the same steps by SciPy, astropy and photutils, where the truth is known.

    python benchmarks/libraries.py [--seeds FIRST LAST]

centre   of a star in noise of 1/100 of its peak, pixels rms in a coordinate: the least squares of
         `lnocl.psf.centring` and those of photutils.centroids. Stars: a Moffat profile 3 pixels
         wide, one 1.5 wide, a Fizeau PSF, and the first with a neighbour a fifth as bright, 8 off
repair   of a block of bad pixels in the core, share of the peak, rms: `lnocl.psf.repair`, and
         astropy.convolution.interpolate_replace_nans with Gaussian kernels of sigma 1 and 2
shift    by random parts of a pixel, share of the peak, the largest: `lnocl.core.scene.shifting`,
         and scipy.ndimage.shift by splines and fourier_shift
rotation by random angles, the same: `lnocl.psf.resampling`, and scipy.ndimage.rotate by splines
sky      level under a jet and stars, in its standard errors: `lnocl.io.levels`, the sigma-clipped
         median, and estimators of photutils.background
"""

import argparse

import numpy as np
from astropy import units as u
from astropy.convolution import Gaussian2DKernel, interpolate_replace_nans
from astropy.stats import sigma_clipped_stats
from astropy.table import Table
from photutils.background import MMMBackground, ModeEstimatorBackground, SExtractorBackground
from photutils.centroids import centroid_1dg, centroid_2dg, centroid_com, centroid_quadratic
from scipy import ndimage

from lnocl.io.levels import sky_level
from lnocl.psf.centring import fit_gaussian
from lnocl.psf.repair import repair
from lnocl.psf.resampling import rotate, shift
from lnocl.simulation import fizeau_psf, hh34

SIDE, NOISE = 65, 0.01
MIDDLE = SIDE // 2


def moffat(width, x=0.0, y=0.0, beta=3.0):
    """Return a Moffat profile of peak 1, its centre (x, y) pixels from the middle."""
    rows, columns = np.indices((SIDE, SIDE)) - MIDDLE
    scale = width / (2.0 * np.sqrt(2.0 ** (1.0 / beta) - 1.0))
    return (1.0 + ((columns - x) ** 2 + (rows - y) ** 2) / scale**2) ** -beta


def fizeau(seed):
    """Return a Fizeau PSF of peak 1 with fringes at an angle, its centre in the middle."""
    psf = fizeau_psf((256, 256), 60 * (seed % 3) * u.deg, 2.12 * u.um, 5.11 * u.mas, 0.75, seed)
    half = SIDE // 2
    return psf[128 - half : 128 + half + 1, 128 - half : 128 + half + 1] / psf.max()


def by_photutils(find, image):
    """Return row and column by a function of photutils, in the star's 21 x 21 pixels."""
    cut = slice(MIDDLE - 10, MIDDLE + 11)
    x, y = find(image[cut, cut])
    return y + MIDDLE - 10, x + MIDDLE - 10


def centring(seed):
    """Return the errors of centres, pixels, by star and method."""
    rng = np.random.default_rng([1, seed])
    dx, dy = rng.uniform(-0.5, 0.5, 2)
    stars = {
        "moffat 3": moffat(3.0, dx, dy),
        "moffat 1.5": moffat(1.5, dx, dy),
        "fizeau": shift(fizeau(seed), (dy, dx)),
        "neighbour": moffat(3.0, dx, dy) + 0.2 * moffat(3.0, dx + 8, dy),
    }
    no_pixel = np.zeros((SIDE, SIDE), bool)
    ways = {
        "lnocl": lambda image: fit_gaussian(image, no_pixel, (MIDDLE, MIDDLE), 0.0)[0],
        **{
            find.__name__: lambda image, find=find: by_photutils(find, image)
            for find in (centroid_2dg, centroid_1dg, centroid_quadratic, centroid_com)
        },
    }
    truth = np.array([MIDDLE + dy, MIDDLE + dx])
    for name, star in stars.items():
        image = star + rng.normal(0, NOISE, star.shape)
        for way, find in ways.items():
            yield name, way, np.sqrt(np.mean((np.array(find(image)) - truth) ** 2))


def repairing(seed):
    """Return the errors of repaired blocks, shares of the peak."""
    rng = np.random.default_rng([2, seed])
    for star_name, star in (("moffat 3", moffat(3.0)), ("fizeau", fizeau(seed))):
        image = star + rng.normal(0, 1e-3, star.shape)
        for side in (1, 2, 3):
            bad = np.zeros(star.shape, bool)
            y, x = MIDDLE + rng.integers(-3, 2, 2)
            bad[y : y + side, x : x + side] = True
            name = f"{star_name}, {side} x {side}"
            ours = np.where(bad, 0.0, image)
            repair(ours, bad, np.ones_like(bad))
            yield name, "lnocl", np.sqrt(np.mean((ours - star)[bad] ** 2))
            for sigma in (1, 2):
                found = interpolate_replace_nans(
                    np.where(bad, np.nan, image), Gaussian2DKernel(sigma)
                )
                yield name, f"astropy, sigma {sigma}", np.sqrt(np.mean((found - star)[bad] ** 2))


def shifting(seed):
    """Return the largest errors of shifted stars, shares of the peak."""
    rng = np.random.default_rng([3, seed])
    dx, dy = rng.uniform(-0.5, 0.5, 2)
    for width in (1.5, 2.0, 3.0):
        star, truth = moffat(width), moffat(width, dx, dy)
        spectrum = ndimage.fourier_shift(np.fft.fft2(star), (dy, dx))
        ways = {
            "lnocl": shift(star, (dy, dx)),
            "scipy, cubic": ndimage.shift(star, (dy, dx), order=3, mode="grid-wrap"),
            "scipy, quintic": ndimage.shift(star, (dy, dx), order=5, mode="grid-wrap"),
            "scipy, fourier": np.fft.ifft2(spectrum).real,
        }
        for way, found in ways.items():
            yield f"width {width:g}", way, abs(found - truth).max()


def rotating(seed):
    """Return the largest errors of rotated stars, shares of the peak."""
    rng = np.random.default_rng([4, seed])
    angle, ratio, first = rng.uniform(0, 90), 0.6, rng.uniform(0, np.pi)

    def oval(turn):
        rows, columns = np.indices((SIDE, SIDE)) - MIDDLE
        along = columns * np.cos(turn) + rows * np.sin(turn)
        across = rows * np.cos(turn) - columns * np.sin(turn)
        return np.exp(-(along**2 + (across / ratio) ** 2) / 8.0)

    star, truth = oval(first), oval(first + np.radians(angle))
    yield "oval, 4.7 x 2.8", "lnocl", abs(rotate(star, angle) - truth).max()
    for order in (3, 5):
        found = ndimage.rotate(star, -angle, reshape=False, order=order)
        yield "oval, 4.7 x 2.8", f"scipy, order {order}", abs(found - truth).max()


def levels(seed):
    """Return how far sky levels are off, in standard errors of a mean over all pixels."""
    rng = np.random.default_rng([5, seed])
    n, sky, read_noise = 128, 100.4, 3.0
    jet = hh34(n).extended
    scenes = {"empty": 0.0, "jet": 2e5 * jet / jet.sum()}
    stars = np.zeros((n, n))
    for _ in range(40):
        y, x = rng.integers(0, n, 2)
        stars += 200 * np.roll(np.pad(moffat(3.0), (0, n - SIDE)), (y - MIDDLE, x - MIDDLE), (0, 1))
    scenes["40 stars"] = stars
    for name, light in scenes.items():
        image = rng.poisson(sky + light + np.zeros((n, n))) + rng.normal(0, read_noise, (n, n))
        no_pixel = np.zeros(image.shape, bool)
        ways = {
            "lnocl": sky_level(0, image, no_pixel)[0],
            "sigma-clipped median": sigma_clipped_stats(image)[1],
            **{
                type(each).__name__: each(image)
                for each in (SExtractorBackground(), MMMBackground(), ModeEstimatorBackground())
            },
        }
        for way, found in ways.items():
            yield name, way, abs(found - sky) / np.sqrt((sky + read_noise**2) / image.size)


def main():
    """Measure, and print a table for each step: medians over seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs=2, type=int, metavar=("FIRST", "LAST"), default=(0, 20))
    seeds = range(*parser.parse_args().seeds)
    for step in (centring, repairing, shifting, rotating, levels):
        rows = Table(
            rows=[row for seed in seeds for row in step(seed)], names=("case", "way", "error")
        )
        print(f"\n{step.__name__}")
        for case in dict.fromkeys(rows["case"]):
            of_case = rows[rows["case"] == case]
            found = {
                way: float(np.median(of_case["error"][of_case["way"] == way]))
                for way in dict.fromkeys(of_case["way"])
            }
            print(f"{case:18}", "; ".join(f"{way} {error:.2g}" for way, error in found.items()))


if __name__ == "__main__":
    main()
