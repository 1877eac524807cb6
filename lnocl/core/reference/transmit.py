"""A transmission of the sky before the PSF: the twins of kernels/transmit.cl."""

from __future__ import annotations

from lnocl.core.reference.convolve import mixed, unmixed
from lnocl.core.reference.rows import ComplexArray, irfft_rows, rfft_rows
from lnocl.core.scene.arrays import Array


def transmit_rows(extended: Array, transmission: Array, mixes: Array | None = None) -> ComplexArray:
    """Return the row spectra of the sky that each image sees, ``t_j f``, as `rfft_rows` does.

    With mixes, shape (p, K), f is ``sum_k mixes_jk f_k`` for image j.
    """
    return rfft_rows(transmission * mixed(extended, mixes))


def gather_rows(
    row_spectra: ComplexArray, transmission: Array, mixes: Array | None = None
) -> ComplexArray:
    """Return the row spectrum of ``sum_j t_j c_j`` from those of the c_j: the adjoint.

    With mixes those of ``sum_j mixes_jk t_j c_j``, of each sky k.
    """
    nx = transmission.shape[-1]
    return rfft_rows(unmixed(transmission * irfft_rows(row_spectra), mixes)) / (2.0 * nx)
