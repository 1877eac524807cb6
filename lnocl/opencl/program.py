"""Building the kernels for a device and a scene, with the tuning that the device calls for."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources

import numpy as np
import pyopencl as cl

from lnocl.errors import DeviceError, warn
from lnocl.opencl import kernel_cache
from lnocl.opencl.device import describe, has_double
from lnocl.opencl.faults import build_failure
from lnocl.process import ignored_warnings

# In the order in which they build on each other: the transforms by themselves; the split-gradient
# method; and the scaled gradient projection method.
TRANSFORMS = ("precision.cl", "complex.cl", "fft.cl", "rows.cl", "columns.cl")
SOURCES = (*TRANSFORMS, "convolve.cl", "sums.cl", "ratio.cl", "smooth.cl", "scale.cl")
STEP_SOURCES = (*SOURCES, "step.cl")


@dataclass(frozen=True)
class Tuning:
    """How the kernels are cut to a device; kernels/precision.cl says what each constant is.

    Attributes
    ----------
    lanes, block, group, chunk : int
        Reals in a vector; columns transformed together; work-items that share a block; points
        of a transform finished before the next are begun.
    padding : int
        Rows of padding behind a block of spectra, which keep neighbouring blocks from falling
        on the same cache sets.
    """

    lanes: int
    block: int
    group: int = 1
    chunk: int = 128
    padding: int = 16


def radices(n: int) -> tuple[int, int]:
    """Return the radices of the outer and the last pass of n points; those between are 8."""
    outer = 4 if n > 2 and n.bit_length() % 3 == 2 else min(8, n)
    last = n // outer
    while last > 8:
        last //= 8
    return outer, last


def tune(device: cl.Device, dtype: np.dtype, grid: tuple[int, int]) -> Tuning:
    """Return the tuning for this kind of device.

    A CPU takes a block as one vector in one work-item; other devices take scalars in a group of
    work-items. Small grids have smaller blocks, so that no block is ever filled in part.
    """
    most = min(grid) // 2
    if device.type & cl.device_type.CPU:
        lanes = min(32 // dtype.itemsize, most)  # 256 bits, benchmarks/tune.py
        return Tuning(lanes=lanes, block=lanes)
    group = max(1, min(128, min(grid) // 8, _power_of_2_up_to(device.max_work_group_size)))
    return Tuning(lanes=1, block=min(8, most), group=group)


def _power_of_2_up_to(n: int) -> int:
    return 1 << (n.bit_length() - 1)


class Program:
    """The kernels built for one device, grid and scene; each is fetched once.

    Parameters
    ----------
    context : pyopencl.Context
        Of one device.
    grid : tuple of int
        Shape (Ny, Nx), powers of two from 2 to 8192.
    dtype : numpy.dtype
        float32 or float64.
    tuning : Tuning, optional
        By default that of `tune`.
    sources : tuple of str, optional
        Files of kernels to build, `SOURCES`, `TRANSFORMS` or `STEP_SOURCES`.
    n_images, n_stars : int, optional
        What the scene has.
    has_mu, has_smoothing, has_weights, has_background_map, has_exposure_map : bool, optional
        What the scene has.
    least_model : float, optional
        The division guard.

    Attributes
    ----------
    kernels : dict of str to pyopencl.Kernel
        Every kernel of the program by name.
    options : list of str
        The build options.
    row_radices, column_radices : tuple of int
        Radices of the outer and the last pass.
    rows : int
        Rows that a block of spectra takes in memory.
    scratch_points : int
        Points of a block that a work-group keeps while it transforms.
    scratch_is_global : bool
        Whether a block is too large for the device's local memory.
    most_groups : int
        Work-groups that have a scratch in global memory; 0 where it is local.

    Raises
    ------
    DeviceError
        Where the device has no double precision and float64 is asked of it, or where the
        device's compiler fails.
    """

    def __init__(
        self,
        context: cl.Context,
        grid: tuple[int, int],
        dtype: np.dtype,
        tuning: Tuning | None = None,
        sources: tuple[str, ...] = SOURCES,
        *,
        n_images: int = 1,
        n_stars: int = 0,
        has_mu: bool = False,
        has_smoothing: bool = False,
        has_weights: bool = False,
        has_background_map: bool = False,
        has_exposure_map: bool = False,
        least_model: float = 0.0,
    ) -> None:
        device = context.devices[0]
        self.context, self.grid, self.dtype = context, grid, dtype
        self.n_images, self.n_stars = n_images, n_stars
        if dtype == np.float64 and not has_double(device):
            raise DeviceError(
                f"{describe(device)} has no double precision; take precision single, or another "
                "device"
            )
        self.tuning = tuning or tune(device, dtype, grid)
        self.rows = grid[0] + self.tuning.padding
        self.scratch_points = max(grid[1], 2 * grid[0])
        self.scratch_is_global = self.scratch_bytes > device.local_mem_size
        self.most_groups = device.max_compute_units if self.scratch_is_global else 0
        self.row_radices = radices(grid[1])
        self.column_radices = radices(grid[0])
        constants = {
            "REAL": "double" if dtype == np.float64 else "float",
            "BITS": "long" if dtype == np.float64 else "int",
            "LANES": self.tuning.lanes,
            "BLOCK": self.tuning.block,
            "GROUP": self.tuning.group,
            "ROW_OUTER": self.row_radices[0],
            "ROW_LAST": self.row_radices[1],
            "COLUMN_OUTER": self.column_radices[0],
            "COLUMN_LAST": self.column_radices[1],
            "CHUNK": self.tuning.chunk,
            "SCRATCH_IS_GLOBAL": int(self.scratch_is_global),
            "NX": grid[1],
            "NY": grid[0],
            "ROWS": self.rows,
            "N_IMAGES": n_images,
            "N_STARS": n_stars,
            "HAS_MU": int(has_mu),
            "HAS_SMOOTHING": int(has_smoothing),
            "HAS_WEIGHTS": int(has_weights),
            "HAS_BACKGROUND_MAP": int(has_background_map),
            "HAS_EXPOSURE_MAP": int(has_exposure_map),
            "LEAST_MODEL": f"{least_model!r}",
        }
        definitions = [f"-D{name}={value}" for name, value in constants.items()]
        self.options = ["-cl-std=CL1.2", "-w", *definitions]
        text = source(sources)
        self.kernels = kernel_cache.build(
            self,
            "\n".join([describe(device), *self.options, text]),
            lambda: _build(context, text, self.options),
        )

    @property
    def row_blocks(self) -> int:
        """Blocks of row pairs in an array of pixels."""
        return self.grid[0] // 2 // self.tuning.block

    @property
    def column_blocks(self) -> int:
        """Blocks of columns in an array of spectra."""
        return self.grid[1] // 2 // self.tuning.block

    @property
    def scratch_bytes(self) -> int:
        """Bytes that a work-group needs for its block."""
        return self.scratch_points * 2 * self.tuning.block * self.dtype.itemsize


def source(names: tuple[str, ...] = SOURCES) -> str:
    """Return the OpenCL source of some or all files of kernels."""
    folder = resources.files("lnocl.kernels")
    return "".join(
        f'#line 1 "{name}"\n{(folder / name).read_text(encoding="ascii")}' for name in names
    )


def _build(context: cl.Context, text: str, options: list[str]) -> dict[str, cl.Kernel]:
    """Return the kernels; caches that cannot be read or written are passed over."""
    try:
        return _try_to_build(context, text, options)
    except DeviceError:
        raise
    except Exception as error:  # a cache may raise anything
        warn(
            f"the kernels that PyOpenCL keeps cannot be used ({type(error).__name__}: {error}), "
            "and are made anew; remove the folders pyopencl and pytools from ~/.cache or from "
            "XDG_CACHE_HOME, or make them writable"
        )
    with kernel_cache.fresh():
        return _try_to_build(context, text, options)


def _try_to_build(context: cl.Context, text: str, options: list[str]) -> dict[str, cl.Kernel]:
    try:
        with ignored_warnings(cl.CompilerWarning):
            built = cl.Program(context, text).build(options)
            # Not by all_kernels: its kernels are retained once too often, and kept with their
            # program.
            names = str(built.get_info(cl.program_info.KERNEL_NAMES)).split(";")
            return {name: cl.Kernel(built, name) for name in names}
    except cl.RuntimeError as error:
        raise build_failure(describe(context.devices[0]), error) from error
