"""Parts of the sky whose light is measured: regions, and the slices of profiles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lnocl.core.scene.arrays import Array

# What is measured: light, in electrons, lengths, in pixels, light of one image, in electrons, or
# how bright a component is over another.
FLUX, LENGTH, AMOUNT, RATIO = "flux", "length", "halo", "ratio"
# A full width at half maximum in standard deviations, of a Gaussian.
FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))


class Label(NamedTuple):
    """The name of something that is measured, its kind, and where it is along a profile."""

    name: str
    kind: str
    at: float | None = None


class Aperture(NamedTuple):
    """The shares of pixels that lie within a region; its light is measured.

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

    @property
    def places(self) -> tuple[Array, Array]:
        """Rows and columns of its pixels, shape (h, w)."""
        places: Array = np.indices(self.weights.shape, np.float64)
        return places[0] + self.y, places[1] + self.x

    def light(self, sky: Array) -> Array:
        """Return the light of each pixel of a sky, shape (ny, nx), that lies within, (h, w)."""
        height, width = self.weights.shape
        return self.weights * sky[self.y : self.y + height, self.x : self.x + width]

    def flux(self, sky: Array) -> float:
        """Return the light of a sky within the region."""
        return float(self.light(sky).sum())

    def labels(self) -> list[Label]:
        """Return the labels of the quantities that `measure` returns."""
        return [Label(self.name, FLUX)]

    def measure(self, sky: Array, light: Array) -> Array:
        """Return the flux of the light, shape (1,)."""
        return np.array([self.flux(light)])


class Profile(NamedTuple):
    """Slices of a box along its axis: the light of each, and how wide it is across.

    Attributes
    ----------
    name : str
        What the box is called.
    at : sequence of float, length k
        The middle of each slice along the axis, pixels from that of the box.
    slices : sequence of Aperture, length k
        The slices.
    across : sequence of ndarray of float64, length k
        Distance of each pixel of a slice from the axis, pixels.
    """

    name: str
    at: Sequence[float]
    slices: Sequence[Aperture]
    across: Sequence[Array]

    def labels(self) -> list[Label]:
        """Return the labels of the quantities that `measure` returns."""
        return [
            *(Label(f"{self.name} flux", FLUX, at) for at in self.at),
            *(Label(f"{self.name} width", LENGTH, at) for at in self.at),
        ]

    def measure(self, sky: Array, light: Array) -> Array:
        """Return the flux of the light, and 2.355 standard deviations of the sky across, (2 k,).

        Light may be negative where noise is; the sky is not. The width of a slice without light is
        0.
        """
        widths = []
        for each, across in zip(self.slices, self.across, strict=True):
            within = each.light(sky)
            flux = float(within.sum())
            if flux <= 0:
                widths.append(0.0)
                continue
            mean = (within * across).sum() / flux
            variance = (within * (across - mean) ** 2).sum() / flux
            widths.append(FWHM * float(np.sqrt(max(variance, 0.0))))
        return np.array([*(each.flux(light) for each in self.slices), *widths])
