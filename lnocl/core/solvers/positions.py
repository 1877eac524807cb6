"""Star positions and fluxes from the likelihood's own gradient, the extended source held fixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.band_matrix import BandMatrix
from lnocl.core.scene.detector import Movable
from lnocl.core.scene.forward_model import ROUNDING, Model
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.shifting import MARGIN, Cutout
from lnocl.core.scene.stars import (
    MAX_SHIFT,
    Order,
    StarImages,
    along_sky,
    covered_pixels,
    order_of,
    places,
)
from lnocl.core.solvers.fluxes import MAX_FADING, StarLikelihood, differ

# The farthest that a star goes in one step, pixels: the likelihood is a parabola in a part of the
# PSF's core only.
MAX_STEP = 0.5
# Share of the information on a position that the pixels of the fit must hold: far wings say little
# and are many.
INFORMATION_SHARE = 0.99
# Floor of a PSF in the estimate of that information, as a share of its peak: it may be negative.
MIN_LIT = 1e-6
# Steps end where they are less than this share of a standard error that images of unit mean would
# give: of a tenth of their own up to a mean of a million electrons.
FINISHED = 1e-4
MAX_STEPS = 30
# Before the first, each star is tried this far along x and y too: fringes make false minima.
TRIAL_STEP = 1.5
MAX_HALVED = 10


class Stars(NamedTuple):
    """Fluxes, shape (n,), and positions, shape (n, 2), of stars."""

    fluxes: Array
    positions: Array


@dataclass(frozen=True)
class _Trial:
    """Stars, their images with derivatives along x and y, the m_j and J_0."""

    stars: Stars
    images: list[StarImages]
    models: list[Array]
    objective: float


class StarFit:
    """The likelihood of stars, for an extended source that is known.

    ``J_0(c, x, y)`` with ``m_j = A_j f + sum_s c_s P_j(x_s, y_s) + b_j`` is minimised by Fisher
    scoring over all of them together, D in `StarLikelihood` being ``P_js``, and ``c_s`` times its
    derivatives with respect to x_s and y_s. It is summed over squares round the stars that hold
    99 % of the information on positions; the light of PSFs beyond them stays where the stars of the
    scene put it.

    Parameters
    ----------
    scene : Scene
        What is modelled; its stars are where the search begins. A star is at one place in all
        epochs.
    model : Model
        Of the scene.
    extended : ndarray of float64, shape (Ny, Nx)
        Extended source, on the grid and scaled.
    given : ndarray of float64, shape (n, 2)
        Positions that the stars, in each epoch, must stay within `MAX_SHIFT` of.
    halos : ndarray of float64, shape (n_halos,), optional
        Fluxes of the halos, which are held.
    """

    def __init__(
        self, scene: Scene, model: Model, extended: Array, given: Array, halos: Array | None = None
    ) -> None:
        self._given, self._observation = given, scene.observation
        n_images, turns = scene.n_images, scene.observation.turns
        part = _part(scene.scaled_psfs())
        shape, own = scene.observation.psfs[0][part].shape, scene.observation.star_psfs.shape[2:]
        shapes = [shape if k < 0 else own for k in scene.owned]
        squares = [
            list(map(partial(_square, scene=scene), shapes, self._observation.places(j, given)))
            for j in range(n_images)
        ]
        covered = [covered_pixels(each, scene.image_grid) for each in squares]
        stars_of_images = [each[: scene.n_stars] for each in scene.star_field.cutouts]
        reached = [
            (places_there, cutouts)
            for places_there, *both in zip(
                scene.star_field.places, stars_of_images, squares, strict=True
            )
            for cutouts in both
        ]
        # The unknowns that fluxes and positions of stars in epochs are, and the stars of a place.
        n, self._n_epochs = scene.n_stars, scene.n_epochs
        place = np.arange(n) // scene.n_epochs
        n_places = n // scene.n_epochs
        self._owners = np.concatenate([np.arange(n), n + place, n + n_places + place])
        is_turned = self._observation.is_turned
        scales = np.repeat(self._observation.scales, 2) if is_turned else None
        order = order_of(scene.stars, reached, scene.image_grid, scales)
        diffuse = model.forward(extended) + model.background
        if halos is not None and len(halos):
            held = np.append(np.zeros(scene.n_stars), halos)
            diffuse += np.array(list(model.starlight(held)))
        self._likelihood = StarLikelihood.of_scene(scene, model, diffuse, covered)
        self._stars = [
            _MovableStars(psfs, turn, where, places_there, whole, around, order, is_shown)
            for psfs, turn, places_there, where, whole, around, is_shown in zip(
                scene.star_psfs(scene.stars, part),
                turns,
                scene.star_field.places,
                covered,
                stars_of_images,
                squares,
                scene.shown[:n].T,
                strict=True,
            )
        ]

    def _try(self, stars: Stars) -> _Trial:
        images = [
            movable.at(self._observation.places(j, stars.positions))
            for j, movable in enumerate(self._stars)
        ]
        models = self._likelihood.models([each.light(stars.fluxes) for each in images])
        return _Trial(stars, images, models, self._likelihood.objective(models))

    def objective(self, stars: Stars) -> float:
        """Return J_0 over the pixels that stars may light, but for a constant."""
        return self._try(stars).objective

    def _gradient(self, trial: _Trial) -> Array:
        """Return the gradient of J_0 in (c_1 ... c_n, x_1 ..., y_1 ...), a place in all epochs."""
        gradient = self._likelihood.gradient(trial.images, trial.models).ravel()
        return np.asarray(np.bincount(self._owners, self._units(trial) * gradient))

    def _information(self, trial: _Trial) -> BandMatrix:
        """Return the Fisher information of the same unknowns."""
        information = self._likelihood.information(trial.images, trial.models)
        information = information.scaled(self._units(trial))
        return information.tied(self._owners) if self._n_epochs > 1 else information

    @staticmethod
    def _units(trial: _Trial) -> Array:
        fluxes = trial.stars.fluxes
        return np.concatenate([np.ones_like(fluxes), fluxes, fluxes])

    def look_round(self, stars: Stars) -> Stars:
        """Return each star at the best of nine places, the others where they are, and its fluxes.

        A star is at one place in all epochs.
        """
        lights = [each.light(stars.fluxes) for each in self._try(stars).images]
        steps = TRIAL_STEP * np.array([(dx, dy) for dx in (0, -1, 1) for dy in (0, -1, 1)])
        tried = np.array([self._look_round(s, stars, lights, steps) for s in range(len(stars[0]))])
        objectives, fluxes = tried.reshape(-1, self._n_epochs, len(steps), 2).transpose(3, 0, 1, 2)
        nearest = np.argmin(objectives.sum(axis=1), axis=1)
        fluxes = np.take_along_axis(fluxes, nearest[:, None, None], axis=2)
        moved = stars.positions + np.repeat(steps[nearest], self._n_epochs, axis=0)
        return Stars(fluxes.ravel(), moved)

    def _look_round(
        self, s: int, stars: Stars, lights: list[Array], steps: Array
    ) -> list[tuple[float, float]]:
        """Return the objective of a star in an epoch after each of some steps, and its flux."""
        position, pixels = stars.positions[s], [each.around[s] for each in self._stars]
        images = self._images_around(s, position)
        others = [
            light[there] - stars.fluxes[s] * image
            for light, there, image in zip(lights, pixels, images, strict=True)
        ]
        alone, tried = self._likelihood.of_one(pixels, others), []
        for step in steps:
            images = self._images_around(s, position + step)
            flux = max(alone.linear_flux(images), MAX_FADING * stars.fluxes[s])
            models = alone.models([flux * image for image in images])
            tried.append((alone.objective(models), flux))
        return tried

    def _images_around(self, s: int, position: Array) -> list[Array]:
        return [
            movable.image_around(s, self._observation.places(j, position))
            for j, movable in enumerate(self._stars)
        ]

    def minimise(self, stars: Stars) -> Stars:
        """Return the stars that are most likely, sought from these."""
        trial, used = self._try(stars), list[Array]()
        for _ in range(MAX_STEPS):
            if differ(trial.models, used):
                information, used = self._information(trial), trial.models
            step = -information.solve(self._gradient(trial))[self._owners]
            for _ in range(MAX_HALVED):
                following = self._try(self._follow(trial.stars, step))
                if following.objective <= trial.objective:
                    break
                step = step / 2.0
            else:
                return trial.stars
            before, after, trial = trial.stars, following.stars, following
            change = np.append(after.fluxes - before.fluxes, (after.positions - before.positions).T)
            if (abs(change) * np.sqrt(information.diagonal[self._owners]) < FINISHED).all():
                break
        return trial.stars

    def _follow(self, stars: Stars, step: Array) -> Stars:
        """Return the stars after a step, none beyond its bounds."""
        n = len(stars.fluxes)
        fluxes = np.maximum(stars.fluxes + step[:n], MAX_FADING * stars.fluxes)
        moves = _shorten(step[n:].reshape(2, n).T, MAX_STEP)
        away = _shorten(stars.positions + moves - self._given, MAX_SHIFT)
        return Stars(fluxes, self._given + away)


class _MovableStars:
    """The images of stars over the covered pixels of one image of the sky, at whatever positions.

    Parameters
    ----------
    psfs : sequence of MovablePsf or DetectorPsf
        The part of the PSF that moves with each star.
    turn : ndarray of float64, shape (2, 2)
        How the image is turned against the sky.
    covered : ndarray of bool, shape (Ny, Nx)
        The pixels.
    positions : ndarray of float64, shape (n, 2)
        In the image, where the stars have their whole PSF.
    whole : sequence of Cutout
        That whole PSF, for each star.
    squares : sequence of Cutout
        The part of the grid that each star may light, wherever it goes.
    order : Order
        Of the stars.
    is_shown : ndarray of bool, shape (n,)
        Whether the image shows a star; others have no light in it.

    Attributes
    ----------
    around : list of ndarray of int
        For each star the pixels that it may light.
    """

    def __init__(
        self,
        psfs: Sequence[Movable],
        turn: Array,
        covered: NDArray[np.bool_],
        positions: Array,
        whole: Sequence[Cutout],
        squares: Sequence[Cutout],
        order: Order,
        is_shown: NDArray[np.bool_],
    ) -> None:
        self._grid, self._covered, self._order = (*covered.shape,), covered, order
        self._psfs, self._turn, self._places = psfs, turn, places(covered)
        self._is_shown = is_shown
        # One number more, which the dark pixels share: their place is -1.
        self._image = np.zeros(int(covered.sum()) + 1)
        self.around: list[NDArray[np.intp]] = []
        self._beyond: list[Cutout] = []
        for s, (position, cutout, square) in enumerate(zip(positions, whole, squares, strict=True)):
            at = [self._places[each.window(self._grid)].ravel() for each in (cutout, square)]
            reached = np.unique(np.concatenate(at))
            self.around.append(reached[reached >= 0])
            self._beyond.append(self._find_beyond(s, position, cutout))

    def _find_beyond(self, s: int, position: Array, whole: Cutout) -> Cutout:
        """Return the whole PSF of star s less the part that moves."""
        at = self._at(whole)
        self._image[at] = whole.values
        moving = self._moving(s, position)
        self._image[self._at(moving)] -= moving.values[0]
        beyond = self._image[at]
        self._image[at] = self._image[self._at(moving)] = 0.0
        is_left = (abs(beyond) > ROUNDING * whole.values.max()) & (at >= 0)
        return Cutout(np.where(is_left, beyond, 0.0)[None], whole.y, whole.x)

    def _at(self, part: Cutout) -> NDArray[np.intp]:
        return self._places[part.window(self._grid)]

    def _moving(self, s: int, position: Array) -> Cutout:
        """Return the part of star s's PSF that moves, and its derivatives along the sky's x, y."""
        star = along_sky(self._psfs[s].with_slopes(*position), self._turn)
        return star._replace(values=self._is_shown[s] * star.values)

    def at(self, positions: Array) -> StarImages:
        """Return the images of the stars and their derivatives along x and y."""
        pieces = [
            [self._moving(s, position), beyond]
            for s, (position, beyond) in enumerate(zip(positions, self._beyond, strict=True))
        ]
        return StarImages(self._covered, pieces, self._order)

    def image_around(self, s: int, position: Array) -> Array:
        """Return the image of star s, there, over the pixels that it may light."""
        pieces = [self._moving(s, position), self._beyond[s]]
        for piece in pieces:
            self._image[self._at(piece)] += piece.values[0]
        image = self._image[self.around[s]]
        for piece in pieces:
            self._image[self._at(piece)] = 0.0
        return image


def _square(shape: tuple[int, ...], position: Array, scene: Scene) -> Cutout:
    """Return the part of an image that a star may light, wherever it goes from a position."""
    margin = int(np.ceil(MAX_SHIFT)) + MARGIN + 1
    sizes = (-(-k // scene.oversample) + 2 * margin for k in shape)
    height, width = map(min, sizes, scene.image_grid)
    x, y = np.floor(position + 0.5).astype(int).tolist()
    return Cutout(np.broadcast_to(1.0, (height, width)), y - height // 2, x - width // 2)


def _part(psfs: list[Array]) -> tuple[slice, slice]:
    """Return the square round the middle of PSFs that holds enough of the information."""
    # Where the star's own light is the noise, a pixel says |grad P|^2 / P of a position.
    information = sum(
        (np.square(np.gradient(np.pad(psf, 1))).sum(axis=0)[1:-1, 1:-1])
        / np.maximum(psf, MIN_LIT * psf.max())
        for psf in psfs
    )
    middle = np.array(psfs[0].shape) // 2
    y, x = np.indices(psfs[0].shape)
    distance = np.maximum(abs(y - middle[0]), abs(x - middle[1]))
    within = np.cumsum(np.bincount(distance.ravel(), np.ravel(information)))
    half = int(np.argmax(within >= INFORMATION_SHARE * within[-1]))
    first = np.maximum(middle - half, 0)
    return np.s_[first[0] : middle[0] + half + 1, first[1] : middle[1] + half + 1]


def _shorten(vectors: Array, longest: float) -> Array:
    lengths = np.hypot(*vectors.T)[:, None]
    return vectors * np.minimum(1.0, longest / np.maximum(lengths, longest))
