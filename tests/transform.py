"""The transforms on a device by themselves, on arrays in natural order."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from kernel_harness import SpectraLayout
from numpy.typing import NDArray

from lnocl.core.opencl.launch import READ_WRITE, Launch, Launcher
from lnocl.core.opencl.layout import reversed_order
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.tuning import Tuning
from lnocl.core.scene.steps import Steps


class Transform:
    """The transforms by themselves, on natural-order NumPy arrays.

    Parameters
    ----------
    context : pyopencl.Context
        Of one device.
    grid : tuple of int
        Shape (Ny, Nx), of `lnocl.core.scene.grid.LENGTHS`.
    dtype : numpy.dtype
        float32 or float64.
    tuning : Tuning, optional
        By default that of `lnocl.core.opencl.tuning.tune`.
    """

    def __init__(
        self,
        context: cl.Context,
        grid: tuple[int, int],
        dtype: np.dtype,
        tuning: Tuning | None = None,
    ) -> None:
        self.program = Program(context, grid, np.dtype(dtype), tuning)
        self.layout = SpectraLayout(self.program)
        self.launcher = Launcher(self.program)
        self._pixels = cl.Buffer(context, READ_WRITE, self.layout.pixels_bytes)
        self._spectra = cl.Buffer(context, READ_WRITE, self.layout.spectra_bytes)
        going = Steps().numbers().astype(self.program.dtype)
        self._steps = cl.Buffer(context, READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=going)

    def fft(self, columns: NDArray) -> NDArray[np.complex128]:
        """Return ``sum_y F(y) exp(-2 pi i k y / Ny)`` of each of (Ny, Nx / 2) complex columns."""
        self._upload(self._spectra, self.layout.pack_columns(columns))
        self._fft_columns()
        return self._download_columns()[np.argsort(reversed_order(self.program.grid[0]))]

    def ifft(self, columns: NDArray) -> NDArray[np.complex128]:
        """Return ``1 / Ny sum_k F(k) exp(+2 pi i k y / Ny)`` of each of (Ny, Nx / 2) columns."""
        ny = self.program.grid[0]
        self._upload(self._spectra, self.layout.pack_columns(columns[reversed_order(ny)]))
        self._ifft_columns()
        return self._download_columns() / ny

    def rfft2(self, pixels: NDArray) -> NDArray[np.complex128]:
        """Return the half spectrum (Ny, Nx // 2 + 1) of real pixels (Ny, Nx)."""
        self._upload(self._pixels, self.layout.pack_pixels(pixels))
        self._bind("rfft_rows")()
        self._fft_columns()
        ny = self.program.grid[0]
        columns = self._download_columns()[np.argsort(reversed_order(ny))] / 2.0
        return half_spectrum(self.layout, columns)

    def irfft2(self, spectrum: NDArray) -> NDArray[np.float64]:
        """Return the real pixels (Ny, Nx) of a half spectrum, divided by Ny Nx."""
        ny, nx = self.program.grid
        columns = self.layout.columns_of(spectrum)[reversed_order(ny)]
        self._upload(self._spectra, self.layout.pack_columns(columns))
        self._ifft_columns()
        self._bind("irfft_rows")()
        packed = np.empty(self.layout.pixels_shape, self.layout.dtype)
        cl.enqueue_copy(self.launcher.queue, packed, self._pixels)
        return self.layout.unpack_pixels(packed) / (ny * nx)

    def _fft_columns(self) -> None:
        self._bind("fft_columns")()

    def _ifft_columns(self) -> None:
        self._bind("ifft_columns")()

    def _bind(self, name: str) -> Launch:
        return self.launcher.bind(
            name,
            spectra=self._spectra,
            pixels=self._pixels,
            steps=self._steps,
            n_images=1,
            n_skies=1,
        )

    def _upload(self, buffer: cl.Buffer, packed: NDArray) -> None:
        cl.enqueue_copy(self.launcher.queue, buffer, packed)

    def _download_columns(self) -> NDArray[np.complex128]:
        packed = np.empty(self.layout.spectra_shape, self.layout.dtype)
        cl.enqueue_copy(self.launcher.queue, packed, self._spectra)
        return self.layout.unpack_columns(packed)


def half_spectrum(layout: SpectraLayout, columns: NDArray) -> NDArray[np.complex128]:
    """Return the half spectrum (Ny, Nx // 2 + 1) of real pixels from their kept columns.

    Column 0 holds ``A + i B`` with A and B the Hermitian spectra of columns 0 and Nx / 2;
    the others hold k or, where conjugated, -k: ``F(-k) = conj(F(k))`` in both axes.
    """
    ny, nx = layout.grid
    opposite = columns[-np.arange(ny)].conj()
    spectrum = np.empty((ny, nx // 2 + 1), np.complex128)
    spectrum[:, 0] = (columns[:, 0] + opposite[:, 0]) / 2
    spectrum[:, -1] = (columns[:, 0] - opposite[:, 0]) / 2j
    spectrum[:, layout.kept] = np.where(layout.conjugated, opposite[:, 1:], columns[:, 1:])
    return spectrum
