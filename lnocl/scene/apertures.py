"""Parts of the sky whose light is summed: the shares of pixels that lie within."""

from __future__ import annotations

from typing import NamedTuple

from lnocl.scene.observation import Array


class Aperture(NamedTuple):
    """The shares of pixels that lie within a region.

    Attributes
    ----------
    name : str
        What it is called.
    y, x : int
        Row and column of the first pixel.
    weights : ndarray of float64, shape (h, w)
        Shares, from 0 to 1.
    """

    name: str
    y: int
    x: int
    weights: Array

    @property
    def n_pixels(self) -> float:
        """The area, pixels."""
        return float(self.weights.sum())

    def flux(self, sky: Array) -> float:
        """Return the light of a sky, shape (ny, nx), within the region."""
        height, width = self.weights.shape
        there = sky[self.y : self.y + height, self.x : self.x + width]
        return float((self.weights * there).sum())
