"""PSFs that are finer than the pixels of the images: what these see of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.shifting import ENDLESS, Cutout, MovablePsf, movable_psf


def movable_psfs(
    psfs: Iterable[Array], observation: Observation, grid: tuple[int, int]
) -> list[Movable]:
    """Return PSFs to be placed on the images' grid, as its pixels see them."""
    if observation.oversample == 1:
        return [movable_psf(psf, grid) for psf in psfs]
    oversample, are_effective = observation.oversample, observation.effective_psfs
    return [DetectorPsf(psf, grid, oversample, are_effective) for psf in psfs]


def pixel_spectrum(v: NDArray[Any], u: NDArray[Any], observation: Observation) -> Array:
    """Return the factors by which pixels change the spectra of PSFs, at frequencies 1 / pixel.

    Those of the response h over those of K (`DetectorPsf`), each about its middle; 1 without
    oversampling.
    """
    q = observation.oversample
    if observation.effective_psfs:
        return np.full(np.broadcast_shapes(v.shape, u.shape), float(q**2))
    places = 2.0 * np.pi * (np.arange(q) - (q - 1) / 2.0)
    along, across = (np.cos(np.multiply.outer(each, places)).sum(axis=-1) for each in (v, u))
    return np.asarray(along * across)


def psfs_with_pixels(observation: Observation) -> list[Array]:
    """Return the PSFs as pixels of the images see points of a finer sky; their sums stay."""
    q = observation.oversample
    if q == 1 or observation.effective_psfs:
        return list(observation.psfs)
    movable = movable_psfs(observation.psfs, observation, ENDLESS)
    return [psf.on_sky(0.0, 0.0).about_origin() / q**2 for psf in movable]


def psfs_on_detector(observation: Observation, psfs: Array | None = None) -> Array:
    """Return the PSFs, or others, as the pixels of the images see a star in the middle of one.

    Shape (p, n, n), the star at ``n // 2``; without oversampling they are those given.
    """
    q, psfs = observation.oversample, observation.psfs if psfs is None else psfs
    if q == 1:
        return psfs
    half = -(-max(psfs.shape[1:]) // (2 * q)) + 1
    n = 2 * half + 1
    movable = movable_psfs(psfs, observation, (n, n))
    return np.array([psf.at(half, half).on_grid((n, n)) for psf in movable])


def on_sky(positions: Array, oversample: int) -> Array:
    """Return positions in pixels of the images in those of the sky."""
    return oversample * positions + (oversample - 1) / 2.0


class DetectorPsf:
    """A PSF finer than the pixels of an image, which sees it at any position.

    Pixel n of an image sees the fine pixels q n to q n + q - 1 along each axis, q being
    `oversample`. For a source of one count in fine pixel u, ``h(q n - u)`` are in pixel n. The
    response h is ``sum_b K(v + b)``, 0 <= b < q along each axis, of a PSF that holds what fine
    pixels see; of an effective PSF, which holds what a pixel of the image sees, it is
    ``q^2 K(v + (q - 1) / 2)``.

    Parameters
    ----------
    psf : ndarray of float64, shape (ky, kx)
        K, of unit sum but for the gain of its image, on fine pixels.
    grid : tuple of int
        Shape (ny, nx) of the images' grid.
    oversample : int
        q.
    is_effective : bool
        Whether it is an effective PSF.

    Attributes
    ----------
    fine : MovablePsf
        The PSF on the pixels of the sky.

    References
    ----------
    J. Anderson, I. R. King, PASP 112, 1360 (2000), for the effective PSF.
    """

    def __init__(
        self, psf: Array, grid: tuple[int, int], oversample: int, is_effective: bool
    ) -> None:
        self._q, self._fine_grid = oversample, (oversample * grid[0], oversample * grid[1])
        self.fine, self._is_effective = movable_psf(psf, self._fine_grid), is_effective
        # From the middle of a pixel to the first of its fine pixels, in these.
        self._half = (oversample - 1) / 2.0
        self._lag = self._half if is_effective else 0.0

    @property
    def contents(self) -> tuple[object, ...]:
        """What tells it from others."""
        return self.fine, self._q, self._is_effective

    @property
    def nbytes(self) -> int:
        """Bytes, as of `fine`."""
        return self.fine.nbytes

    def changed(self, function: Callable[[Array], Array]) -> DetectorPsf:
        """Return what a function makes of the PSF, seen by the same pixels."""
        other = copy(self)
        other.fine = self.fine.changed(function)
        return other

    def response(self, x: float, y: float) -> Cutout:
        """Return h on the fine grid, the sky moved by so many pixels of the image."""
        return self._seen(self.fine.at(self._q * x - self._lag, self._q * y - self._lag))

    def on_sky(self, x: float, y: float) -> Cutout:
        """Return a star's light in a detector pixel whose corner lies at each fine pixel."""
        return self._seen(self.fine.at(*self._on_fine_pixels(x, y)))

    def at(self, x: float, y: float, axis: int | None = None) -> Cutout:
        """Return the image of a star at a position, pixels, or a derivative, as `place` does."""
        cutout = self.fine.at(*self._on_fine_pixels(x, y), axis)
        per_pixel = 1.0 if axis is None else float(self._q)
        return self._sampled(self._seen(cutout._replace(values=per_pixel * cutout.values)))

    def with_slopes(self, x: float, y: float) -> Cutout:
        """Return the image of a star and its derivatives along x and y, (3, h, w)."""
        cutout = self.fine.with_slopes(*self._on_fine_pixels(x, y))
        per_pixel = np.array([1.0, self._q, self._q])[:, None, None]
        return self._sampled(self._seen(cutout._replace(values=per_pixel * cutout.values)))

    def _on_fine_pixels(self, x: float, y: float) -> tuple[float, float]:
        shift = self._half - self._lag
        return self._q * x + shift, self._q * y + shift

    def _seen(self, cutout: Cutout) -> Cutout:
        """Return the light in a detector pixel that begins at each fine pixel."""
        if self._is_effective:
            return cutout._replace(values=self._q**2 * cutout.values)
        y, values = _sum_ahead(cutout.values, cutout.y, self._q, self._fine_grid[0], -2)
        x, values = _sum_ahead(values, cutout.x, self._q, self._fine_grid[1], -1)
        return Cutout(values, y, x)

    def _sampled(self, cutout: Cutout) -> Cutout:
        """Return the light in the pixels of the image, every q-th of the fine ones."""
        q, (values, top, left) = self._q, cutout
        y, x = -(-top // q), -(-left // q)
        return Cutout(values[..., q * y - top :: q, q * x - left :: q], y, x)


# What moves a PSF to a star: on pixels of the sky, or of larger ones.
Movable = MovablePsf | DetectorPsf


def _sum_ahead(values: Array, first: int, q: int, n: int, axis: int) -> tuple[int, Array]:
    """Return the sums over each point and the q - 1 behind it of n round the edge, and the first.

    Beyond the values, whose first point is given, there is 0.
    """
    size = values.shape[axis]
    padding = [(0, 0)] * values.ndim
    if size + q - 1 > n:  # it goes round
        padding[axis] = 0, n - size
        values = np.pad(values, padding)
        return first, np.sum([np.roll(values, -b, axis) for b in range(q)], axis=0)
    padding[axis] = q - 1, q - 1
    padded = np.pad(values, padding)
    length = size + q - 1
    places = (np.arange(b, b + length) for b in range(q))
    return first - (q - 1), np.sum([padded.take(at, axis) for at in places], axis=0)
