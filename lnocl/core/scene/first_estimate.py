"""The estimate that iterations of a scene begin with, by linear least squares or as given."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, numbers, refuse_unless
from lnocl.core.scene.band_matrix import BandMatrix
from lnocl.errors import InputError, warn

if TYPE_CHECKING:
    from lnocl.core.scene.scene import Scene

# A start may be so many times as bright as the images, beside so many times the noise of their sum,
# as the floor of an estimate is.
BRIGHTER, FLOOR = 3.0, 30.0
# A star or a sky that starts at zero stays there, so each keeps this share of the mean.
LEAST = 1e-3
ROUNDING = float(np.finfo(np.float32).eps)


class RoughFit(NamedTuple):
    """Fluxes, shape (n_fluxes,), and the level of a flat extended source, scaled.

    With several skies there is a level of each, shape (K, 1, 1).
    """

    fluxes: Array
    level: Any


def rough_fit(scene: Scene) -> RoughFit:
    """Return star fluxes and the level of a flat extended source, by linear least squares.

    Halos stand in for the level: what a flat one has in common with the sky goes to the halo.
    """
    lights, counts = np.zeros((2, scene.n_images))  # of pixels that were observed
    normal: BandMatrix | None = None
    moment, levels = np.zeros(scene.n_fluxes), []
    for j, (excess, observed) in enumerate(_excesses(scene)):
        light, n_there = float(excess.sum()), int(np.count_nonzero(observed))
        lights[j], counts[j] = light, n_there
        if not (scene.n_fluxes and n_there):
            continue
        covered = scene.star_field.covered(j)
        stars, weights = scene.star_field.images(j, covered), observed[covered].astype(np.float64)
        sums = stars.products(weights)[0]
        information = stars.information(weights)
        normal = information if normal is None else normal + information
        levels.append(sums / np.sqrt(n_there))
        level = 0.0 if scene.n_halos else light / n_there
        moment += stars.products(weights * (excess[covered] - level))[0]
    least = max(LEAST * lights.sum() / counts.sum(), ROUNDING)
    if normal is None:
        best = moment
    elif scene.n_halos:
        best = normal.solve(moment)
    else:
        best = _solve_beside(normal, np.array(levels).T, moment)
    fluxes = np.maximum(best, least * math.prod(scene.image_grid) / 100)
    fluxes[~scene.is_shown] = 0.0
    return RoughFit(fluxes, _levels(scene, lights, counts, fluxes, least * counts.sum()))


def level_beside(scene: Scene, fluxes: Array) -> Any:
    """Return the level of a flat extended source beside stars and halos of these fluxes."""
    lights, counts = np.zeros((2, scene.n_images))
    for j, (excess, observed) in enumerate(_excesses(scene)):
        lights[j], counts[j] = excess[observed].sum(), np.count_nonzero(observed)
    least = max(LEAST * lights.sum(), counts.sum() * ROUNDING)
    return _levels(scene, lights, counts, fluxes, least)


def _levels(scene: Scene, lights: Array, counts: Array, fluxes: Array, least: float) -> Any:
    """Return the level that the light of images leaves beside stars, at least that of `least`."""
    seen, of_stars = scene.seen_areas * counts, fluxes * scene.star_weights
    if scene.mixing is None:
        return max(lights.sum() - float(of_stars.sum()), least) / seen.sum()
    from scipy.optimize import nnls

    levels = []
    for there in scene.mixing.images:
        own = scene.shown[:, there].any(axis=1)
        levels.append((lights[there].sum() - of_stars[own].sum()) / seen[there].sum())
    found = nnls(scene.mixing.rows, np.array(levels))[0]
    return np.maximum(found, least / seen.sum())[:, None, None]


def _excesses(scene: Scene) -> Iterator[tuple[Array, NDArray[np.bool_]]]:
    """Yield where each image was observed, last, and its counts above the background there."""
    for j, (excess, background) in enumerate(zip(scene.images(), scene.background(), strict=True)):
        excess -= background
        observed = np.ones(excess.shape, bool) if scene.weights is None else scene.weights[j] > 0
        excess[~observed] = 0.0
        yield excess, observed


def _solve_beside(normal: BandMatrix, levels: Array, moment: Array) -> Array:
    """Return ``(F - U U^T)^-1 m``: the stars beside the level of each image (Woodbury)."""
    with_levels = normal.solve(levels)
    left = np.eye(levels.shape[1]) - levels.T @ with_levels
    alone = normal.solve(moment)
    return alone + with_levels @ (np.linalg.pinv(left, hermitian=True) @ (levels.T @ alone))


def first_estimate(
    scene: Scene, extended: ArrayLike | None, star_fluxes: ArrayLike | None
) -> tuple[Array, Array]:
    """Return the estimate to begin with, scaled, as `lnocl.core.scene.scene.Scene.start` has it."""
    rough = scene.rough_fit
    if star_fluxes is None:
        fluxes = rough.fluxes.copy()
    else:
        shape = (scene.n_stars,)
        given = numbers("initial_star_fluxes", star_fluxes)
        if given.shape == shape:
            given[~scene.is_shown[: scene.n_stars]] = 0.0
        fluxes = _check("initial_star_fluxes", given, shape) / scene.unit
        fluxes = np.append(fluxes, rough.fluxes[scene.n_stars :])
    if extended is None:
        flat = np.broadcast_to(rough.level, scene.sky_grid).copy()
        _refuse_if_too_bright(scene, float(flat.sum() + fluxes.sum()))
        return flat, fluxes
    given = _check("initial_extended", extended, scene.observation.skies_shape) / scene.unit
    given = _in_their_unit(scene, given)
    _refuse_if_too_bright(scene, float(given.sum() + fluxes.sum()))
    mean = given.mean(axis=(-2, -1), keepdims=True)
    laid = np.broadcast_to(mean, scene.sky_grid).copy()
    laid[..., : given.shape[-2], : given.shape[-1]] = given
    return laid, fluxes


def _in_their_unit(scene: Scene, extended: Array) -> Array:
    """Return an extended source to begin with, as bright as images if far brighter.

    Iterations do not find back from one that is: pixels fall to 0, and stay there.
    """
    counts = excess = exposures = 0.0
    for j, (image, background) in enumerate(zip(scene.images(), scene.background(), strict=True)):
        weights = np.ones(scene.image_grid) if scene.weights is None else scene.weights[j]
        counts += float((weights * image).sum())
        excess += float((weights * (image - background)).sum())
        exposures += float(scene.seen_areas[j] * scene.gains[j] * weights.sum())
    noise = math.sqrt(counts / scene.scale)
    most = (BRIGHTER * max(excess, 0.0) + FLOOR * noise) / exposures
    with np.errstate(over="ignore"):
        mean = float(extended.mean())
    if mean <= most:
        return extended
    level = float(np.mean(scene.rough_fit.level))
    warn(
        f"`initial_extended` has {mean / level:.2g} times the light of the images, as in "
        "another unit, and was divided by that; it is in electrons per pixel, per second with "
        "exposures"
    )
    shape = extended / extended.max()
    return np.asarray(shape * (level / shape.mean()))


def _refuse_if_too_bright(scene: Scene, light: float) -> None:
    """Refuse a start whose counts, in electrons, no number holds."""
    most = scene.weights.max() if scene.weights is not None else 1.0
    if not math.isfinite(light * float(most) * float(scene.gains.max()) * scene.scale):
        raise InputError(
            "the counts predicted for the longest exposure overflow: divide images and "
            "background by a constant"
        )


def _check(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = numbers(name, values)
    if array.shape != shape:
        raise InputError(f"`{name}` has shape {array.shape}; it must have {shape}")
    refuse_unless(f"`{name}`", array, "finite and not negative", array >= 0)
    return array
