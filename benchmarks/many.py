"""Many stars: seconds and memory of ten iterations, and what was announced.

    [OPENBLAS_NUM_THREADS=1] python benchmarks/many.py STARS [--images P]

Stars of 1e3 to 1e5 electrons lie at random places of 512 x 512 pixels on a sky of 50, seen through
a Gaussian of 3 pixels on 41 x 41. All else is by default.
"""

import argparse
import logging
import re
import resource
import time

import numpy as np

import lnocl
from lnocl.core.scene.shifting import MovablePsf

N = 512


def main():
    """Measure, and print a line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stars", type=int)
    parser.add_argument("--images", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    y, x = np.indices((41, 41)) - 20
    psf = np.exp(-4 * np.log(2) * (x**2 + y**2) / 9)
    psf /= psf.sum()
    stars = rng.uniform(5, N - 6, (arguments.stars, 2))
    image, movable = np.full((N, N), 50.0), MovablePsf(psf, (N, N))
    for star, flux in zip(stars, 10 ** rng.uniform(3, 5, len(stars)), strict=True):
        cutout = movable.at(*star)
        image[cutout.window((N, N))] += flux * cutout.values
    images = rng.poisson(image.clip(0), (arguments.images, N, N))
    said = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())
    logging.getLogger("lnocl").addHandler(handler)
    logging.getLogger("lnocl").setLevel("DEBUG")
    began, cpu = time.perf_counter(), time.process_time()
    lnocl.deconvolve(lnocl.Observation(images, psf, background=50.0), stars, n_iter=10, stop=None)
    took, cpu = time.perf_counter() - began, time.process_time() - cpu
    announced = [re.findall(r"([\d.]+) (MiB|GiB)", line) for line in said if "takes" in line][-1]
    total = sum(float(size) * (1024 if unit == "GiB" else 1) for size, unit in announced)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{len(stars)} stars, {arguments.images} images: {took:.1f} s ({cpu:.1f} s of CPU), "
        f"{peak:.0f} MiB at most, announced {total:.0f} ({total / peak:.2f})"
    )


if __name__ == "__main__":
    main()
