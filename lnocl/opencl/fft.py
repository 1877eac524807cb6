"""Layouts of pixels and spectra on the device, roots of unity, and the transforms by themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from lnocl.opencl.program import TRANSFORMS, Program, Tuning

READ_WRITE = cl.mem_flags.READ_WRITE


def bit_reversed(n: int) -> NDArray[np.int64]:
    """Return the bit-reversed order of n points, n a power of two: [0, n/2, n/4, 3n/4, ...]."""
    order = np.zeros(1, np.int64)
    while len(order) < n:
        order = np.concatenate([2 * order, 2 * order + 1])
    return order


def roots(n: int, outer: int, last: int) -> NDArray[np.float64]:
    """Return the twiddles of all passes of a transform of n points, as kernels/fft.cl has them.

    A pass over subtransforms of length L with radix R has, for j < L / R and 0 < q < R, the root
    ``exp(-2 pi i j reversed(q) / L)``, real and imaginary part. The passes have radix `outer`,
    then 8; that of radix `last` has none.
    """
    length, radix = n, outer
    tables = []
    while length == n or length > last:
        j, q = np.arange(length // radix)[:, None], bit_reversed(radix)[None, 1:]
        # In long double, where there is one: a rounded angle would cost a digit in double.
        angle = -8.0 * np.arctan(np.longdouble(1.0)) * (j * q) / length
        tables.append(np.stack([np.cos(angle), np.sin(angle)], axis=-1).ravel())
        length, radix = length // radix, 8
    return np.concatenate(tables).astype(np.float64)


class Layout:
    """Converts arrays between their natural order and that of the kernels.

    Parameters
    ----------
    program : Program
        Whose grid, tuning and precision are meant.

    Notes
    -----
    kernels/precision.cl says what the layouts are, kernels/rows.cl how half spectra are packed.
    """

    def __init__(self, program: Program) -> None:
        self.dtype = program.dtype
        self.grid = program.grid
        ny, nx = program.grid
        block = program.tuning.block
        self.pixels_shape = (ny // 2 // block, nx, 2, block)
        self.spectra_shape = (nx // 2 // block, program.rows, 2, block)
        column = np.arange(1, nx // 2)
        high_bit = 1 << np.frexp(column)[1] - 1
        position = bit_reversed(nx)[column + high_bit]
        opposite = position > nx // 2
        self._kept = np.where(opposite, nx - position, position)
        self._conjugated = opposite

    @property
    def block_bytes(self) -> int:
        """Bytes of one block of row pairs in an array of pixels."""
        return self.pixels_bytes // self.pixels_shape[0]

    @property
    def pixels_bytes(self) -> int:
        """Bytes of one array of pixels."""
        return int(np.prod(self.pixels_shape)) * self.dtype.itemsize

    @property
    def spectra_bytes(self) -> int:
        """Bytes of one array of spectra."""
        return int(np.prod(self.spectra_shape)) * self.dtype.itemsize

    def pack_pixels(self, pixels: NDArray) -> NDArray:
        """Return pixels (..., Ny, Nx), or some blocks' rows of them, in the kernels' order."""
        _, nx, _, block = self.pixels_shape
        pairs = pixels.reshape(*pixels.shape[:-2], -1, block, 2, nx)
        return np.ascontiguousarray(np.swapaxes(pairs, -3, -1), dtype=self.dtype)

    def window(self, rows: NDArray[np.bool_]) -> tuple[int, int]:
        """Return first and number of the blocks, round the edge, that hold some rows (Ny,)."""
        row_blocks = self.pixels_shape[0]
        held = np.flatnonzero(rows.reshape(row_blocks, -1).any(axis=1))
        gaps = np.diff(held, append=held[0] + row_blocks)
        widest = int(np.argmax(gaps))
        return int(held[(widest + 1) % len(held)]), row_blocks - int(gaps[widest]) + 1

    def rows_of(self, first: int, count: int) -> NDArray[np.int64]:
        """Return the rows that some blocks hold, round the edge."""
        rows = 2 * self.pixels_shape[-1]
        return np.arange(first * rows, (first + count) * rows) % self.grid[0]

    def unpack_pixels(self, packed: NDArray) -> NDArray[np.float64]:
        """Return the pixels (Ny, Nx) of an array in the kernels' order."""
        return np.swapaxes(packed, -3, -1).reshape(self.grid).astype(np.float64)

    def pack_spectra(self, row_spectra: NDArray) -> NDArray:
        """Return row spectra (Ny, Nx // 2 + 1) in the kernels' order and precision.

        Column 0 gets the real parts of columns 0 and Nx / 2, as row spectra of real pixels have
        no others.
        """
        ny, nx = self.grid
        kept = np.empty((ny, nx // 2), np.complex128)
        kept[:, 0] = row_spectra[:, 0].real + 1j * row_spectra[:, -1].real
        kept[:, 1:] = row_spectra[:, self._kept]
        kept[:, 1:][:, self._conjugated] = kept[:, 1:][:, self._conjugated].conj()
        return self.pack_columns(kept)

    def unpack_spectra(self, packed: NDArray) -> NDArray[np.complex128]:
        """Return the row spectra (Ny, Nx // 2 + 1) of an array in the kernels' order."""
        ny, nx = self.grid
        kept = self.unpack_columns(packed)
        row_spectra = np.empty((ny, nx // 2 + 1), np.complex128)
        row_spectra[:, 0], row_spectra[:, -1] = kept[:, 0].real, kept[:, 0].imag
        columns = kept[:, 1:]
        row_spectra[:, self._kept] = np.where(self._conjugated, columns.conj(), columns)
        return row_spectra

    def half_spectrum(self, columns: NDArray) -> NDArray[np.complex128]:
        """Return the half spectrum (Ny, Nx // 2 + 1) of real pixels from their kept columns.

        Column 0 holds ``A + i B`` with A and B the Hermitian spectra of columns 0 and Nx / 2;
        the others hold k or, where conjugated, -k: ``F(-k) = conj(F(k))`` in both axes.
        """
        ny, nx = self.grid
        opposite = columns[-np.arange(ny)].conj()
        spectrum = np.empty((ny, nx // 2 + 1), np.complex128)
        spectrum[:, 0] = (columns[:, 0] + opposite[:, 0]) / 2
        spectrum[:, -1] = (columns[:, 0] - opposite[:, 0]) / 2j
        spectrum[:, self._kept] = np.where(self._conjugated, opposite[:, 1:], columns[:, 1:])
        return spectrum

    def columns_of(self, spectrum: NDArray) -> NDArray[np.complex128]:
        """Return the columns (Ny, Nx / 2) that are kept of a half spectrum of real pixels."""
        ny, nx = self.grid
        columns = np.empty((ny, nx // 2), np.complex128)
        columns[:, 0] = spectrum[:, 0] + 1j * spectrum[:, -1]
        kept = spectrum[:, self._kept]
        columns[:, 1:] = np.where(self._conjugated, kept[-np.arange(ny)].conj(), kept)
        return columns

    def pack_columns(self, columns: NDArray) -> NDArray:
        """Return complex columns (Ny, Nx / 2) in the kernels' order, as they are."""
        column_blocks, _, _, block = self.spectra_shape
        ny = self.grid[0]
        packed = np.zeros(self.spectra_shape, self.dtype)
        blocks = columns.reshape(ny, column_blocks, block).transpose(1, 0, 2)
        packed[:, :ny, 0], packed[:, :ny, 1] = blocks.real, blocks.imag
        return packed

    def unpack_columns(self, packed: NDArray) -> NDArray[np.complex128]:
        """Return the complex columns (Ny, Nx / 2) of an array in the kernels' order."""
        ny, nx = self.grid
        parts = packed[:, :ny].astype(np.float64)
        return (parts[:, :, 0] + 1j * parts[:, :, 1]).transpose(1, 0, 2).reshape(ny, nx // 2)


class Launch:
    """A kernel bound to its arguments, which each call launches; it costs the host little.

    A kernel has one set of arguments at a time: binding it anew changes earlier launches of it.
    """

    def __init__(
        self,
        queue: cl.CommandQueue,
        kernel: cl.Kernel,
        arguments: tuple[Any, ...],
        groups: int,
        group: int,
    ) -> None:
        self._queue, self.kernel = queue, kernel
        self._global_size, self._local_size = (groups * group,), (group,)
        # Not set_args, which writes Python for each kernel and keeps it in a cache on disk.
        for index, argument in enumerate(arguments):
            kernel.set_arg(index, argument)

    def __call__(self) -> cl.Event:
        """Enqueue the kernel."""
        return cl.enqueue_nd_range_kernel(
            self._queue, self.kernel, self._global_size, self._local_size
        )


class Launcher:
    """Binds the kernels of a program to arguments: its queue, roots of unity and scratch.

    Parameters
    ----------
    program : Program
        Whose kernels are bound.

    Attributes
    ----------
    queue : pyopencl.CommandQueue
        In order.
    """

    def __init__(self, program: Program) -> None:
        context = program.context
        self.program = program
        self.queue = cl.CommandQueue(context)
        ny, nx = program.grid
        constant = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        row_roots, column_roots = (
            roots(n, *split).astype(program.dtype)
            for n, split in ((nx, program.row_radices), (ny, program.column_radices))
        )
        self._row_roots = cl.Buffer(context, constant, hostbuf=row_roots)
        self._column_roots = cl.Buffer(context, constant, hostbuf=column_roots)
        self._scratch: cl.Buffer | cl.LocalMemory = (
            cl.Buffer(context, READ_WRITE, program.most_groups * program.scratch_bytes)
            if program.scratch_is_global
            else cl.LocalMemory(program.scratch_bytes)
        )

    @staticmethod
    def bytes_needed(program: Program) -> int:
        """Return the bytes that a launcher takes on the device."""
        ny, nx = program.grid
        n_roots = len(roots(nx, *program.row_radices)) + len(roots(ny, *program.column_radices))
        return n_roots * program.dtype.itemsize + program.most_groups * program.scratch_bytes

    def rows(self, name: str, *arguments: Any, blocks: int | None = None) -> Launch:
        """Bind a kernel over blocks of rows, all of one array or as many as given."""
        arguments = (*arguments, self._row_roots, self._scratch)
        return self._bind(name, blocks or self.program.row_blocks, arguments)

    def columns(self, name: str, *arguments: Any) -> Launch:
        """Bind a kernel over all blocks of columns."""
        arguments = (*arguments, self._column_roots, self._scratch)
        return self._bind(name, self.program.column_blocks, arguments)

    def blocks(self, name: str, *arguments: Any) -> Launch:
        """Bind a kernel over the blocks of rows of one array that transforms nothing."""
        return self._bind(name, self.program.row_blocks, arguments)

    def one_group(self, name: str, *arguments: Any) -> Launch:
        """Bind a kernel on one work-group."""
        return self._bind(name, 1, arguments)

    def _bind(self, name: str, blocks: int, arguments: tuple[Any, ...]) -> Launch:
        group = self.program.tuning.group
        groups = min(blocks, self.program.most_groups or blocks)
        return Launch(self.queue, self.program.kernels[name], arguments, groups, group)


class Transform:
    """The transforms by themselves, on natural-order NumPy arrays.

    Parameters
    ----------
    context : pyopencl.Context
        Of one device.
    grid : tuple of int
        Shape (Ny, Nx), powers of two from 2 to 8192.
    dtype : numpy.dtype
        float32 or float64.
    tuning : Tuning, optional
        By default that of `lnocl.opencl.program.tune`.
    """

    def __init__(
        self,
        context: cl.Context,
        grid: tuple[int, int],
        dtype: np.dtype,
        tuning: Tuning | None = None,
    ) -> None:
        self.program = Program(context, grid, np.dtype(dtype), tuning, TRANSFORMS)
        self.layout = Layout(self.program)
        self.launcher = Launcher(self.program)
        self._pixels = cl.Buffer(context, READ_WRITE, self.layout.pixels_bytes)
        self._spectra = cl.Buffer(context, READ_WRITE, self.layout.spectra_bytes)

    def fft(self, columns: NDArray) -> NDArray[np.complex128]:
        """Return ``sum_y F(y) exp(-2 pi i k y / Ny)`` of each of (Ny, Nx / 2) complex columns."""
        self._upload(self._spectra, self.layout.pack_columns(columns))
        self._fft_columns()
        return self._download_columns()[np.argsort(bit_reversed(self.program.grid[0]))]

    def ifft(self, columns: NDArray) -> NDArray[np.complex128]:
        """Return ``1 / Ny sum_k F(k) exp(+2 pi i k y / Ny)`` of each of (Ny, Nx / 2) columns."""
        ny = self.program.grid[0]
        self._upload(self._spectra, self.layout.pack_columns(columns[bit_reversed(ny)]))
        self._ifft_columns()
        return self._download_columns() / ny

    def rfft2(self, pixels: NDArray) -> NDArray[np.complex128]:
        """Return the half spectrum (Ny, Nx // 2 + 1) of real pixels (Ny, Nx)."""
        self._upload(self._pixels, self.layout.pack_pixels(pixels))
        self.launcher.rows("rfft_rows", self._spectra, self._pixels)()
        self._fft_columns()
        ny = self.program.grid[0]
        columns = self._download_columns()[np.argsort(bit_reversed(ny))] / 2.0
        return self.layout.half_spectrum(columns)

    def irfft2(self, spectrum: NDArray) -> NDArray[np.float64]:
        """Return the real pixels (Ny, Nx) of a half spectrum, divided by Ny Nx."""
        ny, nx = self.program.grid
        columns = self.layout.columns_of(spectrum)[bit_reversed(ny)]
        self._upload(self._spectra, self.layout.pack_columns(columns))
        self._ifft_columns()
        self.launcher.rows("irfft_rows", self._pixels, self._spectra)()
        packed = np.empty(self.layout.pixels_shape, self.layout.dtype)
        cl.enqueue_copy(self.launcher.queue, packed, self._pixels)
        return self.layout.unpack_pixels(packed) / (ny * nx)

    def _fft_columns(self) -> None:
        self.launcher.columns("fft_columns", self._spectra)()

    def _ifft_columns(self) -> None:
        self.launcher.columns("ifft_columns", self._spectra)()

    def _upload(self, buffer: cl.Buffer, packed: NDArray) -> None:
        cl.enqueue_copy(self.launcher.queue, buffer, packed)

    def _download_columns(self) -> NDArray[np.complex128]:
        packed = np.empty(self.layout.spectra_shape, self.layout.dtype)
        cl.enqueue_copy(self.launcher.queue, packed, self._spectra)
        return self.layout.unpack_columns(packed)
