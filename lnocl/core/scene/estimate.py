"""An estimate: the extended source and the fluxes of a scene, in electrons.

Engines, and what is linear in the images, have other units, in which images are about 1. They are
changed into each other here alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Estimate:
    """The extended source and the fluxes of a scene.

    Attributes
    ----------
    scene : Scene
        What is modelled, with the stars where they are.
    sky : ndarray, shape (Ny, Nx)
        Extended source on the grid, electrons per pixel of it.
    star_fluxes : ndarray of float64, shape (n_fluxes,)
        Of the stars and then of the halos, electrons.
    """

    scene: Scene
    sky: Array
    star_fluxes: Array

    @classmethod
    def of_scaled(cls, scene: Scene, extended: Array, fluxes: Array) -> Estimate:
        """Return the estimate of an extended source and fluxes as engines have them."""
        return cls(scene, extended * scene.unit, fluxes * scene.unit)

    @property
    def extended(self) -> Array:
        """The extended source as engines have it, shape (Ny, Nx)."""
        return self.sky / self.scene.unit

    @property
    def fluxes(self) -> Array:
        """The fluxes as engines have them, shape (n_fluxes,)."""
        return self.star_fluxes / self.scene.unit

    def part(self, places: tuple[NDArray[np.int_], NDArray[np.int_]]) -> Array:
        """Return some pixels of the extended source as engines have them."""
        return np.asarray(self.sky[places] / self.scene.unit)

    @property
    def observed_sky(self) -> Array:
        """The part of the extended source that images show, of `Observation.sky_shape`."""
        ny, nx = self.scene.observation.sky_shape
        return self.sky[:ny, :nx]

    def models(self) -> Iterator[Array]:
        """Yield the m_j on the grid of the images, scaled; one alone is held."""
        from lnocl.core.scene.forward_model import model_images  # which loads scipy

        return model_images(self.scene, self.extended, self.fluxes)
