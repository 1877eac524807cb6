"""Rings round stars: what an image of the sky has all round them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from lnocl.core.scene.arrays import Array

# A ring is a pixel wide, or this share of its radius.
WIDTH = 0.15
# A tree finds the nearest of more stars than this sooner than all of them are tried.
FEW = 16


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
        distance = _to_nearest(shape, positions) / oversample
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


def _to_nearest(shape: tuple[int, int], positions: Array) -> Array:
    """Return the distance of each pixel from the nearest position."""
    if len(positions) > FEW:
        y, x = np.indices(shape)
        return np.asarray(KDTree(positions).query(np.stack([x, y], axis=-1))[0])
    rows, columns = np.arange(shape[0])[:, None], np.arange(shape[1])
    squares = np.full(shape, np.inf)
    for x, y in positions:
        np.minimum(squares, (rows - y) ** 2 + (columns - x) ** 2, out=squares)
    return np.asarray(np.sqrt(squares))
