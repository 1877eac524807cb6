"""The shears of images that are turned, as kernels/turn.cl has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.scene.arrays import Array
from lnocl.scene.rotation import TAPS, Rotation, whole_and_weights


class Shears:
    """The second and the third shear of one image.

    Parameters
    ----------
    rotation : Rotation
        Of the image.

    Attributes
    ----------
    column_wholes : ndarray of int, shape (Nx,)
        Rows that the former begins at, from 1 - TAPS to Ny - TAPS.
    column_weights : ndarray of float64, shape (Nx, TAPS)
        Its weights.
    image_weights : ndarray of float64, shape (Ny, TAPS)
        Those of the latter.
    roll : ndarray of int, shape (Ny,)
        Columns by which the rows of the image are rotated, for its whole pixels.
    """

    def __init__(self, rotation: Rotation) -> None:
        wholes, self.column_weights = whole_and_weights(rotation.column_shifts)
        ny = rotation.grid[0]
        self.column_wholes = (wholes + TAPS // 2) % ny - TAPS + 1
        self.roll, self.image_weights = whole_and_weights(rotation.image_shifts)

    def pack_image_weights(self, block: int) -> Array:
        """Return the weights of the third shear as the kernel has them, for blocks of row pairs."""
        pairs = self.image_weights.reshape(-1, block, 2, TAPS)
        return np.ascontiguousarray(pairs.transpose(0, 3, 2, 1))

    def lay(self, image: NDArray) -> Array:
        """Return an image on the grid with its rows rotated."""
        return self._rolled(image, -1)

    def take_up(self, image: NDArray) -> Array:
        """Return the inverse of `lay`."""
        return self._rolled(image, 1)

    def _rolled(self, image: NDArray, sign: int) -> Array:
        columns = np.arange(image.shape[-1]) + sign * self.roll[:, None]
        return np.asarray(image[..., np.arange(len(columns))[:, None], columns % image.shape[-1]])
