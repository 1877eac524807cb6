"""What a replica costs beside a run's iterations, and the memory of both.

    python benchmarks/replicas.py [--size 512] [--images 4] [--n-iter 300] [--turns 9]
    python benchmarks/replicas.py --memory run|replicas [--size 512] [--images 4]

The iterations of a run, start-up aside, and whole replicas take turns in one process: medians, and
their ratio. --memory does one of them and prints the peak of the process above that before.
"""

import argparse
import resource
import time

import numpy as np

import lnocl
from lnocl.core.runs.replicas import Replicas
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import make_start
from lnocl.core.scene.penalty import Penalty


def peak():
    """Return the most memory that the process has had, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def observe(p, size):
    """Return images of a star on a flat sky, which take no memory to make."""
    core = np.exp(-((np.arange(size) - size // 2) ** 2) / 10.0)
    psf = np.outer(core, core) / core.sum() ** 2
    images = np.random.default_rng(0).poisson(50.0 + 1e6 * psf, (p, size, size)).astype(float)
    return lnocl.Observation(images, np.array([psf] * p), background=10.0), [(size // 2, size // 2)]


def main():
    """Measure what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--n-iter", type=int, default=300)
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--memory", choices=["run", "replicas"])
    given = parser.parse_args()
    observation, stars = observe(given.images, given.size)
    before = peak()
    result = lnocl.deconvolve(
        observation, stars, n_iter=given.n_iter, stop=None, pad=0, smoothing=1e-3
    )
    if given.memory:
        if given.memory == "replicas":
            result.bootstrap(10)
        print(f"{given.memory}: {peak() - before:.0f} MB above {before:.0f}")
        return
    replicas = Replicas(result._outcome, 0)
    start = make_start(result._outcome.setup, Penalty(smoothing=1e-3))
    run, times = Run(start, given.n_iter), {"iterations": [], "replica": []}
    for k in range(given.turns):
        run.repeat(start, observation)
        begin = time.perf_counter()
        for _ in run:
            pass
        run.star_fluxes()
        times["iterations"].append(time.perf_counter() - begin)
        begin = time.perf_counter()
        replicas.reconstruct(k)
        times["replica"].append(time.perf_counter() - begin)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    ratio = medians["replica"] / medians["iterations"]
    print(
        f"{given.images} x {given.size} x {given.size}, {given.n_iter} iterations: "
        f"{medians['iterations']:.3f} s, a replica {medians['replica']:.3f} s: {ratio:.3f}; "
        f"50 replicas are {50 * ratio:.1f} runs' iterations; {result.device}"
    )


if __name__ == "__main__":
    main()
