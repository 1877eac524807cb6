"""The error that PSFs still have: as a number, as noise near stars, and as what it may fake."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy

import numpy as np

from lnocl.process import ignored_warnings
from lnocl.runs.short_runs import (
    DARK,
    Estimate,
    at_rings,
    estimate_scatter,
    rings_of,
    with_psfs,
)
from lnocl.scene.detector import on_sky
from lnocl.scene.observation import Array, Observation
from lnocl.scene.psf_families import PsfFamilies
from lnocl.scene.rings import Rings
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.solvers.psf_fit import Misfit, step

# The error of PSFs, so many times, is their noise: residuals show less of it than there is.
ALLOWED = 4.0
# Corrections may be so many times as large as residuals show.
LOOSE = 2.0


class PsfErrors:
    """Errors of the PSFs of an observation, and the starlight that suffers from them.

    They are given as the scatter of pixels, or estimated: by those corrections of pixels that fit
    the images best, the extended source marginalised. What a wider source explains as well as a
    wider PSF they do not show.

    Parameters
    ----------
    observation : Observation
        With the PSFs that are used.
    estimate : Estimate
        Of a window of it, with the same PSFs.
    first : ndarray of float64, shape (2,)
        The corner of the window, (x, y).
    misfit : Misfit
        Of the estimate. Where it is noise, the estimated errors are 0.
    scatter : ndarray of float64, shape (p, ky, kx)
        Standard deviations of the pixels; of shape (0, ky, kx) to estimate them.

    Attributes
    ----------
    overall : float
        Their norm, relative to that of the PSFs.
    over_noise : float
        Their square over the variance of the counts at the stars, the mean weighted by starlight.
    edges, at_radius : ndarray of float64, shapes (k + 1,) and (k,)
        Radii of rings round the middle of the PSFs, pixels, and the same number in each.
    """

    def __init__(
        self,
        observation: Observation,
        estimate: Estimate,
        first: Array,
        misfit: Misfit,
        scatter: Array,
    ) -> None:
        self._observation, self._scatter = observation, scatter
        self._fluxes = estimate.fluxes * estimate.scene.unit
        ny, nx = observation.shape
        self._stars = (estimate.scene.stars + first).clip(0, (nx - 1, ny - 1))
        psfs = estimate.scene.observation.psfs
        if len(scatter):
            psfs, errors = observation.psfs, scatter
        else:
            errors = np.zeros_like(psfs) if misfit.is_noise else _corrections(estimate)
        rings = rings_of(psfs, observation.oversample)
        squares, lights = (
            np.bincount(rings.number.ravel(), (each**2).sum(axis=0).ravel())
            for each in (errors, psfs)
        )
        self.overall = float(np.sqrt(squares.sum() / lights.sum()))
        self.edges = rings.edges[: len(squares) + 1]
        # Where PSFs give next to nothing, a share of them means nothing.
        least = np.bincount(rings.number.ravel()) * len(psfs) * (DARK * psfs.max()) ** 2
        shares = np.divide(squares, lights, out=np.zeros_like(squares), where=lights > least)
        self.at_radius = np.sqrt(shares)
        self.over_noise = self._compare_with_noise()

    def as_noise(self) -> Observation:
        """Return the observation with these errors in its noise.

        Their variance is ``(4 kappa(r) sum_s c_s P_js)^2``, or that of the scatter that is given;
        as that of read noise it is added to images and background.
        """
        observation = self._observation
        images, read_noise = observation.images.copy(), np.empty_like(observation.images)
        background = np.empty_like(images)
        for j, (error, _) in enumerate(self._in_images(observation)):
            variance = (ALLOWED * error) ** 2
            images[j] += np.where(observation.mask[j], 0.0, variance)
            background[j] = observation.background[j] + variance
            read_noise[j] = np.sqrt(observation.read_noise[j] ** 2 + variance)
        noisy = copy(observation)
        noisy.images, noisy.background, noisy.read_noise = images, background, read_noise
        return noisy

    def in_sky(self) -> Array:
        """Return what they may fake in the sky, ``kappa(r) sum_s c_s K_s / sqrt(p)``.

        Electrons per pixel of the sky: K is the mean over the PSFs, at the stars.
        """
        sky, oversample = copy(self._observation), self._observation.oversample
        sky.offsets = np.zeros_like(sky.offsets)
        sky.exposure = np.ones(sky.n_images)
        if oversample > 1:  # images of all its pixels
            shape = sky.n_images, *sky.sky_shape
            sky.oversample, sky.images, sky.mask = 1, np.ones(shape), np.zeros(shape, bool)
        errors = [error for error, _ in self._in_images(sky, oversample)]
        return np.asarray(np.mean(errors, axis=0) / np.sqrt(sky.n_images))

    def _compare_with_noise(self) -> float:
        observation, ratios, weights = self._observation, 0.0, 0.0
        for j, (error, light) in enumerate(self._in_images(observation)):
            variance = np.maximum(light + observation.background[j], MIN_MODEL)
            ratios += float((light * error**2 / variance).sum())
            weights += float(light.sum())
        return ratios / weights

    def _in_images(self, observation: Observation, finer: int = 1) -> Iterator[tuple[Array, Array]]:
        """Yield the errors in each image of the stars, and these, electrons.

        The images may be `finer` than those that the stars' positions are for.
        """
        seen = with_psfs(observation, self._scatter) if len(self._scatter) else observation
        positions = on_sky(self._stars, finer)
        with ignored_warnings():
            scene = Scene(seen, positions)
            stars = Scene(observation, positions)
        for j, offset in enumerate(observation.offsets):
            error, light = (_starlight(each, j, self._fluxes) for each in (scene, stars))
            if not len(self._scatter):
                rings = Rings(observation.shape, stars.stars + offset, finer)
                error = light * at_rings(self.at_radius, rings)
            yield error, light


def _corrections(estimate: Estimate) -> Array:
    """Return the corrections of the PSFs' pixels that fit best, shape (p, ky, kx)."""
    observation = estimate.scene.observation
    scatter = LOOSE * estimate_scatter(observation.psfs, estimate.kappa, observation.oversample)
    families = PsfFamilies(("pixels",), observation, scatter)
    fit = step(
        estimate.scene, families, families.first(), estimate.extended, estimate.fluxes, False
    )
    return families.psfs(fit.parameters) - observation.psfs


def _starlight(scene: Scene, j: int, fluxes: Array) -> Array:
    """Return ``sum_s c_s P_js`` where it was observed, electrons."""
    ny, nx = scene.observation.shape
    light = scene.star_field.light(j, fluxes / scene.unit)[:ny, :nx] * scene.scale
    if scene.weights is not None and scene.has_exposure_map:
        light *= scene.weights[j][:ny, :nx]
    return light
