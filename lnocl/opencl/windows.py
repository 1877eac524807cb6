"""The windows in which arrays of stars lie on the device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lnocl.opencl.layout import PixelLayout, shortest_arc
from lnocl.scene.arrays import Array
from lnocl.scene.shifting import Cutout
from lnocl.scene.stars import Covered


def stars_near(corners: NDArray[np.int32], n_blocks: int, row_blocks: int) -> NDArray[np.int32]:
    """Return the stars of each block of row pairs, as kernels/stars.cl has them.

    Parameters
    ----------
    corners : ndarray of int, shape (n, 2)
        First block and column of each star's window.
    n_blocks : int
        Blocks of a window.
    row_blocks : int
        Blocks of the grid.

    Returns
    -------
    ndarray of int32, shape (row_blocks + 1 + n * n_blocks,)
        Where the stars of each block begin, and where the last ones end; then the stars.
    """
    blocks = ((corners[:, :1] + np.arange(n_blocks)) % row_blocks).ravel()
    order = np.argsort(blocks, kind="stable")
    starts = row_blocks + 1 + np.searchsorted(blocks[order], np.arange(row_blocks + 1))
    return np.concatenate([starts, order // n_blocks]).astype(np.int32)


class StarWindows:
    """The blocks of row pairs, and columns, in which arrays of stars are not 0: kernels/stars.cl.

    Parameters
    ----------
    layout : PixelLayout
        Of the arrays.
    boxes : sequence of Covered
        For each star the rows and columns that its arrays may reach into.
    """

    def __init__(self, layout: PixelLayout, boxes: Sequence[Covered]) -> None:
        blocks = [layout.window(box.rows) for box in boxes]
        columns = [shortest_arc(box.columns) for box in boxes]
        self._layout = layout
        self.corners = np.array(
            [(block, x) for (block, _), (x, _) in zip(blocks, columns, strict=True)], np.int32
        ).reshape(-1, 2)
        self.n_blocks = max((count for _, count in blocks), default=1)
        self.n_columns = max((count for _, count in columns), default=1)
        self.near = stars_near(self.corners, self.n_blocks, layout.pixels_shape[0])

    @property
    def n_blocks_of_all(self) -> int:
        """Blocks of the windows of all stars."""
        return len(self.corners) * self.n_blocks

    @property
    def bytes(self) -> int:
        """Bytes of one array for each star."""
        width = self._layout.grid[1]
        return self.n_blocks_of_all * self._layout.block_bytes // width * self.n_columns

    def cut(self, s: int, cutout: Cutout) -> Array:
        """Return the pixels of a star's window, with a cutout in them."""
        block, column = self.corners[s].tolist()
        first = int(self._layout.rows_of(block, 1)[0]), column
        window = np.zeros((self._layout.rows_of(0, self.n_blocks).size, self.n_columns))
        return cutout.add_to(window, first, self._layout.grid)
