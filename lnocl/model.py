"""The model of a scene on the host, in double precision: for what is needed once or seldom."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from lnocl.observation import Array
from lnocl.scene import Scene


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
    stars : StarImages
        The P_js.
    """

    def __init__(self, scene: Scene) -> None:
        self.shape = (scene.n_images, *scene.grid)
        self._otfs = np.array([scipy.fft.rfft2(scene.psf(j)) for j in range(scene.n_images)])
        self.weights = np.broadcast_to(
            np.float64(1.0) if scene.weights is None else scene.weights.astype(np.float64),
            self.shape,
        )
        background = scene.background()
        self.background = background if background.ndim == 3 else background[:, None, None]
        self.move_stars(scene)

    def move_stars(self, scene: Scene) -> None:
        """Put the stars where the scene has them now."""
        self.stars = _star_images(scene)

    def forward(self, extended: Array) -> Array:
        """Return the ``A_j f``, shape (p, Ny, Nx)."""
        spectra = self._otfs * scipy.fft.rfft2(extended)
        return scipy.fft.irfft2(spectra, self.shape[1:], workers=-1, overwrite_x=True)

    def adjoint(self, arrays: Array) -> Array:
        """Return ``sum_j A_j^T x_j``, shape (Ny, Nx)."""
        spectra = scipy.fft.rfft2(arrays, workers=-1)
        spectrum = np.einsum("jyx,jyx->yx", self._otfs.conj(), spectra)
        return scipy.fft.irfft2(spectrum, self.shape[1:])

    def starlight(self, star_fluxes: Array) -> Array:
        """Return ``sum_s c_s P_js``, shape (p, Ny, Nx)."""
        return self.stars.light(star_fluxes).reshape(self.shape)

    def images(self, extended: Array, star_fluxes: Array) -> Array:
        """Return the m_j, not below 0."""
        model = self.forward(extended) + self.starlight(star_fluxes) + self.background
        return np.maximum(model, 0.0)


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
        rows = [self.products(weights * self.light(unit)) for unit in np.eye(len(self))]
        return np.array(rows).reshape(len(self), len(self))

    def on_lit_pixels(self) -> tuple[Pixels, StarImages]:
        """Return the pixels that any star lights, and the images over these alone."""
        is_lit = np.zeros(self.size, bool)
        for pixels, _ in self.lit:
            is_lit[pixels] = True
        size = int(is_lit.sum())
        place = np.cumsum(is_lit) - 1
        lit = [(_unless_all(place[pixels], size), values) for pixels, values in self.lit]
        return _unless_all(np.flatnonzero(is_lit), self.size), StarImages(size, lit)


def _unless_all(pixels: NDArray[np.int64], size: int) -> Pixels:
    return slice(None) if len(pixels) == size else pixels


def _star_images(scene: Scene) -> StarImages:
    lit = []
    for s in range(scene.n_stars):
        images = [scene.star_image(j, s).ravel() for j in range(scene.n_images)]
        star = np.concatenate(images)
        pixels = np.flatnonzero(star)
        lit.append((_unless_all(pixels, star.size), star[pixels]))
    return StarImages(scene.n_images * scene.grid[0] * scene.grid[1], lit)
