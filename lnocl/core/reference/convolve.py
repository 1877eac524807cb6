"""Convolution and its adjoint, as products of spectra: the twins of kernels/convolve.cl."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.reference.columns import fft_columns, ifft_columns
from lnocl.core.reference.rows import ComplexArray
from lnocl.core.scene.arrays import Array


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
    mixes: Array | None = None,
) -> ComplexArray:
    """Return the row spectra of ``A_j f``, shape (p, Ny / oversample, Nx // 2 + 1), from that of f.

    Of the rows, each in `oversample` of them is an image's. Where images are turned, each row has
    been shifted by its phases, the first of three shears (`lnocl.core.scene.rotation`). With mixes,
    shape (p, K), f is ``sum_k mixes_jk f_k`` of K skies for image j.
    """
    rows = ifft_columns(otfs * mixed(fft_columns(row_spectrum), mixes))[..., ::oversample, :]
    return rows if phases is None else rows * phases


def correlate_columns(
    row_spectra: ComplexArray,
    otfs: ComplexArray,
    phases: ComplexArray | None = None,
    mixes: Array | None = None,
) -> ComplexArray:
    """Return the row spectrum of ``sum_j A_j^T (r_j - w_j)`` from those of the r_j - w_j.

    The rows of an image are some of the sky's, each in `oversample` of them; 0 is in the others.
    With mixes that of each sky k, of ``sum_j mixes_jk A_j^T (r_j - w_j)``.
    """
    if phases is not None:
        row_spectra = row_spectra * phases.conj()
    rows = np.zeros((*row_spectra.shape[:-2], *otfs.shape[-2:]), np.complex128)
    rows[..., :: otfs.shape[-2] // row_spectra.shape[-2], :] = row_spectra
    return ifft_columns(unmixed(np.conj(otfs) * fft_columns(rows), mixes))


def mixed(skies: NDArray[Any], mixes: Array | None) -> NDArray[Any]:
    """Return ``sum_k mixes_jk skies_k`` for each image j; one sky as it is."""
    return skies if mixes is None else np.einsum("jk,k...->j...", mixes, skies)


def unmixed(images: NDArray[Any], mixes: Array | None) -> NDArray[Any]:
    """Return ``sum_j mixes_jk images_j`` for each sky k, the adjoint; for one sky the sum."""
    return images.sum(axis=0) if mixes is None else np.einsum("jk,j...->k...", mixes, images)
