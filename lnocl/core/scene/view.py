"""An image of a scene, whole or in a window: its counts, its model, and what sources add to it."""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.camera import Camera, Ranges, ranges
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.shifting import Cutout

Places = tuple[NDArray[np.int_], NDArray[np.int_]]


class Window(NamedTuple):
    """A window of a periodic grid: its first row and column, and its shape."""

    y: int
    x: int
    shape: tuple[int, int]

    def of(self, grid: tuple[int, int]) -> Places:
        """Return its rows and columns, to index arrays on the grid with."""
        rows, columns = (
            np.arange(first, first + k) % n
            for first, k, n in zip((self.y, self.x), self.shape, grid, strict=True)
        )
        return rows[:, None], columns

    @property
    def ranges(self) -> Ranges:
        """Its rows and columns, without an end."""
        return ranges((self.y, self.x), self.shape)

    def finer(self, q: int) -> Window:
        """Return the pixels of a sky q times as fine that it holds."""
        return Window(q * self.y, q * self.x, (q * self.shape[0], q * self.shape[1]))


class View:
    """An image in a window of it, scaled and per exposure as `Scene` has it.

    Parameters
    ----------
    scene : Scene
        With the images.
    j : int
        Which image.
    window : Window, optional
        Of the image; by default the grid of the images.

    Attributes
    ----------
    counts, background, weights : ndarray of float64, shape of the window
        The g_j, b_j and w_j, 0, 1 and 0 where nothing was observed.
    """

    def __init__(self, scene: Scene, j: int, window: Window | None = None) -> None:
        self.scene, self.j = scene, j
        self.window = window or Window(0, 0, scene.image_grid)
        self.there = self.window.of(scene.image_grid)

    @classmethod
    def round(cls, scene: Scene, j: int, window: Window) -> View:
        """Return image j round the middle of a window of the sky, as wide as that.

        The window is in pixels of the images.
        """
        height, width = window.shape
        middle = np.array([window.x + width // 2, window.y + height // 2])
        x, y = np.round(scene.observation.places(j, middle)).astype(int).tolist()
        # Larger pixels are fewer.
        ny, nx = (math.ceil(n / scene.observation.scales[j]) for n in window.shape)
        return cls(scene, j, Window(y - ny // 2, x - nx // 2, (ny, nx)))

    @cached_property
    def counts(self) -> Array:
        """The g_j."""
        return self._observed(self.scene.observation.images[self.j], 0.0)

    @cached_property
    def background(self) -> Array:
        """The b_j."""
        background = self.scene.observation.background[self.j]
        if background.ndim:
            return self._observed(background, 1.0)
        level = np.full(self.window.shape, background / self.scene.scale)
        return self._per_exposure(level, 1.0)

    @cached_property
    def weights(self) -> Array:
        """The w_j."""
        if self.scene.weights is None:
            return np.ones(self.window.shape)
        return np.asarray(self.scene.weights[self.j][self.there], np.float64)

    def _observed(self, image: Array, beyond: float) -> Array:
        rows, columns = self.there
        inside = (rows < image.shape[0]) & (columns < image.shape[1])
        last = image.shape[0] - 1, image.shape[1] - 1
        pixels = image[np.minimum(rows, last[0]), np.minimum(columns, last[1])]
        return self._per_exposure(np.where(inside, pixels / self.scene.scale, beyond), beyond)

    def _per_exposure(self, values: Array, fill: float) -> Array:
        return self.scene.per_exposure(values, fill, self.j, self.there)

    def model(self, estimate: Estimate, camera: Camera | None = None) -> Array:
        """Return the m_j. The camera is that of the image, where it is at hand."""
        scene, window, fluxes = self.scene, self.window, estimate.fluxes
        camera = camera or Camera(scene, self.j)
        image = self.background + camera.part(estimate.sky, window.ranges) / scene.unit
        # The window may reach beyond the grid, which is not a period of images that are turned.
        for s in scene.star_field.reaching(self.j, window[:2], window.shape):
            self._add(scene.star_cutout(self.j, s), image, fluxes[s])
        return image

    def cut(self, cutout: Cutout) -> Array:
        """Return what lies in the window of a part of the image, and 0 elsewhere."""
        return self._add(cutout, np.zeros((*cutout.values.shape[:-2], *self.window.shape)), 1.0)

    def _add(self, cutout: Cutout, image: Array, flux: float) -> Array:
        return cutout.add_to(image, self.window[:2], self.scene.image_grid, flux)

    @cached_property
    def levels(self) -> Array:
        """Changes of the image where its background rises by 1, or by 1 across it along x and y.

        They have the shape (3, height, width).
        """
        return self._per_exposure(planes(self.scene.observation, *self.there), 0.0)


def planes(observation: Observation, y: NDArray, x: NDArray) -> Array:
    """Return one, and what rises by one across an image along x and y, at rows y and columns x.

    y and x have the shapes (h, 1) and (w,); the result has (3, h, w).
    """
    across = [each / max(n - 1, 1) - 0.5 for each, n in zip((y, x), observation.shape, strict=True)]
    ones = np.ones((len(y), len(x)))
    return np.array([ones, across[1] * ones, across[0] * ones])
