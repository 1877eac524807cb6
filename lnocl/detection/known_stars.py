"""Information between the stars' parameters and a test source at each place of the sky."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from functools import reduce
from itertools import product
from operator import add
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy import ndimage

from lnocl.core.scene.apertures import FWHM
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.band_matrix import BandMatrix
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.shifting import Cutout, window
from lnocl.core.scene.stars import FAINT, Order, StarImages

# Stars and sources share nothing farther apart than so many resolutions.
APART = 4.0
# Combinations of stars with less than this share of their information tell nothing.
SAME = 1e-6
# Side of the squares of the sky whose stars are taken out together, resolutions.
TILE = 8.0


class Shared(NamedTuple):
    """What stars share with a source at each place, each of shape (Ny, Nx).

    Attributes
    ----------
    score, flat, information : ndarray of float64
        ``B^T G^-1 T_s``, ``B^T G^-1 W_s`` and ``B^T G^-1 B`` of `lnocl.detection.score`.
    """

    score: Array
    flat: Array
    information: Array


class KnownStars:
    """The stars of a model: their fluxes, and perhaps their positions, are unknowns.

    Parameters
    ----------
    model : Model
        The model.
    fluxes : ndarray of float64, shape (n,)
        Scaled.
    moves : bool
        Whether positions were fitted.
    """

    def __init__(self, model: Model, fluxes: Array, moves: bool) -> None:
        self._model, self._scene, self._fluxes = model, model.scene, fluxes
        scene, order = self._scene, self._scene.star_field.order
        self._cutouts = [self._cutouts_in(j, moves) for j in range(scene.n_images)]
        everywhere = np.ones(scene.image_grid, bool)
        order = Order(order.places[: scene.n_stars], order.width)  # without halos
        self._images = [
            StarImages(everywhere, [[each] for each in cutouts], order) for cutouts in self._cutouts
        ]

    def beside(self, model: Model) -> KnownStars:
        """Return them with sources that are seen as another model has them."""
        other = copy(self)
        other._model = model
        return other

    def _cutouts_in(self, j: int, moves: bool) -> list[Cutout]:
        """Return what the unknowns of each star add to an image, shape (1 or 3, h, w) each."""
        scene, found = self._scene, []
        for s in range(scene.n_stars):
            star = scene.star_cutout(j, s)
            star = star._replace(values=star.values[None])
            if moves:
                star = scene.star_field.with_slopes(j, s)
            found.append(star.trimmed(FAINT * float(abs(star.values).max())))
        return found

    def shared(
        self,
        residuals: Sequence[Array],
        precisions: Sequence[Array],
        width: float,
        resolution: float,
    ) -> Shared:
        """Return the information that their parameters share with a source.

        Parameters
        ----------
        residuals, precisions : sequence of p ndarray of float64, shape (ny, nx)
            ``w_j (g_j - m_j) / v_j`` and ``w_j / v_j``.
        width : float
            Full width at half maximum of the source, pixels of the sky; 0 for a point.
        resolution : float
            That of all images together, pixels of the sky.
        """
        grid, n = self._scene.grid, self._scene.n_stars
        found, half = Shared(*np.zeros((3, *grid))), int(np.ceil(APART * resolution))
        if not n:
            return found
        gram, moments = self._gram(precisions), np.zeros((2, len(self._cutouts[0][0].values) * n))
        for images, ones, residual, precision in zip(
            self._images, self._model.of_ones, residuals, precisions, strict=True
        ):
            both = residual, precision * ones
            moments += [images.products(values.ravel()).ravel() for values in both]
        common = [
            _wider(self._with_source(*divmod(k, n), precisions, half), width)
            for k in range(moments.shape[1])
        ]
        firsts = np.array([each[1:] for each in common]).reshape(-1, 2)
        sizes = np.array([each.values.shape for each in common]).reshape(-1, 2)
        for first, shape in _tiles(grid, int(np.ceil(TILE * resolution))):
            here = window(*first, shape, grid)
            reach = (firsts - first) % grid < shape, (first - firsts) % grid < sizes
            near = np.flatnonzero(np.logical_or(*reach).all(axis=1)).tolist()
            if not near:
                continue
            laid = np.array([common[k].add_to(np.zeros(shape), first, grid) for k in near])
            of_source = laid.reshape(len(near), -1)
            solved = _inverse(gram.block(near)) @ of_source
            found.score[here], found.flat[here] = (moments[:, near] @ solved).reshape(2, *shape)
            found.information[here] = (of_source * solved).sum(axis=0).reshape(shape)
        return found

    def _with_source(self, k: int, s: int, precisions: Sequence[Array], half: int) -> Cutout:
        """Return what unknown k of a star shares with a point round the star."""
        scene, weighed = self._scene, []
        for cutouts, precision in zip(self._cutouts, precisions, strict=True):
            values = cutouts[s].values[k] * precision[cutouts[s].window(scene.image_grid)]
            weighed.append(cutouts[s]._replace(values=values))
        common = self._model.adjoint_of_cutouts(weighed)
        return _cut_round(common, on_sky(scene.stars, scene.oversample)[s], half, scene.grid)

    def _gram(self, precisions: Sequence[Array]) -> BandMatrix:
        """Return the information of the unknowns: all stars for each in turn."""
        each = zip(self._images, precisions, strict=True)
        return reduce(add, (images.information(values.ravel()) for images, values in each))

    def squares(
        self, precisions: Sequence[Array], edges: Array, errors: Array
    ) -> tuple[list[Array], list[Array]]:
        """Return the squares of errors of starlight over the variance of the counts, per image.

        The first are of the relative errors of PSFs in rings with these edges, pixels of the
        images; the second of relative errors of 1.
        """
        scene = self._scene
        found, whole = np.zeros((2, scene.n_images, *scene.image_grid))
        for j, precision in enumerate(precisions):
            for s, flux in enumerate(self._fluxes):
                cutout = scene.star_cutout(j, s)
                there = cutout.window(scene.image_grid)
                squares = (flux * cutout.values * precision[there]) ** 2
                whole[j][there] += squares
                if len(errors):
                    distance = _distance(cutout, scene.observation.places(j, scene.stars[s]))
                    ring = np.digitize(distance, edges) - 1
                    found[j][there] += errors[np.minimum(ring, len(errors) - 1)] ** 2 * squares
        return list(found), list(whole)

    def rings(self, width: float) -> Array:
        """Return distances from the star that lights each place most, in so many pixels."""
        scene = self._scene
        brightest, ring = np.zeros(scene.grid), np.full(scene.grid, np.hypot(*scene.grid) / width)
        fluxes = self._fluxes * scene.transmitted(scene.stars).mean(axis=0)
        for s, flux in enumerate(fluxes):
            cutout = scene.psf_on_sky(0, s)
            there = cutout.window(scene.grid)
            distance = _distance(cutout, on_sky(scene.stars[s], scene.oversample))
            light = abs(flux * cutout.values)
            is_brighter = light > brightest[there]
            ring[there] = np.where(is_brighter, distance / width, ring[there])
            brightest[there] = np.maximum(brightest[there], light)
        return ring


def _inverse(matrix: Array) -> Array:
    """Return the inverse of an information matrix, in which stars at one place are one."""
    units = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    scaled = matrix * units * units[:, None]
    return np.asarray(scipy.linalg.pinvh(scaled, atol=SAME) * units * units[:, None])


def _distance(cutout: Cutout, place: Array) -> Array:
    """Return the distances of the pixels of a cutout from a place, (x, y)."""
    rows, columns = (
        first + np.arange(n) for first, n in zip(cutout[1:], cutout.values.shape, strict=True)
    )
    return np.asarray(np.hypot((rows - place[1])[:, None], columns - place[0]))


def _wider(cutout: Cutout, width: float) -> Cutout:
    """Return what a star shares with a Gaussian source, from what it shares with a point."""
    if not width:
        return cutout
    blurred = ndimage.gaussian_filter(cutout.values, width / FWHM, mode="constant")
    return cutout._replace(values=blurred)


def _tiles(grid: tuple[int, int], side: int) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield the first pixel and the shape of each."""
    for y, x in product(range(0, grid[0], side), range(0, grid[1], side)):
        yield (y, x), (min(side, grid[0] - y), min(side, grid[1] - x))


def _cut_round(cutout: Cutout, place: Array, half: int, grid: tuple[int, int]) -> Cutout:
    """Return the values within so many pixels of a place."""
    x, y = np.round(place).astype(int).tolist()
    height, width = (min(2 * half + 1, n) for n in grid)
    first = y - height // 2, x - width // 2
    return Cutout(cutout.add_to(np.zeros((height, width)), first, grid), *first)
