"""An estimate: the extended source and the fluxes of a scene, in electrons.

Engines, and what is linear in the images, have other units, in which images are about 1. They are
changed into each other here alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

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
    sky : ndarray, shape (Ny, Nx), or with several skies (K, Ny, Nx)
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
        return self.sky[..., :ny, :nx]

    @cached_property
    def parts(self) -> list[Part]:
        """What the images of each filter show, as one sky; this estimate where it has one."""
        scene = self.scene
        if scene.mixing is None:
            return [Part(range(scene.n_images), np.arange(scene.n_fluxes), self)]
        found = []
        for images, sky in zip(scene.mixing.images, scene.mixing.seen(self.sky), strict=True):
            fluxes = scene.fluxes_of(images)
            own = Estimate(scene.of_images(images), sky, self.star_fluxes[fluxes])
            found.append(Part(images, fluxes, own))
        return found

    def changed(self, change: Callable[[Estimate], Estimate]) -> Estimate:
        """Return the estimate whose parts are changed; skies are not below 0."""
        mixing = self.scene.mixing
        if mixing is None:
            return change(self)
        pairs = [(part, change(part.estimate)) for part in self.parts]
        scene, fluxes = copy(self.scene), self.star_fluxes.copy()
        for part, after in pairs:
            fluxes[part.fluxes] = after.star_fluxes
        observations = [(part.images, after.scene.observation) for part, after in pairs]
        scene.observation = scene.observation.joined(observations)
        added = mixing.components([after.sky - part.estimate.sky for part, after in pairs])
        return Estimate(scene, np.maximum(self.sky + added, 0.0), fluxes)

    def models(self) -> Iterator[Array]:
        """Yield the m_j on the grid of the images, scaled; one alone is held."""
        from lnocl.core.scene.forward_model import model_images  # which loads scipy

        return model_images(self.scene, self.extended, self.fluxes)


class Part(NamedTuple):
    """A part of an estimate.

    Attributes
    ----------
    images : sequence of int
        Its images.
    fluxes : ndarray of int
        Its fluxes, by their numbers among all.
    estimate : Estimate
        That of its sky and fluxes.
    """

    images: Sequence[int]
    fluxes: NDArray[np.intp]
    estimate: Estimate
