"""The time of each kernel of an iteration, by the cut of the kernels to the device.

    python benchmarks/kernels.py [--device SPEC] [--size N ...] [--output STEM]

Four images with a star, single precision, the split-gradient method. The table has microseconds of
an iteration, by the host's clock, and of each kernel in it, by the device's. The bytes that an
iteration must move give its bandwidth. With --output the table goes to STEM.ecsv.
"""

import argparse
import functools
import time

import numpy as np
import pyopencl as cl
import sides
from astropy.table import Table
from machine import bytes_moved

from lnocl.core.opencl.device import choose, describe
from lnocl.core.opencl.launch import Launch
from lnocl.core.opencl.tuning import Tuning, chosen
from lnocl.core.scene.scene import Scene

SECONDS = 0.1


def cuts(device, grid):
    """Return the cuts to try: that of lnocl, then others that a GPU may like."""
    own = chosen(device, np.dtype(np.float32)).fit(device, np.dtype(np.float32), grid)
    found = {"lnocl": own}
    if own.lanes > 1:
        return found
    for block in (1, 2, 4, 8):
        for group in (128, 256, 512, 1024):
            cut = Tuning(1, block, group)
            fits = cut.local_bytes(grid, 1, np.dtype(np.float32)) <= device.local_mem_size
            if fits and group <= min(device.max_work_group_size, min(grid) // 8 * block):
                found[f"{block} x {group}"] = cut
    found["8 x 256 global"] = Tuning(1, 8, 256, scratch_is_global=True)
    found["8 x 512 global"] = Tuning(1, 8, 512, scratch_is_global=True)
    return found


class Profile:
    """Microseconds of each kernel, by the device's own clock, in iterations as they run."""

    def __init__(self):
        self.events = []
        self._call = Launch.__call__

    def __enter__(self):
        """Keep the event of each launch from now on."""

        def call(launch):
            event = self._call(launch)
            self.events.append((launch._name, event))
            return event

        Launch.__call__ = call
        return self

    def __exit__(self, *_):
        """Keep no more."""
        Launch.__call__ = self._call

    def medians(self):
        """Return the median of each kernel."""
        times = {}
        for name, event in self.events:
            times.setdefault(name, []).append(1e-3 * (event.profile.end - event.profile.start))
        return {name: float(np.median(each)) for name, each in times.items()}


def microseconds(side, queue):
    """Return microseconds of an iteration, launches and all."""
    count = 4
    while True:
        queue.finish()
        start = time.perf_counter()
        side.enqueue(count)
        queue.finish()
        seconds = time.perf_counter() - start
        if seconds > SECONDS:
            return 1e6 * seconds / count
        count = max(2 * count, round(1.2 * count * SECONDS / max(seconds, 1e-4)))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device")
    parser.add_argument("--size", type=int, nargs="+", default=[256, 1024, 2048, 4096])
    parser.add_argument("--output")
    given = parser.parse_args()
    device = choose(given.device).device
    properties = cl.command_queue_properties.PROFILING_ENABLE
    cl.CommandQueue = functools.partial(cl.CommandQueue, properties=properties)
    print(describe(device), flush=True)
    rows = []
    for size in given.size:
        scene = Scene(sides.observation(size, 4), [(size / 3 + 0.2, size / 2)])
        for name, cut in cuts(device, scene.grid).items():
            side = sides.Lnocl(scene, np.float32, given.device, cut)
            queue = side.engine._queue
            row = {"size": size, "cut": name, "group": f"{cut.block} x {cut.group}"}
            row["iteration"] = microseconds(side, queue)
            with Profile() as profile:
                side.enqueue(20)
                queue.finish()
            row |= profile.medians()
            row["GB/s"] = 1e-3 * bytes_moved(4, size, size, 4) / row["iteration"]
            rows.append(row)
            print(
                {k: round(v, 1) if isinstance(v, float) else v for k, v in row.items()}, flush=True
            )
    table = Table(rows)
    table.meta["device"] = describe(device)
    for name in table.colnames[3:]:
        table[name].format = "%.1f"
    table.pprint_all()
    if given.output:
        table.write(f"{given.output}.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
