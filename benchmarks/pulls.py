"""Star fluxes less the truth, in their stated errors, by default, over scenes drawn at random.

    python benchmarks/pulls.py [--kind KIND ...] [--seeds FIRST LAST]

Kinds: "jets", 1 to 4 images of different depth and PSF, of 48 to 96 pixels, 1 to 3 stars and a jet,
whose PSFs are up to 5 % too wide, each by itself; "right", the same with right PSFs; "wide", a star
with a PSF of its own, two lopsided Gaussians as wide as an extended source, on an empty sky, with a
planet, PSFs exact; "ring", the same with a ring of 15 % of its light.
"""

import argparse
import warnings

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

import lnocl

STAR, PLANET, SIDE = (18.3, 20.6), (25.2, 15.9), 48


def moffat(side, width, skew, at=(0.0, 0.0)):
    """Return a lopsided Moffat function about the middle of an array, and a place there."""
    y, x = np.indices((side, side)) - side // 2
    x, y = x - at[0], y - at[1]
    return (1.0 + ((x + skew * y) ** 2 + y**2) / width**2) ** -2.5


def with_jet(seed, factors):
    """Return an observation, and places and fluxes of its stars."""
    rng = np.random.default_rng(seed)
    n, p, k = (int(rng.integers(*ends)) for ends in ((48, 97), (1, 5), (1, 4)))
    y, x = np.indices((n, n)) - 0.5 * n
    slope = rng.uniform(-0.6, 0.6)
    jet = np.exp(
        -(((x - slope * y) / rng.uniform(1.5, 4)) ** 2) - ((y - 0.12 * n) / (0.12 * n)) ** 2
    )
    light = 10 ** rng.uniform(3.5, 5.3) * jet / jet.sum()
    stars, fluxes = rng.uniform(0.25 * n, 0.75 * n, (k, 2)), 10 ** rng.uniform(4, 6, k)
    sky, images, psfs, exposures = 10 ** rng.uniform(0.3, 3), [], [], []
    for _ in range(p):
        width, skew, wrong = rng.uniform(1.8, 3.2), rng.uniform(-0.3, 0.3), rng.choice(factors)
        exposures.append(rng.uniform(0.3, 1.5))
        total = moffat(2 * n + 1, width, skew).sum()
        image = fftconvolve(light, moffat(61, width, skew), mode="same")
        for star, flux in zip(stars, fluxes, strict=True):
            image += flux * moffat(2 * n + 1, width, skew, star - n)[:n, :n]
        images.append(rng.poisson((sky + exposures[-1] * image / total).clip(0)))
        psfs.append(moffat(61, width * wrong, skew))
    given = {"background": sky, "exposure": exposures, "psf_centre": "given"}
    return lnocl.Observation(images, psfs, **given), stars, fluxes


def blob(dx, dy, width):
    """Return a lopsided Gaussian of unit sum."""
    return np.exp(-(dx**2 + 1.3 * dy**2) / 2 / width**2) * np.sqrt(1.3) / 2 / np.pi / width**2


def behind(dx, dy):
    """Return the PSF of the star: a twentieth of its light."""
    return 0.1 * (blob(dx + 0.7, dy, 6.0) - 0.5 * blob(dx, dy, 4.5))


def behind_a_mask(seed, ring):
    """Return an observation, and places and fluxes of star and planet."""
    y, x = np.indices((SIDE, SIDE))
    light = 4e6 * behind(x - STAR[0], y - STAR[1])
    light += 4e3 * blob(x - PLANET[0], y - PLANET[1], 1.5)
    round_it = np.exp(-(((np.hypot(x - 24, 1.6 * (y - 22)) - 13) / 2) ** 2) / 2)
    light += ring * gaussian_filter(round_it / round_it.sum(), 1.5)
    v, u = np.indices((95, 95)) - 47
    observation = lnocl.Observation(
        np.random.default_rng(seed).poisson(light + 20.0), blob(u, v, 1.5), background=20.0,
        psf_error=0.0, star_psfs=behind(u, v), star_places=STAR,
    )  # fmt: skip
    return observation, [STAR, PLANET], np.array([4e6, 4e3])


KINDS = {
    "jets": lambda seed: with_jet(seed, (1.0, 1.02, 0.98, 1.05)),
    "right": lambda seed: with_jet(seed, (1.0,)),
    "wide": lambda seed: behind_a_mask(seed, 0.0),
    "ring": lambda seed: behind_a_mask(seed, 3e4),
}


def main():
    """Print what the pulls of each kind are."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seeds", nargs=2, type=int, default=(2000, 2019))
    given = parser.parse_args()
    for kind in given.kind:
        pulls = []
        for seed in range(given.seeds[0], given.seeds[1] + 1):
            observation, stars, fluxes = KINDS[kind](seed)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", lnocl.LnoclWarning)
                result = lnocl.deconvolve(observation, stars)
            pulls += ((result.star_fluxes - fluxes) / result.star_flux_errors).tolist()
        # Of stars behind a mask the first alone.
        shown = np.array(pulls[:: 2 if kind in ("wide", "ring") else 1])
        print(
            f"{kind}: {len(shown)} stars, pulls mean {shown.mean():+.2f}, rms "
            f"{np.sqrt(np.mean(shown**2)):.2f}, most {abs(shown).max():.2f}"
        )


if __name__ == "__main__":
    main()
