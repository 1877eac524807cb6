"""Amounts of images, and places of points, that explain an image best: by least squares."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lnocl.core.scene.arrays import Array

# The farthest that a point moves in one step, pixels, and the steps in which places are fitted.
FARTHEST, STEPS = 0.5, 8
# Combinations of images with less than this share of the largest tell nothing.
SAME = 1e-8


def amounts(parts: Sequence[Array], light: Array, weights: Array) -> Array:
    """Return the amounts of n images whose sum explains an image best, shape (n,).

    Parameters
    ----------
    parts : sequence of n ndarray of float64, shape (h, w)
        The images; one that is dark has no amount.
    light, weights : ndarray of float64, shape (h, w)
        What they are to explain, and one over the variance of each pixel.
    """
    root = np.sqrt(weights).ravel()
    matrix = np.array([part.ravel() for part in parts]) * root
    sizes = np.linalg.norm(matrix, axis=1)
    units = np.divide(1.0, sizes, out=np.zeros_like(sizes), where=sizes > 0)
    return np.asarray(
        units * np.linalg.lstsq((units[:, None] * matrix).T, light.ravel() * root, rcond=SAME)[0]
    )


def step(
    points: Sequence[Array],
    fluxes: Array,
    light: Array,
    weights: Array,
    others: Sequence[Array] = (),
) -> tuple[Array, Array]:
    """Return the fluxes of points that explain an image best, shape (n,), and their moves, (n, 2).

    A point moves by its slopes, which its flux scales: without one it stays.

    Parameters
    ----------
    points : sequence of n ndarray of float64, shape (3, h, w)
        A point of unit flux, and its derivatives by x and y of its place.
    fluxes : ndarray of float64, shape (n,)
        About those of the points.
    light, weights : ndarray of float64, shape (h, w)
        As of `amounts`; the light includes that of the points.
    others : sequence of ndarray of float64, shape (h, w), optional
        Images whose amounts are not known either.
    """
    n = len(points)
    slopes = [flux * slope for flux, point in zip(fluxes, points, strict=True)
              for slope in point[1:]]  # fmt: skip
    found = amounts([*(point[0] for point in points), *slopes, *others], light, weights)
    return found[:n], found[n : 3 * n].reshape(n, 2).clip(-FARTHEST, FARTHEST)


def fit(
    point: Callable[[float, float], Array],
    places: Array,
    fluxes: Array,
    light: Array,
    weights: Array,
    others: Sequence[Array] = (),
    n_steps: int = STEPS,
) -> tuple[Array, Array]:
    """Return places (x, y) of points, shape (n, 2), and their fluxes, (n,), after steps of a fit.

    The arguments are those of `step`, but for the function that returns a point at a place.
    """
    for _ in range(n_steps):
        points = [point(x, y) for x, y in places]
        fluxes, moves = step(points, fluxes, light, weights, others)
        places = places + moves
    return places, fluxes
