"""Time the candidates for a device's tuning in turn, and print their medians.

    python benchmarks/tune.py [--size 1024] [--images 4] [--precision single] [--device SPEC]

Candidates take turns in random order; the ratio is that to the present default of
lnocl.program.tune, turn by turn, its median. A candidate's worth is in its ratio, not in its
milliseconds.
"""

import argparse
from dataclasses import replace

import numpy as np
import pyopencl as cl
from iteration import take_turns
from sides import Lnocl, observation

from lnocl.opencl.device import choose, describe
from lnocl.opencl.program import tune
from lnocl.scene.scene import Scene


def candidates(default, device):
    """Return tunings to try: the default with one or two of its constants changed."""
    most = default.block
    tried = [default]
    if device.type & cl.device_type.CPU:
        tried += [replace(default, lanes=n, block=n) for n in (2 * most, most // 2)]
        tried += [replace(default, block=2 * most), replace(default, block=4 * most)]
    else:
        tried += [replace(default, block=n) for n in (2 * most, most // 2)]
        tried += [replace(default, group=n) for n in (32, 64, 128, 256)]
        tried += [replace(default, block=most // 2, group=n) for n in (32, 64, 256)]
    tried += [replace(default, chunk=chunk) for chunk in (32, 64, 256, 1024)]
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
    tried = candidates(default, device)
    runs = {tuning: Lnocl(scene, dtype.type, given.device, tuning) for tuning in tried}
    times = take_turns(runs, given.turns)
    ratios = np.median(times / times[:, :1], axis=0)
    print(f"{given.images} x {given.size} x {given.size} {given.precision}, {describe(device)}")
    for i in np.argsort(ratios):
        mark = "  <- default" if tried[i] == default else ""
        print(f"{np.median(times[:, i]):8.2f} ms  {ratios[i]:5.2f}  {tried[i]}{mark}")


if __name__ == "__main__":
    main()
