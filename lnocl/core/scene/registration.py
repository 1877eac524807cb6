r"""Where images lie by their stars, beside where their offsets and angles put them.

An image less its background, seen back through its PSF P, tells at each pixel how bright a star
there would be over its noise, but for a factor,

.. math:: C = \frac{P \star w (g - b)}{\sqrt{P^2 \star w}},

w being 0 at bad pixels. A misplaced image has all its stars moved alike, so that the squares of C
at these are summed for each move. The candidate is the nearest maximum of the sum that is no side
lobe of a brighter one. What the image needs too whose pixels the sky has is an error of the places
of stars, not of images.

Other sources may be brighter, or blend with the stars where PSFs are wide. So image k has to agree
much better with that image i where it is moved. Each is seen through the PSF of the other, so that
both have one PSF,

.. math:: (g_i - b_i) * P_k \approx s \, (g_k - b_k) * P_i.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, map_coordinates, maximum_filter
from scipy.signal import fftconvolve

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.transforms import enlarged, part

# Images are sought so many pixels round the places of their brightest stars; less than the other is
# left to the fit of PSFs, which tells it better.
REACH, LEAST, MOST_STARS = 30, 0.75, 20
# The side of what is looked at round a star, and of a PSF; pixels beside that for interpolation.
SIDE, BESIDE = 2 * REACH + 1, 3
# A maximum is no side lobe where it is so many times as high as one. It is that of stars where it
# is this share of the highest, or so many times the share that they have in the first image; the
# highest is so many times its noise.
APART, SHARE, ALIKE, SIGNIFICANT = 1.5, 0.2, 0.6, 30.0
# The same where stars are expected to so many pixels: others may be brighter in one image.
LEAST_SHARE, NEAR = 0.05, 2.0
# The squares by which an image differs from the first, moved or turned, over those as it is.
BETTER, CLEARLY = 0.5, 0.25


def displacements(observation: Observation, stars: Array) -> Array:
    """Return how far each image lies from its place, pixels of its own, shape (p, 2).

    That is 0 for the image whose pixels the sky has, for those that lie within `LEAST` of their
    places, and for those whose stars do not tell.

    Parameters
    ----------
    observation : Observation
        Images and PSFs.
    stars : ndarray of float64, shape (n, 2)
        Places of stars on the sky, pixels.
    """
    psfs, moved = _middles(observation), np.zeros((observation.n_images, 2))
    i, stars = _first(observation), _brightest(observation, stars)
    found, share = _found(observation, i, stars, psfs[i], moved[i], SHARE / ALIKE)
    of_stars = np.linalg.solve(observation.turns[i], found)
    if not np.isfinite(of_stars).all():
        return moved
    turns = observation.turns @ np.linalg.inv(observation.turns[i])
    for k, turn in enumerate(turns):
        expected = observation.turns[k] @ of_stars
        by = _found(observation, k, stars, psfs[k], expected, share)[0] - expected
        if np.hypot(*by) > LEAST:
            at = observation.places(k, stars + of_stars)
            stays, goes = (
                _unlike(observation, i, k, stars + of_stars, psfs, lie, turn)
                for lie in (at, at + by)
            )
            moved[k] = by if goes < BETTER * stays else 0.0
    return moved


def _first(observation: Observation) -> int:
    """Return the image whose pixels the sky has."""
    is_own = (observation.turns == np.eye(2)).all(axis=(1, 2)) & ~observation.offsets.any(axis=1)
    return int(np.argmax(is_own))


def _unlike(
    observation: Observation,
    i: int,
    k: int,
    stars: Array,
    psfs: list[Array],
    lie: Array,
    turn: Array,
) -> float:
    """Return the sum of squares by which images differ round stars, each through the other's PSF.

    Image k has the stars where they `lie`, and is turned by `turn` against image i. A factor
    between the images is free.
    """
    one = fftconvolve(_light(observation, i), _turned(psfs[k], turn), "same")
    other = fftconvolve(_light(observation, k), _turned(psfs[i], np.linalg.inv(turn)), "same")
    around = np.indices((SIDE, SIDE)).reshape(2, -1)[::-1] - REACH  # x and y
    of_one, of_other = (
        np.concatenate([map_coordinates(seen, (at[:, None] + by)[::-1], order=1) for at in places])
        for seen, places, by in (
            (one, observation.places(i, stars), around),
            (other, lie, turn @ around),
        )
    )
    scale = (of_one @ of_other) / max(float(of_other @ of_other), 1e-300)
    return float(((of_one - scale * of_other) ** 2).sum())


def _turned(psf: Array, turn: NDArray[Any]) -> Array:
    """Return a PSF at pixels ``turn @ u`` from its middle, of unit sum."""
    u = np.flip(turn)  # in the order of rows and columns
    middle = np.array(psf.shape) // 2
    turned = (
        affine_transform(psf, u, middle - u @ middle, order=3) if (turn != np.eye(2)).any() else psf
    )
    return np.asarray(turned / turned.sum())


def _light(observation: Observation, j: int) -> Array:
    """Return an image above its background, 0 where it is bad."""
    light = observation.images[j] - observation.background[j]
    return np.where(observation.mask[j], 0.0, light)


def _found(
    observation: Observation, j: int, stars: Array, psf: Array, expected: Array, share: float
) -> tuple[Array, float]:
    """Return how far the stars of an image are from their places, and their share; NaN if unknown.

    That is of the highest maximum, and is not much less than that which is given.
    """
    total, width = _total(observation, j, psf, observation.places(j, stars)), SIDE
    y, x = np.indices(total.shape) - REACH
    highest = row, column = divmod(int(np.argmax(total)), width)
    rows, columns = (slice(width - 1 - i, 2 * width - 1 - i) for i in (row, column))
    lobes = fftconvolve(psf, psf[::-1, ::-1]) / (psf**2).sum()
    lobe = total[highest] * lobes[rows, columns]
    peaks = (total == maximum_filter(total, 3)) & (total > APART * lobe)
    away = np.hypot(y - expected[1], x - expected[0])
    peaks &= total > np.where(away < NEAR, LEAST_SHARE, ALIKE * share) * total[highest]
    peaks[highest] = True
    peaks[[0, -1]] = peaks[:, [0, -1]] = False  # which rise beyond
    if not peaks.any() or total[highest] < SIGNIFICANT:
        return np.full(2, np.nan), np.nan
    nearest = np.argmin(np.where(peaks, away, np.inf))
    row, column = divmod(int(nearest), width)
    above, middle, below = total[row - 1 : row + 2, column].tolist()
    left, _, right = total[row, column - 1 : column + 2].tolist()
    finer = [_vertex(left, middle, right), _vertex(above, middle, below)]
    found = np.array([column - REACH, row - REACH]) + finer
    return found, float(total[row, column] / total[highest])


def turned_otherwise(observation: Observation, stars: Array) -> list[int]:
    """Return images that are much more alike the first if turned by as much the other way."""
    psfs, others = _middles(observation), list[int]()
    i, stars = _first(observation), _brightest(observation, stars)
    for k, turn in enumerate(observation.turns @ np.linalg.inv(observation.turns[i])):
        if len(stars) < 2 or (turn == turn.T).all():
            continue
        lie, middle = observation.places(k, stars), observation.places(k, stars.mean(axis=0))
        rotation = turn / np.sqrt(abs(np.linalg.det(turn)))
        would_lie = middle + (lie - middle) @ rotation @ rotation  # back, and as far again
        is_, would_be = (
            _unlike(observation, i, k, stars, psfs, at + _highest(observation, k, psfs[k], at), way)
            for at, way in ((lie, turn), (would_lie, turn.T))
        )
        if would_be < CLEARLY * is_:
            others.append(k)
    return others


def _highest(observation: Observation, k: int, psf: Array, places: Array) -> Array:
    """Return the move for which stars at these places are most significant."""
    total = _total(observation, k, psf, places)
    return np.array(divmod(int(np.argmax(total)), SIDE)[::-1]) - REACH


def _total(observation: Observation, j: int, psf: Array, places: Array) -> Array:
    """Return the root of the sum of squares of C over its noise, for each move of all places."""
    image, mask, light = observation.images[j], observation.mask[j], _light(observation, j)
    noise = np.sqrt(max(float(np.median(image[~mask])), 1.0)) if not mask.all() else 1.0
    half = 2 * REACH + BESIDE
    y, x = np.indices((SIDE, SIDE)) + BESIDE
    total, seen = np.zeros((SIDE, SIDE)), psf[::-1, ::-1]
    for at_x, at_y in places.tolist():
        row, column = round(at_y), round(at_x)
        rows, columns = (range(at - half, at + half + 1) for at in (row, column))
        found = fftconvolve(part(light, rows, columns), seen, "valid").clip(min=0.0)
        squares = fftconvolve(part(~mask, rows, columns), seen**2, "valid")
        significance = found / (noise * np.sqrt(squares.clip(min=(psf**2).sum() / 4.0)))
        total += map_coordinates(significance, [y + at_y - row, x + at_x - column]) ** 2
    return np.sqrt(total)


def _middles(observation: Observation) -> list[Array]:
    """Return the middle of the PSF of each image, of odd sides."""
    return [enlarged(psf, (SIDE, SIDE), is_centred=True) for psf in psfs_on_detector(observation)]


def _brightest(observation: Observation, stars: Array) -> Array:
    """Return the stars of which that image has most light, `MOST_STARS` of them."""
    i = _first(observation)
    columns, rows = np.round(observation.places(i, stars)).astype(int).T
    image = observation.images[i]
    inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    light = np.where(inside, image[rows * inside, columns * inside], 0.0)
    return stars[np.argsort(-light, kind="stable")[:MOST_STARS]]


def _vertex(before: float, middle: float, after: float) -> float:
    """Return where a parabola through three points has its maximum, from the middle one."""
    bend = 2.0 * middle - before - after
    return float(0.5 * (after - before) / bend) if bend > 0 else 0.0
