"""Two halves of real counts: whether their reconstructions differ by what the errors say.

    python benchmarks/halves.py quasar|chandra DATA [--splits 4] [--replicas 30] [--n-iter N]

The counts of real frames are split binomially into two independent halves, each reconstructed by
default. The light of apertures and the fluxes of stars differ by d; chi squared is the sum of
``d^2 / (e_1^2 + e_2^2)``, per degree of freedom, over apertures of 12 pixels on light, stars and
splits. It is told for errors by replicas of the sky with texture, as `Result.bootstrap` has them,
and without: halves share what both cannot resolve, so that they differ by the noise alone.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from regions import CirclePixelRegion, PixCoord
from scipy.ndimage import uniform_filter

import lnocl
from lnocl.core.runs import replicas
from lnocl.core.scene.texture import Texture


class Smooth(Texture):
    """No texture: the estimate itself."""

    def __init__(self, extended, stars, resolution):
        super().__init__(extended, stars, resolution)
        self.estimate = extended

    def draw(self, rng):
        """Return the estimate."""
        return self.estimate


def quasar(data):
    """Return the images in electrons with their sky, and a function that observes such."""
    folder = data / "hst-lensed-quasar"
    exposure = fits.getdata(folder / "quasar_F814W_exptime.fits").astype(float)
    sky = 5.187**2
    counts = fits.getdata(folder / "quasar_F814W_sci.fits") * exposure + sky
    given = fits.getdata(folder / "quasar_F814W_psf.fits").astype(float)
    stars = [(77, 73), (47, 56), (55, 77), (73, 48)]
    whole = lnocl.deconvolve(
        lnocl.Observation(counts, given, background=sky, exposure=exposure), stars,
        refine_positions=True, refine_psfs=["jitter", "pixels"], n_iter=4000,
    )  # fmt: skip
    psf, found = whole.psfs, whole.star_positions

    def observe(images):
        return lnocl.Observation(
            images, psf, background=sky / 2, exposure=exposure, psf_centre="given"
        ), found

    return counts[None].round().clip(0), observe


def chandra(data):
    """Likewise, of two observations of the Galactic Centre without a star."""
    folder = data / "chandra-sgra-pair"
    names = ["4683", "4684"]
    counts = [fits.getdata(folder / f"chandra-counts-obs-id-{n}.fits.gz") for n in names]
    kernels = [fits.getdata(folder / f"chandra-psf-obs-id-{n}.fits.gz") for n in names]

    def observe(images):
        return lnocl.Observation(
            images, kernels, offsets=[(0.0, 0.0), (0.55, -0.33)], psf_centre="fit"
        ), ()

    return np.array(counts, float), observe


def apertures(counts):
    """Return circles on light, apart from each other."""
    light, found = counts.sum(axis=0).astype(float), []
    smooth = uniform_filter(light, 9)
    smooth[:10] = smooth[-10:] = 0
    smooth[:, :10] = smooth[:, -10:] = 0
    y, x = np.indices(light.shape)
    for _ in range(15):
        row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
        found.append(CirclePixelRegion(PixCoord(column, row), 6.0))
        smooth[np.hypot(y - row, x - column) < 13] = 0
    return found


def main():
    """Measure what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", choices=["quasar", "chandra"])
    parser.add_argument("data", type=Path)
    parser.add_argument("--splits", type=int, default=4)
    parser.add_argument("--replicas", type=int, default=30)
    parser.add_argument("--n-iter", type=int, help="of both halves; by default each chooses")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    counts, observe = {"quasar": quasar, "chandra": chandra}[given.frames](given.data)
    regions = apertures(counts)
    for split in range(given.splits):
        half = np.random.default_rng(split).binomial(counts.astype(int), 0.5).astype(float)
        runs = []
        for images in (half, counts - half):
            observation, stars = observe(images)
            moves = len(stars) > 0
            length = {"n_iter": given.n_iter, "stop": None} if given.n_iter else {"n_iter": 4000}
            runs.append(lnocl.deconvolve(observation, stars, refine_positions=moves, **length))
        n_stars = len(runs[0].star_fluxes)
        line = [f"split {split}: {[run.n_iter for run in runs]} iterations"]
        for name, texture in (("texture", Texture), ("noise", Smooth)):
            replicas.Texture = texture
            found = [run.bootstrap(given.replicas, regions=regions) for run in runs]
            difference = found[0].values - found[1].values
            z2 = difference**2 / sum(each.standard_errors**2 for each in found)
            stars, light = z2[:n_stars], z2[-len(regions) :]
            line.append(f"{name}: stars {stars.mean():.2f}, apertures {light.mean():.2f}")
        print("; ".join(line), flush=True)


if __name__ == "__main__":
    main()
