"""The scaling of the scaled gradient projection method, made from a scene and where it starts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.band_matrix import BandMatrix
from lnocl.core.scene.forward_model import Box, Model, largest_window
from lnocl.core.scene.scene import MIN_MODEL, Scene
from lnocl.core.scene.shifting import Cutout
from lnocl.core.scene.star_prior import StarPrior
from lnocl.core.solvers.fluxes import best_step, fit_fluxes, movable_weights

# Share of the light of stars and background that shifts the scaling. With all of it the
# empty sky takes up noise from the first steps on, without any it is stuck where it is 0: measured
# in docs/validation/sgp.md.
SHIFT = 0.1
# Least light of stars and background in a pixel, as a share of the images' mean.
MIN_BACKGROUND = 2.0**-20

# Information that leaves nothing of a step, and the window of no cross information.
HELD = 1e38
NOTHING = np.array([[0, 0, 1, 1]], np.int32)


@dataclass(frozen=True)
class Scaling:
    """What steps of the extended source and of the star fluxes are measured with.

    Attributes
    ----------
    shift : ndarray of float64, of the shape of the extended source
        z in the scaling ``D = (f + z) / (alpha + mu (f + z))``, ``alpha = sum_j A_j^T w_j``: a
        share of ``alpha / sum_j A_j^T (w_j / (sum_s c_s P_js + b_j))``, the light of stars and
        background that reaches the pixel.
    star_information : BandMatrix
        Fisher information of the star fluxes, ``sum_j <P_js, w_j P_jt / m_j>`` at the start.
    cross_values : ndarray of float64
        The values of `cross_information`, one cutout after the other.
    cross_windows : ndarray of int32, shape (n, 4)
        For each cutout y, x, height and width.
    total_weight : ndarray of float64, of the same shape, or None
        alpha, where that is not the number of images.
    """

    shift: Array
    star_information: BandMatrix
    cross_values: Array
    cross_windows: NDArray[np.int32]
    total_weight: Array | None

    def restored(self, state: Mapping[str, NDArray]) -> Scaling:
        """Return the scaling of a state of the same observation."""
        information = BandMatrix(state["star_information"].T, state["star_order"])
        shift, values, windows = (state[e] for e in ("shift", "cross_values", "cross_windows"))
        return Scaling(shift, information, values, windows, self.total_weight)

    def state(self) -> dict[str, NDArray]:
        """Return the arrays from which `restored` makes the scaling."""
        return {
            "shift": self.shift,
            "star_information": self.star_information.band.T,
            "star_order": self.star_information.places,
            "cross_values": self.cross_values,
            "cross_windows": self.cross_windows,
        }

    @property
    def cross_information(self) -> list[Cutout]:
        """Fisher information between each star flux and the extended source, where it is not 0.

        ``sum_j A_j^T (w_j P_js / m_j)`` at the start.
        """
        windows = self.cross_windows.tolist()
        ends = np.cumsum([height * width for _, _, height, width in windows], dtype=int)
        return [
            Cutout(self.cross_values[end - height * width : end].reshape(height, width), y, x)
            for end, (y, x, height, width) in zip(ends, windows, strict=True)
        ]

    def holding(self, n: int) -> Scaling:
        """Return this scaling with so many fluxes more, which stay as they are."""
        before = self.star_information
        m = len(before.places)
        band = np.zeros((len(before.band), m + n), order="F")
        band[:, :m], band[0, m:] = before.band, HELD
        return replace(
            self,
            star_information=BandMatrix(band, np.append(before.places, np.arange(m, m + n))),
            cross_values=np.append(self.cross_values, np.zeros(n)),
            cross_windows=np.append(self.cross_windows, np.tile(NOTHING, (n, 1)), axis=0),
        )

    def with_prior(self, prior: StarPrior) -> Scaling:
        """Return this scaling with the information that a prior of the fluxes adds."""
        information = self.star_information
        added = np.zeros_like(information.band)
        added[0, information.places] = prior.precision
        return replace(self, star_information=information + BandMatrix(added, information.places))


def prepare(
    scene: Scene, model: Model, extended: Array, star_fluxes: Array
) -> tuple[Array, Scaling]:
    """Return the star fluxes that are best for this extended source, and the scaling of steps.

    The fluxes minimise ``J`` for the extended source as given, whatever fluxes they are sought
    from; so the answer does not depend on those.

    Parameters
    ----------
    scene : Scene
        What is modelled.
    model : Model
        Of the scene.
    extended : ndarray of float64, shape (Ny, Nx)
        Extended source to start from, on the grid and scaled; where it was not observed it is 0.
    star_fluxes : ndarray of float64, shape (n,)
        Where the fluxes are sought from, scaled.
    """
    if scene.holds_halos:
        stars, halos = np.split(star_fluxes, [scene.n_stars])
        held = np.append(np.zeros_like(stars), halos)
        known = model.with_background(scene.of_stars(), list(model.starlight(held)))
        stars, scaling = prepare(known.scene, known, extended, stars)
        return np.append(stars, halos), scaling.holding(len(halos))
    total_weight, inverse = _back_projections(model)
    is_plain = scene.weights is None and scene.mixing is None
    kept = None if is_plain else np.array(total_weight)  # no view of more
    information = BandMatrix(np.zeros((1, 0)), np.zeros(0, int))
    values, windows = np.zeros(0), np.zeros((0, 4), np.int32)
    if scene.n_fluxes:
        covered = [scene.star_field.covered(j) for j in range(scene.n_images)]
        boxes = [_box(each) for each in covered]
        observed = np.where(scene.observed(total_weight), extended, 0.0)
        diffuse = model.images_at(boxes, observed)
        star_fluxes = fit_fluxes(scene, model, diffuse, star_fluxes)
        _add_change_by_stars(inverse, model, star_fluxes, boxes)
        information, ratios = _star_information(scene, model, diffuse, star_fluxes, covered)
        values, windows = _cross_information(scene, model, ratios)
    shift = np.divide(total_weight, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    np.maximum(shift, 0.0, out=shift)
    shift *= SHIFT
    return star_fluxes, Scaling(shift, information, values, windows, kept)


def inverse_weight(scene: Scene, scaling: Scaling | None) -> Array:
    """Return ``1 / sum_j A_j^T w_j`` of a scene with weights, 0 where nothing was observed."""
    total = scaling.total_weight if scaling is not None else None
    if total is None:
        model = Model(scene)
        total = model.adjoint(model.weights)
    return np.divide(1.0, total, out=np.zeros_like(total), where=scene.observed(total))


def heed(prior: StarPrior | None, star_fluxes: Array, scaling: Scaling) -> tuple[Array, Scaling]:
    """Return star fluxes and the scaling of steps, of `prepare`, where a prior of them holds."""
    if prior is None:
        return star_fluxes, scaling
    scaling = scaling.with_prior(prior)
    change = best_step(scaling.star_information, prior.gradient(star_fluxes), star_fluxes)
    return star_fluxes + change, scaling


def _back_projections(model: Model) -> tuple[Array, Array]:
    """Return ``sum_j A_j^T w_j`` and ``sum_j A_j^T (w_j / b_j)``."""
    dark = np.maximum(model.background, MIN_BACKGROUND)
    if dark.shape[1:] == (1, 1) and np.ptp(dark) == 0.0:
        total = model.adjoint(model.weights)
        return total, total / dark[0, 0, 0]
    if dark.shape[1:] == (1, 1):  # numbers: one transform of each w_j
        both = model.adjoints(model.weights, np.array([np.ones(len(dark)), 1.0 / dark[:, 0, 0]]))
        return both[0], both[1].copy()
    per_background = (w / b for w, b in zip(model.weights, dark, strict=True))
    return model.adjoint(model.weights), model.adjoint(per_background)


def _add_change_by_stars(
    inverse: Array, model: Model, star_fluxes: Array, boxes: Sequence[Box]
) -> None:
    """Add the change of ``sum_j A_j^T (w_j / b_j)`` by the light of stars."""
    changes = _changes(model, star_fluxes, boxes)
    if model.are_large(boxes):  # one after the other, lest all are held
        inverse += model.adjoint(each.on_grid(model.shape[1:]) for each in changes)
        return
    held, skies = list(changes), inverse.reshape(-1, *model.grid)
    for sky, shares in zip(skies, model.scene.mixes.T.tolist(), strict=True):
        change = model.adjoint_of_cutouts(
            [each._replace(values=w * each.values) for w, each in zip(shares, held, strict=True)]
        )
        sky[change.window(model.grid)] += change.values


def _changes(model: Model, star_fluxes: Array, boxes: Sequence[Box]) -> Iterator[Cutout]:
    for j, (light, box) in enumerate(zip(model.starlight(star_fluxes), boxes, strict=True)):
        background = np.broadcast_to(model.background[j], light.shape)[box]
        bright, dark = (
            np.maximum(each, MIN_BACKGROUND) for each in (light[box] + background, background)
        )
        values = model.weights[j][box] * (1.0 / bright - 1.0 / dark)
        yield Cutout(values, box[0].start, box[1].start)


def _star_information(
    scene: Scene,
    model: Model,
    diffuse: Array,
    star_fluxes: Array,
    covered: Sequence[NDArray[np.bool_]],
) -> tuple[BandMatrix, list[Array]]:
    """Return the Fisher information of the star fluxes, and the w_j / m_j under stars."""
    informations, ratios = [], []
    for j, (light, where) in enumerate(zip(model.starlight(star_fluxes), covered, strict=True)):
        total = np.maximum(light[where] + diffuse[j][where], MIN_MODEL)
        ratio = np.zeros(scene.image_grid)
        ratio[where] = movable_weights(model.weights[j][where], total) / total
        informations.append(scene.star_field.images(j, where).information(ratio[where]))
        ratios.append(ratio)
    return reduce(add, informations), ratios


def _cross_information(
    scene: Scene, model: Model, ratios: Sequence[Array]
) -> tuple[Array, NDArray[np.int32]]:
    """Return the values and the windows of the cross information."""
    # Memory is taken where values are written, and a list of them would take it twice.
    of_stars = scene.n_stars * math.prod(largest_window(scene))
    values = np.empty(of_stars + scene.n_halos * math.prod(scene.grid))
    windows, end = np.empty((scene.n_fluxes, 4), np.int32), 0
    for s, at in enumerate(windows):
        cutout = model.adjoint_of_cutouts(
            [_times(cores[s], w) for cores, w in zip(scene.star_field.cores, ratios, strict=True)]
        )
        at[:] = cutout.y, cutout.x, *cutout.values.shape
        begin, end = end, end + cutout.values.size
        values[begin:end] = cutout.values.ravel()
    return values[:end], windows


def _box(covered: NDArray[np.bool_]) -> Box:
    """Return rows and columns from the first to the last pixel that is covered."""
    rows, columns = (np.flatnonzero(covered.any(axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _times(cutout: Cutout, x: Array) -> Cutout:
    """Return a cutout times an array on the grid."""
    return Cutout(cutout.values * x[cutout.window(x.shape)], cutout.y, cutout.x)
