"""Replicas of a reconstruction: skies that it may stand for, observed and reconstructed alike."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import NamedTuple

import numpy as np

from lnocl.process import ignored_warnings
from lnocl.runs.outcome import Outcome
from lnocl.runs.run import Run
from lnocl.scene.forward_model import Model
from lnocl.scene.observation import Array, Observation
from lnocl.scene.texture import Texture


class Sky(NamedTuple):
    """A sky: what was drawn, or what was found.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Extended source, electrons per pixel.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons.
    star_positions : ndarray of float64, shape (n, 2)
        Pixels.
    """

    extended: Array
    star_fluxes: Array
    star_positions: Array


class Replicas:
    """Reconstructions of observations that are drawn from an answer.

    Replica k has a sky drawn from `lnocl.scene.texture.Texture`, with the stars as they were found.
    Its counts are drawn from the model of that, with exposures, bad pixels, background and read
    noise as observed, and reconstructed by as many iterations, with the same penalty, from the same
    start. All replicas use the buffers and programs of one run.

    Parameters
    ----------
    outcome : Outcome
        The answer.
    seed : int
        Replica k hangs on this and k alone.
    """

    def __init__(self, outcome: Outcome, seed: int) -> None:
        self._outcome, self._seed, scene = outcome, seed, outcome.scene
        self._texture = Texture(scene, outcome.sky / scene.unit)
        self._model = Model(scene)
        with ignored_warnings():  # those of the reconstruction are the same
            self._start = outcome.restart(outcome.penalty)
        self._run = Run(self._start, max(len(outcome.objectives) - 1, 1))

    def reconstruct(self, k: int) -> tuple[Sky, Sky]:
        """Return the sky of replica k, and what was found of it.

        Raises
        ------
        NotFiniteError, DivergedError
            Its objective is not finite, or rises.
        """
        *of_images, of_sky = np.random.SeedSequence([self._seed, k]).spawn(self._n_images + 1)
        sky = self._texture.draw(np.random.default_rng(of_sky))
        self._run.repeat(self._start, self._observe(sky, of_images))
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in self._run:
                pass
        scene = self._outcome.scene
        ny, nx = scene.observation.shape
        drawn = Sky(sky[:ny, :nx] * scene.unit, self._outcome.star_fluxes, scene.stars)
        run = self._run
        return drawn, Sky(run.extended(), run.star_fluxes(), run.star_positions())

    @property
    def _n_images(self) -> int:
        return self._outcome.scene.n_images

    def _observe(self, sky: Array, seeds: list[np.random.SeedSequence]) -> Observation:
        """Return an observation of a sky on the grid, scaled."""
        observation = copy(self._outcome.scene.observation)
        with ThreadPoolExecutor() as pool:
            observation.images = np.array(list(pool.map(self._draw, self._means(sky), seeds)))
        observation.images[observation.mask] = 0.0
        return observation

    def _means(self, sky: Array) -> Iterator[tuple[Array, Array]]:
        """Yield the mean of the counts of each image, and the variance of its read noise."""
        scene = self._outcome.scene
        images = self._model.images(sky, self._outcome.star_fluxes / scene.unit)
        ny, nx = scene.observation.shape
        for j, image in enumerate(images):
            if scene.weights is not None and scene.has_exposure_map:
                image *= scene.weights[j]
            yield image[:ny, :nx] * scene.scale, scene.observation.read_noise[j] ** 2

    @staticmethod
    def _draw(mean: tuple[Array, Array], seed: np.random.SeedSequence) -> Array:
        """Return counts, with the variance of the read noise added as `Observation` has it."""
        model, variance = mean
        rng = np.random.default_rng(seed)
        counts = rng.poisson(np.maximum(model - variance, 0.0)).astype(np.float64)
        if np.any(variance):
            counts += rng.standard_normal(counts.shape) * np.sqrt(variance) + variance
        return np.maximum(counts, 0.0)
