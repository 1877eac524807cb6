"""Launching kernels: arguments bound by name, the roots of unity, the scratch."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from lnocl.core.opencl.layout import reversed_order
from lnocl.core.opencl.program import Program

# Lines that a work-group of sample_lines makes, as in kernels/turn.cl.
RUN = 16
# Stars that a work-group of collect_sums sums up one after the other.
STARS_A_GROUP = 16
# Types of arguments that are whole numbers, by words for them in OpenCL.
WHOLE = {"int": np.int32, "ulong": np.uint64}
READ_WRITE = cl.mem_flags.READ_WRITE


def roots(n: int, odd: int, outer: int, last: int) -> NDArray[np.float64]:
    """Return the roots of unity of a transform of n points, as kernels/scratch.cl has them.

    First ``exp(2 pi i k / odd)`` for all k, where `odd` is more than 1. Then the twiddles: a pass
    over subtransforms of length L with radix R has, for j < L / R and 0 < q < R, the root
    ``exp(-2 pi i j reversed(q) / L)``. The passes have radix `outer`, then 8; that of radix `last`
    has none. Each root is a real and an imaginary part.
    """
    length, radix = n, outer
    tables = [_roots(-np.arange(odd), odd)] if odd > 1 else []
    while length == n or length > last:
        j, q = np.arange(length // radix)[:, None], reversed_order(radix)[None, 1:]
        tables.append(_roots(j * q, length))
        length, radix = length // radix, 8
    return np.concatenate(tables).astype(np.float64)


def roots_in_registers(n: int, odd: int, outer: int, last: int) -> NDArray[np.float64]:
    """Return the roots of unity of a transform of n points, as kernels/registers.cl has them.

    As `roots` has them, but those of an odd factor in front, by q, and then for each pass of radix
    `outer` / `odd`, but the last, those of the bits of q alone, by bit.
    """
    tables = [_roots(-np.arange(odd), odd)] if odd > 1 else []
    tables += [_roots(np.arange(n // odd) * q, n) for q in range(1, odd)]
    length, radix = n // odd, outer // odd
    while length > last:
        j, bits = np.arange(length // radix), 1 << np.arange(radix.bit_length() - 1)
        tables.append(_roots(bits[:, None] * j, length))
        length //= radix
    return np.concatenate(tables).astype(np.float64)


def _roots(k: NDArray[np.int64], n: int) -> NDArray[np.longdouble]:
    # In long double, where there is one: a rounded angle would cost a digit in double.
    angle = -8.0 * np.arctan(np.longdouble(1.0)) * k / n
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).ravel()


def _all_roots(program: Program) -> dict[str, NDArray[np.float64]]:
    """Return the roots of unity that kernels take, by their names as arguments.

    Those of images are left out where their grid is the sky's.
    """
    lengths = (*program.grid[::-1], *program.image_grid[::-1])
    made = roots_in_registers if program.tuning.points else roots
    tables = {
        f"{name}_roots": made(n, *radices)
        for (name, radices), n in zip(program.radices.items(), lengths, strict=True)
    }
    return tables if program.oversample > 1 else dict(islice(tables.items(), 2))


class Launch:
    """A kernel bound to its arguments, which each call launches; it costs the host little.

    A kernel has one set of arguments at a time: binding it anew changes earlier launches of it.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
        Where it is launched.
    program : Program
        Which has the kernel.
    name : str
        The kernel's.
    arguments : mapping of str
        Buffers, local memory and numbers by the names that the kernel declares; others are
        ignored.
    groups : int
        Work-groups of each member.
    n_members : int
        Members of the batch.
    """

    def __init__(
        self,
        queue: cl.CommandQueue,
        program: Program,
        name: str,
        arguments: Mapping[str, Any],
        groups: int,
        n_members: int,
    ) -> None:
        self._queue, self._program, self._name = queue, program, name
        self._types, self._real = program.arguments[name], program.dtype.type
        self._index = {each: index for index, each in enumerate(self._types)}
        group = program.tuning.group
        self._global_size, self._local_size = (groups * group, n_members), (group, 1)
        self._new: dict[int, Any] = {}
        self.set(**{each: arguments[each] for each in self._types})

    def set(self, **arguments: Any) -> None:
        """Give some arguments other values."""
        for name, value in arguments.items():
            kind = self._types[name]
            if "*" not in kind:
                own = next((each for word, each in WHOLE.items() if word in kind), self._real)
                value = own(value)
            self._new[self._index[name]] = value

    def __call__(self) -> cl.Event:
        """Enqueue the kernel, which is made as it is first launched: see `ahead`."""
        kernel = self._program.kernel(self._name)
        while self._new:
            # Not set_args, which writes Python for each kernel and stores it in a cache on disk.
            kernel.set_arg(*self._new.popitem())
        return cl.enqueue_nd_range_kernel(self._queue, kernel, self._global_size, self._local_size)


class Launcher:
    """The kernels of a program with a queue, and the arguments that no scene changes.

    Parameters
    ----------
    program : Program
        Whose kernels are launched.
    n_members : int, optional
        Members of a batch, for all of which each launch is.

    Attributes
    ----------
    queue : pyopencl.CommandQueue
        In order.
    own : dict of str
        The roots of unity and the scratch, by their names as arguments.
    """

    def __init__(self, program: Program, n_members: int = 1) -> None:
        context = program.context
        self.program, self._n_members = program, n_members
        self.queue = cl.CommandQueue(context)
        constant = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        self.own: dict[str, Any] = {
            name: cl.Buffer(context, constant, hostbuf=table.astype(program.dtype))
            for name, table in _all_roots(program).items()
        }
        for axis in ("row_roots", "column_roots"):
            self.own.setdefault(f"image_{axis}", self.own[axis])
        self.own["scratch"] = (
            cl.Buffer(context, READ_WRITE, n_members * self.sizes(program)["scratch"])
            if program.tuning.scratch_is_global
            else cl.LocalMemory(program.scratch_bytes)
        )

    @staticmethod
    def sizes(program: Program) -> dict[str, int]:
        """Return the bytes that a launcher takes on the device, the scratch's for a member."""
        n_roots = sum(map(len, _all_roots(program).values()))
        scratch = program.max_groups * program.scratch_bytes
        return {"roots": n_roots * program.dtype.itemsize, "scratch": scratch}

    def bind(self, name: str, arguments: Mapping[str, Any] | None = None, **others: Any) -> Launch:
        """Bind a kernel to arguments by name, some of them in a mapping for several kernels."""
        given = {**self.own, **(arguments or {}), **others}
        blocks = self._blocks(name, given)
        groups = min(blocks, self.program.max_groups or blocks)
        return Launch(self.queue, self.program, name, given, groups, self._n_members)

    def _blocks(self, name: str, arguments: Mapping[str, Any]) -> int:
        """Return the number of work-groups that a kernel has work for."""
        if name == "collect_sums":
            return 1 + int(arguments["n_stars"]) // STARS_A_GROUP
        if name == "follow_stars":
            return 1
        if name == "sample_lines":
            return int(arguments["parts"]) * int(arguments["lines"]) // RUN
        if name == "ratio_sheared":
            return int(arguments["image_blocks"]) * int(arguments["count"])
        if name in ("irfft_sheared", "rfft_sheared"):
            return self.program.row_blocks * int(arguments["count"])
        if name == "ratio_rows":
            return self.program.image_row_blocks * int(arguments["n_images"])
        if name.endswith("_columns"):
            n_own = int(arguments["n_images"]) if arguments.get("has_transmission") else 1
            return n_own * self.program.grid[1] // 2 // self.program.tuning.block
        n_skies = 1 if name in ("transmit_rows", "gather_rows") else int(arguments["n_skies"])
        return n_skies * self.program.row_blocks
