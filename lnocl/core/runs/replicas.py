"""Replicas of a reconstruction: skies that it may stand for, observed and reconstructed alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from lnocl.core.runs.outcome import Outcome, marginalise
from lnocl.core.runs.repeated import RerunWithCounts
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.components import Mixing
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.psf_field import Psfs, mapped
from lnocl.core.scene.psf_pixels import PsfPixels
from lnocl.core.scene.star_prior import StarPrior
from lnocl.core.scene.texture import Texture, hidden_radii, resolution

# Counts, shape (p, ny, nx), and a prior of the stars.
Given = tuple[Array, StarPrior | None]


class Sky(NamedTuple):
    """A sky: what was drawn, or what was found.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Extended source, electrons per pixel.
    light : ndarray of float64, shape (ny, nx)
        Its light without bias (`lnocl.core.solvers.light`), where it was found.
    star_fluxes : ndarray of float64, shape (n,)
        Electrons.
    star_positions : ndarray of float64, shape (n, 2)
        Pixels.
    """

    extended: Array
    light: Array
    star_fluxes: Array
    star_positions: Array


class Replica(NamedTuple):
    """A simulated sky and its reconstructions, with the right PSFs and with perturbed ones."""

    drawn: Sky
    found: Sky
    found_with_psfs: Sky | None


class Replicas:
    """Reconstructions of observations that are drawn from an answer.

    Replica k has a sky drawn from `lnocl.core.scene.texture.Texture`, with the stars as they were
    found. Its counts are drawn from the model of that, with exposures, bad pixels, background and
    read noise as observed, and reconstructed by as many iterations, with the same penalty, from the
    same start. All replicas use the buffers and programs of one run.

    Where the scatter of the PSFs is known, or an error of them was found, the same sky is also seen
    through PSFs that are drawn from it, with the same noise, and reconstructed with those of the
    answer.

    Parameters
    ----------
    outcome : Outcome
        The answer.
    seed : int
        Replica k depends on this and k alone.
    n : int, optional
        As many are reconstructed together, at most.
    """

    def __init__(self, outcome: Outcome, seed: int, n: int = 1) -> None:
        self._outcome, self._seed, scene = outcome, seed, outcome.scene
        width = resolution(scene)
        skies = outcome.estimate.extended.reshape(-1, *scene.grid)
        given = scene.shown_stars, width, hidden_radii(scene, width)
        self._textures = [Texture(sky, *given) for sky in skies]
        self._model = Model(scene)
        observation = scene.observation
        self._added = observation.read_noise**2
        self._pixels = None
        if len(observation.psf_scatter):
            self._pixels = PsfPixels(
                observation.psfs, observation.psf_scatter, observation.oversample
            )
        self._repeated = RerunWithCounts(outcome, n)

    def reconstruct(self, *numbers: int) -> list[Replica]:
        """Return replicas of these numbers.

        Raises
        ------
        NotFiniteError, DivergedError
            An objective is not finite, or rises.
        """
        drawn, counts, others = zip(*map(self._observe, numbers), strict=True)
        found = self._find(counts)
        of_psfs = self._find(others) if self._pixels else [None] * len(found)
        return list(map(Replica, drawn, found, of_psfs))

    def _observe(self, k: int) -> tuple[Sky, Given, Given | None]:
        """Return the sky of a replica, counts and prior, and those where the PSFs are wrong too."""
        scene = self._outcome.scene
        seeds = np.random.SeedSequence([self._seed, k]).spawn(scene.n_images + 4)
        of_sky, of_psfs, *of_images, of_prior, of_weights = seeds
        rng = np.random.default_rng(of_sky)
        drawn_skies = [texture.draw(rng) for texture in self._textures]
        sky = np.reshape(drawn_skies, scene.sky_grid)
        estimate = Estimate.of_scaled(scene, sky, self._outcome.estimate.fluxes)
        models = mixed = list(self._means(self._model, sky))
        drawn = Sky(estimate.observed_sky, *self._without_noise(estimate, models), scene.stars)
        model = self._mixed_otherwise(self._model, np.random.default_rng(of_weights))
        if model is not self._model:
            mixed = list(self._means(model, sky))
        counts = self._draw(mixed, of_images)
        prior, star_fluxes = scene.penalty.stars, self._outcome.star_fluxes
        prior = prior and prior.drawn(star_fluxes, np.random.default_rng(of_prior))
        if self._pixels is None:
            return drawn, (counts, prior), None
        others = self._means(Model(scene.seen_through(self._draw_psfs(of_psfs))), sky)
        # The same noise: counts that are drawn of almost the same mean may be quite others.
        changed = [n + b - a for n, a, b in zip(counts, models, others, strict=True)]
        return drawn, (counts, prior), (np.maximum(changed, 0.0), prior)

    def _mixed_otherwise(self, model: Model, rng: np.random.Generator) -> Model:
        """Return a model with weights of components that are drawn from their errors."""
        scene = model.scene
        errors = scene.observation.component_errors
        if scene.mixing is None or not errors.any():
            return model
        shifts = rng.standard_normal(scene.mixing.rows.shape)[scene.mixing.filters]
        other = copy(model)
        other.scene = copy(scene)
        other.scene.mixing = Mixing.of(np.maximum(scene.mixing.weights + errors * shifts, 0.0))
        return other

    def _without_noise(self, drawn: Estimate, models: Sequence[Array]) -> tuple[Array, Array]:
        """Return light and fluxes of a drawn sky, beside levels and halos fitted to its means.

        No pixel of an estimate is negative, so that a drawn sky is nowhere dark. Levels and halos
        take up what it has everywhere, which real skies have not.
        """
        halos, levels = self._outcome.has_marginal_halos, self._outcome.has_levels
        if not (halos or levels):
            return drawn.observed_sky, drawn.star_fluxes
        scene = copy(drawn.scene)
        scene.observation = scene.observation.replace(images=models)
        seen = Estimate(scene, drawn.sky, drawn.star_fluxes)
        fitted = replace(self._outcome, estimate=marginalise(seen, False, halos, levels))
        return fitted.light().sky(), fitted.star_fluxes

    def _find(self, given: Iterable[Given]) -> list[Sky]:
        """Return the reconstructions of observations with these counts and priors."""
        return [
            # The scene moves its stars for the next.
            Sky(x.estimate.observed_sky, x.light().sky(), x.star_fluxes, x.scene.stars.copy())
            for x in self._repeated.of(*given)
        ]

    def _draw_psfs(self, seed: np.random.SeedSequence) -> Psfs:
        psfs = self._outcome.scene.observation.psfs
        rng = np.random.default_rng(seed)
        # One PSF for all images has one error.
        is_shared = psfs.strides[0] == 0
        fields = rng.standard_normal(psfs[:1].shape if is_shared else psfs.shape)
        fields = np.broadcast_to(fields, psfs.shape)
        changes = [cast(PsfPixels, self._pixels).correction(j, x) for j, x in enumerate(fields)]
        over_images = self._outcome.scene.observation.psfs_over_images
        return mapped(over_images, lambda j, stack: stack + changes[j])

    def _draw(self, models: Sequence[Array], seeds: Sequence[np.random.SeedSequence]) -> Array:
        """Return counts of these models, shape (p, ny, nx)."""
        with ThreadPoolExecutor() as pool:
            return np.array(list(pool.map(_draw, models, self._added, seeds)))

    def _means(self, model: Model, sky: Array) -> Iterator[Array]:
        """Yield the model of each image, electrons."""
        scene = self._outcome.scene
        images = model.images(sky, self._outcome.estimate.fluxes)
        ny, nx = scene.observation.shape
        for j, image in enumerate(images):
            yield scene.in_electrons(image, j)[:ny, :nx]


def _draw(model: Array, added: Array, seed: np.random.SeedSequence) -> Array:
    """Return counts with read noise of this variance, which images and model have had added."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(np.maximum(model - added, 0.0)).astype(np.float64)
    if np.any(added):
        counts += rng.standard_normal(counts.shape) * np.sqrt(added)
    return np.maximum(counts + added, 0.0)
