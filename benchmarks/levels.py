"""Levels of the sky beside stars, galaxies and gradients, and the light of galaxies above them.

    python benchmarks/levels.py estimators [--seeds FIRST END]
    python benchmarks/levels.py fluxes [--known] [--seeds FIRST END]

Frames of 96 to 128 pixels are simulated, with a PSF without symmetry: 3 to 20 stars that are told
to lnocl, 1 to 4 galaxies (Sersic profiles of index 0.6 to 3), a sky of 0.03 to 600 electrons, which
rises by up to 3 % across the frame in half of them, Poisson noise, and read noise where the sky has
more than 1 electron.

"estimators" compares levels of the sky. Columns are the error that 68 and 95 % of the frames do not
exceed, and 68 % of those with less than 1 electron, in standard errors of a mean of all pixels.
"fluxes" reconstructs each frame with `lnocl deconvolve --background auto`, or with the level that
is known, and compares the light of its galaxies with the errors that are stated. Their unit is the
noise of the sum of all pixels.
"""

import argparse
import tempfile
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.stats import sigma_clipped_stats
from photutils.background import Background2D, MMMBackground, SExtractorBackground
from scipy.fft import irfft2, rfft2
from scipy.special import gamma

from lnocl.commands.cli import main as main_of_shell
from lnocl.io.levels import sky_level

SIDES = 96, 112, 128


def moffat(fwhm, beta, axis_ratio, angle, side=65):
    """Return a PSF without symmetry: a Moffat profile with a companion wing."""
    y, x = np.indices((side, side)) - side // 2
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    alpha = fwhm / 2 / np.sqrt(2 ** (1 / beta) - 1)
    psf = (1 + (along**2 + (across / axis_ratio) ** 2) / alpha**2) ** -beta
    psf += 0.06 * np.exp(-((along - 0.7 * fwhm) ** 2 + (across - 0.4 * fwhm) ** 2) / fwhm**2)
    return psf / psf.sum()


def galaxy(side, x0, y0, radius, index, ratio, angle):
    """Return a Sersic profile of unit flux, all of it, on a frame five times as finely sampled."""
    fine = 5
    y, x = (np.indices((side * fine, side * fine)) + 0.5) / fine - 0.5
    x, y = x - x0, y - y0
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    b = 2 * index - 1 / 3
    r = np.hypot(along, across / ratio) / radius
    total = 2 * np.pi * radius**2 * ratio * index * np.exp(b) * b ** (-2 * index) * gamma(2 * index)
    light = np.exp(-b * (r ** (1 / index) - 1)) / total
    return light.reshape(side, fine, side, fine).mean(axis=(1, 3))


class Frame:
    """A simulated frame: `image`, `psf`, `stars`, the light of the galaxies and the sky in it."""

    def __init__(self, seed):
        rng = np.random.default_rng([53, seed])
        side = int(rng.choice(SIDES))
        self.sky = float(10 ** rng.uniform(-1.5, 2.8))
        self.read_noise = float(rng.uniform(2, 6)) if self.sky > 1 else 0.0
        noise = np.sqrt(self.sky + self.read_noise**2)
        self.psf = moffat(
            rng.uniform(2.2, 4), rng.uniform(2.8, 4.5), rng.uniform(0.75, 1), rng.uniform(0, np.pi)
        )
        light = np.zeros((side, side))
        for _ in range(rng.integers(1, 5)):
            shape = rng.uniform(2, side / 16), rng.uniform(0.6, 3), rng.uniform(0.4, 1)
            x, y = rng.uniform(0.2, 0.8, 2) * side
            area = shape[0] ** 2 * 10
            flux = noise * np.sqrt(area) * 10 ** rng.uniform(0.8, 2.2)
            light += flux * galaxy(side, x, y, *shape, rng.uniform(0, np.pi))
        self.light = float(light.sum())
        sharp = light.copy()
        wide = np.zeros((2 * side, 2 * side))
        wide[:side, :side] = sharp
        kernel = np.zeros_like(wide)
        kernel[: len(self.psf), : len(self.psf)] = self.psf
        kernel = np.roll(kernel, (-(len(self.psf) // 2),) * 2, (0, 1))
        image = irfft2(rfft2(wide) * rfft2(kernel), wide.shape)[:side, :side].clip(0)
        places = rng.uniform(4, side - 5, (rng.integers(3, 21), 2)).round()
        self.stars = np.unique(places, axis=0)
        half = len(self.psf) // 2
        for x, y in self.stars.astype(int):
            flux = noise * 10 ** rng.uniform(1.3, 3.3)
            laid = np.zeros((side + 2 * half, side + 2 * half))
            laid[y : y + 2 * half + 1, x : x + 2 * half + 1] = flux * self.psf
            image += laid[half:-half, half:-half]
        y, x = np.indices((side, side)) / (side - 1) - 0.5
        angle, rise = rng.uniform(0, 2 * np.pi), rng.choice([0.0, 1.0]) * rng.uniform(0, 0.03)
        self.rise = rise
        sky = self.sky * (1 + rise * (x * np.cos(angle) + y * np.sin(angle)))
        self.image = rng.poisson(image + sky) + rng.normal(0, self.read_noise, image.shape)
        self.error = noise / side
        self.noise = noise


def estimators(seeds):
    """Print how far levels are off in all frames, and in those of few counts."""
    none, rows = [], []
    for seed in seeds:
        frame = Frame(seed)
        no_pixel = np.zeros(frame.image.shape, bool)
        level, error = sky_level(0, frame.image, no_pixel)
        ways = {
            "sigma-clipped median": sigma_clipped_stats(frame.image)[1],
            "mode of pixels": SExtractorBackground()(frame.image),
            "MMM": MMMBackground()(frame.image),
            "mode of meshes of 16 pixels": Background2D(frame.image, 16).background_median,
            "lnocl, mode of blocks": level,
        }
        off = {way: (found - frame.sky) / frame.error for way, found in ways.items()}
        rows.append(list(off.values()))
        none.append((frame.sky < 1, (level - frame.sky) / error))
    rows, (is_few, in_errors) = np.abs(rows), np.array(none).T
    for k, way in enumerate(ways):
        quantiles = [
            *np.quantile(rows[:, k], (0.68, 0.95)),
            *np.quantile(rows[is_few > 0, k], [0.68]),
        ]
        print(f"{way:28}", " ".join(f"{each:7.1f}" for each in quantiles))
    print("within one and two stated errors", coverage(in_errors))


def coverage(errors):
    """Return the shares of errors that are within one and two of those stated."""
    return " ".join(f"{np.mean(abs(errors) < n):.2f}" for n in (1, 2))


def reconstructed(seed, is_known, folder):
    """Return flux, error and truth of the extended source, as the shell states them."""
    frame = Frame(seed)
    names = [str(Path(folder) / name) for name in ("frame.fits", "psf.fits", "out.fits")]
    for name, values in zip(names, (frame.image, frame.psf), strict=False):
        fits.PrimaryHDU(values).writeto(name, overwrite=True)
    stars = [word for x, y in frame.stars for word in ("--star", f"{x:g},{y:g}")]
    level = f"{frame.sky}" if is_known else "auto"
    words = ["--background", level, "--read-noise", f"{frame.read_noise:g}", "-o", names[2]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        words += ["--quiet", "--overwrite"]
        if main_of_shell(["deconvolve", names[0], "--psf", names[1], *stars, *words]) != 0:
            raise RuntimeError(f"the frame of seed {seed} failed")
    header = fits.getheader(names[2])
    return header["EXTFLUX"], header["EXTERROR"], frame.light, frame.noise * frame.image.shape[0]


def fluxes(seeds, is_known):
    """Print the errors of the light of galaxies, and how many are within those stated."""
    with tempfile.TemporaryDirectory() as folder:
        rows = np.array([reconstructed(seed, is_known, folder) for seed in seeds])
    off = rows[:, 0] - rows[:, 2]
    print(f"{len(rows)} frames: within one and two stated errors {coverage(off / rows[:, 1])}")
    for name, values in {"errors": off, "stated": rows[:, 1]}.items():
        scaled = abs(values / rows[:, 3])
        print(f"{name}, in noise of the frame: median {np.median(scaled):.2f}, "
              f"95 % {np.quantile(scaled, 0.95):.2f}")  # fmt: skip


def main():
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=("estimators", "fluxes"))
    parser.add_argument("--seeds", nargs=2, type=int, metavar=("FIRST", "END"), default=(0, 50))
    parser.add_argument("--known", action="store_true", help="give the level of the sky")
    arguments = parser.parse_args()
    seeds = range(*arguments.seeds)
    if arguments.study == "estimators":
        estimators(seeds)
    else:
        fluxes(seeds, arguments.known)


if __name__ == "__main__":
    main()
