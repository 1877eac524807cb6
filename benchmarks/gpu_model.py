"""How kernels are cut to GPUs, and what a model says of their speed; no GPU is needed, or measured.

    python benchmarks/gpu_model.py

The first tables give, for each length of a square grid and each size of local memory that a device
reports, columns in a block x work-items in a group, and the points that an item holds in registers.

The next table has the wavefronts that a transform costs the L1 of a GPU, a point: a warp of 32
work-items reads or writes 32 banks of local memory at once, or one line of 128 bytes. They are
counted over the addresses of the passes of kernels/scratch.cl and kernels/registers.cl. Beside them
is what this makes of a kernel on an H100,

    max(bytes / bandwidth, wavefronts / (units clock)),

and what was measured there with lines in the scratch (results/h100-kernels.ecsv).

The last table has an iteration, which is the four kernels, of images whose lines are in registers.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
from astropy.table import Table

from lnocl.core.opencl.program import radices
from lnocl.core.opencl.tuning import Tuning, candidates

RESULTS = Path(__file__).parent / "results"
LENGTHS = [64 * 2**k for k in range(8)]
LOCAL_KIB = 32, 48, 64
SINGLE, DOUBLE = np.dtype("f4"), np.dtype("f8")
# An H100 SXM: compute units, KiB of local memory of a group, cycles and bytes a second.
UNITS, GROUP_KIB, CLOCK, BANDWIDTH = 132, 48, 1.755e9, 2.95e12
WARP = 32
# Images; and of each kernel the arrays of pixels that it moves, where sums over images and the
# sky's spectrum go through memory, and where not; its transforms, and how often it reads or
# writes tiles of spectra, and lines.
P = 4
KERNELS = {
    "ratio_rows": (3 * P, 3 * P, 2 * P, 2 * P, P),
    "correlate_columns": (4 * P - 1, 2 * P + 1, P + 1, 0, 2 * P + 1),
    "scale_rows": (4, 4, 2, 2, 2),
    "convolve_columns": (3 * P + 2, 2 * P + 1, P + 1, 0, 2 * P + 1),
}
# Wavefronts a complex point: of tiles, eight loads or stores that each find eight lines for 32
# items, or two of four numbers; of the real and the imaginary parts of lines, two lines each.
TILES, QUADS, LINES = 8 * 8 / 64, 0.25, 4 / 32


def device(local_kib):
    """Return a GPU with so much local memory."""
    return SimpleNamespace(
        type=cl.device_type.GPU,
        local_mem_size=1024 * local_kib,
        max_compute_units=UNITS,
        max_work_group_size=1024,
    )


def cut(local_kib, n, dtype):
    """Return the tuning of a grid of n x n."""
    gpu = device(local_kib)
    return candidates(gpu, dtype)[0].fit(gpu, dtype, (n, n))


def cuts():
    """Yield the lines of a table for each precision."""
    for name, dtype in (("single", SINGLE), ("double", DOUBLE)):
        yield f"\n{name} precision, {UNITS} compute units\n"
        yield "| Length | " + " | ".join(f"{kib} KiB" for kib in LOCAL_KIB) + " |"
        yield "| --- " * (1 + len(LOCAL_KIB)) + "|"
        for n in LENGTHS:
            cells = []
            for kib in LOCAL_KIB:
                own = cut(kib, n, dtype)
                held = f"{n * own.block // own.group} points" if own.points else "scratch"
                where = "global " if own.scratch_is_global else ""
                cells.append(f"{own.block} x {own.group}, {where}{held}")
            yield f"| {n} | " + " | ".join(cells) + " |"


def wavefronts(instructions, is_local, size=1):
    """Return those of loads or stores, each of the places of the items' numbers of `size` words."""
    total = 0
    for places in instructions:
        for some in np.split(places, range(WARP // size, len(places), WARP // size)):
            own = np.unique(np.add.outer(size * some, np.arange(size)))
            total += np.bincount(own % WARP).max() if is_local else len(np.unique(own // WARP))
    return total


def in_scratch(n, block):
    """Return the wavefronts of a transform of a block, in local memory and for the roots."""
    _, outer, last = radices(n)
    length, radix, local, roots = n, outer, 0, 0
    while length > 1:
        width, piece = length // radix, np.arange(n // radix * block)
        b, lane = piece // block, piece % block
        at = b // width * length + b % width
        legs = [(2 * (at + q * width) + i) * block + lane for q in range(radix) for i in (0, 1)]
        local += wavefronts(legs, True) * (1 if length == n else 2)
        if width > 1:
            j = b % width
            table = [2 * ((radix - 1) * j + q) + i for q in range(radix - 1) for i in (0, 1)]
            roots += wavefronts(table, False)
        length, radix = width, 8 if width // 8 >= last else last
    return local, roots


def in_registers(n, own, dtype):
    """Return the same with lines in registers, for an even number of points."""
    size = dtype.itemsize // SINGLE.itemsize
    items = own.group // own.block
    points = n // items
    _, _, last = radices(n, items)
    item = np.arange(own.group)
    j, lane = item // own.block, item % own.block
    lengths = [n]
    while lengths[-1] > last:
        lengths.append(lengths[-1] // points)
    local = roots = 0
    for k, length in enumerate(lengths):
        radix = min(points, length)
        width = length // radix
        b = [j * (points // radix) + i // radix for i in range(points)]
        at = [each // width * length + each % width + i % radix * width for i, each in enumerate(b)]
        times = 2 * (1 if k in (0, len(lengths) - 1) else 2)
        local += times * wavefronts([(x + x // 16) * own.block + lane for x in at], True, size)
        bits = [1 << bit for bit in range(radix.bit_length() - 1)] if width > 1 else []
        roots += wavefronts(
            [2 * (k * width + j % width) + i for k in range(len(bits)) for i in (0, 1)], False, size
        )
    return local, roots


def microseconds(kernel, n, waves, held, dtype=SINGLE):
    """Return those of a kernel, of which a transform costs so many wavefronts a point."""
    in_memory, in_hand, transforms, tiles, lines = KERNELS[kernel]
    n_bytes = (in_hand if held else in_memory) * n * n * dtype.itemsize
    moved = tiles * (QUADS if held else TILES) + lines * LINES
    a_point = transforms * waves + moved * dtype.itemsize / SINGLE.itemsize
    return 1e6 * max(n_bytes / BANDWIDTH, a_point * n * n / 2 / (UNITS * CLOCK))


def kernels():
    """Yield the lines of the table of wavefronts and times."""
    measured = Table.read(RESULTS / "h100-kernels.ecsv")
    yield "\n| Length | Lines | Local memory | Roots | " + " | ".join(KERNELS) + " |"
    yield "| --- " * (4 + len(KERNELS)) + "|"
    for n in (256, 1024, 2048, 4096):
        gpu = device(GROUP_KIB)
        old = Tuning(1, 8, group=256).fit(gpu, SINGLE, (n, n))
        new = cut(GROUP_KIB, n, SINGLE)
        sides = {
            "scratch": (in_scratch(n, old.block), old.block, False),
            "registers": (in_registers(n, new, SINGLE), new.block, True),
        }
        row = measured[(measured["size"] == n) & (measured["cut"] == "lnocl")][0]
        for side, (counts, block, held) in sides.items():
            local, roots = (count / (n * block) for count in counts)
            times = [microseconds(kernel, n, local + roots, held) for kernel in KERNELS]
            if not held:
                times = [
                    f"{t:.0f} ({row[each]:.0f})" for t, each in zip(times, KERNELS, strict=True)
                ]
            else:
                times = [f"{t:.0f}" for t in times]
            yield f"| {n} | {side} | {local:.2f} | {roots:.2f} | " + " | ".join(times) + " |"


def iterations():
    """Yield the lines of the table of iterations."""
    yield "\n| Images | Precision | Iteration (us) |"
    yield "| --- | --- | --- |"
    for skies, n, name, dtype in (
        (1000, 64, "single", SINGLE),
        (1, 1024, "single", SINGLE),
        (1, 1024, "double", DOUBLE),
        (1, 2048, "single", SINGLE),
        (1, 4096, "single", SINGLE),
    ):
        own = cut(GROUP_KIB, n, dtype)
        waves = sum(in_registers(n, own, dtype)) / (n * own.block)
        time = skies * sum(microseconds(kernel, n, waves, True, dtype) for kernel in KERNELS)
        yield f"| {skies} x {P} x {n} x {n} | {name} | {time:.0f} |"


if __name__ == "__main__":
    print("\n".join([*cuts(), *kernels(), *iterations()]))
