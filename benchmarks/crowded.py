"""Seconds and peak memory of a crowded field, star positions refined or fixed.

    python benchmarks/crowded.py [--stars 200] [--size 1000] [--images 1] [--psf 33] [--refine]
        [--solver sgp] [--engine opencl] [--precision single] [--n-iter 3] [--output FILE.npz]
        [held-out | price]

Stars lie at random, a tenth of the side from the edges and farther; they are given up to a third of
a pixel off. Memory is the peak of the process above that before the run, when it holds the images.
With held-out, held-out counts choose the smoothing and the iteration as well. With price, an
iteration with the stars is timed beside one without any, in turn.
"""

import argparse
import resource
import time

import numpy as np
from parts import paper

import lnocl


def field(n_stars, size, n_images, side):
    """Return an observation of stars on a flat sky, and where they are said to be."""
    rng = np.random.default_rng(0)
    true = rng.uniform(0.1 * size, 0.9 * size, (n_stars, 2))
    axis = np.arange(size)
    mean = np.full((size, size), 10.0)
    for flux, (x, y) in zip(10 ** rng.uniform(4, 6, n_stars), true, strict=True):
        profiles = (np.exp(-0.5 * ((axis - at) / 1.5) ** 2) / 1.5 for at in (y, x))
        mean += flux / (2 * np.pi) * np.outer(*profiles)
    images = rng.poisson(mean, (n_images, size, size)).astype(float)
    core = np.exp(-0.5 * ((np.arange(side) - side // 2) / 1.5) ** 2)
    psf = np.outer(core, core)
    given = true + rng.uniform(-0.3, 0.3, true.shape)
    return lnocl.Observation(images, psf, background=5.0), given


def peak():
    """Return the most memory that the process has had, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def price(observation, stars, turns=7, count=50, **settings):
    """Return milliseconds of an iteration with stars and without, medians of several turns."""

    def seconds(positions, n_iter):
        begin = time.perf_counter()
        paper(observation, stars=positions, n_iter=n_iter, **settings)
        return time.perf_counter() - begin

    both = stars, stars[:0]
    for each in both:
        seconds(each, 3)  # compiles
    turns = [[seconds(each, 5 + count) - seconds(each, 5) for each in both] for _ in range(turns)]
    return 1e3 / count * np.median(turns, axis=0)


def main():
    """Measure what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rule", nargs="?", choices=["held-out", "price"])
    parser.add_argument("--stars", type=int, default=200)
    parser.add_argument("--size", type=int, default=1000)
    parser.add_argument("--images", type=int, default=1)
    parser.add_argument("--psf", type=int, default=33)
    parser.add_argument("--refine", action="store_true")
    parser.add_argument("--solver", default="sgp")
    parser.add_argument("--engine", default="opencl")
    parser.add_argument("--precision", default="single")
    parser.add_argument("--n-iter", type=int, default=3)
    parser.add_argument("--output")
    given = parser.parse_args()
    observation, stars = field(given.stars, given.size, given.images, given.psf)
    if given.rule == "price":
        settings = {name: getattr(given, name) for name in ("solver", "engine", "precision")}
        with_stars, without = price(observation, stars, **settings)
        print(f"{with_stars:.2f} ms an iteration, {without:.2f} without stars")
        return
    before, begin, first = peak(), time.perf_counter(), []
    result = paper(
        observation,
        stars=stars,
        solver=given.solver,
        engine=given.engine,
        precision=given.precision,
        n_iter=given.n_iter,
        refine_positions=given.refine,
        stop=given.rule,
        smoothing="auto" if given.rule else 0.0,
        callback=lambda *_: first.append(time.perf_counter() - begin) and None,
    )
    seconds = time.perf_counter() - begin
    print(
        f"{seconds:.2f} s, {first[0]:.2f} of them to the first iteration; {peak() - before:.0f} MB"
    )
    if given.output:
        np.savez(
            given.output,
            extended=result.extended,
            fluxes=result.star_fluxes,
            positions=result.star_positions,
            flux_errors=result.star_flux_errors,
            position_errors=result.star_position_errors,
            objective=result.history["objective"],
        )


if __name__ == "__main__":
    main()
