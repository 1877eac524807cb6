"""The transforms along rows: the twins of kernels/rows.cl."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array

ComplexArray = NDArray[np.complex128]


def rfft_rows(pixels: Array) -> ComplexArray:
    """Return twice the half spectrum of each row: ``2 sum_x f(x) exp(-2 pi i k x / Nx)``."""
    return 2.0 * np.fft.rfft(pixels, axis=-1)


def irfft_rows(row_spectra: ComplexArray) -> Array:
    """Return ``sum_k F(k) exp(+2 pi i k x / Nx)`` of each row, not divided by Nx."""
    nx = 2 * (row_spectra.shape[-1] - 1)
    return np.fft.irfft(row_spectra, n=nx, axis=-1, norm="forward")
