"""Draw the symptoms of the page on troubleshooting, each beside what is right.

``python docs/symptoms.py FOLDER`` writes one PNG a symptom.
"""

import sys
import warnings
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import fftconvolve

import lnocl
from lnocl.simulation import hh34

N, STAR = 128, (64.0, 32.0)
BACKGROUND, FLUX = 20.0, 5e5
# A number for the smoothing: else PSFs and positions would be mended.
RUN = {"stop": None, "n_iter": 60, "smoothing": 0}


def moffat(fwhm, n=65):
    """Return a Moffat function of exponent 2.5."""
    y, x = np.mgrid[:n, :n] - n // 2
    scale = fwhm / 2 / np.sqrt(2 ** (1 / 2.5) - 1)
    psf = (1 + (x**2 + y**2) / scale**2) ** -2.5
    return psf / psf.sum()


def observe(seed=0, flux=FLUX):
    """Return counts of a jet and its star, and the PSF."""
    psf = moffat(4.0)
    sky = 1.5e5 * hh34(N).extended
    x, y = map(int, STAR)
    sky[y, x] += flux
    seen = np.maximum(fftconvolve(sky, psf, "same"), 0) + BACKGROUND
    return np.random.default_rng(seed).poisson(seen).astype(float), psf


def solve(image, psf, stars=(STAR,), background=BACKGROUND, oversample=1, **options):
    """Return the result, whatever is said on the way: the fault is the subject."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        observation = lnocl.Observation(image, psf, background=background, oversample=oversample)
        return lnocl.deconvolve(observation, stars, **{**RUN, **options})


def rings():
    """Leave the star out."""
    image, psf = observe(flux=1e7)
    return solve(image, psf, stars=(), smoothing=0, n_iter=200), solve(image, psf)


def dipole():
    """Name the star 0.15 pixels beside its place."""
    image, psf = observe()
    beside = (STAR[0] + 0.15, STAR[1])
    return solve(image, psf, [beside]), solve(image, psf, [beside], refine_positions=True)


def hole():
    """Give a PSF that is too wide."""
    image, _ = observe()
    wide = moffat(4.6)
    return solve(image, wide), solve(image, wide, refine_psfs=["jitter"])


def spots():
    """Give a PSF that is too narrow."""
    image, _ = observe()
    narrow = moffat(3.5)
    return solve(image, narrow), solve(image, narrow, refine_psfs=["jitter"])


def halo():
    """Give a PSF that lacks its wings."""
    image, psf = observe()
    return solve(image, psf[26:39, 26:39]), solve(image, psf)


def level():
    """Give a background that is too low."""
    image, psf = observe()
    return solve(image, psf, background=0.6 * BACKGROUND), solve(image, psf)


def grain():
    """Take too many iterations."""
    image, psf = observe()
    return solve(image, psf, n_iter=1000, smoothing=0), solve(image, psf)


def checkerboard():
    """Resample the image to pixels half as wide."""
    image, psf = observe()
    coarse = image.reshape(N // 2, 2, N // 2, 2).sum(axis=(1, 3))
    fine = coarse.repeat(2, axis=0).repeat(2, axis=1) / 4
    wrong = solve(fine, psf, [np.add(STAR, 0.5)], stop="held-out", n_iter=1000)
    place = np.subtract(STAR, 0.5) / 2
    return wrong, solve(coarse, psf, [place], 4 * BACKGROUND, oversample=2)


SYMPTOMS = {
    each.__name__: each for each in (rings, dipole, hole, spots, halo, level, grain, checkerboard)
}


def draw(wrong, right):
    """Return residuals and extended source of what is wrong, and the source of what is right."""
    figure = Figure((10.0, 3.0), layout="constrained")
    axes = figure.subplots(1, 3)
    rows, columns = slice(4, 84), slice(24, 104)
    top = np.percentile(right.extended[rows, columns], 99.5)
    panels = [
        ("residuals", wrong.residuals()[0], "RdBu_r", -5, 5),
        ("extended source", wrong.extended, "inferno", 0, top),
        ("extended source, mended", right.extended, "inferno", 0, top),
    ]
    for axis, (title, data, colours, low, high) in zip(axes, panels, strict=True):
        shown = axis.imshow(
            data[rows, columns], origin="lower", cmap=colours, vmin=low, vmax=high,
            extent=(23.5, 103.5, 3.5, 83.5),
        )  # fmt: skip
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("x (pixels)", fontsize=8)
        axis.set_ylabel("y (pixels)", fontsize=8)
        bar = figure.colorbar(shown, cax=axis.inset_axes((1.03, 0.0, 0.05, 1.0)))
        bar.set_label("residual / noise" if low else "electrons per pixel", fontsize=8)
        for each in (axis, bar.ax):
            each.tick_params(labelsize=8)
    return figure


def main(folder):
    """Draw all symptoms."""
    for name, make in SYMPTOMS.items():
        draw(*make()).savefig(Path(folder) / f"{name}.png", dpi=100)


if __name__ == "__main__":
    main(sys.argv[1])
