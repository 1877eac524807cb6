"""Sources that are put into the images of a reconstruction, which is then made again."""

from __future__ import annotations

import numpy as np

from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.repeated import RerunWithCounts
from lnocl.core.scene.apertures import FWHM
from lnocl.core.scene.arrays import Array

# Sources of one image lie so many resolutions apart, so that none is in the level round another.
APART = 9.0


class Injections:
    """Reconstructions of the same images with more sources in them.

    Parameters
    ----------
    outcome : Outcome
        The reconstruction.
    width : float
        Full width at half maximum of the sources, pixels of the sky; 0 for points.
    """

    def __init__(self, outcome: Outcome, width: float) -> None:
        self._outcome, self._width = outcome, width
        self._repeated = RerunWithCounts(outcome)

    def reconstruct(self, places: Array, fluxes: Array, rng: np.random.Generator) -> Outcome:
        """Return the reconstruction with sources at these places, pixels of the images.

        Parameters
        ----------
        places : ndarray of float64, shape (n, 2)
            (x, y).
        fluxes : ndarray of float64, shape (n,)
            Electrons.
        rng : numpy.random.Generator
            Of the counts of the sources.
        """
        images = self._outcome.observation.images + self._counts(places, fluxes, rng)
        return self._repeated.of((images, None))[0]

    def _counts(self, places: Array, fluxes: Array, rng: np.random.Generator) -> Array:
        """Return counts of sources in each image, 0 in bad pixels."""
        scene, observation = self._outcome.scene, self._outcome.scene.observation
        ny, nx = observation.shape
        light = np.zeros((scene.n_images, *scene.image_grid))
        for place, flux in zip(places, fluxes, strict=True):
            other = scene.with_star(place)
            for j in range(scene.n_images):
                deviation = self._width / (scene.oversample * float(observation.scales[j]) * FWHM)
                for s in range(scene.n_stars, scene.n_stars + observation.n_epochs):
                    cutout = other.star_cutout(j, s).blurred(deviation, scene.image_grid)
                    light[j][cutout.window(scene.image_grid)] += flux / scene.unit * cutout.values
        means = [scene.in_electrons(each, j)[:ny, :nx] for j, each in enumerate(light)]
        counts = rng.poisson(np.maximum(means, 0.0)).astype(np.float64)
        return np.where(observation.mask, 0.0, counts)
