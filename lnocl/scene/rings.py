"""Rings round stars: what an image of the sky has all round them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lnocl.scene.arrays import Array

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
        distance, nearest = KDTree(positions).query(np.stack([x, y], axis=-1))
        distance = distance / oversample
        edges = [0.0]
        while edges[-1] <= distance.max():
            edges.append(edges[-1] + max(1.0, WIDTH * edges[-1]))
        self.edges = np.array(edges)
        self.number = np.digitize(distance, self.edges) - 1
        self._cell = nearest * len(self) + self.number
        self._n_stars = len(positions)

    def __len__(self) -> int:
        return len(self.edges) - 1

    def sums(self, image: Array) -> Array:
        """Return the sum of the pixels in each ring, round all stars."""
        return np.asarray(np.bincount(self.number.ravel(), image.ravel(), len(self)), np.float64)

    def round_stars(self, image: Array, share: float) -> Array:
        """Return what an image has all round each star: falling outwards, and 0 at the last ring.

        In each ring that is the quantile `share` of its pixels, never more than in the ring inside.
        """
        levels = np.zeros(self._n_stars * len(self))
        order = np.argsort(self._cell, axis=None)
        cells, values = self._cell.ravel()[order], image.ravel()[order]
        present, first = np.unique(cells, return_index=True)
        for cell, part in zip(present, np.split(values, first[1:]), strict=True):
            levels[cell] = np.quantile(part, share)
        shape = self._n_stars, len(self)
        is_there = np.isin(np.arange(levels.size), present).reshape(shape)
        known = np.where(is_there, levels.reshape(shape), np.inf)
        falling = np.minimum.accumulate(known, axis=1)
        last = np.where(is_there, falling, np.inf).min(axis=1, keepdims=True)
        return np.asarray((falling - last).ravel()[self._cell], np.float64)


def medians(number: NDArray[np.int_], values: Array) -> Array:
    """Return the median of the values of each number, 0 where there is none."""
    order = np.argsort(number)
    found = np.zeros(number.max(initial=0) + 1)
    present, first = np.unique(number[order], return_index=True)
    for ring, part in zip(present, np.split(values[order], first)[1:], strict=True):
        found[ring] = np.median(part)
    return found
