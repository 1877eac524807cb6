"""Replicas of a reconstruction: skies that it may stand for, observed and reconstructed alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import NamedTuple, cast

import numpy as np

from lnocl.process import ignored_warnings
from lnocl.runs.outcome import Outcome
from lnocl.runs.run import Run
from lnocl.scene.forward_model import Model
from lnocl.scene.observation import Array, Observation
from lnocl.scene.psf_pixels import PsfPixels
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


class Replica(NamedTuple):
    """A sky that was drawn, what was found of it, and what was where the PSFs were wrong too."""

    drawn: Sky
    found: Sky
    found_with_psfs: Sky | None


class Replicas:
    """Reconstructions of observations that are drawn from an answer.

    Replica k has a sky drawn from `lnocl.scene.texture.Texture`, with the stars as they were found.
    Its counts are drawn from the model of that, with exposures, bad pixels, background and read
    noise as observed, and reconstructed by as many iterations, with the same penalty, from the same
    start. All replicas use the buffers and programs of one run.

    Where the scatter of the PSFs is known, the same sky is also seen through PSFs that are drawn
    from it, with the same noise, and reconstructed with those of the answer.

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
        observation = scene.observation
        self._noise = self._added = observation.read_noise**2
        self._pixels = None
        if len(observation.psf_scatter):
            self._pixels = PsfPixels(observation.psfs, observation.psf_scatter)
            if outcome.read_noise is not None:  # the scatter of PSFs is drawn instead
                self._noise = outcome.read_noise**2
        with ignored_warnings():  # those of the reconstruction are the same
            self._start = outcome.restart(outcome.penalty)
        self._run = Run(self._start, max(len(outcome.objectives) - 1, 1))

    def reconstruct(self, k: int) -> Replica:
        """Return replica k.

        Raises
        ------
        NotFiniteError, DivergedError
            Its objective is not finite, or rises.
        """
        scene = self._outcome.scene
        of_sky, of_psfs, *of_images = np.random.SeedSequence([self._seed, k]).spawn(
            scene.n_images + 2
        )
        sky = self._texture.draw(np.random.default_rng(of_sky))
        ny, nx = scene.observation.shape
        drawn = Sky(sky[:ny, :nx] * scene.unit, self._outcome.star_fluxes, scene.stars)
        found = self._find(self._observe(self._model, sky, of_images))
        if self._pixels is None:
            return Replica(drawn, found, None)
        model = Model(scene.seen_through(self._draw_psfs(of_psfs)))
        return Replica(drawn, found, self._find(self._observe(model, sky, of_images)))

    def _find(self, observation: Observation) -> Sky:
        run = self._run
        run.repeat(self._start, observation)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in run:
                pass
        return Sky(run.extended(), run.star_fluxes(), run.star_positions())

    def _draw_psfs(self, seed: np.random.SeedSequence) -> Array:
        psfs = self._outcome.scene.observation.psfs
        fields = np.random.default_rng(seed).standard_normal(psfs.shape)
        changes = [cast(PsfPixels, self._pixels).correction(j, x) for j, x in enumerate(fields)]
        return np.asarray(psfs + np.array(changes))

    def _observe(
        self, model: Model, sky: Array, seeds: Sequence[np.random.SeedSequence]
    ) -> Observation:
        """Return an observation of a sky on the grid, scaled."""
        observation = copy(self._outcome.scene.observation)
        with ThreadPoolExecutor() as pool:
            counts = pool.map(_draw, self._means(model, sky), self._added, self._noise, seeds)
            observation.images = np.array(list(counts))
        observation.images[observation.mask] = 0.0
        return observation

    def _means(self, model: Model, sky: Array) -> Iterator[Array]:
        """Yield the model of each image, electrons."""
        scene = self._outcome.scene
        images = model.images(sky, self._outcome.star_fluxes / scene.unit)
        ny, nx = scene.observation.shape
        for j, image in enumerate(images):
            if scene.weights is not None and scene.has_exposure_map:
                image *= scene.weights[j]
            yield image[:ny, :nx] * scene.scale


def _draw(
    model: Array, added: Array | float, noise: Array | float, seed: np.random.SeedSequence
) -> Array:
    """Return counts with read noise of this variance, and what was added to images and model."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(np.maximum(model - added, 0.0)).astype(np.float64)
    if np.any(noise):
        counts += rng.standard_normal(counts.shape) * np.sqrt(noise)
    return np.maximum(counts + added, 0.0)
