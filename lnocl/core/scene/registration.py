r"""Where images lie by their stars, beside where their offsets and angles put them.

An image less its background, seen back through its PSF P, tells at each pixel how bright a star
there would be over its noise, but for a factor,

.. math:: C = \frac{P \star w (g - b)}{\sqrt{P^2 \star w}},

w being 0 at bad pixels. A misplaced image has all its stars moved alike, so that the squares of C
at these are summed for each move. It is moved by the nearest maximum of the sum that is no side
lobe of a brighter one. What the image that the sky's pixels are of needs too is no error of places
of images, but of stars.

Other sources may be brighter, or blend with the stars where PSFs are wide. So an image k, seen
through the PSF of that image i too, has to be much more alike that image through its PSF, where it
is moved, than where it is not: these are of one PSF,

.. math:: (g_i - b_i) * P_k \approx s \, (g_k - b_k) * P_i.
"""

from __future__ import annotations

import numpy as np
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
# The square of what is left where an image is moved is this share of that where it is not.
BETTER = 0.5
# Stars are so many times as bright at places of other angles where these are the right ones.
CLEARLY = 1.1


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
    for k in range(len(psfs)):
        expected = observation.turns[k] @ of_stars
        by = _found(observation, k, stars, psfs[k], expected, share)[0] - expected
        if np.hypot(*by) > LEAST and _is_better(observation, (i, k), stars + of_stars, psfs, by):
            moved[k] = by
    return moved


def _first(observation: Observation) -> int:
    """Return the image whose pixels the sky has."""
    is_own = (observation.turns == np.eye(2)).all(axis=(1, 2)) & ~observation.offsets.any(axis=1)
    return int(np.argmax(is_own))


def _is_better(
    observation: Observation, pair: tuple[int, int], stars: Array, psfs: list[Array], by: Array
) -> bool:
    """Return whether image k, moved, is much more alike image i, each through the other's PSF."""
    i, k = pair
    turn = observation.turns[k] @ np.linalg.inv(observation.turns[i])  # from image i to image k
    seen = [
        fftconvolve(_light(observation, a), _turned(psfs[b], m), "same")
        for a, b, m in ((i, k, turn), (k, i, np.linalg.inv(turn)))
    ]
    y, x = np.indices((SIDE, SIDE)) - REACH
    left = []
    for move in (np.zeros(2), by):
        pairs = []
        for star in stars:
            rows_columns = [y, x] + observation.places(i, star)[::-1, None, None]
            offsets = np.einsum("ab,byx->ayx", turn, np.stack([x, y]))
            there = offsets + (observation.places(k, star) + move)[:, None, None]
            pairs.append(
                [
                    map_coordinates(seen[0], rows_columns, order=1),
                    map_coordinates(seen[1], there[::-1], order=1),
                ]
            )
        one, other = np.array(pairs).transpose(1, 0, 2, 3)
        scale = (one * other).sum() / max((other**2).sum(), 1e-300)
        left.append(((one - scale * other) ** 2).sum())
    return bool(left[1] < BETTER * left[0])


def _turned(psf: Array, turn: Array) -> Array:
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
    """Return images whose stars lie as if they were turned by as much the other way."""
    found, stars = list[int](), _brightest(observation, stars)
    for j, psf in enumerate(_middles(observation)):
        places, turn = observation.places(j, stars), observation.turns[j]
        if len(stars) > 1 and (turn != turn.T).any():
            others = places.mean(axis=0) + (stars - stars.mean(axis=0)) @ turn
            both = places, others
            lies, would_lie = (_total(observation, j, psf, each).max() for each in both)
            if would_lie > max(CLEARLY * lies, SIGNIFICANT):
                found.append(j)
    return found


def _total(observation: Observation, j: int, psf: Array, places: Array) -> Array:
    """Return the root of the sum of squares of C over its noise, for each move of all places."""
    image, mask = observation.images[j], observation.mask[j]
    background = np.broadcast_to(observation.background[j], image.shape)
    noise = np.sqrt(max(float(np.median(image[~mask])), 1.0))
    half = 2 * REACH + BESIDE
    y, x = np.indices((SIDE, SIDE)) + BESIDE
    total, seen = np.zeros((SIDE, SIDE)), psf[::-1, ::-1]
    for at_x, at_y in places.tolist():
        row, column = round(at_y), round(at_x)
        rows, columns = (range(at - half, at + half + 1) for at in (row, column))
        good = part(~mask, rows, columns) * 1.0
        above = part(image, rows, columns) - part(background, rows, columns)
        light = fftconvolve(good * above, seen, "valid")
        squares = fftconvolve(good, seen**2, "valid").clip(min=(psf**2).sum() / 4.0)
        significance = light.clip(min=0.0) / (noise * np.sqrt(squares))
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
