"""Time the candidates for a device's tuning in turn, and print their medians.

    python benchmarks/tune.py [--size 1024] [--images 4] [--precision single] [--device SPEC]

Each turn times every candidate once, a few iterations long, so that a noisy machine is noisy for
all; the ratio is that to the present default of lnocl.program.tune, turn by turn, its median.
A turn's order is random. A candidate's worth is in its ratio, not in its milliseconds.
"""

import argparse
import random
from dataclasses import replace

import numpy as np
from iteration import OpenCLIterations, milliseconds, observation

from lnocl.device import choose, describe
from lnocl.program import tune
from lnocl.scene import Scene


def candidates(default):
    """Return tunings to try: the default with one or two of its constants changed."""
    most = default.block
    tried = [default]
    for lanes in (2 * most, most, most // 2):
        tried.append(replace(default, lanes=lanes, block=lanes))
    tried.append(replace(default, block=2 * most))
    tried += [replace(default, chunk=chunk) for chunk in (32, 1024)]
    tried += [replace(default, padding=padding) for padding in (0, 8, 32)]
    return list(dict.fromkeys(tried))


def main():
    """Time what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--precision", choices=("single", "double"), default="single")
    parser.add_argument("--device")
    parser.add_argument("--turns", type=int, default=9)
    given = parser.parse_args()
    device = choose(given.device).device
    dtype = np.dtype(np.float64 if given.precision == "double" else np.float32)
    scene = Scene(observation(given.size, given.images))
    default = tune(device, dtype, scene.grid)
    tried = candidates(default)
    runs = [OpenCLIterations(scene, given.precision, given.device, tuning) for tuning in tried]
    count = max(2, round(4e6 / (given.size**2 * given.images)))
    for run in runs:
        run(1)
    times = np.zeros((given.turns, len(runs)))
    for turn in range(given.turns):
        for i in random.sample(range(len(runs)), len(runs)):
            times[turn, i] = milliseconds(lambda i=i: runs[i](count)) / count
    ratios = np.median(times / times[:, :1], axis=0)
    print(f"{given.images} x {given.size} x {given.size} {given.precision}, {describe(device)}")
    for i in np.argsort(ratios):
        mark = "  <- default" if tried[i] == default else ""
        print(f"{np.median(times[:, i]):8.2f} ms  {ratios[i]:5.2f}  {tried[i]}{mark}")


if __name__ == "__main__":
    main()
