"""The cut of the kernels to a device: what was measured there, else what is safe anywhere."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pyopencl as cl

from lnocl.core.opencl import kernel_cache
from lnocl.core.opencl.device import describe
from lnocl.core.scene.line_weights import TAPS
from lnocl.errors import FileError

# Bytes that a device reads or writes at once.
SECTOR = 32
# Work-items of a group of a GPU, by default, and the most: more leave each too few registers.
GROUP, MAX_GROUP = 256, 512
# Points of a line that a work-item of a GPU holds in registers at most, in single precision.
MAX_POINTS = 16


@dataclass(frozen=True)
class Tuning:
    """The cut of the kernels to a device; kernels/precision.cl explains each constant.

    Attributes
    ----------
    lanes, block, group, chunk : int
        Reals in a vector; columns transformed together; work-items that share a block; points
        of a transform that are finished before the next ones.
    padding : int
        Rows of padding behind a block of spectra. They keep neighbouring blocks from falling on
        the same cache sets.
    scratch_is_global : bool
        Whether a block lies in global memory while it is transformed, not in local memory.
    scratch_blocks : int
        Blocks that the scratch has room for: 2 where local memory is the cache of a CPU; 1 where it
        is scarce, and products with OTFs wait in global memory.
    points : int
        Points of a line that a work-item holds in registers at most while it is transformed; 0
        where lines lie in the scratch.
    """

    lanes: int
    block: int
    group: int = 1
    chunk: int = 128
    padding: int = 16
    scratch_is_global: bool = False
    scratch_blocks: int = 1
    points: int = 0

    def fit(
        self,
        device: cl.Device,
        dtype: np.dtype,
        grid: tuple[int, int],
        oversample: int = 1,
        has_turns: bool = False,
    ) -> Tuning:
        """Return the tuning for a grid.

        Blocks are no larger than those of this tuning, and none is filled in part. They are the
        largest with which a device is busy: two groups fit in the local memory that one may have,
        and each compute unit has a block of columns. Else they are the smallest of which a tile of
        spectra fills a sector of memory; if that does not fit the smallest. If that does not fit
        either lines lie in the scratch, and then the scratch in global memory. In the scratch lie
        lines of images that are turned, too.
        """
        cuts = [] if self.points and has_turns else self._cuts(dtype, grid, oversample)
        sizes = {cut: cut.local_bytes(grid, oversample, dtype, has_turns) for cut in cuts}
        full = [cut for cut in cuts if 4 * cut.block**2 * dtype.itemsize >= SECTOR] or cuts[:1]
        busy = [cut for cut in full if min(grid) // (2 * cut.block) >= device.max_compute_units]
        if not self.scratch_is_global:
            fitting = [cut for cut in busy if 2 * sizes[cut] <= device.local_mem_size]
            for cut in (*fitting[:1], *full[-1:], *cuts[-1:]):
                if sizes[cut] <= device.local_mem_size:
                    return cut
        if self.points:
            in_scratch = replace(self, points=0, group=min(self.group, GROUP))
            return in_scratch.fit(device, dtype, grid, oversample, has_turns)
        return replace((busy or full)[0], scratch_is_global=True)

    def _cuts(self, dtype: np.dtype, grid: tuple[int, int], oversample: int) -> list[Tuning]:
        """Return the cuts for each size of a block, the largest first."""
        most = min(n // odd_part(n) for n in grid) // (2 * oversample)
        lanes = min(self.lanes, most)
        blocks = _powers_of_2_down(min(self.block, most), lanes)
        if self.points:  # of which an item has whole tiles
            items = line_items(grid, oversample, self.points * 4 // dtype.itemsize)
            fitting = (each for each in blocks if 2 * each * items * odd_part(grid[1]) <= grid[1])
            groups = {block: items * block for block in fitting if items}
        else:  # no more than a pass has butterflies of radix 8
            butterflies = min(grid) // (8 * oversample)
            groups = {
                each: min(self.group, _power_of_2_up_to(max(1, butterflies * each // lanes)))
                for each in blocks
            }
        return [
            replace(self, lanes=lanes, block=block, group=group)
            for block, group in groups.items()
            if group <= self.group
        ]

    def local_bytes(
        self, grid: tuple[int, int], oversample: int, dtype: np.dtype, has_turns: bool = False
    ) -> int:
        """Return the bytes of local memory of a work-group: its block, and a sum for each item."""
        sums = 2 * self.group if self.group > 1 else 0
        return (self.scratch_reals(grid, oversample, has_turns) + sums) * dtype.itemsize

    def scratch_reals(self, grid: tuple[int, int], oversample: int, has_turns: bool = False) -> int:
        """Return the reals that a work-group's scratch takes: its block, or what it exchanges."""
        if self.points:
            return max(max(grid) * 17 // 16 * self.block, 2 * grid[0])
        ny, nx = grid
        held = ny // oversample if self.scratch_blocks > 1 else 0
        rows = nx + (nx // oversample if oversample > 1 else 0)
        return 2 * self.block * max(2 * (nx + TAPS) if has_turns else rows, ny + held)


def line_items(grid: tuple[int, int], oversample: int, most: int) -> int:
    """Return the work-items that hold a line in registers: those with the fewest passes.

    It is a power of two, and the largest of those with as few passes. It is 0 where no number
    leaves each item at most so many points, and no more passes than in the scratch.
    """
    lengths = [each for n in grid for each in (n, n // oversample)]
    found = list[tuple[int, int]]()
    for items in _powers_of_2_down(min(n // odd_part(n) for n in lengths) // 2, max(2, oversample)):
        passes = [_passes(n, n // items, n // items // odd_part(n)) for n in lengths]
        if max(lengths) <= most * items and all(
            few <= _passes(n, odd_part(n), 8) for n, few in zip(lengths, passes, strict=True)
        ):
            found.append((sum(passes), -items))
    return -min(found, default=(0, 0))[1]


def _passes(n: int, outer: int, radix: int) -> int:
    """Return the passes of a transform, the outer one and others, of these radices."""
    return math.ceil(math.log(n // outer, radix) - 1e-9) + (outer > 1)


def odd_part(n: int) -> int:
    """Return the largest odd factor of a length."""
    return n // (n & -n)


def tune(
    device: cl.Device,
    dtype: np.dtype,
    grid: tuple[int, int],
    oversample: int = 1,
    has_turns: bool = False,
) -> Tuning:
    """Return the tuning of a device for a grid: what was measured there, else the default."""
    return chosen(device, dtype).fit(device, dtype, grid, oversample, has_turns)


def chosen(device: cl.Device, dtype: np.dtype) -> Tuning:
    """Return the tuning of a device for large grids."""
    return measured(device, dtype) or candidates(device, dtype)[0]


def candidates(device: cl.Device, dtype: np.dtype) -> list[Tuning]:
    """Return the tunings that may be fastest on a device, first the one that is safe anywhere.

    A CPU takes a block as one vector in one work-item, of 256 or 512 bits; other devices take
    scalars in a group of work-items.
    """
    if device.type & cl.device_type.CPU:
        lanes = (n_bytes // dtype.itemsize for n_bytes in (32, 64))
        return [Tuning(n, n, scratch_blocks=2) for n in lanes]
    most = min(MAX_GROUP, _power_of_2_up_to(device.max_work_group_size))
    groups = dict.fromkeys(min(n, most) for n in (GROUP, MAX_GROUP, 128, 64))
    in_registers = (Tuning(1, 8, most, points=n) for n in (MAX_POINTS, MAX_POINTS // 2))
    return [*in_registers, *(Tuning(1, block, group) for block in (8, 2) for group in groups)]


def measured(device: cl.Device, dtype: np.dtype) -> Tuning | None:
    """Return the fastest of `candidates` as it was measured, or None where it was not.

    Warns
    -----
    LnoclWarning
        The file of what was measured is damaged.
    """
    words = json.loads(kernel_cache.read(_file(device)) or b"{}").get(dtype.name)
    return next((each for each in candidates(device, dtype) if asdict(each) == words), None)


def store(device: cl.Device, fastest: Mapping[np.dtype, Tuning]) -> Path:
    """Store the fastest tunings of a device, by precision; return the file.

    Raises
    ------
    FileError
        It cannot be written.
    """
    file, known = _file(device), {dtype.name: asdict(each) for dtype, each in fastest.items()}
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    kernel_cache.write(file, content := json.dumps(known).encode("ascii"))
    if kernel_cache.read(file) != content:
        raise FileError(
            f"the tunings cannot be written to {file}; set {kernel_cache.VARIABLE} to a folder "
            "that can be written to, for this command and later ones"
        )
    return file


def _file(device: cl.Device) -> Path:
    return kernel_cache.file_of(describe(device)).with_suffix(".tunings")


def in_words(tuning: Tuning, dtype: np.dtype) -> str:
    """Return the width of the vectors, the size of the work-groups or their points in words."""
    if tuning.points:
        return f"{tuning.points * 4 // dtype.itemsize} points a work-item in registers at most"
    if tuning.group > 1 or tuning.lanes == 1:
        return f"work-groups of {tuning.group} and blocks of {tuning.block}"
    return f"vectors of {8 * dtype.itemsize * tuning.lanes} bits"


def describe_tuning(device: cl.Device, dtype: np.dtype, used: Tuning | None = None) -> str:
    """Return the tuning that is used, or that of a device, and whether the latter was measured."""
    words = in_words(used or chosen(device, dtype), dtype)
    if measured(device, dtype):
        return f"{words}, as measured"
    return f"{words}; lnocl devices --tune measures whether others are faster"


def _power_of_2_up_to(n: int) -> int:
    return 1 << (n.bit_length() - 1)


def _powers_of_2_down(most: int, least: int) -> list[int]:
    return [1 << k for k in range(most.bit_length() - 1, least.bit_length() - 2, -1)]
