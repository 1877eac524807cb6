"""The transforms along columns: the twins of kernels/columns.cl."""

from __future__ import annotations

import numpy as np

from lnocl.core.reference.rows import ComplexArray


def fft_columns(spectra: ComplexArray) -> ComplexArray:
    """Return the spectrum of each column: ``sum_y F(y) exp(-2 pi i k y / Ny)``."""
    return np.fft.fft(spectra, axis=-2)


def ifft_columns(spectra: ComplexArray) -> ComplexArray:
    """Return ``sum_k F(k) exp(+2 pi i k y / Ny)`` of each column, not divided by Ny."""
    return np.fft.ifft(spectra, axis=-2, norm="forward")
