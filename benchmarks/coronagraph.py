"""Fluxes beside a coronagraph's mask, taken for a transmission of the sky or for an exposure.

python benchmarks/coronagraph.py [--seeds FIRST LAST]
"""

import argparse

import numpy as np
from scipy.signal import fftconvolve

import lnocl

N, BACKGROUND, EDGE = 96, 20.0, 20
# Of the masks, pixels; the first lets half of the light through at 4.7, the PSF's width.
SIZES = 4.0, 12.0
# Distances of the stars, in sizes.
FLUXES, RADII = np.array([3e4, 2e4, 1e4]), np.array([1.25, 1.75, 2.75])
Y, X = np.indices((N, N))


def psf(j, x, y):
    """Return the PSF of an image at distances from its middle, not normalised."""
    core = np.exp(-0.5 * ((x / (1.9 + 0.2 * j)) ** 2 + (y / 1.6) ** 2))
    return core + 0.2 * np.exp(-0.5 * (((x - 2.0) / 1.8) ** 2 + ((y + 1.5) / 1.8) ** 2))


def transmission(j, x, y, middle, size):
    """Return the share of light that an image gets of places."""
    radius = np.hypot(x - middle[0], y - middle[1])
    return (1.0 - np.exp(-0.5 * (radius / (size, 1.1 * size)[j]) ** 2)) * (1.0, 1.0 - 0.4 * x / N)[
        j
    ]


def errors_of(seed, size):
    """Yield relative errors of stars and ring, those of stars over the stated, and the stated."""
    rng = np.random.default_rng(seed)
    middle = 48.0 + rng.uniform(-1.0, 1.0, 2)
    angles = rng.uniform(0.0, 2.0 * np.pi) + 2.1 * np.arange(3)
    stars = middle + size * RADII[:, None] * np.array([np.cos(angles), np.sin(angles)]).T
    away = abs(np.hypot(X - middle[0], (Y - middle[1]) / 0.6) - 22.0)
    ring, is_ring = 60.0 * np.exp(-0.5 * (away / 4.0) ** 2), away < 8.0
    y, x = np.indices((25, 25)) - 12
    psfs = np.array([psf(j, x, y) for j in range(2)])
    sums = psfs.sum(axis=(1, 2))
    shares = np.array([transmission(j, X, Y, middle, size) for j in range(2)])
    means = []
    for j in range(2):
        wide = np.pad(shares[j] * ring, EDGE, mode="edge")
        mean = fftconvolve(wide, psfs[j] / sums[j], mode="same")[EDGE:-EDGE, EDGE:-EDGE]
        for (sx, sy), flux in zip(stars, FLUXES, strict=True):
            light = flux * transmission(j, sx, sy, middle, size)
            mean += light * psf(j, X - sx, Y - sy) / sums[j]
        means.append(mean + BACKGROUND)
    counts = rng.poisson(means).astype(float)
    given = {"background": BACKGROUND, "psf_centre": "given"}
    for how in ({"transmission": shares}, {"exposure": np.maximum(shares, 1e-3)}):
        observation = lnocl.Observation(counts, psfs, **given, **how)
        found = lnocl.deconvolve(observation, stars, refine_psfs=(), refine_positions=False)
        off = found.star_fluxes - FLUXES
        extended = found.extended[is_ring].sum() / ring[is_ring].sum() - 1.0
        errors = found.star_flux_errors
        yield np.append(off / FLUXES, extended), off / errors, errors / FLUXES


def main():
    """Print a row of the table for each way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 7))
    first, last = parser.parse_args().seeds
    for size in SIZES:
        found = [list(errors_of(seed, size)) for seed in range(first, last + 1)]
        for k, name in enumerate(("transmission", "exposure")):
            errors = 100.0 * np.array([each[k][0] for each in found])
            ratios = np.array([each[k][1] for each in found])
            mean, rms = errors.mean(axis=0), np.sqrt((errors**2).mean(axis=0))
            cells = [f"{m:.1f} ({r:.1f})" for m, r in zip(mean, rms, strict=True)]
            stated = 100.0 * np.array([each[k][2] for each in found])[:, 0]
            print(
                f"| {size:g} | `{name}` | {' | '.join(cells)} | {np.sqrt((ratios**2).mean()):.2f} |"
                f" {stated.min():.1f} to {stated.max():.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
