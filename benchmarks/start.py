"""Seconds from the call of `lnocl.deconvolve` to its first iteration, and host time an iteration.

    python benchmarks/start.py [--size 1024] [--images 4] [--solver sgp] [--turns 5]

Each start is a process of its own, cold with empty kernel caches (PoCL's and PyOpenCL's), warm with
those that the cold start left. Host time is what the Python thread computes for an iteration; on a
CPU it runs beside the kernels.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time

import numpy as np
from parts import paper
from sides import Lnocl, observation

from lnocl.core.scene.scene import Scene

ITERATIONS = 200


def start(size, n_images, solver):
    """Print the seconds from the call to the first iteration."""
    given = observation(size, n_images)
    begin = time.perf_counter()
    stars = [(size // 2, size // 2)]
    paper(given, stars=stars, solver=solver, callback=lambda *_: print_since(begin))


def print_since(begin):
    """Print the seconds since then; return True, which ends a run."""
    print(time.perf_counter() - begin)
    return True


def seconds_of_a_start(caches, size, n_images, solver):
    """Return what a new process takes, its kernel caches in a folder."""
    environment = os.environ | {"POCL_CACHE_DIR": f"{caches}/pocl", "XDG_CACHE_HOME": caches}
    scene = "--size", str(size), "--images", str(n_images), "--solver", solver
    command = [sys.executable, __file__, "--start", *scene]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout)


def host_milliseconds(size, n_images):
    """Return what the Python thread computes for an iteration, and what an iteration takes."""
    side = Lnocl(Scene(observation(size, n_images)), np.float32)
    side(3)
    wall, own = time.perf_counter(), time.thread_time()
    side.enqueue(ITERATIONS)
    own = time.thread_time() - own
    side(1)
    return 1e3 * own / ITERATIONS, 1e3 * (time.perf_counter() - wall) / (ITERATIONS + 1)


def main():
    """Measure what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--solver", choices=("sgp", "sgm"), default="sgp")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--start", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.start:
        start(given.size, given.images, given.solver)
        return
    cold, warm = [], []
    for _ in range(given.turns):
        with tempfile.TemporaryDirectory() as caches:
            cold.append(seconds_of_a_start(caches, given.size, given.images, given.solver))
            warm.append(seconds_of_a_start(caches, given.size, given.images, given.solver))
    host, iteration = host_milliseconds(given.size, given.images)
    scene = f"{given.images} x {given.size} x {given.size} single, {given.solver}"
    print(f"{scene}, medians of {given.turns} starts")
    print(f"cold start   {np.median(cold):6.2f} s")
    print(f"warm start   {np.median(warm):6.2f} s")
    print(f"host         {host:6.3f} ms an iteration of {iteration:.2f} ms")


if __name__ == "__main__":
    main()
