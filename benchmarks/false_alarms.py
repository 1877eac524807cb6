"""False alarms in empty fields, over the number that is stated.

    python benchmarks/false_alarms.py --formula
    python benchmarks/false_alarms.py [--kinds sky star jet crowded] [--errors 0 0.03]
        [--fields N] [--alarms A] [--first SEED] [--processes P] [--output TABLE.ecsv]

Fields of 96 x 96 pixels with a sky of 20 electrons and an Airy pattern of 3 pixels FWHM, central
obstruction a fifth. They hold nothing beside the sources that are known or extended:

sky      nothing
star     a star of 3e5 electrons
jet      the same star, and a jet of 26 pixels from its side, of 2e4 electrons
crowded  40 stars of 1e3 to 1e5 electrons, two pixels apart or more

With an error the images are made through other PSFs in each field: each pixel is wrong by this
share, correlated over 0.6 pixels. All fits are lnocl's with the defaults. An alarm is a detection
that is called a point, or one that is called extended where the jet, as seen, has less than a
hundredth of its peak. The columns are the stated number of alarms a field, that found and its
standard error, the median of the PSF error that the runs have found, and the medians of the times
of a run and of its map.

With --formula the threshold is tried on noise alone, of a level that is known: 1000 fields of 64 x
64 pixels with so many counts a pixel, with and without the correction for few counts.
"""

import argparse
import multiprocessing
import os
import time
import warnings

import numpy as np
import scipy.fft
from astropy.table import Table
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.special import j1

N, AROUND, SKY, WIDTH, OBSTRUCTED = 96, 24, 20.0, 3.0, 0.2
STAR, JET, STARS = 3e5, 2e4, 40
EDGE = 32.5  # that of the PSF's array: what it lacks would be an error of it
KINDS = "sky", "star", "jet", "crowded"
CORRELATED = 0.6


def airy(distance):
    """Return the Airy pattern of an obstructed pupil at distances in pixels, to 32 of them."""
    v = np.maximum(np.pi * distance / WIDTH, 1e-6)
    amplitude = (2 * j1(v) - OBSTRUCTED**2 * 2 * j1(OBSTRUCTED * v) / OBSTRUCTED) / v
    return np.where(distance < EDGE, amplitude**2, 0.0)


def psf_at(x, y, size):
    """Return the pattern, of unit sum over a wide square, centred on a place."""
    rows, columns = np.indices((size, size))
    return airy(np.hypot(columns - x, rows - y)) / TOTAL


TOTAL = airy(np.hypot(*np.mgrid[-48:49, -48:49])).sum()
PSF = airy(np.hypot(*np.mgrid[-32:33, -32:33]))


def field(kind, error, seed):
    """Return the counts, the stars, and the jet as seen."""
    rng = np.random.default_rng(seed)
    size = N + 2 * AROUND
    stars, fluxes = np.zeros((0, 2)), np.zeros(0)
    if kind in ("star", "jet"):
        stars, fluxes = AROUND + N / 2 + rng.uniform(-1, 1, (1, 2)), np.array([STAR])
    if kind == "crowded":
        while len(stars) < STARS:
            place = AROUND + rng.uniform(2, N - 3, 2)
            if not len(stars) or np.hypot(*(stars - place).T).min() > 2.0:
                stars = np.append(stars, [place], axis=0)
        fluxes = 10 ** rng.uniform(3, 5, STARS)
    seen = sum((flux * psf_at(x, y, size) for (x, y), flux in zip(stars, fluxes, strict=True)),
               np.zeros((size, size)))  # fmt: skip
    jet = np.zeros((size, size))
    if kind == "jet":
        rows, columns = np.indices(jet.shape)
        x, y = columns - stars[0, 0], rows - stars[0, 1]
        jet = (abs(y - 0.3 * x) < 2) * (x > 2) * (x < 28) * np.exp(-np.maximum(x, 0) / 15.0)
        jet = gaussian_filter(jet, 1.0)
        jet *= JET / jet.sum()
        kernel = scipy.fft.rfft2(np.fft.ifftshift(psf_at(size // 2, size // 2, size)))
        jet = scipy.fft.irfft2(scipy.fft.rfft2(jet) * kernel, jet.shape).clip(0)
    seen = seen + jet
    if error:
        # The same relative change at the same distance from each star: that of the PSF.
        change = gaussian_filter(rng.standard_normal((size, size)), CORRELATED, mode="wrap")
        change *= error / change.std()
        seen = jet.copy()
        for (x, y), flux in zip(stars, fluxes, strict=True):
            moved = np.roll(change, (round(y), round(x)), (0, 1))
            wrong = psf_at(x, y, size) * (1 + moved)
            seen += flux * wrong
    inside = np.s_[AROUND:-AROUND, AROUND:-AROUND]
    counts = rng.poisson(SKY + seen[inside]).astype(float)
    return counts, stars - AROUND, jet[inside]


def measure(job):
    """Return the alarms of a field, the PSF error that was found, and the times."""
    import lnocl

    kind, error, alarms, seed = job
    counts, stars, jet = field(kind, error, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        begin = time.perf_counter()
        result = lnocl.deconvolve(lnocl.Observation(counts, PSF, background=SKY), stars)
        middle = time.perf_counter()
        found = result.significance(false_alarms=alarms)
        end = time.perf_counter()
    wrong = 0
    for each in found.detections:
        x, y = (int(np.clip(round(each[name].value), 0, N - 1)) for name in ("x", "y"))
        on_jet = jet[y, x] > 0.01 * jet.max() if jet.any() else False
        wrong += each["kind"] == "point" or not on_jet
    refinement = result.psf_refinement
    known = 0.0 if refinement is None else refinement.psf_error
    return wrong, known, middle - begin, end - middle


def try_formula(alarms, fields=1000, n=64):
    """Print the alarms of noise of known levels."""
    from lnocl.detection.false_alarms import Rarity, threshold
    from lnocl.detection.maxima import peaks

    psf = np.fft.ifftshift(psf_at(n // 2, n // 2, n))
    otf, squares = scipy.fft.rfft2(psf).conj(), (psf**2).sum()
    power, waves = abs(scipy.fft.fft2(psf)) ** 2, 2.0 * np.pi * np.fft.fftfreq(n)
    axes = waves[:, None], waves
    curvature = np.array([[(power * a * b).sum() for a in axes] for b in axes]) / power.sum()
    least = threshold(alarms, n * n * np.sqrt(np.linalg.det(curvature)))
    rarity, skewness = Rarity(psf), (psf**3).sum() / squares**1.5
    for level in (1e4, 10.0, 1.0, 0.1, 0.01, 0.001):
        found = np.zeros(2)
        for seed in range(fields):
            counts = np.random.default_rng(seed).poisson(level, (n, n)) - level
            values = scipy.fft.irfft2(scipy.fft.rfft2(counts) * otf, (n, n))
            values /= np.sqrt(level * squares)
            y, x = np.nonzero((values == maximum_filter(values, 3, mode="wrap")) & (values > 2))
            highest = peaks(values, y, x, "wrap")[1]
            gaussian = rarity(highest, np.full(highest.shape, skewness / np.sqrt(level)))
            found += (gaussian > least).sum(), (highest > least).sum()
        corrected, plain = found / fields
        print(f"{level:g} counts: {corrected:.3f} of {alarms:g}, {plain:.3f} without correction")


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--errors", nargs="+", type=float, default=[0.0, 0.03])
    parser.add_argument("--fields", type=int, default=1000)
    parser.add_argument("--alarms", type=float, default=0.2)
    parser.add_argument("--first", type=int, default=7000)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--output")
    parser.add_argument("--formula", action="store_true")
    given = parser.parse_args()
    if given.formula:
        try_formula(given.alarms)
        return
    rows = []
    with multiprocessing.get_context("spawn").Pool(given.processes) as pool:
        for error in given.errors:
            for kind in given.kinds:
                if error and kind == "sky":
                    continue
                jobs = [(kind, error, given.alarms, given.first + i) for i in range(given.fields)]
                found = np.array(pool.map(measure, jobs, chunksize=5))
                alarms = found[:, 0]
                rows.append({
                    "kind": kind, "psf_error": error, "fields": given.fields,
                    "stated": given.alarms, "found": alarms.mean(),
                    "error": alarms.std() / np.sqrt(len(alarms)),
                    "error_seen": np.median(found[:, 1]),
                    "run_s": np.median(found[:, 2]), "map_s": np.median(found[:, 3]),
                })  # fmt: skip
                print(rows[-1], flush=True)
    table = Table(rows)
    for name in ("found", "error", "error_seen", "run_s", "map_s"):
        table[name].format = ".3f"
    print(table)
    if given.output:
        table.write(given.output, overwrite=True)


if __name__ == "__main__":
    main()
