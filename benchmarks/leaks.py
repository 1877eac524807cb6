"""Whether long and many deconvolutions in one process leave memory or open files behind.

    python benchmarks/leaks.py [--device SPEC] [--output STEM]

For each solver, on two images of 64 x 64 pixels: so many iterations in as few deconvolutions as
they take, then so many deconvolutions of ten iterations, and as often their kernels alone, made
and let go, to see what a runtime keeps of them: all in one process. A tenth of each goes before, to
warm up. Resident memory, the second number of /proc/self/statm, and the files in
/proc/self/fd are looked at in twenty places, the first of which is "before"; growth is from the
least so far. The exit status is 1 where memory grows by more than 1 % or files become more.
"""

import argparse
import ctypes
import os
import sys
from pathlib import Path

import numpy as np
import parts
import pyopencl as cl
from parts import paper

import lnocl
from lnocl.core.opencl import program
from lnocl.core.opencl.device import choose

SOLVERS = ("sgm", "sgp")
SHORT = 10
PLACES = 20
MOST_GROWTH = 0.01  # of resident memory


def observation():
    """Return two images of a star on a ramp."""
    y, x = np.mgrid[-8:9, -8:9]
    psfs = [np.exp(-0.5 * ((x / 2.0) ** 2 + (y / width) ** 2)) for width in (1.5, 2.5)]
    means = np.broadcast_to(np.linspace(10.0, 30.0, 64), (2, 64, 64)).copy()
    for mean, psf in zip(means, psfs, strict=True):
        mean[22:39, 12:29] += 5000.0 * psf / psf.sum()
    images = np.random.default_rng(1).poisson(means)
    return lnocl.Observation(images, psfs, background=5.0)


def held():
    """Return the bytes of resident memory and the number of open files.

    Free memory is given back first: compilers leave 100 MiB of it, which would take in a leak.
    """
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGESIZE"), len(os.listdir("/proc/self/fd"))


def iterate(solver, count, device, look):
    """Do so many iterations, looking after each; return how many deconvolutions they took."""
    given, done, runs = observation(), 0, 0

    def follow(iteration, _):
        look(done + iteration)

    while done < count:
        result = paper(
            given,
            stars=[(20, 30)],
            solver=solver,
            n_iter=count - done,
            precision="double",
            device=device,
            callback=follow,
        )
        done, runs = done + result.n_iter, runs + 1
    return runs


def deconvolve(solver, count, device, look):
    """Do so many deconvolutions, looking after each; return their number."""
    given = observation()
    for done in range(1, count + 1):
        paper(
            given, stars=[(20, 30)], solver=solver, n_iter=SHORT, precision="single", device=device
        )
        look(done)
    return count


def build(solver, count, device, look):
    """Build the kernels so many times, looking after each; return the number of deconvolutions."""
    chosen, dtype = choose(device).device, np.dtype(np.float32)
    for done in range(1, count + 1):
        program.Program(cl.Context([chosen]), (64, 64), dtype).kernel("rfft_rows")
        program._build.cache_clear()
        look(done)
    return 0


def measure(work, solver, count, device=None):
    """Return a row with what some work holds, and how that grows."""
    work(solver, max(1, count // 10), device, lambda _: None)
    seen = []

    def look(done):
        if done % max(1, count // PLACES) == 0:
            seen.append(held())

    runs = work(solver, count, device, look)
    memory, files = np.array(seen).T
    return {
        "solver": solver,
        "what": work.__name__,
        "count": count,
        "deconvolutions": runs,
        "MiB before": memory[0] / 2**20,
        "MiB after": memory[-1] / 2**20,
        "most growth, %": 100.0 * ((memory / np.minimum.accumulate(memory)).max() - 1.0),
        "files before": int(files[0]),
        "most files": int(files.max()),
    }


def is_flat(row):
    """Return whether memory and files stay as they are."""
    memory_is = row["most growth, %"] <= 100.0 * MOST_GROWTH
    return memory_is and row["most files"] <= row["files before"]


def main():
    """Measure what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device")
    parser.add_argument("--iterations", type=int, default=20_000)
    parser.add_argument("--deconvolutions", type=int, default=500)
    parser.add_argument("--output")
    given = parser.parse_args()
    rows = []

    def measured():
        for solver in SOLVERS:
            for work, count in (
                (iterate, given.iterations),
                (deconvolve, given.deconvolutions),
                (build, given.deconvolutions),
            ):
                rows.append(measure(work, solver, count, given.device))
                yield rows[-1]

    parts.report(measured(), "leaks", given.device, given.output)
    return 0 if all(map(is_flat, rows)) else 1


if __name__ == "__main__":
    sys.exit(main())
