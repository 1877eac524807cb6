"""Stars on the grid of a scene: their images, and sums over the pixels that these light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError
from lnocl.scene import containers, star_tables
from lnocl.scene.detector import DetectorPsf
from lnocl.scene.observation import Array, Observation, numbers
from lnocl.scene.shifting import MARGIN, MovablePsf, Stamp

# Pixels of a flattened array: a slice where they are all of it, which takes no gathering.
Pixels = NDArray[np.intp] | slice

# Pixels that are taken together where images light all of them: as many as a cache holds.
CHUNK = 1 << 14

# Some pixels, and k values at each of them, shape (k, number of pixels).
Piece = tuple[Pixels, Array]


class StarImages:
    """k linear functions of the pixels for each star: its image, and perhaps derivatives of it.

    Parameters
    ----------
    size : int
        Number of pixels.
    pieces : list of lists of (pixels, ndarray of float64, shape (k, m))
        The image of each star is the sum of its pieces, each over m pixels.
    overlap : ndarray of bool, shape (n, n)
        Which stars may light the same pixels as which.
    """

    def __init__(self, size: int, pieces: list[list[Piece]], overlap: NDArray[np.bool_]) -> None:
        self._size, self._pieces, self._overlap = size, pieces, overlap
        self._k = pieces[0][0][1].shape[0] if pieces else 1

    def light(self, fluxes: Array) -> Array:
        """Return ``sum_s c_s P_s``, shape (size,)."""
        total = np.zeros(self._size)
        for flux, pieces in zip(fluxes, self._pieces, strict=True):
            for pixels, values in pieces:
                total[pixels] += flux * values[0]
        return total

    def products(self, x: Array) -> Array:
        """Return the ``<P_s, x>``, shape (k, n)."""
        products = [sum(values @ x[pixels] for pixels, values in each) for each in self._pieces]
        return np.array(products).reshape(len(self._pieces), self._k).T

    def information(self, weights: Array) -> Array:
        """Return the ``<P_s, w P_t>``, shape (k n, k n), all stars for each of the k in turn."""
        k, n = self._k, len(self._pieces)
        if all(isinstance(pixels, slice) for each in self._pieces for pixels, _ in each):
            return self._information_of_full_images(weights)
        information = np.zeros((k, n, k, n))
        weighted = np.zeros((k, self._size))
        for s, pieces in enumerate(self._pieces):
            for pixels, values in pieces:
                weighted[:, pixels] += weights[pixels] * values
            for t in s + np.flatnonzero(self._overlap[s, s:]):
                block = sum(weighted[:, pixels] @ values.T for pixels, values in self._pieces[t])
                information[:, s, :, t] = block
                information[:, t, :, s] = np.transpose(block)
            for pixels, _ in pieces:
                weighted[:, pixels] = 0.0
        return information.reshape(k * n, k * n)

    def _information_of_full_images(self, weights: Array) -> Array:
        """Return the information of images that light all pixels: a product of matrices."""
        information: Any = 0.0
        for first in range(0, self._size, CHUNK):
            part = slice(first, first + CHUNK)
            images = np.array([sum(v[:, part] for _, v in pieces) for pieces in self._pieces])
            columns = images.swapaxes(0, 1).reshape(-1, images.shape[2])
            information = information + (columns * weights[part]) @ columns.T
        return np.asarray(information, np.float64)


class StarField:
    """Stars at their positions; the image of each through each PSF is made once.

    Parameters
    ----------
    psfs : sequence of p sequences of n MovablePsf or DetectorPsf
        That of each image at each star.
    offsets : ndarray of float64, shape (p, 2)
        Of the images, pixels.
    grid : tuple of int
        Shape (ny, nx) of the images' grid.
    positions : ndarray of float64, shape (n, 2)
        Pixels of an image without offset.
    """

    def __init__(
        self,
        psfs: Sequence[Sequence[MovablePsf | DetectorPsf]],
        offsets: Array,
        grid: tuple[int, int],
        positions: Array,
    ) -> None:
        self.positions = positions
        self.psfs, self._offsets, self._grid = psfs, offsets, grid

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def stamps(self) -> list[list[Stamp]]:
        """P_js for each image j and star s."""
        return [
            [
                psf.at(*(position + offset)).aligned(self._grid)
                for psf, position in zip(psfs, self.positions, strict=True)
            ]
            for psfs, offset in zip(self.psfs, self._offsets, strict=True)
        ]

    def light(self, j: int, fluxes: Array) -> Array:
        """Return ``sum_s c_s P_js``, shape (Ny, Nx)."""
        total = np.zeros(self._grid)
        for flux, stamp in zip(fluxes, self.stamps[j], strict=True):
            if flux:
                total[stamp.window(self._grid)] += flux * stamp.values
        return total

    def lit(self, j: int) -> NDArray[np.bool_]:
        """Return the pixels of image j that any star lights, shape (Ny, Nx)."""
        return light_up(self.stamps[j], self._grid)

    def images(self, j: int, lit: NDArray[np.bool_]) -> StarImages:
        """Return the P_js over these pixels, to which all that any star lights must belong."""
        place, size = places(lit), int(np.count_nonzero(lit))
        pieces: list[list[Piece]] = []
        for stamp in self.stamps[j]:
            window = stamp.window(self._grid)
            fills = stamp.values.size == size and isinstance(window[0], slice)
            pixels = slice(None) if fills else place[window].ravel()
            pieces.append([(pixels, stamp.values.reshape(1, -1))])
        return StarImages(size, pieces, overlap(self.stamps[j], self._grid))


def light_up(stamps: Sequence[Stamp], grid: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels of the grid that stamps lie on."""
    lit = np.zeros(grid, bool)
    for stamp in stamps:
        lit[stamp.window(grid)] = True
    return lit


def places(lit: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the place of each pixel that is lit among all that are, -1 where it is dark."""
    place = np.full(lit.shape, -1)
    place[lit] = np.arange(np.count_nonzero(lit))
    return place


def overlap(stamps: Sequence[Stamp], grid: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which stamps overlap which, shape (n, n)."""
    overlap = np.ones((len(stamps), len(stamps)), bool)
    for axis, n in enumerate(grid):
        first = np.array([stamp[1 + axis] for stamp in stamps], int)
        size = np.array([stamp.values.shape[axis] for stamp in stamps], int)
        distance = np.subtract.outer(first, first)
        overlap &= (distance % n < size) | (-distance % n < size[:, None])
    return overlap


class Lit(NamedTuple):
    """Rows of the grid, shape (Ny,), and columns, shape (Nx,), that hold light."""

    rows: NDArray[np.bool_]
    columns: NDArray[np.bool_]


def lit_box(stamps: Sequence[Stamp], grid: tuple[int, int], leeway: float = 0.0) -> Lit:
    """Return the rows and columns that stamps light, moved by up to the leeway."""
    box = Lit(*(np.zeros(n, bool) for n in grid))
    for stamp in stamps:
        for axis, at in enumerate((stamp.rows(grid), stamp.columns(grid))):
            may_be_lit = (stamp.values != 0).any(axis=1 - axis) | (leeway > 0)
            box[axis][at[may_be_lit]] = True
    if not leeway:
        return box
    distance = int(np.ceil(leeway)) + MARGIN + 1
    steps = range(-distance, distance + 1)
    return Lit(*(np.any([np.roll(each, step) for step in steps], axis=0) for each in box))


# Stars that are nearer to each other, in pixels, are one: nothing tells their fluxes apart.
CLOSEST = 1e-3


def check_positions(stars: Any, observation: Observation) -> Array:
    """Return the positions of stars, shape (n, 2).

    Raises
    ------
    InputError
        They are not pairs of numbers, or not in pixels; a table that `star_tables.positions`
        refuses; one lies outside all images; two are at one position.
    """
    if isinstance(stars, (Iterator, Set)):  # which can be read once, or have no order
        stars = list(stars)
    if hasattr(stars, "colnames"):  # a table of astropy
        positions = star_tables.positions(stars)
    else:
        positions = numbers("stars", containers.pixels("stars", stars))
    if positions.size == 0:
        return np.zeros((0, 2))
    if positions.ndim != 2 or positions.shape[1] != 2:
        raise InputError(f"stars has shape {positions.shape}; give pairs (x, y)")
    ny, nx = observation.shape
    for position in positions:
        x, y = (position + observation.offsets).T
        if not ((x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)).any():
            raise InputError(
                f"the star at ({position[0]:g}, {position[1]:g}) lies outside the images: x must "
                f"be in [0, {nx - 1}] and y in [0, {ny - 1}]"
                + (" of one of them, its offset added" if observation.offsets.any() else "")
            )
    _refuse_twins(positions)
    return positions


def _refuse_twins(positions: Array) -> None:
    order = np.argsort(positions[:, 0], kind="stable")
    x, y = positions[order].T
    for lag in range(1, len(order)):
        is_near = x[lag:] - x[:-lag] < CLOSEST
        if not is_near.any():
            return
        twins = np.flatnonzero(is_near & (abs(y[lag:] - y[:-lag]) < CLOSEST))
        if twins.size:
            first, second = sorted((order[twins[0]], order[twins[0] + lag]))
            raise InputError(
                f"stars {first + 1} and {second + 1} are at one position, ({positions[first, 0]:g},"
                f" {positions[first, 1]:g}), where their fluxes cannot be told apart; leave one of "
                "them out"
            )
