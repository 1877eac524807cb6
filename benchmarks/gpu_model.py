"""How kernels are cut to GPUs, and what a model says of their speed; no GPU is needed, or measured.

    python benchmarks/gpu_model.py

The first tables give, for each length of a square grid and each size of local memory that a device
reports, columns in a block x work-items in a group, the groups that a compute unit holds at once,
and the share of its work-items that these are. The last one has times of an iteration of the
split-gradient method. An iteration moves 10 p + 7 arrays of pixels, for p images; it takes

    bytes / min(bandwidth, DUTY items in flight x BYTES_AN_ITEM / LATENCY) + 5 launches

where items in flight are those of all compute units. Arrays that a block of columns holds count as
moved, though a cache may have them. Bandwidths, compute units and local memory are the vendors'.
"""

from types import SimpleNamespace

import numpy as np

from lnocl.core.opencl.tuning import Tuning

LENGTHS = [64 * 2**k for k in range(8)]
LOCAL_KIB = 32, 48, 64, 96, 128
UNITS = 132
# Most work-items that a compute unit holds.
MAX_ITEMS = 2048
# Registers of 32 bits that a unit has, and those of a work-item: tests/system/test_back_ends.py.
REGISTERS, REGISTERS_OF_ITEM = 65536, {"single": 64, "double": 96}
# Share of the time in which loads are under way; bytes that an item then waits for; seconds.
DUTY, BYTES_AN_ITEM, LATENCY = 1 / 3, 64, 600e-9
LAUNCH = 5e-6
# Compute units, KiB of local memory that a group may have, KiB of a unit, bytes a second.
DEVICES = {
    "NVIDIA H100 SXM": (132, 48, 228, 3.35e12),
    "AMD MI300X": (304, 64, 64, 5.3e12),
    "Intel Arc A770": (32, 64, 128, 0.56e12),
    "Apple M3 Max": (40, 32, 60, 0.4e12),
    "Intel Iris Xe": (12, 64, 128, 0.068e12),
}
SCENES = {"4 x 1024 x 1024": (4, 1024), "33 x 4096 x 4096": (33, 4096)}


def cut(units, local_kib, n, dtype):
    """Return the tuning of a grid of n x n."""
    device = SimpleNamespace(local_mem_size=1024 * local_kib, max_compute_units=units)
    return Tuning(1, 8, group=256).fit(device, dtype, (n, n))


def groups_of_unit(tuning, unit_kib, n, dtype):
    """Return how many groups a compute unit holds."""
    registers = REGISTERS_OF_ITEM["double" if dtype == np.float64 else "single"]
    most = min(MAX_ITEMS, REGISTERS // registers) // tuning.group
    if tuning.scratch_is_global:
        return min(4, most)
    return min(most, 1024 * unit_kib // tuning.local_bytes((n, n), 1, dtype))


def tables():
    """Yield the lines of a table for each precision."""
    for name, dtype in (("single", np.dtype("f4")), ("double", np.dtype("f8"))):
        yield f"\n{name} precision, {UNITS} compute units\n"
        yield "| Length | " + " | ".join(f"{kib} KiB" for kib in LOCAL_KIB) + " |"
        yield "| --- " * (1 + len(LOCAL_KIB)) + "|"
        for n in LENGTHS:
            cells = []
            for kib in LOCAL_KIB:
                tuning = cut(UNITS, kib, n, dtype)
                groups = groups_of_unit(tuning, kib, n, dtype)
                share = groups * tuning.group / MAX_ITEMS
                where = " global" if tuning.scratch_is_global else ""
                cells.append(f"{tuning.block} x {tuning.group}{where}, {groups}, {share:.0%}")
            yield f"| {n} | " + " | ".join(cells) + " |"


def milliseconds(device, p, n):
    """Return the cut, the share of items in flight, and the milliseconds of an iteration."""
    units, group_kib, unit_kib, bandwidth = device
    dtype = np.dtype("f4")
    tuning = cut(units, group_kib, n, dtype)
    launched = n // (2 * tuning.block)  # blocks of columns, the fewest of all kernels
    groups = min(groups_of_unit(tuning, unit_kib, n, dtype), launched / units)
    items = units * groups * tuning.group
    wasted = max(1.0, 32 / (4 * tuning.block**2 * dtype.itemsize))
    n_bytes = (10 * p + 7) * n * n * dtype.itemsize * wasted
    rate = min(bandwidth, DUTY * items * BYTES_AN_ITEM / LATENCY)
    return tuning, groups * tuning.group / MAX_ITEMS, 1e3 * (n_bytes / rate + 5 * LAUNCH)


def times():
    """Yield the lines of the table of devices."""
    yield "\n| Device | " + " | ".join(SCENES) + " |"
    yield "| --- " * (1 + len(SCENES)) + "|"
    for name, device in DEVICES.items():
        cells = []
        for p, n in SCENES.values():
            tuning, share, ms = milliseconds(device, p, n)
            where = " global" if tuning.scratch_is_global else ""
            cells.append(f"{tuning.block} x {tuning.group}{where}, {share:.0%}, {ms:.3g} ms")
        yield f"| {name} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    print("\n".join([*tables(), *times()]))
