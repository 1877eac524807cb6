"""PSFs in error: what other ways make of them, and one linear estimate that knows all variances.

    python benchmarks/blind.py [--size N] [--images P] [--seeds FIRST LAST] [--contrasts C ...]
        [--errors NAME ...] [--output FILE.ecsv]

Scenes of benchmarks/psfs.py. Each column is the best rho'' of the iterations that a way takes:

true, given   100 iterations with these PSFs
refined       the same after `refine_psfs`
free          PSFs free pixel by pixel, not negative and of unit sum, alternating: 20 rounds of 15
              iterations for the sky, from where it is, and 10 Richardson-Lucy steps for the PSFs
bounded       the same, with no pixel above the Strehl ratio times the peak of the ideal PSF, after
              M. Prato et al., Inverse Problems 29, 065017 (2013), and A&A 576, A37 (2015); the true
              Strehl ratio is given
wiener        one Wiener filter that knows the variance of each pixel of the sky, f^2, and the one
              that the error of the PSFs gives each pixel of the images, (c (G - K))^2, with G the
              PSF given; no pixel below 0

For alternation it is the best of all rounds, which needs the truth.
"""

import argparse
import warnings

import numpy as np
from astropy.table import Table
from psfs import ERRORS, EXPERIMENT, FAMILIES, make_scene
from scipy.optimize import brentq

import lnocl
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.metrics import restoration_error, star_rows

ROUNDS, OF_SKY, OF_PSFS = 20, 15, 10
LEVEL, NOISE = EXPERIMENT.sky_electrons, EXPERIMENT.read_noise.value
STREHL = 0.7


def observe(images, psfs):
    """Return an observation with the experiment's background and noise."""
    known = {"background": LEVEL, "read_noise": NOISE, "psf_centre": "given"}
    return lnocl.Observation(images, np.maximum(psfs, 0.0), **known)


def reconstruct(observation, star, judge, n_iter=100, **start):
    """Return the result of so many iterations, and the least error of them."""
    errors = []
    options = {"n_iter": n_iter, "stop": None, "smoothing": 0.0, "pad": 0, **start}
    result = lnocl.deconvolve(
        observation, [star], callback=lambda _, e: errors.append(judge(e.extended)), **options
    )
    return result, min(errors)


def alternate(images, psfs, star, judge, most):
    """Return the least error of alternating steps for sky and PSFs, these at most so bright."""
    psfs, errors, start = np.array(psfs), [], {}
    for _ in range(ROUNDS):
        observation = observe(images, psfs)
        result, error = reconstruct(observation, star, judge, OF_SKY, **start)
        errors.append(error)
        start = {
            "initial_extended": np.maximum(result.extended, 1e-3),
            "initial_star_fluxes": result.star_fluxes,
        }
        sky = result.extended.copy()
        sky[star[::-1]] += result.star_fluxes[0]
        spectrum = np.fft.rfft2(sky)
        for _ in range(OF_PSFS):
            for psf, counts, back in zip(
                psfs, observation.images, observation.background, strict=True
            ):
                otf = np.fft.rfft2(np.fft.ifftshift(psf))
                model = np.maximum(np.fft.irfft2(spectrum * otf, sky.shape) + back, 1e-9)
                ratio = np.fft.irfft2(np.fft.rfft2(counts / model) * spectrum.conj(), sky.shape)
                psf[:] = nearest(psf * np.fft.fftshift(ratio) / sky.sum(), most)
    return min(errors)


def nearest(psf, most):
    """Return the nearest PSF of unit sum with pixels in 0 to `most`."""

    def excess(level):
        return np.clip(psf - level, 0.0, most).sum() - 1.0

    return np.clip(psf - brentq(excess, psf.min() - 1.0, psf.max()), 0.0, most)


def filtered(observation, star, true, sky, flux):
    """Return the sky of a Wiener filter that knows all variances."""
    scene = Scene(observation, [star])
    model = Model(scene)
    shape = model.shape[1:]
    spread, stars = [], []
    place = (star[1] - shape[0] // 2, star[0] - shape[1] // 2)
    lit = sky.copy()
    lit[star[::-1]] += flux
    for j, psf in enumerate(true):
        mean = np.fft.irfft2(np.fft.rfft2(lit) * np.fft.rfft2(np.fft.ifftshift(psf)), shape)
        error = flux * np.roll(observation.psfs[j] - psf, place, (0, 1))
        spread.append(np.maximum(mean, 0.0) + observation.background[j] + error**2)
        stars.append(np.roll(observation.psfs[j], place, (0, 1)))
    weights, stars = 1.0 / np.array(spread), np.array(stars)
    counts = observation.images - observation.background[:, None, None]

    def forward(x):
        return model.forward(sky * x[1:].reshape(shape)) + flux * x[0] * stars

    def adjoint(images):
        weighted = weights * images
        of_sky = sky * model.adjoint(weighted)
        return np.append(flux * (stars * weighted).sum(), of_sky)

    prior = np.append(0.0, np.ones(sky.size))
    return sky * solve(lambda x: adjoint(forward(x)) + prior * x, adjoint(counts))[1:].reshape(
        shape
    )


def solve(matrix, wanted, n_steps=400):
    """Return the solution of a positive linear system, by conjugate gradients."""
    x, rest, along = np.zeros_like(wanted), wanted, wanted
    square = first = rest @ rest
    for _ in range(n_steps):
        if square < 1e-12 * first:
            break
        image = matrix(along)
        share = square / (along @ image)
        x, rest = x + share * along, rest - share * image
        before, square = square, rest @ rest
        along = rest + square / before * along
    return x


def row(error, contrast, p, seed, n):
    """Return a row of the table."""
    images, true, given, known, sky, stars, fluxes = make_scene(error, contrast, p, seed, n)
    star, rows = stars[0], star_rows(stars[0], sky.shape)

    def judge(found):
        return restoration_error(found, sky, rows)

    names = ("pupil",) if error == "phase" else FAMILIES
    observation = lnocl.Observation(
        images, given, background=LEVEL, read_noise=NOISE, psf_centre="given", **known
    )
    refined = lnocl.deconvolve(observation, stars, pad=0, n_iter=2, stop=None, refine_psfs=names)
    most = STREHL * max(psf.max() for psf in known["ideal_psfs"])
    values = {"error": error, "contrast": contrast, "p": p, "seed": seed}
    for name, psfs in {"true": true, "given": given, "refined": refined.psfs}.items():
        values[name] = reconstruct(observe(images, psfs), star, judge)[1]
    values["free"] = alternate(images, given, star, judge, 1.0)
    values["bounded"] = alternate(images, given, star, judge, most)
    wiener = filtered(observe(images, given), star, true, sky, fluxes[0])
    return values | {"wiener": judge(np.maximum(wiener, 0.0))}


def main():
    """Print the table, a row a scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 3))
    parser.add_argument("--contrasts", type=float, nargs="+", default=(0.3, 1.0, 10.0, 30.0))
    parser.add_argument(
        "--errors", nargs="+", choices=ERRORS, default=("none", "strehl", "speckle")
    )
    parser.add_argument("--output", metavar="FILE.ecsv")
    given = parser.parse_args()
    rows = []
    for error in given.errors:
        for contrast in given.contrasts:
            for seed in range(*given.seeds):
                rows.append(row(error, contrast, given.images, seed, given.size))
                print(*(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}"
                        for k, v in rows[-1].items()), sep="  ", flush=True)  # fmt: skip
                if given.output:
                    Table(rows).write(given.output, overwrite=True)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        main()
