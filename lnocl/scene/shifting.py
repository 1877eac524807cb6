"""A PSF at any position of a periodic grid, between pixels too."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.scene.observation import Array

# Pixels that a PSF is given on each side before it is moved by a fraction: what rings beyond the
# edges of its array dies out in them.
MARGIN = 16
# Aliases of a frequency, 1 / pixel, that are told apart: more would be lost in rounding.
ALIASES = np.arange(-6, 7)
# The least share of the light at the highest frequency that is taken for more than rounding.
LEAST_NYQUIST = 1e-16


class Stamp(NamedTuple):
    """Part of a periodic grid: its values, and the row and column of the first of them."""

    values: Array
    y: int
    x: int

    def on_grid(self, grid: tuple[int, int]) -> Array:
        """Return the values on the whole grid, 0 elsewhere."""
        laid = np.zeros(grid)
        laid[: self.values.shape[0], : self.values.shape[1]] = self.values
        return np.roll(laid, (self.y, self.x), axis=(0, 1))

    def rows(self, grid: tuple[int, int]) -> NDArray[np.int_]:
        """Return the rows of the grid that the values lie in."""
        return (self.y + np.arange(self.values.shape[0])) % grid[0]

    def columns(self, grid: tuple[int, int]) -> NDArray[np.int_]:
        """Return the columns of the grid that the values lie in."""
        return (self.x + np.arange(self.values.shape[1])) % grid[1]


def place(psf: Array, grid: tuple[int, int], x: float, y: float, axis: int | None = None) -> Stamp:
    """Return a PSF with its middle, pixel ``(ky // 2, kx // 2)``, at a position of a grid.

    Whole pixels move it as it is; the fraction left, at most half a pixel, by the phase
    ``exp(-2 pi i (kx dx / nx + ky dy / ny))`` of its spectrum. Its sum is kept to rounding.

    Each frequency f that the pixels can hold has in it what the light has at f + 1, f - 1 ... per
    pixel, which moves by other phases. It is shared out among these, along each axis, in the ratio
    of ``sinc(f) exp(-2 pi^2 sigma^2 f^2)``, a Gaussian's that is seen by pixels, with the sigma
    that the PSF shows at the highest frequency. So a PSF is taken for a sum of Gaussians, one on
    each pixel, which are moved as they are; one that has nothing at the highest frequency is moved
    by its phase alone, exact where it is limited to the frequencies that its pixels can hold.

    Parameters
    ----------
    psf : ndarray of float64, shape (ky, kx)
        Of any size; where it is larger than the grid it is wrapped round.
    grid : tuple of int
        Shape (Ny, Nx).
    x, y : float
        Where the middle goes, in pixels of the grid, which is periodic.
    axis : {0, 1}, optional
        Return the derivative with respect to y (0) or x (1) instead.

    Notes
    -----
    PSFs integrated over pixels, moved by half a pixel in x and y: the largest error and the most
    negative pixel, as shares of the peak before (tests/scene/test_shifting.py).

    ==========================  =======  ==========  =======  ==========
    ..                          error    phase only  darkest  phase only
    ==========================  =======  ==========  =======  ==========
    Gaussian, FWHM 1            2.4e-5   0.079       5e-7     0.065
    Gaussian, 1.5               7e-10    0.021       2e-11    0.018
    Gaussian, 2                 4e-16    0.0040      0        0.0036
    Gaussian, 3                 4e-16    3.7e-5      0        3.6e-5
    Moffat, beta 2.5, FWHM 1.5  0.015    0.025       2e-8     0.011
    Airy, lambda / D 1          0.014    0.088       2e-7     0.068
    Airy, 1.33                  0.014    0.035       6e-7     0.029
    Airy, 2                     2.4e-4   1e-6        6e-6     7e-6
    Airy, 2.8                   4e-7     8e-7        1e-5     1e-5
    ==========================  =======  ==========  =======  ==========

    All of it is for PSFs whose peak is in the middle of a pixel. A Gaussian of 1.5 pixels that is a
    quarter of a pixel off along both axes has an error of 0.10, by the phase alone 0.066.
    """
    whole = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
    fraction = y - whole[0], x - whole[1]
    if any(fraction) or axis is not None:
        variances = _variance(psf.sum(axis=1)), _variance(psf.sum(axis=0))
        for i, n in enumerate(grid):
            psf = _widen(psf, n, i)
        psf = _move(psf, fraction, variances, axis)
    first = []
    for i, n in enumerate(grid):
        if psf.shape[i] > n:
            psf = fold(psf, n, i)
        first.append(whole[i] - psf.shape[i] // 2)
    return Stamp(psf, *first)


def _variance(profile: Array) -> float:
    """Return the sigma^2 of the Gaussian, seen by pixels, that has as much at the frequency 1 / 2.

    It and its alias -1 / 2 have ``2 sinc(1 / 2) exp(-pi^2 sigma^2 / 2)`` together, of unit light.
    """
    signs = 1 - 2 * (np.arange(len(profile)) % 2)
    light = float(profile.sum())
    seen = abs(float(signs @ profile)) / light if light else 1.0
    return 2.0 / np.pi**2 * float(np.log(4.0 / np.pi / np.clip(seen, LEAST_NYQUIST, 1.0)))


def _move(
    psf: Array, fraction: tuple[float, float], variances: tuple[float, float], axis: int | None
) -> Array:
    import scipy.fft  # it takes a twentieth of a second, which stars on whole pixels need not spend

    y, x = (_phases(n, fraction[i], variances[i], i == axis) for i, n in enumerate(psf.shape))
    spectrum = scipy.fft.rfft2(psf) * y[:, None] * x[: len(x) // 2 + 1]
    return scipy.fft.irfft2(spectrum, psf.shape)


def _phases(n: int, fraction: float, variance: float, derivative: bool) -> NDArray[np.complex128]:
    """Return what moves a spectrum of n frequencies, or the derivative of that.

    The highest frequency of an even number has no sign: it and its alias share it equally, so that
    a mirrored PSF moves as its mirror image does.
    """
    own = np.fft.fftfreq(n)[:, None]
    frequencies = own + ALIASES
    shares = np.sinc(frequencies) * np.exp(-2.0 * variance * (np.pi * frequencies) ** 2)
    shares /= shares.sum(axis=1, keepdims=True)
    if derivative:
        shares = shares * (-2j * np.pi * frequencies)
    moved = np.exp(-2j * np.pi * fraction * own[:, 0])
    phases: NDArray[np.complex128] = moved * (shares @ np.exp(-2j * np.pi * fraction * ALIASES))
    return phases


def fold(psf: Array, n: int, axis: int) -> Array:
    """Return a PSF on n points of an axis, its middle at ``n // 2``, its wings round the edge."""
    k = psf.shape[axis]
    before = (n // 2 - k // 2) % n
    wide = -(-(k + before) // n) * n
    padding = [(0, 0), (0, 0)]
    padding[axis] = before, wide - k - before
    padded = np.pad(psf, padding)
    shape = (*padded.shape[:axis], wide // n, n, *padded.shape[axis + 1 :])
    return padded.reshape(shape).sum(axis)


def _widen(psf: Array, n: int, axis: int) -> Array:
    """Return a PSF with margins along an axis, or round the whole axis where they do not fit."""
    if psf.shape[axis] + 2 * MARGIN >= n:
        return fold(psf, n, axis)
    padding = [(0, 0), (0, 0)]
    padding[axis] = MARGIN, MARGIN
    return np.pad(psf, padding)
