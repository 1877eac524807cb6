"""A transmission of the sky before the PSF: the twins of kernels/transmit.cl."""

from __future__ import annotations

from lnocl.core.reference.rows import ComplexArray, irfft_rows, rfft_rows
from lnocl.core.scene.arrays import Array


def transmit_rows(extended: Array, transmission: Array) -> ComplexArray:
    """Return the row spectra of the sky that each image sees, ``t_j f``, as `rfft_rows` does."""
    return rfft_rows(transmission * extended)


def gather_rows(row_spectra: ComplexArray, transmission: Array) -> ComplexArray:
    """Return the row spectrum of ``sum_j t_j c_j`` from those of the c_j: the adjoint."""
    nx = transmission.shape[-1]
    return rfft_rows((transmission * irfft_rows(row_spectra)).sum(axis=0)) / (2.0 * nx)
