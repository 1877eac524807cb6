"""Time of an iteration of a member of a batch over that of a run alone, on a device.

    python benchmarks/batches.py [--sizes N ...] [--images P ...] [--members N ...] [--turns N]
        [--output FILE.ecsv]

Members share PSFs and differ in their images. A batch and a run alone take turns in one process,
each the first ten iterations of `sgp`, shortened steps included. Medians of so many turns.
"""

import argparse
import time
from itertools import product

import numpy as np
from answer import observe
from parts import report

from lnocl.core.runs.run import make_runs
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty
from lnocl.process import ignored_notes, ignored_warnings

N_ITER = 10


class Batch:
    """Runs that share their ticks."""

    def __init__(self, starts):
        self._start = starts[0]
        with ignored_notes():
            self._engines = [run.engine for run in make_runs(starts, N_ITER)]

    def seconds(self, count):
        """Return seconds of an iteration of all members, from where they start."""
        for engine in self._engines:
            engine.start(self._start.extended, self._start.star_fluxes)
        for engine in self._engines:
            engine.go_on(count + 1, 0.0)
        begin = time.perf_counter()
        self._engines[0].finish()
        took = time.perf_counter() - begin
        assert all(engine.look().done == count for engine in self._engines)
        return took / count


def starts_of(n, p, most):
    """Return starts with so many draws of images."""
    observation, stars = observe(n, p, 1, 0.0)
    with ignored_warnings():
        start = make_start(Setup(observation, stars, 0, "sgp", "single", "opencl", None), Penalty())
    rng = np.random.default_rng(1)
    draws = (rng.poisson(np.asarray(observation.images)) for _ in range(most))
    return [start.of_half(observation.replace(images=each)) for each in draws]


def rows(given):
    """Yield a row for each scene and number of members."""
    for n, p in product(given.sizes, given.images):
        starts = starts_of(n, p, max(given.members))
        alone = Batch(starts[:1])
        alone.seconds(1)  # which compiles
        for members in given.members:
            batch, found = Batch(starts[:members]), []
            batch.seconds(1)
            for _ in range(given.turns):
                found.append((batch.seconds(N_ITER), alone.seconds(N_ITER)))
            both, one = np.median(found, axis=0)
            share = np.median([a / members / b for a, b in found])
            yield {
                **{"size": n, "images": p, "members": members},
                **{"ms alone": 1e3 * one, "ms a member": 1e3 * both / members, "over alone": share},
            }


def main():
    """Measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256, 512])
    parser.add_argument("--images", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--members", type=int, nargs="+", default=[1, 2, 4, 16])
    parser.add_argument("--turns", type=int, default=31)
    parser.add_argument("--output")
    given = parser.parse_args()
    report(rows(given), "batches", None, given.output)


if __name__ == "__main__":
    main()
