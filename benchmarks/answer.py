"""Seconds of a default answer, and of a plain run of as many iterations with one weight.

    python benchmarks/answer.py [--sizes N ...] [--images P ...] [--stars K ...] [--wrong SHARE ...]
        [--turns N] [--against FOLDER] [--cold] [--output FILE.ecsv]

A scene has a jet of 1e5 electrons and K stars of 2e5, p lopsided Moffat PSFs of which each is wider
than that before, and a background of 20. The PSFs given are wider by a share (by default 0 and 6
%). The plain run has exact PSFs. Kernels are compiled before. Medians of so many turns; with
--against another checkout takes turns with this one, each in a process of its own, and the last
column is the time here over the time there. With --cold the columns are a first answer of a new
process whose cache of kernels is empty, and the one after that.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
import warnings
from itertools import product
from pathlib import Path

import numpy as np
from parts import report
from scipy.signal import fftconvolve

import lnocl

HERE = Path(__file__).resolve()


def moffat(side, j, wider=1.0, at=(0.0, 0.0)):
    """Return the PSF of image j, the middle of the array moved."""
    y, x = np.indices((side, side)) - side // 2
    x, y, width = x - at[0], y - at[1], (2.2 + 0.2 * j) * wider
    return (1.0 + ((x + 0.2 * j * y) ** 2 + y**2) / width**2) ** -2.5


def observe(n, p, k, wrong):
    """Return an observation, and where its stars are."""
    rng = np.random.default_rng(0)
    y, x = np.indices((n, n))
    jet = np.exp(
        -((((x - 0.5 * n) - 0.4 * (y - 0.5 * n)) / 2.2) ** 2) - ((y - 0.6 * n) / (0.12 * n)) ** 2
    )
    stars = rng.uniform(0.1 * n, 0.9 * n, (k, 2)) if k > 1 else np.array([(0.5 * n, 0.45 * n)])
    images, psfs, side = [], [], min(61, n - 1)
    for j in range(p):
        psf = moffat(side, j)
        image = 20.0 + fftconvolve(1e5 * jet / jet.sum(), psf / psf.sum(), mode="same")
        for star in stars:
            whole = moffat(2 * n + 1, j, at=star - n)
            image += 2e5 * whole[:n, :n] / psf.sum()
        images.append(rng.poisson(image.clip(0)))
        psfs.append(moffat(side, j, 1.0 + wrong))
    return lnocl.Observation(images, psfs, background=20.0, psf_centre="given"), stars


def seconds(n, p, k, wrong, turns):
    """Return medians of a default answer and a plain run, and how many iterations they do."""
    observation, stars = observe(n, p, k, wrong)
    exact, took = observation.replace(psf_error=0.0), []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        for turn in range(turns + 1):
            begun = time.perf_counter()
            result = lnocl.deconvolve(observation, stars)
            plain = {"n_iter": result.n_iter, "stop": None, "smoothing": result.smoothing}
            done = time.perf_counter()
            lnocl.deconvolve(exact, stars, **plain)
            if turn:  # the first compiles
                took.append((done - begun, time.perf_counter() - done))
    return (*np.median(took, axis=0).tolist(), result.n_iter)


def cold_seconds(n, p, k, wrong):
    """Return seconds of the first default answer of this process and the second; iterations."""
    observation, stars = observe(n, p, k, wrong)
    times = [time.perf_counter()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        for _ in range(2):
            result = lnocl.deconvolve(observation, stars)
            times.append(time.perf_counter())
    return (*np.diff(times).tolist(), result.n_iter)


def elsewhere(folder, what, arguments):
    """Return what this script prints with the package of a checkout and no compiled kernels."""
    with tempfile.TemporaryDirectory() as cache:
        done = subprocess.run(
            [sys.executable, str(HERE), what, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": str(folder), "POCL_CACHE_DIR": cache},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    return tuple(map(float, done.stdout.split()))


def rows(given):
    """Yield a row for each scene."""
    own = HERE.parents[1]
    for each in product(given.sizes, given.images, given.stars, given.wrong):
        row = dict(zip(("size", "images", "stars", "wrong"), each, strict=True))
        if not given.against and not given.cold:
            found = np.array([seconds(*each, given.turns)])
        else:
            call = ("--first", each) if given.cold else ("--one", (*each, 1))
            sides = [own, given.against] if given.against else [own]
            turns = range(given.turns)
            found = np.median([[elsewhere(at, *call) for at in sides] for _ in turns], axis=0)
        default, other, n_iter = found[0].tolist()
        names = ("first", "second") if given.cold else ("default", "plain")
        row |= {"iterations": int(n_iter), names[0]: default, names[1]: other}
        row[f"over {names[1]}"] = default / other
        yield row | ({"over before": default / found[1, 0]} if given.against else {})


def main():
    """Measure."""
    if sys.argv[1:2] in (["--one"], ["--first"]):
        n, p, k, wrong, *turns = map(float, sys.argv[2:])
        of = seconds if turns else cold_seconds
        print(*of(int(n), int(p), int(k), wrong, *map(int, turns)))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 256, 1024])
    parser.add_argument("--images", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--stars", type=int, nargs="+", default=[1, 5])
    parser.add_argument("--wrong", type=float, nargs="+", default=[0.0, 0.06])
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--output")
    given = parser.parse_args()
    report(rows(given), "answer", None, given.output)


if __name__ == "__main__":
    main()
