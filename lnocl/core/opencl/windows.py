"""The windows in which arrays of stars lie on the device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lnocl.core.opencl.layout import PixelLayout, shortest_arc
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.camera import spread
from lnocl.core.scene.shifting import Cutout
from lnocl.core.scene.stars import Covered


def stars_near(
    corners: NDArray[np.integer],
    n_blocks: int,
    row_blocks: int,
    shown: NDArray[np.bool_] | None = None,
    counts: NDArray[np.integer] | None = None,
) -> NDArray[np.int32]:
    """Return the stars of each block of row pairs, as kernels/stars.cl has them.

    Parameters
    ----------
    corners : ndarray of int, shape (n, n_arrays, 2)
        First block and column of the windows of each star.
    n_blocks : int
        Blocks of a window.
    row_blocks : int
        Blocks of the grid.
    shown : ndarray of bool, shape (n, n_arrays), optional
        Which arrays hold each star; by default all.
    counts : ndarray of int, shape (n, n_arrays), optional
        Blocks of each window that are not 0, the first of it; by default all.

    Returns
    -------
    ndarray of int32, shape (n_arrays * row_blocks + 1 + n * n_arrays * n_blocks,) or less
        Where the stars of each block of each array begin, and where the last ones end; then the
        stars.
    """
    n, n_arrays = corners.shape[:2]
    blocks = (corners[..., :1] + np.arange(n_blocks)) % row_blocks
    units = (blocks + row_blocks * np.arange(n_arrays)[:, None]).ravel()
    stars = np.repeat(np.arange(n), n_arrays * n_blocks)
    is_held = np.ones((n, n_arrays, n_blocks), bool)
    if shown is not None:
        is_held &= shown[..., None]
    if counts is not None:
        is_held &= np.arange(n_blocks) < counts[..., None]
    units, stars = units[is_held.ravel()], stars[is_held.ravel()]
    order = np.argsort(units, kind="stable")
    n_units = n_arrays * row_blocks
    starts = n_units + 1 + np.searchsorted(units[order], np.arange(n_units + 1))
    return np.concatenate([starts, stars[order]]).astype(np.int32)


class StarWindows:
    """The blocks of row pairs, and columns, in which arrays of stars are not 0: kernels/stars.cl.

    Parameters
    ----------
    layout : PixelLayout
        Of the arrays.
    boxes : sequence of sequences of Covered
        For each star, and each of its arrays, the rows and columns that it may reach into.
    n_arrays : int
        Arrays of a star.
    rolls : sequence of ndarray of int, shape (Ny,), optional
        For each array the columns by which its rows are rotated.
    shown : ndarray of bool, shape (n, n_arrays), optional
        Which arrays hold each star; by default all. With it sums over other blocks are not written.
    step : int, optional
        Each pixel of boxes and cutouts is the first of so many of the layout, along each axis.
    """

    def __init__(
        self,
        layout: PixelLayout,
        boxes: Sequence[Sequence[Covered]],
        n_arrays: int,
        rolls: Sequence[NDArray[np.int_]] = (),
        shown: NDArray[np.bool_] | None = None,
        step: int = 1,
    ) -> None:
        self._layout, self._rolls, self._step = layout, rolls, step
        blocks, columns, first = [], [], np.arange(step) == 0
        for of_star in boxes:
            for a, coarse in enumerate(of_star):
                box = Covered(*(np.kron(each, first) if step > 1 else each for each in coarse))
                blocks.append(layout.window(box.rows))
                columns.append(_rolled_arc(box, rolls[a]) if rolls else shortest_arc(box.columns))
        self.corners = np.array(
            [(block, x) for (block, _), (x, _) in zip(blocks, columns, strict=True)], np.int32
        ).reshape(-1, n_arrays, 2)
        self.n_blocks = max((count for _, count in blocks), default=1)
        self.n_columns = max((count for _, count in columns), default=1)
        # Windows are as large as the largest, which may be a halo's.
        counts = np.array([count for _, count in blocks], int).reshape(-1, n_arrays)
        self.near = stars_near(
            self.corners,
            self.n_blocks,
            layout.pixels_shape[0],
            shown,
            None if shown is None else counts,
        )

    @property
    def n_blocks_of_all(self) -> int:
        """Blocks of the windows of one array of all stars."""
        return len(self.corners) * self.n_blocks

    @property
    def bytes(self) -> int:
        """Bytes of one array for each star."""
        width = self._layout.grid[1]
        return self.n_blocks_of_all * self._layout.block_bytes // width * self.n_columns

    def cut(self, s: int, a: int, cutout: Cutout) -> Array:
        """Return the pixels of a window of a star, with a cutout in them."""
        q, (block, column) = self._step, self.corners[s, a].tolist()
        cutout = Cutout(spread(cutout.values, q), q * cutout.y, q * cutout.x)
        rows = self._layout.rows_of(block, self.n_blocks)
        if not self._rolls:
            window = np.zeros((rows.size, self.n_columns))
            return cutout.add_to(window, (int(rows[0]), column), self._layout.grid)
        ny, nx = self._layout.grid
        y = ((rows - cutout.y) % ny)[:, None]
        x = (column + np.arange(self.n_columns) - self._rolls[a][rows, None] - cutout.x) % nx
        height, width = cutout.values.shape
        inside = (y < height) & (x < width)
        return np.where(inside, cutout.values[y % height, x % width], 0.0)


def _rolled_arc(box: Covered, roll: NDArray[np.int_]) -> tuple[int, int]:
    """Return first and number of the columns of a box, its rows being rotated by some columns."""
    nx = len(box.columns)
    first, count = shortest_arc(box.columns)
    by = roll[box.rows] if box.rows.any() else np.zeros(1, int)
    count = min(count + int(np.ptp(by)), nx)
    return (first + int(by.min())) % nx, count
