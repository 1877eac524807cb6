"""Rings round stars: what an image of the sky has all round them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from lnocl.core.scene.arrays import Array

# A ring is a pixel wide, or this share of its radius.
WIDTH = 0.15


class Rings:
    """Rings round stars, each pixel in that of the star nearest to it.

    Parameters
    ----------
    shape : tuple of int
        Of the images, (ny, nx).
    positions : ndarray of float64, shape (n, 2)
        Of the stars, (x, y), pixels; one or more.
    oversample : int, optional
        Pixels of the array to one of the images along each axis: radii are in those of the images.

    Attributes
    ----------
    edges : ndarray of float64
        Radii at which rings begin and end, pixels.
    number : ndarray of int, shape (ny, nx)
        The ring that each pixel is in, counted from the star outwards.
    """

    def __init__(self, shape: tuple[int, int], positions: Array, oversample: int = 1) -> None:
        y, x = np.indices(shape)
        distance = KDTree(positions).query(np.stack([x, y], axis=-1))[0] / oversample
        edges = [0.0]
        while edges[-1] <= distance.max():
            edges.append(edges[-1] + max(1.0, WIDTH * edges[-1]))
        self.edges = np.array(edges)
        self.number = np.digitize(distance, self.edges) - 1

    def __len__(self) -> int:
        return len(self.edges) - 1

    def sums(self, image: Array) -> Array:
        """Return the sum of the pixels in each ring, round all stars."""
        return np.asarray(np.bincount(self.number.ravel(), image.ravel(), len(self)), np.float64)
