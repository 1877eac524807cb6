"""False alarms and points in images that differ in depth, PSF and scale.

    python benchmarks/mixes.py [--mixes faint depths bars scales coarse dimmed field] [--fields N]
        [--alarms A] [--first SEED] [--processes P] [--output STEM]

The sky has 80 x 80 pixels; PSFs are two Gaussians without symmetry. Means are formulae, and exact.

faint   a PSF of 4 pixels FWHM, and two of 2 and 9 with 1e-5 of its information
depths  PSFs of 2.2, 3 and 4.5 pixels, exposures of 1, 3 and 20, other read noise and sky in each
bars    four PSFs of 2 x 5 pixels, turned by 45 degrees each, exposures of 1 to 8
scales  a PSF of 2.5 pixels, and an image turned by 20 degrees, 30 times as deep, whose pixels are
        2.8 times as large, with a PSF of 2 of its own pixels
coarse  the same with pixels 5.6 times as large
dimmed  a PSF of 3 pixels behind a transmission that falls to 0.3 to the right, with a hole of 6
        pixels radius, in which no point is put; half of the sky is behind it
field   two images whose PSFs vary from 2.6 to 3.4 and from 3.6 to 3.2 pixels, left to right

The first table is of fields that hold nothing: the stated number of alarms a field, that found and
its standard error. For the second a point is put in at random, of 9 standard deviations with the
level known: the share of fields with one detection within two FWHM of the widest PSF, with it
called a point, the medians of its distance and of its error of place, pixels, and the means of its
signal-to-noise, and of flux over truth. All fits are lnocl's with the defaults.
"""

import argparse
import multiprocessing
import os
import warnings

import numpy as np
from astropy.table import Table
from scipy.signal import fftconvolve

N, SIGMA = 80, 1.0 / np.sqrt(8.0 * np.log(2.0))  # of a FWHM of 1
MIDDLE = np.full(2, (N - 1) / 2.0)
SIGNAL, INSIDE = 9.0, 15.0
MIXES = "faint", "depths", "bars", "scales", "coarse", "dimmed", "field"
HOLE, HIDDEN = (30.0, 44.0), 6.0


class Camera:
    """An image: its PSF, its map from the sky, exposure, background and read noise."""

    end, behind = None, 0.0  # a camera of the PSFs at the right edge; sky behind a transmission

    def __init__(self, fwhm, exposure, sky, read=0.0, *, long=1.0, tilt=0.0, scale=1.0, turn=0.0):
        self.exposure, self.read, self.scale = exposure, read, scale
        self.side = round(N / scale)
        self.background = exposure * sky * scale**2
        axis = np.array([np.cos(tilt), np.sin(tilt)])
        self.covariance = (SIGMA * fwhm) ** 2 * (np.eye(2) + (long**2 - 1.0) * np.outer(axis, axis))
        self.width = fwhm * long * scale
        cos, sin = np.cos(turn), np.sin(turn)
        self.linear = np.array([[cos, -sin], [sin, cos]]) / scale
        self.shift = (self.side - 1) / 2.0 - self.linear @ MIDDLE
        self.half = int(np.ceil(2.5 * fwhm * long)) + 1

    def light(self, x, y):
        """Return the PSF at distances from its core, of unit sum: a core, and a ghost beside it."""
        wide, long = 1.5**2 * self.covariance, np.sqrt(self.covariance[0, 0])
        core = _gaussian(x, y, self.covariance)
        return 0.85 * core + 0.15 * _gaussian(x - 1.2 * long, y + 0.7 * long, wide)

    def psf(self):
        """Return its array."""
        y, x = np.mgrid[-self.half : self.half + 1, -self.half : self.half + 1]
        return self.light(x, y)

    def point(self, place):
        """Return what a point of one electron at a place of the sky adds."""
        x, y = self.linear @ place + self.shift
        rows, columns = np.indices((self.side, self.side))
        light = self.light(columns - x, rows - y)
        if self.end:
            there = self.end.light(columns - x, rows - y)
            light += place[0] / (N - 1) * (there - light)
        return self.exposure * (self.share(*place) if self.behind else 1.0) * light

    def share(self, x, y):
        """Return the transmission at a place of the sky."""
        is_open = np.hypot(x - HOLE[0], y - HOLE[1]) > HIDDEN
        return is_open * (1.0 - 0.7 * x / (N - 1))

    def sky(self):
        """Return the counts of the sky beside the background."""
        if not self.behind:
            return np.zeros((self.side, self.side))
        rows, columns = np.mgrid[-20 : N + 20, -20 : N + 20]
        seen = self.share(columns.clip(0, N - 1), rows)
        return self.behind * fftconvolve(seen, self.psf(), "same")[20:-20, 20:-20]

    @property
    def variance(self):
        """Of a pixel of the empty sky."""
        return self.background + self.read**2


def _gaussian(x, y, covariance):
    (a, b), (_, c) = np.linalg.inv(covariance)
    exponent = a * x**2 + 2.0 * b * x * y + c * y**2
    return np.exp(-0.5 * exponent) / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)))


def cameras(mix):
    """Return the images of a mix."""
    if mix == "faint":
        faint = Camera(2.0, 6e-6, 10.0, 0.01), Camera(9.0, 6e-5, 10.0, 0.01)
        return [faint[0], Camera(4.0, 1.0, 10.0), faint[1]]
    if mix == "depths":
        return [Camera(2.2, 1.0, 20.0, 3.0), Camera(3.0, 3.0, 40.0), Camera(4.5, 20.0, 20.0, 5.0)]
    if mix == "bars":
        return [Camera(2.0, 2.0**k, 20.0, 3.0, long=2.5, tilt=k * np.pi / 4) for k in range(4)]
    if mix == "dimmed":
        camera = Camera(3.0, 1.0, 20.0)
        camera.behind = 20.0
        return [camera]
    if mix == "field":
        ends = [(2.6, 3.4), (3.6, 3.2)]
        seen = [Camera(left, 1.0 + k, 20.0) for k, (left, _) in enumerate(ends)]
        for camera, (_, right) in zip(seen, ends, strict=True):
            camera.half, camera.end = 11, Camera(right, 1.0, 20.0)
            camera.end.half = 11
        return seen
    scale = 2.8 if mix == "scales" else 5.6
    return [Camera(2.5, 1.0, 20.0), Camera(2.0, 30.0, 20.0, scale=scale, turn=np.radians(20.0))]


def significance(images, seen, alarms):
    """Return what lnocl finds."""
    import lnocl

    known = {}
    if any(each.scale != 1.0 for each in seen):
        known["transforms"] = np.array([np.column_stack([c.linear, c.shift]) for c in seen])
    psfs = [each.psf() for each in seen]
    if seen[0].end:
        edges = [(0.0, 0.0), (N - 1.0, 0.0)]
        psfs = [lnocl.PsfField([each.psf(), each.end.psf()], edges) for each in seen]
    if seen[0].behind:
        known["transmission"] = seen[0].share(*np.indices((N, N))[::-1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        observation = lnocl.Observation(
            images,
            psfs,
            background=[each.background for each in seen],
            read_noise=[each.read for each in seen],
            exposure=[each.exposure for each in seen],
            psf_centre="given",
            **known,
        )
        return lnocl.deconvolve(observation).significance(false_alarms=alarms)


def expose(seen, rng, light):
    """Return counts and read noise."""
    for camera, of_point in zip(seen, light, strict=True):
        counts = rng.poisson(camera.background + of_point)
        yield counts + camera.read * rng.standard_normal(counts.shape)


def measure(job):
    """Return the alarms of a field without and with a point, and what is found of the point."""
    mix, alarms, seed = job
    rng, seen = np.random.default_rng(seed), cameras(mix)
    dark = [each.sky() for each in seen]
    wrong = len(significance(list(expose(seen, rng, dark)), seen, alarms).detections)
    place = MIDDLE + rng.uniform(-INSIDE, INSIDE, 2)
    while mix == "dimmed" and np.hypot(*(place - HOLE)) < HIDDEN + 3.0:
        place = MIDDLE + rng.uniform(-INSIDE, INSIDE, 2)
    points = [each.point(place) for each in seen]
    terms = zip(points, seen, dark, strict=True)
    information = sum((p**2 / (c.variance + sky)).sum() for p, c, sky in terms)
    flux = SIGNAL / np.sqrt(information)
    images = list(expose(seen, rng, [d + flux * p for d, p in zip(dark, points, strict=True)]))
    found = significance(images, seen, 0.01).detections
    away = np.hypot(found["x"].value - place[0], found["y"].value - place[1])
    near = found[away < 2.0 * max(each.width for each in seen)]
    if not len(near):
        return wrong, 0, 0, *[np.nan] * 4
    best, distance = near[0], away.min()
    told = np.hypot(best["x_error"].value, best["y_error"].value)
    return (wrong, len(near), best["kind"] == "point", distance, told, best["significance"],
            best["flux"].value / flux)  # fmt: skip


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mixes", nargs="+", default=MIXES, choices=MIXES)
    parser.add_argument("--fields", type=int, default=40)
    parser.add_argument("--alarms", type=float, default=2.0)
    parser.add_argument("--first", type=int, default=9000)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--output")
    given = parser.parse_args()
    alarms, points = [], []
    with multiprocessing.get_context("spawn").Pool(given.processes) as pool:
        for mix in given.mixes:
            jobs = [(mix, given.alarms, given.first + i) for i in range(given.fields)]
            rows = np.array(pool.map(measure, jobs, chunksize=2), float)
            wrong, number, is_point, distance, told, signal, flux = rows.T
            error = wrong.std() / np.sqrt(len(wrong))
            alarms.append((mix, len(wrong), given.alarms, wrong.mean(), error))
            medians = np.nanmedian(distance), np.nanmedian(told)
            shares = (number == 1).mean(), ((number == 1) & (is_point > 0)).mean()
            means = np.nanmean(signal), np.nanmean(flux)
            points.append((mix, len(wrong), *shares, *medians, *means))
            print(alarms[-1], points[-1], flush=True)
    first = Table(rows=alarms, names=("mix", "fields", "stated", "found", "error"))
    names = "mix", "fields", "once", "point", "distance", "told", "signal", "flux"
    second = Table(rows=points, names=names)
    for table, ending in ((first, "alarms"), (second, "points")):
        for name in table.colnames[2:]:
            table[name].format = ".3f"
        print(table)
        if given.output:
            table.write(f"{given.output}_{ending}.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
