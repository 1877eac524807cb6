r"""Lines of pixels between their points: the weights of a shift, and what undoes their effect.

A point between pixels is a sum of six, with weights of a Kaiser-Bessel window. What these weights
do to a frequency is undone before, in the OTF, as a transform on unequal points does it (Barnett,
Magland & af Klinteberg, SIAM J. Sci. Comput. 41, C479, 2019). So they are right to 5e-5 up to 0.3
cycles per pixel, and to 1.3e-4 at 0.35. Where all points are whole pixels they are taken as they
are.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array

# Weights of a point, and the parameter of their Kaiser-Bessel window: of the least error up to 0.35
# cycles per pixel.
TAPS = 6
BETA = 11.75
# Fractions of a pixel, and frequencies, on which the window's own effect is averaged.
FRACTIONS, FREQUENCIES = 64, 513


def shift_weights(fractions: Array) -> Array:
    """Return the weights, shape (..., TAPS), that shift a line by fractions of a pixel, 0 to 1.

    Point i becomes ``sum_k w_k f(i - TAPS / 2 + 1 + k)``. Their sum is 1, so that flux is kept.
    """
    distance = np.asarray(fractions)[..., None] + (TAPS / 2 - 1 - np.arange(TAPS))
    window = np.i0(BETA * np.sqrt(np.clip(1.0 - (2.0 * distance / TAPS) ** 2, 0.0, None)))
    return np.asarray(window / window.sum(axis=-1, keepdims=True))


def _own_effect() -> tuple[Array, Array]:
    """Return frequencies, cycles per pixel, and by what the weights' effect on them is undone.

    It is the factor of least mean squared error over all fractions of a pixel.
    """
    frequencies = np.linspace(0.0, 0.5, FREQUENCIES)
    fractions = (np.arange(FRACTIONS) + 0.5) / FRACTIONS
    places = np.arange(TAPS) - TAPS / 2 + 1 - fractions[:, None]
    phases = np.exp(2j * np.pi * frequencies * places[..., None])
    gains = np.einsum("ik,ikf->if", shift_weights(fractions), phases)
    return frequencies, gains.real.mean(axis=0) / (abs(gains) ** 2).mean(axis=0)


_EFFECT = _own_effect()


def undone(places: Array, frequencies: Array) -> Array:
    """Return by what the effect of the weights at some places is undone, at frequencies."""
    if are_whole(places):
        return np.ones_like(frequencies)
    return np.interp(abs(frequencies), *_EFFECT)


def are_whole(places: Array) -> bool:
    """Return whether all places are whole pixels."""
    return bool((places == np.floor(places)).all())


def whole_and_weights(places: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the whole pixels of places, shape (n,), and the weights of what is left."""
    return _of_places(np.asarray(places, float).tobytes())


@lru_cache(maxsize=256)  # iterations shift the same lines each time
def _of_places(content: bytes) -> tuple[NDArray[np.int64], Array]:
    places = np.frombuffer(content)
    floor = np.floor(places)
    whole, weights = floor.astype(int), shift_weights(places - floor)
    if are_whole(places):
        weights = np.tile(np.arange(TAPS) == TAPS // 2 - 1, (len(places), 1)) * 1.0
    whole.flags.writeable = weights.flags.writeable = False
    return whole, weights


def shifted(rows: Array, shifts: Array, sign: int) -> Array:
    """Return rows, each shifted round its end; the adjoint for a sign of -1."""
    whole, weights = whole_and_weights(shifts)
    n = rows.shape[1]
    first = 1 - TAPS // 2 if sign > 0 else -TAPS // 2
    places = np.arange(n + TAPS - 1) + first + sign * whole[:, None]
    longer = np.take_along_axis(rows, places % n, axis=1)
    total = np.zeros_like(rows)
    for k in range(TAPS):
        at = k if sign > 0 else TAPS - 1 - k
        total += weights[:, k, None] * longer[:, at : at + n]
    return total


def sums_of_lines(
    lines: NDArray[Any], firsts: NDArray[np.int_], weights: Array, axis: int
) -> NDArray[Any]:
    """Return ``sum_k w_ik x(firsts_i + k)`` along an axis, round its end."""
    shape = [1] * lines.ndim
    shape[axis] = len(firsts)
    terms = (
        weights[:, k].reshape(shape) * lines.take(firsts + k, axis, mode="wrap")
        for k in range(TAPS)
    )
    return np.asarray(sum(terms))


class LineSampling:
    """Points of a line of the sky in steps of an image's larger pixels, and the adjoint.

    Parameters
    ----------
    places : ndarray of float64, shape (n,)
        Where each point lies in the line, pixels; they rise by one step, 1 or more, but for where
        the period ends.
    first : int
        The line holds the places from here on, n of them, round its end. Points too near to the
        ends of that, or beyond, are 0.

    Attributes
    ----------
    firsts, back_firsts : ndarray of int, shape (n,)
        The first place of each point's sum, from 0 to n - 1; for the adjoint the first point.
    weights, back_weights : ndarray of float64, shape (n, TAPS)
        Of these sums.
    """

    def __init__(self, places: Array, first: int) -> None:
        n = len(places)
        self.places = places
        whole, weights = whole_and_weights(places)
        begins = whole - TAPS // 2 + 1
        is_held = (begins >= first) & (begins + TAPS <= first + n)
        self.firsts, self.weights = begins % n, np.where(is_held[:, None], weights, 0.0)
        # Points rise along the period that is held, so those that reach a place are neighbours.
        points = np.flatnonzero(is_held)
        points = points[np.argsort(places[points])]
        line = np.arange(first, first + n)
        reached = np.searchsorted(begins[points] + TAPS - 1, line)
        self.back_firsts = np.zeros(n, int)
        self.back_weights = np.zeros((n, TAPS))
        at = line % n
        self.back_firsts[at] = points[np.minimum(reached, len(points) - 1)]
        for k in range(TAPS):
            nearest = np.minimum(reached + k, len(points) - 1)
            tap = line - begins[points[nearest]]
            is_reached = (reached + k < len(points)) & (tap >= 0) & (tap < TAPS)
            self.back_weights[at, k] = np.where(
                is_reached, weights[points[nearest], tap.clip(0, TAPS - 1)], 0.0
            )

    def forward(self, lines: NDArray[Any], axis: int) -> NDArray[Any]:
        """Return the points of lines."""
        return sums_of_lines(lines, self.firsts, self.weights, axis)

    def adjoint(self, points: NDArray[Any], axis: int) -> NDArray[Any]:
        """Return the adjoint of `forward`."""
        return sums_of_lines(points, self.back_firsts, self.back_weights, axis)
