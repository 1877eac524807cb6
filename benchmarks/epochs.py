"""Light curves of a lensed quasar: bias and coverage of fluxes in many nights, and seconds.

    python benchmarks/epochs.py [--nights N] [--seeds FIRST LAST] [--output FILE.ecsv]

Four images of a quasar lie on the ring of its host, beside the lens, in 64 x 64 pixels. Each night
has a PSF of its own, a Moffat function with a seeing of 3 to 4.5 pixels that is a little elongated,
known exactly, and each image of the quasar a flux of its own. The table has for each image the bias
of its fluxes over the nights, relative, with its error, the share of fluxes within one standard
error of the truth, and the rms of the errors over those stated; then that of the changes, fluxes
less their mean.
"""

import argparse
import time

import numpy as np
from astropy.table import Table

import lnocl

N, K, SKY = 64, 41, 200.0
PLACES = np.array([(24.3, 30.6), (38.8, 25.2), (41.7, 38.9), (28.4, 42.1)])
MEANS = np.array([40000.0, 28000.0, 20000.0, 9000.0])
FINE = 4


def moffat(dx, dy, seeing, beta=3.0):
    """Return a Moffat function, not normalised."""
    width = seeing / (2.0 * np.sqrt(2.0 ** (1.0 / beta) - 1.0))
    return (1.0 + (dx**2 + dy**2) / width**2) ** -beta


def make_psf(rng):
    """Return a function that gives the PSF of a night at distances in pixels, of unit sum."""
    seeing, ratio, angle = rng.uniform(3.0, 4.5), rng.uniform(1.0, 1.15), rng.uniform(0, np.pi)
    cos, sin = np.cos(angle), np.sin(angle)

    def psf(dx, dy):
        return moffat((cos * dx + sin * dy) * ratio, (cos * dy - sin * dx) / ratio, seeing)

    v, u = np.indices((K, K)) - K // 2
    total = psf(u, v).sum()
    return lambda dx, dy: psf(dx, dy) / total


def make_host():
    """Return the lens and the ring, electrons a pixel."""
    y, x = np.indices((N, N)) - np.array([34.0, 33.0])[:, None, None]
    r = np.hypot(x, 1.15 * y)
    return 120.0 * np.exp(-0.5 * (r / 2.5) ** 2) + 25.0 * np.exp(-0.5 * ((r - 10.0) / 1.8) ** 2)


def simulate(seed, n_nights):
    """Return images, PSFs and fluxes, shape (4, n_nights)."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((N, N))
    v, u = np.indices((K, K)) - K // 2
    host = np.fft.rfft2(make_host())
    steps = rng.normal(0.0, 0.03, (4, n_nights)).cumsum(axis=1)
    fluxes = MEANS[:, None] * np.exp(steps)
    images, psfs = [], []
    for night in range(n_nights):
        psf = make_psf(rng)
        psfs.append(psf(u, v))
        laid = np.zeros((N, N))
        laid[:K, :K] = psfs[-1]
        laid = np.roll(laid, (-(K // 2), -(K // 2)), (0, 1))
        mean = SKY + np.fft.irfft2(host * np.fft.rfft2(laid), (N, N))
        for flux, (at_x, at_y) in zip(fluxes[:, night], PLACES, strict=True):
            mean += flux * psf(x - at_x, y - at_y)
        images.append(rng.poisson(mean))
    return np.array(images, float), np.array(psfs), fluxes


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nights", type=int, default=100)
    parser.add_argument("--seeds", type=int, nargs=2, default=(900, 900), metavar=("FIRST", "LAST"))
    parser.add_argument("--output")
    given = parser.parse_args()
    names = ("seed", "image", "bias", "bias_error", "coverage", "rms_pull", "rms_change")
    table = Table(names=names, dtype=(int, int, *[float] * 5))
    for seed in range(given.seeds[0], given.seeds[1] + 1):
        images, psfs, fluxes = simulate(seed, given.nights)
        begin = time.perf_counter()
        observation = lnocl.Observation(
            images, psfs, background=SKY, epochs=range(given.nights), psf_error=0.0
        )
        result = lnocl.deconvolve(observation, PLACES)
        fitted = time.perf_counter()
        errors = result.star_flux_errors.reshape(4, -1)
        ended = time.perf_counter()
        of_changes = result.star_variation_errors.reshape(4, -1)
        off = result.star_fluxes.reshape(4, -1) - fluxes
        print(
            f"seed {seed}: {result.n_iter} iterations ({result.stop_reason}), "
            f"{fitted - begin:.1f} s, errors {ended - fitted:.1f} s"
        )
        for s in range(4):
            relative, pulls = off[s] / fluxes[s], off[s] / errors[s]
            error = relative.std() / np.sqrt(given.nights)
            coverage, rms = np.mean(abs(pulls) < 1.0), np.sqrt(np.mean(pulls**2))
            changes = (off[s] - off[s].mean()) / of_changes[s]
            of_change = np.sqrt(np.mean(changes**2))
            table.add_row((seed, s + 1, relative.mean(), error, coverage, rms, of_change))
    for name in names[2:]:
        table[name].format = "%.4f"
    print(table)
    if given.output:
        table.write(given.output, overwrite=True)


if __name__ == "__main__":
    main()
