"""The model of a scene on the host, in double precision: for what is needed once or seldom."""

from __future__ import annotations

import numpy as np
import scipy.fft
import scipy.sparse

from lnocl.observation import Array
from lnocl.scene import Scene


class Model:
    """The linear maps of a scene: ``m_j = A_j f + sum_s c_s P_js + b_j``, on the grid and scaled.

    Attributes
    ----------
    shape : tuple of int
        (p, Ny, Nx).
    weights : ndarray of float64, shape (p, Ny, Nx)
        1 where a pixel was observed, else 0.
    background : ndarray of float64, shape (p, 1, 1) or (p, Ny, Nx)
        b_j.
    stars : scipy.sparse.csr_array, shape (n, p Ny Nx)
        The star images P_js.
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
        return (self.stars.T @ star_fluxes).reshape(self.shape)

    def images(self, extended: Array, star_fluxes: Array) -> Array:
        """Return the m_j, not below 0."""
        model = self.forward(extended) + self.starlight(star_fluxes) + self.background
        return np.maximum(model, 0.0)


def _star_images(scene: Scene) -> scipy.sparse.csr_array:
    size = scene.n_images * scene.grid[0] * scene.grid[1]
    values, indices = [np.empty(0)], [np.empty(0, np.int64)]
    for s in range(scene.n_stars):
        images = [scene.star_image(j, s).ravel() for j in range(scene.n_images)]
        star = np.concatenate(images)
        indices.append(np.flatnonzero(star))
        values.append(star[indices[-1]])
    ends = np.cumsum([len(lit) for lit in indices])
    return scipy.sparse.csr_array(
        (np.concatenate(values), np.concatenate(indices), ends), (scene.n_stars, size)
    )
