"""Seconds and bytes of each kernel as it is compiled, with no kernel compiled before.

    python benchmarks/compiling.py [--sizes N ...] [--images P] [--output STEM]

A default answer on p images of a jet and its star (answer.py), in a process of its own for each
size, which compiles all kernels by itself. "front" is what compilers do of all kernels of a program
at once. A kernel is compiled as it is first launched. Bytes are those of its library, on PoCL.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings

import answer
from parts import report

import lnocl
from lnocl.core.opencl import ahead, kernel_cache, program
from lnocl.core.opencl.launch import Launch


def timed(function, seconds, name):
    """Return a function that does the same, and appends a name and the seconds that it takes."""

    def call(*arguments):
        start = time.perf_counter()
        try:
            return function(*arguments)
        finally:
            seconds.append((name, time.perf_counter() - start))

    return call


def compile_all(n, p):
    """Return seconds by kernel and grid, and bytes."""
    fronts, seconds, seen, call = [], [], set(), Launch.__call__
    ahead.begin = lambda *_: None
    program._compile = timed(program._compile, fronts, "front")

    def first(launch):
        name = f"{launch._name} {launch._program.grid[0]}"
        if name in seen:
            return call(launch)
        seen.add(name)
        launch._program.kernel(launch._name)  # whose program may be built here
        launch._queue.finish()
        event = timed(lambda: (call(launch), launch._queue.finish()), seconds, name)()
        return event[0]

    Launch.__call__ = first
    observation, stars = answer.observe(n, p, 1, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        lnocl.deconvolve(observation, stars)
    sizes = {}
    for file in kernel_cache._own[0].path.glob("??/*/*/*/*.so"):
        sizes[file.stem] = sizes.get(file.stem, 0) + file.stat().st_size
    return [*fronts, *seconds], sizes


def rows(sizes, p):
    """Yield a row for each size and kernel, and one for all."""
    for n in sizes:
        with tempfile.TemporaryDirectory() as cache:
            done = subprocess.run(
                [sys.executable, __file__, "--one", str(n), str(p)],
                env={**os.environ, "POCL_CACHE_DIR": cache},
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
        seconds, sizes_of = json.loads(done.stdout)
        totals = {}
        for name, each in seconds:
            totals.setdefault(name.split()[0], []).append(each)
        for name, each in totals.items():
            row = {"size": n, "images": p, "kernel": name, "times": len(each)}
            yield row | {"seconds": sum(each), "bytes": sizes_of.get(name, 0)}
        whole = {"size": n, "images": p, "kernel": "all", "times": len(seconds)}
        yield whole | {"seconds": sum(s for _, s in seconds), "bytes": sum(sizes_of.values())}


def main():
    """Measure."""
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(compile_all(*map(int, sys.argv[2:]))))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256, 1024])
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--output")
    given = parser.parse_args()
    report(rows(given.sizes, given.images), "compiling", None, given.output)


if __name__ == "__main__":
    main()
