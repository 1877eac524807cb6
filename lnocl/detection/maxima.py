"""Maxima between the pixels of a map."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array

# A maximum is a source's where it is so many times its noise, unless another threshold is given.
SIGNIFICANT = 5.0
# A maximum lies at most so far from the middle of its pixel, pixels.
FARTHEST = 0.7


def peaks(
    values: Array, y: NDArray[np.int_], x: NDArray[np.int_], beyond: Literal["wrap", "reflect"]
) -> tuple[Array, Array]:
    """Return how far maxima lie from their pixels, x and y, shape (n, 2), and their values, (n,).

    They are those of Gaussians through 3 x 3 values; of parabolas where a value is not positive.

    Parameters
    ----------
    values : ndarray of float64, shape (ny, nx)
        The map.
    y, x : ndarray of int, shape (n,)
        Pixels that are not below those beside them.
    beyond : {"wrap", "reflect"}
        How the map goes on beyond its edges, as for `numpy.pad`.
    """
    padded, steps = np.pad(values, 1, beyond), range(3)
    near = np.array([[padded[y + dy, x + dx] for dx in steps] for dy in steps])
    moves, higher = _vertices(near)
    is_positive = np.all(near > 0, axis=(0, 1))
    of_logs, logs = _vertices(np.log(np.where(is_positive, near, 1.0)))
    moves = np.where(is_positive[:, None], of_logs, moves)
    return moves, np.where(is_positive, np.exp(logs), higher)


def _vertices(near: Array) -> tuple[Array, Array]:
    """Return where parabolas through 3 x 3 values have their maxima, (n, 2), and their values."""
    middle = near[1, 1]
    slope = np.stack([near[1, 2] - near[1, 0], near[2, 1] - near[0, 1]], axis=1) / 2.0
    xx, yy = near[1, 2] + near[1, 0] - 2 * middle, near[2, 1] + near[0, 1] - 2 * middle
    xy = (near[2, 2] + near[0, 0] - near[0, 2] - near[2, 0]) / 4.0
    determinant = xx * yy - xy**2
    is_peak = (determinant > 0) & (xx < 0)
    safe = np.where(is_peak, determinant, 1.0)
    moves = -np.stack([yy * slope[:, 0] - xy * slope[:, 1], xx * slope[:, 1] - xy * slope[:, 0]],
                      axis=1) / safe[:, None]  # fmt: skip
    moves = np.where(is_peak[:, None], moves, 0.0).clip(-FARTHEST, FARTHEST)
    return moves, middle + (slope * moves).sum(axis=1) / 2.0
