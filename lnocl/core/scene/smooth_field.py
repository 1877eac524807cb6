"""Random fields that are smooth."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.threads import threads


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
        self._shape, self._threads = shape, threads(shape)
        u, v = np.fft.rfftfreq(shape[1]), np.fft.fftfreq(shape[0])[:, None]
        root = np.exp(-((np.pi * width) ** 2) * (u**2 + v**2))
        root /= np.sqrt(np.fft.irfft2(root**2, shape)[0, 0])
        self._root = root.astype(dtype)

    def apply(self, x: Array) -> Array:
        """Return the fields of x, shape (..., ny, nx)."""
        from scipy import fft  # which the start of a command need not load

        x = np.asarray(x, self._root.dtype)
        spectrum = self._root * fft.rfft2(x, workers=self._threads)
        return np.asarray(fft.irfft2(spectrum, self._shape, workers=self._threads))
