"""An iteration of two skies, line and continuum, beside that of one, and a cube by default.

    python benchmarks/skies.py [--sizes N ...] [--turns N] [--slices K] [--side N]

Milliseconds of processor time an iteration, of both in turn, medians, and their ratio: four images,
single precision, one star, w = (1, 1), (0, 1) twice. Then the seconds that a cube of as many slices
takes by default, without a star and with one, and the same with `spectral_smoothing` 1; and errors
of slices beside those of slices that are deconvolved one by one.
"""

import argparse
import time
import warnings

import numpy as np

import lnocl
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty

LINE = {"line": [1, 0, 1, 0], "continuum": [1, 1, 1, 1]}


def blob(n, x0, y0, width):
    """Return a Gaussian of a peak of 1."""
    y, x = np.indices((n, n))
    return np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 2 / width**2)


def psf(k):
    """Return the PSF of an image or a slice."""
    core, wings = blob(33, 16, 16, 1.6 + 0.02 * k), blob(33, 16, 16, 6.0)
    return core / core.sum() + 0.1 * wings / wings.sum()


def runs(n, solver):
    """Return runs of one sky and of two."""
    rng = np.random.default_rng(0)
    images = rng.poisson(20.0 + 100.0 * blob(n, n / 3, n / 2, n / 20), (4, n, n))
    found = []
    for components in (None, LINE):
        observation = lnocl.Observation(
            images, [psf(3 * j) for j in range(4)], background=10.0, components=components
        )
        setup = Setup(
            observation, np.array([(n // 2, n // 2)]), 0, solver, "single", "opencl", None
        )
        found.append(Run(make_start(setup, Penalty(smoothing=0.01)), 10**6))
    return found


def ticks(run, n):
    """Return milliseconds of processor time an iteration, over n of them."""
    begin = time.process_time()
    run.goal = run.done + n
    run._advance()
    return 1e3 * (time.process_time() - begin) / n


def compare(n, solver, turns):
    """Return the medians of one sky and of two, in turn."""
    both, count = runs(n, solver), max(2**21 // n**2, 2)
    for run in both:
        run.stride = count
        ticks(run, count)
    return np.median([[ticks(run, count) for run in both] for _ in range(turns)], axis=0)


def slices(n_slices, n, has_star, seed=1):
    """Return PSFs, images and skies of a cube: a nebula, and a knot in a sixth of the slices."""
    rng, skies, images = np.random.default_rng(seed), [], []
    psfs = [psf(k) for k in range(n_slices)]
    for k, each in enumerate(psfs):
        sky = (30.0 + 9.0 * k / n_slices) * blob(n, 0.6 * n, 0.55 * n, 0.08 * n)
        if n_slices // 3 <= k < n_slices // 2:
            sky += 60.0 * blob(n, 0.7 * n, 0.5 * n, 3.0)
        laid = np.zeros((n, n))
        laid[:33, :33] = each / each.sum()
        otf = np.fft.rfft2(np.roll(laid, (-16, -16), (0, 1)))
        whole = sky.copy()
        whole[n // 2, n // 2] += 3e5 * has_star
        skies.append(sky)
        images.append(rng.poisson(np.fft.irfft2(np.fft.rfft2(whole) * otf).clip(0) + 8.0))
    return psfs, images, np.array(skies)


def of_cube(cube, stars, **options):
    """Return the seconds of a default answer of a cube, and its relative error."""
    psfs, images, skies = cube
    bands = {f"{k}": row for k, row in enumerate(np.eye(len(images)))}
    observation = lnocl.Observation(images, psfs, background=8.0, components=bands)
    begin = time.perf_counter()
    found = lnocl.deconvolve(observation, stars, **options).extended
    return time.perf_counter() - begin, error(found, skies)


def alone(cube):
    """Return the relative error of slices that are deconvolved one by one."""
    psfs, images, skies = cube
    pairs = zip(images, psfs, strict=True)
    each = (lnocl.deconvolve(lnocl.Observation(*pair, background=8.0)) for pair in pairs)
    return error(np.array([result.extended for result in each]), skies)


def error(found, skies):
    """Return the relative error of skies."""
    return np.linalg.norm(found - skies) / np.linalg.norm(skies)


def main():
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 1024])
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--slices", type=int, default=32)
    parser.add_argument("--side", type=int, default=256)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    for n in args.sizes:
        for solver in ("sgp", "sgm"):
            one, two = compare(n, solver, args.turns)
            print(f"4 x {n} {solver}: {one:.3f} ms, two skies {two:.3f} ms, ratio {two / one:.2f}")
    middle = (args.side // 2, args.side // 2)
    for has_star in (False, True):
        cube = slices(args.slices, args.side, has_star)
        for spectral in (0.0, 1.0):
            seconds, of_skies = of_cube(cube, [middle] * has_star, spectral_smoothing=spectral)
            print(
                f"{args.slices} slices of {args.side}, {'a' if has_star else 'no'} star, "
                f"spectral_smoothing {spectral:g}: {seconds:.1f} s, error {of_skies:.3f}"
            )
    for seed in range(1, 4):
        cube = slices(12, 128, False, seed)
        both = [of_cube(cube, (), spectral_smoothing=each)[1] for each in (0.0, 1.0)]
        print(
            f"12 slices of 128, seed {seed}: errors alone {alone(cube):.3f}, in one fit "
            f"{both[0]:.3f}, with spectral_smoothing 1 {both[1]:.3f}"
        )


if __name__ == "__main__":
    main()
