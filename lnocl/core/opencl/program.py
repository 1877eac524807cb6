"""Building the kernels for a device and a scene, with the tuning that the device calls for."""

from __future__ import annotations

import math
import mmap
import os
import weakref
from collections import defaultdict
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import cast

import numpy as np
import pyopencl as cl

from lnocl.core.opencl import ahead, kernel_cache, trial, unknown_cpu
from lnocl.core.opencl.device import describe, has_double
from lnocl.core.opencl.faults import after_fault, build_failure
from lnocl.core.opencl.sources import LAST, arguments, beside, source
from lnocl.core.opencl.tuning import Tuning, odd_part, tune
from lnocl.core.scene.line_weights import TAPS
from lnocl.core.scene.rotation import PHASE_ROWS
from lnocl.core.scene.scene import MIN_MODEL
from lnocl.errors import DeviceError
from lnocl.process import LOCK, ignored_warnings

# Groups a compute unit that have a scratch in global memory, where groups have several work-items.
GROUPS_A_UNIT = 4

# What kernels are told of a tuning.
TUNED = "lanes", "block", "group", "chunk", "scratch_is_global", "scratch_blocks"
# Pairs of rows in a piece of a column, where an image is sheared.
COLUMN_PAIRS = 64

# Built programs that a process holds, the last used; each takes some MiB.
MAX_PROGRAMS = 48

# Bytes of addresses with which PoCL builds and launches kernels for sure. With too few it fails
# while it holds its locks, and waits for them as the process ends.
ROOM = 512 * 2**20


def radices(n: int, items: int = 0) -> tuple[int, int, int]:
    """Return the odd factor of n points, and the radices of the outer and the last pass.

    Those between are 8. Where so many items hold a line in registers the outer pass is of all
    points of one, and those between are of that radix but for the odd factor.
    """
    odd = odd_part(n)
    outer = odd if odd > 1 else 4 if n > 2 and n.bit_length() % 3 == 2 else min(8, n)
    if items:
        outer = n // items
    last, radix = n // outer, outer // odd if items else 8
    while last > radix:
        last //= radix
    return odd, outer, last


class Program:
    """The kernels for one device, grid and scene.

    A process builds each program once; every instance has kernels of its own, which hold their
    own arguments.

    Parameters
    ----------
    context : pyopencl.Context
        Of one device.
    grid : tuple of int
        Shape (Ny, Nx) of the sky, of `lnocl.core.scene.grid.LENGTHS`.
    dtype : numpy.dtype
        float32 or float64.
    tuning : Tuning, optional
        By default that of `lnocl.core.opencl.tuning.tune`.
    oversample : int, optional
        Pixels of the sky to one of the images, along each axis: 1, 2 or 4.
    has_turns : bool, optional
        Whether images are turned against the sky.

    Attributes
    ----------
    options : list of str
        The build options.
    arguments : dict of str to dict of str to str
        The types of each kernel's arguments by their names, in the order of its declaration.
    image_grid : tuple of int
        Shape of the images' grid.
    radices : dict of str to tuple of int
        Those of each transform: "row", "column", "image_row" and "image_column".
    rows : int
        Rows that a block of spectra takes in memory.
    is_stored : bool
        Whether a process has compiled it before.
    max_groups : int
        Work-groups that have a scratch in global memory; 0 where it is local.

    Raises
    ------
    DeviceError
        The device has no double precision and float64 is asked of it, or its compiler fails.
    """

    def __init__(
        self,
        context: cl.Context,
        grid: tuple[int, int],
        dtype: np.dtype,
        tuning: Tuning | None = None,
        oversample: int = 1,
        has_turns: bool = False,
    ) -> None:
        device = context.devices[0]
        self.context, self.grid, self.dtype = context, grid, dtype
        if dtype == np.float64 and not has_double(device):
            raise DeviceError(
                f"{describe(device)} has no double precision; take `precision` single, or another "
                "device"
            )
        self.tuning = tuning or tune(device, dtype, grid, oversample, has_turns)
        self.has_turns, self.phase_rows = has_turns, math.gcd(grid[0], PHASE_ROWS)
        self.oversample = oversample
        self.image_grid = grid[0] // oversample, grid[1] // oversample
        self.rows = grid[0] + self.tuning.padding
        a_unit = GROUPS_A_UNIT if self.tuning.group > 1 else 1
        self.max_groups = a_unit * device.max_compute_units * self.tuning.scratch_is_global
        lengths = {"row": grid[1], "column": grid[0]}
        lengths |= {"image_row": self.image_grid[1], "image_column": self.image_grid[0]}
        items = self.tuning.group // self.tuning.block if self.tuning.points else 0
        self.radices = {name: radices(n, items) for name, n in lengths.items()}
        constants = {
            "REAL": "double" if dtype == np.float64 else "float",
            "BITS": "long" if dtype == np.float64 else "int",
            **{name.upper(): int(getattr(self.tuning, name)) for name in TUNED},
            **{
                f"{name.upper()}_{part}": value
                for name, each in self.radices.items()
                for part, value in zip(("ODD", "OUTER", "LAST"), each, strict=True)
            },
            "IN_REGISTERS": int(self.tuning.points > 0),
            "HAS_BUILTIN_PREFETCH": int(_has_builtin_prefetch(device)),
            "NX": grid[1],
            "NY": grid[0],
            "OVERSAMPLE": oversample,
            "ROWS": self.rows,
            "HAS_TURNS": int(has_turns),
            "TURN_TAPS": TAPS,
            "PHASE_ROWS": self.phase_rows,
            "COLUMN_PAIRS": self.column_pairs,
            "MIN_MODEL": MIN_MODEL,
        }
        definitions = [f"-D{name}={value}" for name, value in constants.items()]
        self.options = ["-cl-std=CL1.2", "-w", *definitions]
        self.arguments = arguments(source())
        self._kernels: dict[str, cl.Kernel] = {}
        last = _file(context, beside(LAST[0], source()), self.options)
        self.is_stored = os.path.exists(last)  # a folder may not be looked into
        with LOCK:
            ahead.begin(last, self)

    def kernel(self, name: str) -> cl.Kernel:
        """Return a kernel, always the same one."""
        if name not in self._kernels:
            with LOCK:
                built = _build(self.context, beside(name, source()), tuple(self.options))
            self._kernels[name] = built.kernel(name)
            weakref.finalize(self, built.take_back, name, self._kernels[name])
        return self._kernels[name]

    @property
    def row_blocks(self) -> int:
        """Blocks of row pairs in an array of pixels of the sky."""
        return self.grid[0] // 2 // self.tuning.block

    @property
    def image_row_blocks(self) -> int:
        """Blocks of row pairs in an image."""
        return self.image_grid[0] // 2 // self.tuning.block

    @property
    def column_pairs(self) -> int:
        """Pairs of rows in a piece of a column: see kernels/turn.cl."""
        return math.gcd(self.grid[0] // 2, COLUMN_PAIRS)

    @property
    def columns_size(self) -> int:
        """Reals that the columns of an image take, which kernels/turn.cl shears."""
        pairs, (ny, nx), block = self.column_pairs, self.grid, self.tuning.block
        copied = -(-(self.tuning.lanes + TAPS // 2) // block) * block
        return ny // pairs * nx * (pairs + copied)

    @property
    def scratch_bytes(self) -> int:
        """Bytes that a work-group needs for its block."""
        reals = self.tuning.scratch_reals(self.grid, self.oversample, self.has_turns)
        return reals * self.dtype.itemsize


def _has_builtin_prefetch(device: cl.Device) -> bool:
    """Return whether a device's compiler is known to take clang's builtin."""
    return device.platform.name == unknown_cpu.POCL and bool(device.type & cl.device_type.CPU)


class _Built:
    """A built program, and the file that later processes have it from."""

    def __init__(
        self, context: cl.Context, text: str, options: tuple[str, ...], file: Path
    ) -> None:
        self._file, self._process = file, os.getpid()
        self._content = kernel_cache.read(file)
        self._is_pocl = context.devices[0].platform.name == unknown_cpu.POCL
        if self._is_pocl:
            self._folders = kernel_cache.unpack(self._content)
            before = kernel_cache.folders()
            self.program = _compile(context, text, options)
            self._folders |= kernel_cache.folders() - before
        else:
            self.program = self._load(context, options) or _compile(context, text, options)
        self.used, self._looked_at = set[str](), set[str]()
        self._idle: dict[str, list[cl.Kernel]] = defaultdict(list)

    def kernel(self, name: str) -> cl.Kernel:
        """Return a kernel that nothing else launches, an idle one where there is one.

        PyOpenCL takes half a millisecond to make one.
        """
        self.used.add(name)
        with LOCK:
            idle = self._idle[name]
            return idle.pop() if idle else cl.Kernel(self.program, name)

    def take_back(self, name: str, kernel: cl.Kernel) -> None:
        """Have a kernel that nothing launches any more for the next program."""
        self._idle[name].append(kernel)
        self.store()

    def _load(self, context: cl.Context, options: tuple[str, ...]) -> cl.Program | None:
        if not self._content:
            return None
        try:
            program = cl.Program(context, context.devices, [self._content])
            return _quietly_built(program, options)
        except cl.Error:
            kernel_cache.discard(self._file)
            return None

    def store(self) -> None:
        """Store the program, if there is more of it than before.

        PoCL compiles each kernel as it is first launched. Its binaries are not asked for: it would
        compile all kernels once more, for groups of any size.
        """
        if self.used <= self._looked_at or os.getpid() != self._process:
            return
        with LOCK:
            self._looked_at |= self.used
            if self._is_pocl:
                try:
                    content = kernel_cache.pack(self._folders)
                except OSError:  # files there are gone
                    return
            else:
                (content,) = cast(list[bytes], self.program.get_info(cl.program_info.BINARIES))
            if content != self._content and kernel_cache.can_write(self._file.parent):
                kernel_cache.write(self._file, content)
                self._content = content


def _file(context: cl.Context, text: str, options: Iterable[str]) -> Path:
    """Return the file that holds a program when it is compiled."""
    return kernel_cache.file_of("\n".join([describe(context.devices[0]), *options, text]))


@lru_cache(MAX_PROGRAMS)
def _build(context: cl.Context, text: str, options: tuple[str, ...]) -> _Built:
    """Return a program that the process has, that a file holds, or that is compiled now."""
    device = context.devices[0]
    _need_room(device)
    unknown_cpu.name_level(device)
    if device.platform.name != unknown_cpu.POCL:
        trial.check(device)
    file = _file(context, text, options)
    ahead.wait(file)
    built = _Built(context, text, options, file)
    trial.check(device)  # PoCL may end the process as it links kernels, no sooner
    return built


after_fault(_build.cache_clear)  # the context may be lost


def _need_room(device: cl.Device) -> None:
    """Refuse to compile with PoCL where addresses are too few, or files that may be open.

    Raises
    ------
    DeviceError
        They are.
    """
    if device.platform.name != unknown_cpu.POCL or not hasattr(mmap, "MAP_PRIVATE"):
        return
    trial.need_files()
    try:
        mmap.mmap(-1, ROOM, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS).close()
    except OSError as error:
        raise DeviceError(
            f"PoCL needs {ROOM // 2**20} MiB of addresses more than this process may have: raise "
            "the limit of memory (ulimit -v), or take `engine` numpy"
        ) from error


def _compile(context: cl.Context, text: str, options: tuple[str, ...]) -> cl.Program:
    try:
        return _quietly_built(cl.Program(context, text), options)
    except cl.RuntimeError as error:
        raise build_failure(describe(context.devices[0]), error) from error


def _quietly_built(program: cl.Program, options: tuple[str, ...]) -> cl.Program:
    with ignored_warnings():
        program.int_ptr  # noqa: B018  makes PyOpenCL build without its own cache, and warn of it
        return program.build(list(options))
