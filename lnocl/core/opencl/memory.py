"""Named buffers on a device, and numbers on their way between it and the host."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from copy import copy
from pathlib import Path

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from lnocl.core.opencl.device import describe
from lnocl.core.opencl.launch import READ_WRITE
from lnocl.core.opencl.layout import Layout
from lnocl.core.scene.arrays import Array
from lnocl.errors import LOG, DeviceError, InputError

# Buffers of which each member of a batch has its own.
OWN = {
    *("images", "extended", "spectra", "star_fluxes", "star_corrections", "prior_fluxes"),
    *("star_totals", "star_sums", "ratio_sums", "data_term", "square_sums", "slope", "curvature"),
    *("smooth_sums", "objectives", "steps", "transmitted", "columns", "ratio_columns", "sampled"),
    *("previous", "gradient", "change_sums", "star_steps", "step_sums", "coupling_sums"),
    "scratch",
}
# Bytes of pixels that are converted and copied at once, lest a second array of all is needed.
MAX_COPIED = 16 * 2**20
# And bytes from which on a copy costs more than the call.
MIN_COPIED = 2**20


class Memory:
    """The buffers of a scene on a device, by name.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
        For transfers.
    layout : Layout
        Of arrays of pixels.
    scale : float
        Electrons per unit, for messages.
    n_members : int, optional
        Members of a batch.

    Attributes
    ----------
    buffers : dict of str to pyopencl.Buffer
        All of them.
    n_members : int
        As given.

    Notes
    -----
    Each member has its own part of some buffers (`OWN`), one behind the other. This is the memory
    of the first, `of` that of another: its verbs move that part, or what all members share.
    """

    def __init__(
        self, queue: cl.CommandQueue, layout: Layout, scale: float, n_members: int = 1
    ) -> None:
        self._queue, self._layout, self._scale = queue, layout, scale
        self.n_members, self._member = n_members, 0
        self.buffers: dict[str, cl.Buffer] = {}
        self._uploads: dict[tuple[int, str], cl.Event] = {}

    def of(self, member: int) -> Memory:
        """Return the memory of another member of the batch."""
        other = copy(self)
        other._member = member
        return other

    def allocate(self, **sizes: int) -> None:
        """Make buffers of so many bytes a member, in the place of those with the same names."""
        for name, size in of_all(sizes, self.n_members).items():
            self.buffers.pop(name, None)  # first, lest the memory of both is taken
            self.buffers[name] = cl.Buffer(self._queue.context, READ_WRITE, size)

    def _part(self, name: str) -> tuple[int, int]:
        """Return where in a buffer the member's part begins, and the bytes it has."""
        n, size = self.n_members if name in OWN else 1, int(self.buffers[name].size)
        return self._member % n * (size // n), size // n

    def copy(self, one: str, other: str) -> None:
        """Copy a buffer, or its first numbers, to another, all of which is written."""
        given, to, copy = self.buffers[one], self.buffers[other], cl.enqueue_copy
        (begin, _), (at, size) = self._part(one), self._part(other)
        copy(self._queue, to, given, byte_count=size, src_offset=begin, dst_offset=at)

    def clear(self, name: str, of_all: bool = False) -> None:
        """Set all of a buffer to 0, that of all members too if wanted."""
        zero, buffer = np.zeros(1, self._layout.dtype), self.buffers[name]
        part = (0, buffer.size) if of_all else self._part(name)
        cl.enqueue_fill_buffer(self._queue, buffer, zero, *part)

    def upload(self, name: str, values: NDArray) -> Array:
        """Copy numbers to a buffer, not waiting for the device; return them in its precision."""
        rounded = self._rounded(name, values)
        if rounded.size:
            # An event that is let go waits for its copy.
            to, (at, _), copy = self.buffers[name], self._part(name), cl.enqueue_copy
            copied = copy(self._queue, to, rounded, dst_offset=at, is_blocking=False)
            self._uploads[self._member, name] = copied
        return rounded.astype(np.float64)

    def upload_points(self, name: str, values: NDArray) -> None:
        """Copy values to a buffer, each as a point that holds for all pixels."""
        self.upload(name, np.repeat(values, self.count(name) // len(values)))

    def upload_pixels(self, name: str, arrays: Iterable[NDArray]) -> None:
        """Copy arrays of pixels, or of some blocks' rows, to a buffer, one behind the other."""
        offset, _ = self._part(name)
        for pixels in self._copied_at_once(arrays):
            packed = self._layout.pack_pixels(self._rounded(name, pixels))
            cl.enqueue_copy(self._queue, self.buffers[name], packed, dst_offset=offset)
            offset += packed.nbytes

    def _copied_at_once(self, arrays: Iterable[NDArray]) -> Iterator[NDArray]:
        """Yield several small arrays together, and large ones in parts of some rows."""
        small = list[NDArray]()
        for array in arrays:
            small.append(array)
            if array.nbytes * len(small) < MIN_COPIED:
                continue
            if len(small) > 1:
                yield np.array(small)
            else:
                slices = self._layout.row_slices(len(array), MAX_COPIED)
                yield from (array[rows] for rows in slices)
            small.clear()
        if small:
            yield np.array(small)

    def download(self, name: str, count: int) -> Array:
        """Return the first numbers in a buffer, as float64."""
        return self.download_raw(name, count).astype(np.float64)

    def download_raw(self, name: str, count: int | None = None) -> NDArray:
        """Return a buffer as it lies on the device, all of it or the first numbers."""
        values = np.empty(self.count(name) if count is None else count, self._layout.dtype)
        if values.size:
            cl.enqueue_copy(self._queue, values, self.buffers[name], src_offset=self._part(name)[0])
        return values

    def upload_raw(self, name: str, values: NDArray) -> None:
        """Copy what `download_raw` returned, or the first of it, back."""
        if values.size:
            offset, _ = self._part(name)
            cl.enqueue_copy(self._queue, self.buffers[name], values, dst_offset=offset)

    def count(self, name: str) -> int:
        """Return how many numbers a buffer holds."""
        return self._part(name)[1] // self._layout.dtype.itemsize

    def _rounded(self, name: str, values: NDArray | float) -> NDArray:
        """Return values in the precision of the device; refuse values too large for it."""
        dtype = self._layout.dtype
        with np.errstate(over="ignore"):
            rounded = np.asarray(values).astype(dtype)
        if rounded.size and not np.isfinite((rounded.min(), rounded.max())).all():
            raise InputError(
                f"{name.replace('_', ' ')} as large as {np.abs(values).max() * self._scale:g} "
                f"cannot be held in {dtype}: scale the scene, or take `precision` double"
            )
        return rounded


def of_all(sizes: Mapping[str, int], n_members: int) -> dict[str, int]:
    """Return the bytes of buffers for all members of a batch, given those of one."""
    return {name: size * (n_members if name in OWN else 1) for name, size in sizes.items()}


def refuse_if_too_large(device: cl.Device, sizes: Mapping[str, int], count: int) -> int:
    """Return the bytes of all buffers together.

    Parameters
    ----------
    device : pyopencl.Device
        The device.
    sizes : mapping of str to int
        Bytes of each buffer.
    count : int
        How many such sets of buffers it is to hold.

    Raises
    ------
    DeviceError
        The device has too little memory, or gives too little at once for the largest buffer.
    """
    total = sum(sizes.values())
    largest = max(sizes, key=lambda name: sizes[name])
    if count * total > device.global_mem_size or sizes[largest] > device.max_mem_alloc_size:
        raise DeviceError(
            f"the scene needs {count * total / 2**20:.0f} MiB, {sizes[largest] / 2**20:.0f} MiB of "
            f"it for {largest}; {describe(device)} has {device.global_mem_size / 2**20:.0f} MiB "
            f"and gives {device.max_mem_alloc_size / 2**20:.0f} MiB at once: take fewer or "
            "smaller images, fewer stars, `precision` single, or another `device`"
        )
    return total


def held_bytes() -> tuple[int, int]:
    """Return the bytes of memory that this process holds, and the most that it has held.

    Where only the second is known they are the same; where neither is, they are 0.
    """
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").split("\n")
        held, most = (
            1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))
            for name in ("VmRSS:", "VmHWM:")
        )
        return held, most
    try:
        import resource
    except ImportError:  # on Windows
        return 0, 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on a Mac
    return most, most


def announce(device: cl.Device, device_bytes: int, host_bytes: int, tuned: str) -> None:
    """Log what a scene takes on a device and on the host, and the tuning of the device.

    These figures depend on the process, so that the file of a result leaves them out.
    """
    LOG.debug(
        "%s: the scene takes %.1f MiB there, and up to %.0f MiB of the host's memory; %s",
        describe(device),
        device_bytes / 2**20,
        host_bytes / 2**20,
        tuned,
        extra={"is_passing": True},
    )
