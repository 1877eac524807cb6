"""Random fields that are smooth."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.threads import threads

# Sides up to which two products of matrices take less time, which BLAS does in one thread.
SMALL = 64


class SmoothField:
    r"""The root of a covariance of unit variance, ``C(d) = exp(-d^2 / (2 width^2))``, periodic.

    ``apply`` makes of white noise x the field :math:`C^{1/2} x`. It is its own transpose.

    Parameters
    ----------
    shape : tuple of int
        Shape (ny, nx) of the field.
    width : float
        Pixels.
    dtype : dtype, optional
        Of the arithmetic.
    """

    def __init__(self, shape: tuple[int, ...], width: float, dtype: DTypeLike = np.float64) -> None:
        from scipy.linalg import circulant  # which the start of a command need not load

        self._shape, self._threads = shape, threads(shape)
        roots = [np.exp(-((np.pi * width * np.fft.fftfreq(n)) ** 2)) for n in shape]
        v, u = (root / np.sqrt(np.mean(root**2)) for root in roots)
        self._root = np.outer(v, u[: shape[1] // 2 + 1]).astype(dtype)
        small = [np.fft.ifft(root).real for root in (v, u) if max(shape) <= SMALL]
        self._axes = [circulant(lags).astype(dtype) for lags in small]

    def apply(self, x: Array) -> Array:
        """Return the fields of x, shape (..., ny, nx)."""
        from scipy import fft

        x = np.asarray(x, self._root.dtype)
        if self._axes:
            return np.asarray(self._axes[0] @ x @ self._axes[1])
        spectrum = self._root * fft.rfft2(x, workers=self._threads)
        return np.asarray(fft.irfft2(spectrum, self._shape, workers=self._threads))
