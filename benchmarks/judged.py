"""Star fluxes and extended sources of all kinds of scenes, through PSFs that are right and wrong.

    python benchmarks/judged.py [KIND ...] [--errors ERROR ...] [--seeds FIRST LAST]
        [--output FILE.ecsv]

A scene has two stars and a lopsided extended source in 72 x 72 pixels, and is reconstructed by
default. Each image has a PSF, an exposure and noise of its own.

plain    two images, one of them shifted
turned   three images, turned by 0, 25 and 70 degrees
scaled   two images, of which the second is turned by 10 degrees and has pixels 1.4 times as large
epochs   four nights, in which the stars differ
halos    two images with a halo round the brighter star, known in shape
field    one image whose PSF grows along x

right    the PSFs are exact
wide     they are 5 % wider than those given
long     they are longer along a diagonal, as by a jitter of 0.3 pixel^2
moved    that of the last image is 0.3 pixel off
wings    a Moffat function of beta 2.5 was taken for one of 4, of the same width

"flux" is the mean of the stars' fluxes over the truth, "sigmas" the root of the mean square of
their errors over those stated. "rho" is the L1 norm of the error of the extended source over that
of the truth, within three pixels' smoothing.
"""

import argparse
import time
import warnings

import numpy as np
from astropy.table import Table
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

import lnocl

N, SIDE = 72, 41
STARS = np.array([(30.3, 37.8), (50.6, 22.1)])
FLUXES = np.array([4e5, 6e4])
LIGHT = 2e5
CENTRE = np.array([35.0, 34.0])
ERRORS = "right", "wide", "long", "moved", "wings"


def profile(x, y, width, beta, jitter=0.0):
    """Return a Moffat function, drawn out along y = x and lopsided, of width FWHM."""
    along, across = (x + y) / np.sqrt(2), (x - y) / np.sqrt(2)
    square = width**2 / 4 / (2 ** (1 / beta) - 1)
    scale = 1 + 5.545 * jitter / width**2
    core = (1 + (along**2 / (1.2 * scale) + across**2) / square) ** -beta
    return core * (1 + 0.1 * np.tanh(across / width))


def psf(width, beta=4.0, jitter=0.0, shift=0.0):
    """Return it in pixels, of unit sum."""
    y, x = np.indices((SIDE, SIDE)) - SIDE // 2
    values = profile(x - shift, y, width, beta, jitter)
    return values / values.sum()


def wrong(error, width, last):
    """Return the PSF that is taken for the one of a width."""
    if error == "wide":
        return psf(width / 1.05)
    if error == "wings":
        return psf(width, 2.5)
    if error == "moved":
        return psf(width, shift=0.3 * last)
    return psf(width)


def source(x, y):
    """Return the extended source at places of the sky."""
    arc = np.exp(-((np.hypot(x - 34, y - 36) - 15) ** 2) / 8) * (1 + np.sin(np.arctan2(y - 36, x)))
    knots = sum(
        a * np.exp(-((x - 30 - d) ** 2 + (y - 38 - 0.6 * d) ** 2) / 6)
        for a, d in ((2.0, 7), (1.2, 13), (1.5, 20))
    )
    return arc + knots


def observe(transform, width, depth, fluxes, rng, true, halo=None, oversample=5):
    """Return an image of the sky, and its background."""
    shift = (np.arange(N * oversample) + 0.5) / oversample - 0.5
    x, y = np.meshgrid(shift, shift)
    back = np.linalg.inv(transform[:, :2])
    at = np.einsum("ij,jyx->iyx", back, np.stack([x, y]) - transform[:, 2][:, None, None])
    fine = source(*at) * abs(np.linalg.det(back))
    sky = fine.reshape(N, oversample, N, oversample).mean(axis=(1, 3))
    whole = source(*np.meshgrid(np.arange(N), np.arange(N))).sum()
    image = fftconvolve(LIGHT * sky / whole, true(0), "same").clip(0)
    for s, (flux, star) in enumerate(zip(fluxes, STARS, strict=True)):
        place = transform[:, :2] @ star + transform[:, 2]
        image += flux * star_at(place, width, true(s + 1))
    if halo is not None:
        image += halo
    return rng.poisson(depth * image + 60.0).astype(float)


def star_at(place, width, kernel):
    """Return a PSF moved to a place by its spectrum."""
    whole = np.floor(place + 0.5).astype(int)
    dx, dy = place - whole
    n = SIDE + 40
    laid = np.zeros((n, n))
    first = n // 2 - SIDE // 2
    laid[first : first + SIDE, first : first + SIDE] = kernel
    v, u = np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)
    laid = np.fft.irfft2(np.fft.rfft2(laid) * np.exp(-2j * np.pi * (u * dx + v * dy)), (n, n))
    image = np.zeros((N + 2 * n, N + 2 * n))
    y, x = whole[1] + n - n // 2, whole[0] + n - n // 2
    image[y : y + n, x : x + n] = laid
    return image[n : n + N, n : n + N]


def scene(kind, error, seed):
    """Return images, PSFs, what else is known, and the true fluxes."""
    rng = np.random.default_rng([seed, 54])
    still = np.hstack([np.eye(2), np.zeros((2, 1))])
    maps, fluxes, halo, known = [still], [FLUXES], None, {}
    if kind in ("plain", "halos"):
        moved = still + np.array([[0, 0, 1.3], [0, 0, -2.4]])
        maps, known = [still, moved], {"offsets": [(0, 0), (1.3, -2.4)]}
    if kind == "turned":
        maps = lnocl.rotations([0.0, 25.0, 70.0], centre=CENTRE)
        known = {"transforms": maps}
    if kind == "scaled":
        maps = np.array(lnocl.rotations([0.0, 10.0], centre=CENTRE))
        maps[1, :, :2] /= 1.4
        maps[1, :, 2] = CENTRE - maps[1, :, :2] @ CENTRE
        known = {"transforms": maps}
    if kind == "epochs":
        maps, known = [still] * 4, {"epochs": range(4)}
        fluxes = FLUXES * rng.uniform(0.6, 1.4, (4, 2))
    p = len(maps)
    fluxes = np.broadcast_to(fluxes, (p, 2))
    widths, depths = rng.uniform(2.8, 3.6, p), rng.uniform(0.5, 1.5, p)
    if kind == "halos":
        y, x = np.indices((N, N))
        shapes = [
            (1 + np.hypot(x - at[0], 1.2 * (y - at[1])) ** 2 / 60) ** -1.6
            for at in (maps[j][:, :2] @ STARS[0] + maps[j][:, 2] for j in range(p))
        ]
        halo = [3e5 * shape / shape.sum() for shape in shapes]
        known["halos"] = np.array([shapes])
    jitter = 0.3 * (error == "long")
    images, psfs = [], []
    for j, (width, depth) in enumerate(zip(widths, depths, strict=True)):

        def true(s, width=width):
            """Return the PSF in the middle, or of a star."""
            if kind != "field":
                return psf(width, jitter=jitter)
            x = (N - 1) / 2 if s == 0 else STARS[s - 1][0]
            return psf(width * (1 + 0.06 * (x / N - 0.5)), jitter=jitter)

        own = None if halo is None else halo[j]
        images.append(observe(maps[j], width, depth, fluxes[j], rng, true, own))
        psfs.append(wrong(error, width, j == p - 1))
    if kind == "field":
        places = [(0.0, 0.0), (N, 0.0), (0.0, N), (N, N)]
        nodes = [wrong(error, widths[0] * (1 + 0.06 * (x / N - 0.5)), True) for x, _ in places]
        psfs = [lnocl.PsfField(nodes, places)]
    known |= {"background": 60.0, "exposure": depths}
    return np.array(images), psfs, known, fluxes


KINDS = "plain", "turned", "scaled", "epochs", "halos", "field"


def main():
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("kinds", nargs="*", choices=[*KINDS, []], default=[])
    parser.add_argument("--errors", nargs="+", choices=ERRORS, default=ERRORS)
    parser.add_argument("--seeds", nargs=2, type=int, default=(0, 1))
    parser.add_argument("--output")
    options = parser.parse_args()
    y, x = np.indices((N, N))
    truth = source(x, y)
    truth *= LIGHT / truth.sum()
    inside = np.hypot(x - CENTRE[0], y - CENTRE[1]) < 26
    rows = []
    for kind in options.kinds or KINDS:
        for error in options.errors:
            for seed in range(options.seeds[0], options.seeds[1] + 1):
                images, psfs, known, fluxes = scene(kind, error, seed)
                begun = time.perf_counter()
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    observation = lnocl.Observation(images, psfs, psf_centre="given", **known)
                    found = lnocl.deconvolve(observation, STARS)
                    errors = found.star_flux_errors
                taken = time.perf_counter() - begun
                true = fluxes.T if kind == "epochs" else FLUXES
                fluxes = found.star_fluxes.reshape(true.shape)
                ratio, errors = fluxes / true, errors.reshape(true.shape)
                off = (fluxes - true) / errors
                left = abs(gaussian_filter(found.extended - truth, 1.3))[inside].sum()
                rho = left / truth[inside].sum()
                light = found.extended[inside].sum() / truth[inside].sum()
                row = (
                    kind,
                    error,
                    seed,
                    ratio[0].mean(),
                    ratio[1].mean(),
                    (errors / true).max(),
                    np.sqrt((off**2).mean()),
                    rho,
                    light,
                    found.n_iter,
                    taken,
                    len(caught),
                )
                print(
                    *(f"{each:.3f}" if isinstance(each, float) else each for each in row),
                    flush=True,
                )
                rows.append(row)
    names = "kind", "error", "seed", "flux", "faint", "stated", "sigmas", "rho", "light"
    table = Table(rows=rows, names=(*names, "n_iter", "seconds", "warned"))
    if options.output:
        table.write(options.output, overwrite=True)


if __name__ == "__main__":
    main()
