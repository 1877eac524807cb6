"""The cut of the kernels to a device: what was measured there, else what is safe anywhere."""

from __future__ import annotations

import contextlib
import json
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
    """

    lanes: int
    block: int
    group: int = 1
    chunk: int = 128
    padding: int = 16
    scratch_is_global: bool = False
    scratch_blocks: int = 1

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
        spectra fills a sector of memory; if that does not fit the smallest; and if that does not
        fit either they lie in global memory.
        """
        most = min(n // odd_part(n) for n in grid) // (2 * oversample)
        lanes = min(self.lanes, most)
        cuts = [
            replace(self, lanes=lanes, block=block, group=self._group(grid, oversample, block))
            for block in _powers_of_2_down(min(self.block, most), lanes)
        ]
        full = [cut for cut in cuts if 4 * cut.block**2 * dtype.itemsize >= SECTOR] or cuts[:1]
        busy = [cut for cut in full if min(grid) // (2 * cut.block) >= device.max_compute_units]
        if not self.scratch_is_global:
            sizes = {cut: cut.local_bytes(grid, oversample, dtype, has_turns) for cut in cuts}
            fitting = [cut for cut in busy if 2 * sizes[cut] <= device.local_mem_size]
            for cut in (*fitting[:1], full[-1], cuts[-1]):
                if sizes[cut] <= device.local_mem_size:
                    return cut
        return replace((busy or full)[0], scratch_is_global=True)

    def _group(self, grid: tuple[int, int], oversample: int, block: int) -> int:
        """Return the items of a group: no more than a pass has butterflies of radix 8."""
        butterflies = min(grid) // (8 * oversample) * block // min(self.lanes, block)
        return min(self.group, _power_of_2_up_to(max(1, butterflies)))

    def local_bytes(
        self, grid: tuple[int, int], oversample: int, dtype: np.dtype, has_turns: bool = False
    ) -> int:
        """Return the bytes of local memory of a work-group: its block, and a sum for each item."""
        sums = 2 * self.group if self.group > 1 else 0
        points = self.scratch_points(grid, oversample, has_turns)
        return (points * 2 * self.block + sums) * dtype.itemsize

    def scratch_points(
        self, grid: tuple[int, int], oversample: int, has_turns: bool = False
    ) -> int:
        """Return the points of a block that a work-group holds while it transforms."""
        ny, nx = grid
        held = ny // oversample if self.scratch_blocks > 1 else 0
        rows = nx + (nx // oversample if oversample > 1 else 0)
        return max(2 * (nx + TAPS) if has_turns else rows, ny + held)


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
    most = _power_of_2_up_to(device.max_work_group_size)
    groups = dict.fromkeys(min(n, most) for n in (256, 512, 128, 64))
    return [Tuning(1, block, group) for block in (8, 2) for group in groups]


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
    """Return the width of the vectors, or the size of the work-groups, of a tuning."""
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
