"""Convolution and its adjoint, as products of spectra: the twins of kernels/convolve.cl."""

from __future__ import annotations

import numpy as np

from lnocl.core.reference.columns import fft_columns, ifft_columns
from lnocl.core.reference.rows import ComplexArray


def otf_columns(row_spectra: ComplexArray) -> ComplexArray:
    """Return the optical transfer function, from the row spectra of a PSF (peak at the origin).

    The spectrum divided by what the transforms leave in: Ny Nx of the two inverse ones, 2 of
    each of the two forward ones.
    """
    ny, nx = row_spectra.shape[-2], 2 * (row_spectra.shape[-1] - 1)
    return fft_columns(row_spectra) / (4.0 * ny * nx)


def convolve_columns(
    row_spectrum: ComplexArray,
    otfs: ComplexArray,
    oversample: int = 1,
    phases: ComplexArray | None = None,
) -> ComplexArray:
    """Return the row spectra of ``A_j f``, shape (p, Ny / oversample, Nx // 2 + 1), from that of f.

    Of the rows, each in `oversample` of them is an image's. Where images are turned, each row has
    been shifted by its phases, the first of three shears (`lnocl.core.scene.rotation`).
    """
    rows = ifft_columns(otfs * fft_columns(row_spectrum))[..., ::oversample, :]
    return rows if phases is None else rows * phases


def correlate_columns(
    row_spectra: ComplexArray, otfs: ComplexArray, phases: ComplexArray | None = None
) -> ComplexArray:
    """Return the row spectrum of ``sum_j A_j^T (r_j - w_j)`` from those of the r_j - w_j.

    The rows of an image are some of the sky's, each in `oversample` of them; 0 is in the others.
    """
    if phases is not None:
        row_spectra = row_spectra * phases.conj()
    rows = np.zeros((*row_spectra.shape[:-2], *otfs.shape[-2:]), np.complex128)
    rows[..., :: otfs.shape[-2] // row_spectra.shape[-2], :] = row_spectra
    return ifft_columns((np.conj(otfs) * fft_columns(rows)).sum(axis=0))
