"""The shears of images that are turned, as kernels/turn.cl has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.line_weights import TAPS, whole_and_weights
from lnocl.core.scene.rotation import Rotation


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
    line_firsts, line_weights : ndarray of int32 and of float64, shapes (n,) and (n, TAPS)
        For `sample_lines`, where the image's pixels are larger than the sky's: of rows, of columns,
        and of their adjoints; else n is 0.
    """

    def __init__(self, rotation: Rotation) -> None:
        wholes, self.column_weights = whole_and_weights(rotation.column_shifts)
        ny = rotation.grid[0]
        self.column_wholes = (wholes + TAPS // 2) % ny - TAPS + 1
        self.roll, self.image_weights = whole_and_weights(rotation.image_shifts)
        samplings = rotation.samplings
        firsts = [each.firsts for each in samplings] + [each.back_firsts for each in samplings]
        weights = [each.weights for each in samplings] + [each.back_weights for each in samplings]
        self.line_firsts = np.concatenate([np.zeros(0, np.int32), *firsts], dtype=np.int32)
        self.line_weights = np.concatenate([np.zeros((0, TAPS)), *weights])

    def pack_image_weights(self, block: int) -> Array:
        """Return the weights of the third shear as the kernel has them, for blocks of row pairs."""
        pairs = self.image_weights.reshape(-1, block, 2, TAPS)
        return np.ascontiguousarray(pairs.transpose(0, 3, 2, 1))

    def lay(self, image: NDArray) -> Array:
        """Return an image on the grid with its rows rotated."""
        columns = (np.arange(image.shape[-1]) - self.roll[:, None]) % image.shape[-1]
        return np.asarray(image[..., np.arange(len(columns))[:, None], columns])
