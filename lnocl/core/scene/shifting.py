"""A PSF at any position of a periodic grid, between pixels too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.remembered import remembered

# Pixels added on each side of a PSF before it is moved by a fraction: ringing beyond the edges of
# its array dies out in them.
MARGIN = 16
# Aliases of a frequency, 1 / pixel, that are told apart: more would be lost in rounding.
ALIASES = np.arange(-6, 7)
# A smaller share of the light at the highest frequency is taken for rounding.
MIN_NYQUIST = 1e-16

# A grid that no PSF goes round.
ENDLESS = 2**31, 2**31

# Rows and columns of PSFs.
AXES = -2, -1

# Rows and columns of an array: slices, or arrays of indices where they wrap round its edge.
Window = tuple[Any, Any]


class Cutout(NamedTuple):
    """Part of a periodic grid: its values, and the row and column of the first of them.

    Several functions of the same pixels have values of shape (k, h, w).
    """

    values: Array
    y: int
    x: int

    def on_grid(self, grid: tuple[int, int]) -> Array:
        """Return the values on the whole grid, 0 elsewhere."""
        laid = np.zeros((*self.values.shape[:-2], *grid))
        laid[..., *self.window(grid)] = self.values
        return laid

    def window(self, grid: tuple[int, int]) -> Window:
        """Return where the values lie, as an index of arrays on the grid."""
        return window(self.y, self.x, self.values.shape[-2:], grid)

    def rows(self, grid: tuple[int, int]) -> NDArray[np.int_]:
        """Return the rows of the grid that the values lie in."""
        return (self.y + np.arange(self.values.shape[-2])) % grid[0]

    def columns(self, grid: tuple[int, int]) -> NDArray[np.int_]:
        """Return the columns of the grid that the values lie in."""
        return (self.x + np.arange(self.values.shape[-1])) % grid[1]

    def add_to(
        self, light: Array, first: tuple[int, int], grid: tuple[int, int], flux: float = 1.0
    ) -> Array:
        """Add the values times a flux to the light in a window of the grid; return that light.

        The window has a first row and column, and may go round the edges of the grid.
        """
        y, x = (self.rows(grid) - first[0]) % grid[0], (self.columns(grid) - first[1]) % grid[1]
        y_in, x_in = y < light.shape[-2], x < light.shape[-1]
        light[..., *np.ix_(y[y_in], x[x_in])] += flux * self.values[..., *np.ix_(y_in, x_in)]
        return light

    def aligned(self, grid: tuple[int, int]) -> Cutout:
        """Return the same values, those that fill an axis of the grid beginning at its origin."""
        y, x = (
            (first, 0) if size == n else (0, first)
            for first, size, n in zip((self.y, self.x), self.values.shape, grid, strict=True)
        )
        values = np.roll(self.values, (y[0], x[0]), axis=(0, 1)) if y[0] or x[0] else self.values
        return Cutout(values, y[1], x[1])

    def about_origin(self) -> Array:
        """Return the values on an array with the origin of the grid in its middle."""
        ends = zip(self[1:], self.values.shape, strict=True)
        halves = [max(-first, first + size - 1) for first, size in ends]
        laid = np.zeros([2 * half + 1 for half in halves])
        return self.add_to(laid, (-halves[0], -halves[1]), ENDLESS)

    def blurred(self, deviation: float, grid: tuple[int, int]) -> Cutout:
        """Return the values convolved with a Gaussian of this standard deviation, pixels.

        They may go round the edges of the grid.
        """
        if not deviation:
            return self
        from scipy.ndimage import gaussian_filter

        margin = 2 * int(np.ceil(4.0 * deviation))
        more = [min(margin, n - size) for n, size in zip(grid, self.values.shape, strict=True)]
        wide = np.pad(self.values, [(n // 2, n - n // 2) for n in more])
        values = gaussian_filter(wide, deviation, mode="wrap")
        return Cutout(values, self.y - more[0] // 2, self.x - more[1] // 2)

    def trimmed(self, least: float) -> Cutout:
        """Return the cutout without outer rows and columns whose values all are this or less.

        One pixel is left, at least.
        """
        large = abs(self.values).reshape(-1, *self.values.shape[-2:]).max(axis=0) > least
        rows, columns = (np.flatnonzero(large.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return Cutout(self.values[..., :1, :1], self.y, self.x)
        inner = np.s_[..., rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        values = np.ascontiguousarray(self.values[inner])
        return Cutout(values, self.y + int(rows[0]), self.x + int(columns[0]))


def window(y: int, x: int, shape: Sequence[int], grid: tuple[int, int]) -> Window:
    """Return the index of a window of this shape on a periodic grid, its first pixel at (y, x)."""
    first = y % grid[0], x % grid[1]
    last = first[0] + shape[0], first[1] + shape[1]
    if last[0] <= grid[0] and last[1] <= grid[1]:
        return slice(first[0], last[0]), slice(first[1], last[1])
    rows, columns = (np.arange(a, b) % n for a, b, n in zip(first, last, grid, strict=True))
    return rows[:, None], columns


class MovablePsf:
    """A PSF to be placed at several positions of a grid; its spectrum is made once.

    Parameters
    ----------
    psf : ndarray of float64, shape (ky, kx) or (k, ky, kx)
        Of any size; where it is larger than the grid it is wrapped round. Several are placed alike.
    grid : tuple of int
        Shape (Ny, Nx).
    """

    def __init__(self, psf: Array, grid: tuple[int, int]) -> None:
        self._psf, self._grid = psf, grid

    @property
    def contents(self) -> tuple[object, ...]:
        """What tells it from others."""
        return self._psf, self._grid

    @property
    def nbytes(self) -> int:
        """Bytes, of its spectrum in margins too."""
        return 4 * self._psf.nbytes

    def at(self, x: float, y: float, axis: int | None = None) -> Cutout:
        """Return the PSF at a position, or a derivative, as `place` does."""
        whole = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
        fraction = y - whole[0], x - whole[1]
        is_moved = any(fraction) or axis is not None
        values = self._spectrum.moved(fraction, axis) if is_moved else self._folded
        return Cutout(values, *(i - n // 2 for i, n in zip(whole, values.shape[-2:], strict=True)))

    @property
    def fine(self) -> MovablePsf:
        """The PSF on the pixels of the sky."""
        return self

    def changed(self, function: Callable[[Array], Array]) -> MovablePsf:
        """Return what a function makes of the PSF, to be placed alike."""
        return MovablePsf(function(self._psf), self._grid)

    def on_sky(self, x: float, y: float) -> Cutout:
        """Return the PSF at a position."""
        return self.at(x, y)

    def response(self, x: float, y: float) -> Cutout:
        """Return the image of a source at the origin, with the sky moved by (x, y) pixels."""
        return self.at(x, y)

    def with_slopes(self, x: float, y: float) -> Cutout:
        """Return the PSF at a position and its derivatives along x and y, (3, h, w)."""
        whole = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
        values = self._spectrum.with_slopes((y - whole[0], x - whole[1]))
        first = (i - n // 2 for i, n in zip(whole, values.shape[1:], strict=True))
        return Cutout(values, *first)

    @cached_property
    def _folded(self) -> Array:
        psf = self._psf
        for i, n in zip(AXES, self._grid, strict=True):
            if psf.shape[i] > n:
                psf = fold(psf, n, i)
        return psf

    @cached_property
    def _spectrum(self) -> _Spectrum:
        psf = self._psf
        for i, n in zip(AXES, self._grid, strict=True):
            psf = _widen(psf, n, i)
        variances = _variance(self._psf.sum(axis=-1)), _variance(self._psf.sum(axis=-2))
        return _Spectrum(psf, variances)


def movable_psf(psf: Array, grid: tuple[int, int]) -> MovablePsf:
    """Return a `MovablePsf`; a small one is kept, but a large one would take long to be told."""
    return _kept_psf(psf, grid) if psf.nbytes <= 2**20 else MovablePsf(psf, grid)


@remembered(2**24)  # scenes of one call have the same
def _kept_psf(psf: Array, grid: tuple[int, int]) -> MovablePsf:
    return MovablePsf(psf.copy(), grid)


def place(psf: Array, grid: tuple[int, int], x: float, y: float, axis: int | None = None) -> Cutout:
    """Return a PSF with its middle, pixel ``(ky // 2, kx // 2)``, at a position of a grid.

    Whole pixels move it as it is; the fraction left, at most half a pixel, by the phase
    ``exp(-2 pi i (kx dx / nx + ky dy / ny))`` of its spectrum. Its sum stays, but for rounding.

    Each frequency f that the pixels can hold includes the light at its aliases f + 1, f - 1 ... per
    pixel, which move by other phases. It is shared out among these, along each axis, in the ratio
    of ``sinc(f) exp(-2 pi^2 sigma^2 f^2)``, a Gaussian's integrated over pixels, with the sigma
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
    return MovablePsf(psf, grid).at(x, y, axis)


def _variance(profile: Array) -> Array:
    """Return the sigma^2 of the Gaussian, integrated over pixels, with as much at 1 / 2 per pixel.

    It and its alias -1 / 2 have ``2 sinc(1 / 2) exp(-pi^2 sigma^2 / 2)`` together, of unit light.
    """
    signs = 1 - 2 * (np.arange(profile.shape[-1]) % 2)
    light = profile.sum(axis=-1)
    share = np.divide(abs(profile @ signs), light, out=np.ones_like(light), where=light != 0)
    return np.asarray(2.0 / np.pi**2 * np.log(4.0 / np.pi / share.clip(MIN_NYQUIST, 1.0)))


class _Spectrum:
    """The spectrum of a PSF in its margins, and how its frequencies move along each axis."""

    def __init__(self, psf: Array, variances: tuple[Array, Array]) -> None:
        # Imported here: it takes a twentieth of a second, which stars on whole pixels need not.
        import scipy.fft

        self._shape, self._inverse = psf.shape[-2:], scipy.fft.irfft2
        self._values = scipy.fft.rfft2(psf)
        self._phases = [_Phases(n, each) for n, each in zip(self._shape, variances, strict=True)]

    def moved(self, fraction: tuple[float, float], axis: int | None) -> Array:
        """Return the PSF moved by fractions of a pixel (dy, dx), or a derivative of that."""
        y, x = (p.at(fraction[i], i == axis) for i, p in enumerate(self._phases))
        moved: Array = self._inverse(self._values * y[..., None] * _half(x), self._shape)
        return moved

    def with_slopes(self, fraction: tuple[float, float]) -> Array:
        """Return the PSF moved and its derivatives along x and y, shape (3, h, w)."""
        y, x = (p.at(fraction[i], False) for i, p in enumerate(self._phases))
        slope_y, slope_x = (p.at(fraction[i], True) for i, p in enumerate(self._phases))
        along = np.array([y, y, slope_y])[:, :, None]
        across = np.array([_half(x), _half(slope_x), _half(x)])
        values: Array = self._inverse(self._values * along * across, self._shape)
        return values


def _half(phases: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the factors of the frequencies that a real transform holds."""
    return phases[..., None, : phases.shape[-1] // 2 + 1]


class _Phases:
    """Return the factors that move a spectrum of n frequencies along an axis.

    The highest frequency of an even number has no sign: it and its alias share it equally, so that
    a mirrored PSF moves as its mirror image does.
    """

    def __init__(self, n: int, variance: Array) -> None:
        self._own = np.fft.fftfreq(n)
        frequencies = self._own[:, None] + ALIASES
        squares = (np.pi * frequencies) ** 2
        shares = np.sinc(frequencies) * np.exp(-2.0 * variance[..., None, None] * squares)
        self._shares = shares / shares.sum(axis=-1, keepdims=True)
        self._slopes = self._shares * (-2j * np.pi * frequencies)

    def at(self, fraction: float, derivative: bool) -> NDArray[np.complex128]:
        """Return the factors for a fraction of a pixel, or the derivatives of these."""
        moved = np.exp(-2j * np.pi * fraction * self._own)
        aliases = np.exp(-2j * np.pi * fraction * ALIASES)
        factors: NDArray[np.complex128] = (self._slopes if derivative else self._shares) @ aliases
        return moved * factors


def fold(psf: Array, n: int, axis: int) -> Array:
    """Return a PSF on n points of an axis, its middle at ``n // 2``, its wings round the edge."""
    k = psf.shape[axis]
    before = (n // 2 - k // 2) % n
    wide = -(-(k + before) // n) * n
    padding = [(0, 0)] * psf.ndim
    padding[axis] = before, wide - k - before
    padded = np.pad(psf, padding)
    at = axis % psf.ndim
    shape = (*padded.shape[:at], wide // n, n, *padded.shape[at + 1 :])
    return padded.reshape(shape).sum(at)


def _widen(psf: Array, n: int, axis: int) -> Array:
    """Return a PSF with margins along an axis, or round the whole axis where they do not fit."""
    if psf.shape[axis] + 2 * MARGIN >= n:
        return fold(psf, n, axis)
    padding = [(0, 0)] * psf.ndim
    padding[axis] = MARGIN, MARGIN
    return np.pad(psf, padding)
