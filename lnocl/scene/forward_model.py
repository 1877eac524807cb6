"""The model of a scene on the host, in double precision: for what is needed once or seldom."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from lnocl.scene.observation import Array
from lnocl.scene.scene import Scene


class Model:
    """The linear maps of a scene: ``m_j = A_j f + sum_s c_s P_js + b_j``, on the grid and scaled.

    Attributes
    ----------
    shape : tuple of int
        (p, Ny, Nx).
    weights : ndarray of float64, shape (p, Ny, Nx)
        Its relative exposure where a pixel was observed, else 0.
    background : ndarray of float64, shape (p, 1, 1) or (p, Ny, Nx)
        b_j.
    stars : list of StarImages
        The P_js of each image.

    Notes
    -----
    Images are worked on one after the other: fresh memory for all at once would cost more time than
    the arithmetic on it.
    """

    def __init__(self, scene: Scene) -> None:
        self.shape = (scene.n_images, *scene.grid)
        self._otfs = [scipy.fft.rfft2(scene.psf(j), workers=-1) for j in range(scene.n_images)]
        self.weights = np.broadcast_to(
            np.float64(1.0) if scene.weights is None else scene.weights.astype(np.float64),
            self.shape,
        )
        background = scene.background()
        self.background = background if background.ndim == 3 else background[:, None, None]
        self.move_stars(scene)

    def move_stars(self, scene: Scene) -> None:
        """Put the stars where the scene has them now."""
        self.stars = [_star_images(scene, j) for j in range(scene.n_images)]

    def forward(self, extended: Array) -> Array:
        """Return the ``A_j f``, shape (p, Ny, Nx)."""
        spectrum = scipy.fft.rfft2(extended, workers=-1)
        images = np.empty(self.shape)
        for image, otf in zip(images, self._otfs, strict=True):
            image[:] = scipy.fft.irfft2(otf * spectrum, image.shape, workers=-1, overwrite_x=True)
        return images

    def adjoint(self, arrays: Iterable[Array]) -> Array:
        """Return ``sum_j A_j^T x_j``, shape (Ny, Nx)."""
        spectrum = np.zeros_like(self._otfs[0])
        for array, otf in zip(arrays, self._otfs, strict=True):
            spectrum += otf.conj() * scipy.fft.rfft2(array, workers=-1)
        return scipy.fft.irfft2(spectrum, self.shape[1:], workers=-1, overwrite_x=True)

    def starlight(self, star_fluxes: Array) -> Iterator[Array]:
        """Yield ``sum_s c_s P_js`` of each image, shape (Ny, Nx)."""
        for stars in self.stars:
            yield stars.light(star_fluxes).reshape(self.shape[1:])

    def images(self, extended: Array, star_fluxes: Array) -> Array:
        """Return the m_j, not below 0."""
        images = self.forward(extended)
        for image, background, light in zip(
            images, self.background, self.starlight(star_fluxes), strict=True
        ):
            image += background
            image += light
            np.maximum(image, 0.0, out=image)
        return images


# All pixels are a slice, which takes no gathering and scattering.
Pixels = NDArray[np.int64] | slice


class StarImages:
    """Images of stars over some pixels, in one dimension, of which they light few or all.

    Attributes
    ----------
    size : int
        Number of pixels.
    lit : list of (ndarray of int64 or slice, ndarray of float64)
        For each star the pixels that it lights, and P there.
    """

    def __init__(self, size: int, lit: list[tuple[Pixels, Array]]) -> None:
        self.size, self.lit = size, lit

    def __len__(self) -> int:
        return len(self.lit)

    def light(self, fluxes: Array) -> Array:
        """Return ``sum_s c_s P_s``."""
        total = np.zeros(self.size)
        for flux, (pixels, values) in zip(fluxes, self.lit, strict=True):
            total[pixels] += flux * values
        return total

    def products(self, x: Array) -> Array:
        """Return the ``<P_s, x>``."""
        return np.array([values @ x[pixels] for pixels, values in self.lit])

    def information(self, weights: Array) -> Array:
        """Return the ``<P_s, w P_t>``."""
        rows = []
        for pixels, values in self.lit:
            weighted = np.zeros(self.size)
            weighted[pixels] = weights[pixels] * values
            rows.append(self.products(weighted))
        return np.array(rows).reshape(len(self), len(self))

    def on_lit_pixels(self) -> tuple[Pixels, StarImages]:
        """Return the pixels that any star lights, and the images over these alone."""
        is_lit = np.zeros(self.size, bool)
        for pixels, _ in self.lit:
            is_lit[pixels] = True
        if is_lit.all():
            return slice(None), self
        size = int(is_lit.sum())
        place = np.cumsum(is_lit) - 1
        lit = [(_unless_all(place[pixels], size), values) for pixels, values in self.lit]
        return np.flatnonzero(is_lit), StarImages(size, lit)


def _unless_all(pixels: NDArray[np.int64], size: int) -> Pixels:
    return slice(None) if len(pixels) == size else pixels


def _star_images(scene: Scene, j: int) -> StarImages:
    lit: list[tuple[Pixels, Array]] = []
    for s in range(scene.n_stars):
        star = scene.star_image(j, s).ravel()
        pixels = np.flatnonzero(star)
        lit.append((_unless_all(pixels, star.size), star[pixels]))
    return StarImages(scene.grid[0] * scene.grid[1], lit)
