"""Layouts of pixels and spectra on the device."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lnocl.core.opencl.program import Program
from lnocl.core.opencl.tuning import odd_part
from lnocl.core.scene.rotation import Rotation


def reversed_order(n: int) -> NDArray[np.int64]:
    """Return the order in which a transform of n points leaves its spectrum (kernels/fft.cl).

    Bit-reversed, [0, n/2, n/4, 3n/4, ...], for a power of two; for M times that first the multiples
    of M, so ordered, then those with remainder 1, and so on.
    """
    odd = odd_part(n)
    order = np.zeros(1, np.int64)
    while len(order) < n // odd:
        order = np.concatenate([2 * order, 2 * order + 1])
    return np.concatenate([odd * order + remainder for remainder in range(odd)])


def shortest_arc(held: NDArray[np.bool_]) -> tuple[int, int]:
    """Return start and length of the shortest cyclic range that holds all True elements.

    It is one place where none is held.
    """
    at, n = np.flatnonzero(held), len(held)
    if not at.size:
        return 0, 1
    gaps = np.diff(at, append=at[0] + n)
    widest = int(np.argmax(gaps))
    return int(at[(widest + 1) % len(at)]), n - int(gaps[widest]) + 1


class PixelLayout:
    """Converts arrays of pixels between their natural order and that of the kernels.

    Parameters
    ----------
    program : Program
        Whose tuning and precision are meant.
    grid : tuple of int
        Shape of the arrays: that of its sky or of its images.

    Notes
    -----
    kernels/precision.cl says what the layouts are.
    """

    def __init__(self, program: Program, grid: tuple[int, int]) -> None:
        self.dtype, self.grid = program.dtype, grid
        block = program.tuning.block
        self.pixels_shape = (grid[0] // 2 // block, grid[1], 2, block)

    @property
    def block_bytes(self) -> int:
        """Bytes of one block of row pairs in an array of pixels."""
        return self.pixels_bytes // self.pixels_shape[0]

    @property
    def pixels_bytes(self) -> int:
        """Bytes of one array of pixels."""
        return int(np.prod(self.pixels_shape)) * self.dtype.itemsize

    def pack_pixels(self, pixels: NDArray) -> NDArray:
        """Return pixels (..., Ny, Nx), or some blocks' rows of them, in the kernels' order.

        They may be of the sky or of images.
        """
        nx, block = pixels.shape[-1], self.pixels_shape[-1]
        pairs = pixels.reshape(*pixels.shape[:-2], -1, block, 2, nx)
        return np.ascontiguousarray(np.swapaxes(pairs, -3, -1), dtype=self.dtype)

    def window(self, rows: NDArray[np.bool_]) -> tuple[int, int]:
        """Return first and number of the blocks, round the edge, that hold some rows (Ny,)."""
        return shortest_arc(np.any(rows.reshape(self.pixels_shape[0], -1), axis=1))

    def rows_of(self, first: int, count: int) -> NDArray[np.int64]:
        """Return the rows that some blocks hold, round the edge."""
        rows = 2 * self.pixels_shape[-1]
        return np.arange(first * rows, (first + count) * rows) % self.grid[0]

    def row_slices(self, n_rows: int, n_bytes: int) -> Iterator[slice]:
        """Yield slices of so many rows, each of whole blocks and of about so many bytes."""
        step = 2 * self.pixels_shape[-1] * max(1, n_bytes // self.block_bytes)
        return (slice(first, first + step) for first in range(0, n_rows, step))

    def unpack_pixels(self, packed: NDArray) -> NDArray:
        """Return the rows of pixels (..., Nx) that blocks in the kernels' order hold."""
        _, nx, _, block = self.pixels_shape
        return np.swapaxes(packed.reshape(-1, nx, 2, block), -3, -1).reshape(-1, nx)


class Layout(PixelLayout):
    """Converts spectra too, and pixels of the sky.

    Parameters
    ----------
    program : Program
        Whose grid, tuning and precision are meant.

    Attributes
    ----------
    images : PixelLayout
        Of the images.
    kept, conjugated : ndarray, shape (Nx / 2 - 1,)
        Which column of a half spectrum lies in each column but the first, and whether its
        conjugate does.

    Notes
    -----
    kernels/rows.cl says how half spectra are packed. Spectra of an image have fewer rows than those
    of a finer sky: they are the first of as many.
    """

    def __init__(self, program: Program) -> None:
        super().__init__(program, program.grid)
        self.images, self._program = PixelLayout(program, program.image_grid), program
        nx, block = program.grid[1], program.tuning.block
        self.spectra_shape = (nx // 2 // block, program.rows, 2, block)
        column = np.arange(1, nx // 2)
        high_bit = 1 << np.frexp(column)[1] - 1
        shift = np.minimum(high_bit, nx // odd_part(nx) // 2)
        wavenumber = reversed_order(nx)[column + shift]
        self.conjugated = wavenumber > nx // 2
        self.kept = np.where(self.conjugated, nx - wavenumber, wavenumber)

    @property
    def columns_shape(self) -> tuple[int, int, int, int]:
        """Shape of an image between the kernels of kernels/turn.cl: [PIECES][NX][2][PIECE]."""
        (ny, nx), pairs = self.grid, self._program.column_pairs
        pieces = ny // 2 // pairs
        return pieces, nx, 2, self._program.columns_size // (pieces * nx * 2)

    @property
    def spectra_bytes(self) -> int:
        """Bytes of one array of spectra."""
        return int(np.prod(self.spectra_shape)) * self.dtype.itemsize

    def pack_phases(self, rotation: Rotation) -> NDArray:
        """Return the phases of the first shear of an image, as `convolve_columns` has them."""
        nx, block = self.grid[1], self.spectra_shape[-1]
        kept = np.append(nx // 2, self.kept)  # column 0 takes the phase of Nx / 2
        signs = np.append(1.0, np.where(self.conjugated, -1.0, 1.0))
        frequency = signs * np.fft.rfftfreq(nx)[kept]
        phases = np.concatenate(rotation.phase_tables(frequency))
        blocks = phases.reshape(len(phases), -1, block).transpose(1, 0, 2)
        return np.stack([blocks.real, blocks.imag], axis=2).astype(self.dtype)
