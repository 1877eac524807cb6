"""Stars on the grid of a scene: their images, and sums over the pixels that these light."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence, Set
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene import star_tables
from lnocl.core.scene.arrays import Array, numbers
from lnocl.core.scene.band_matrix import BandMatrix
from lnocl.core.scene.detector import Movable
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.shifting import MARGIN, Cutout
from lnocl.errors import InputError

# Pixels of a flattened array: a slice where they are all of it, which takes no gathering.
Pixels = NDArray[np.intp] | slice

# How far from where it was given a star may be moved, pixels.
MAX_SHIFT = 3.0

# Side of the squares of pixels in which products of images are summed, by matrices of stars and
# pixels that a cache holds.
TILE = 32

# Outer rows and columns of a star with less than this share of its peak have no part in the Fisher
# information that measures steps: all of them together change it by 2e-7.
FAINT = 1e-6


class Order(NamedTuple):
    """An order of stars in which those that light the same pixels are near each other.

    Attributes
    ----------
    places : ndarray of int, shape (n,)
        The place of each star.
    width : int
        How many places such stars are apart, at most.
    """

    places: NDArray[np.int_]
    width: int


class StarImages:
    """k linear functions of the pixels for each star: its image, and perhaps derivatives of it.

    Parameters
    ----------
    covered : ndarray of bool, shape (Ny, Nx)
        The pixels that are looked at.
    pieces : list of lists of Cutout
        The image of each star is the sum of its pieces. The first may be of all k functions, the
        others of the image alone, which does not move.
    order : Order
        Of the stars.
    cores : list of lists of Cutout, optional
        What the information is of, where that is less than the images.
    """

    def __init__(
        self,
        covered: NDArray[np.bool_],
        pieces: list[list[Cutout]],
        order: Order,
        cores: list[list[Cutout]] | None = None,
    ) -> None:
        self._grid = covered.shape[0], covered.shape[1]
        self._covered = slice(None) if covered.all() else np.flatnonzero(covered)
        self._pieces, self._order = pieces, order
        self._cores = pieces if cores is None else cores
        self._k = next((each[0].values.shape[0] for each in pieces if each), 1)

    def light(self, fluxes: Array) -> Array:
        """Return ``sum_s c_s P_s`` at the pixels that are covered."""
        total = np.zeros(self._grid)
        for flux, pieces in zip(fluxes, self._pieces, strict=True):
            for piece in pieces:
                total[piece.window(self._grid)] += flux * piece.values[0]
        return np.asarray(total.reshape(-1)[self._covered])

    def products(self, x: Array) -> Array:
        """Return the ``<P_s, x>``, shape (k, n)."""
        x = self._on_grid(x)
        products = np.zeros((len(self._pieces), self._k))
        for product, pieces in zip(products, self._pieces, strict=True):
            for piece in pieces:
                k = len(piece.values)
                product[:k] += piece.values.reshape(k, -1) @ x[piece.window(self._grid)].ravel()
        return products.T

    def information(self, weights: Array) -> BandMatrix:
        """Return the ``<P_s, w P_t>``: all stars for each of the k unknowns in turn."""
        k, n = self._k, len(self._pieces)
        places = k * self._order.places + np.arange(k)[:, None]
        band = np.zeros((min(k * (self._order.width + 1), k * n), k * n), order="F")
        roots = np.sqrt(self._on_grid(weights))
        flat, step = band.reshape(-1, order="F"), len(band) - 1
        for tile, stars, images in self._tiles(np.argsort(self._order.places)):
            images *= roots[tile]
            columns = images.reshape(k * len(stars), -1)
            block = columns @ columns.T
            at = places[:, stars].T.ravel()
            distance = at[:, None] - at
            is_near = (distance >= 0) & (distance <= step)  # what is beyond is 0
            flat[np.add.outer(at, step * at)[is_near]] += block[is_near]
        return BandMatrix(band, places.ravel())

    def _on_grid(self, x: Array) -> Array:
        laid = np.zeros(self._grid)
        laid.reshape(-1)[self._covered] = x
        return laid

    def _tiles(
        self, stars: NDArray[np.intp]
    ) -> Iterator[tuple[tuple[slice, slice], NDArray[np.intp], Array]]:
        """Yield squares of the grid, which stars have light there, and their images of it."""
        owners = [i for i, s in enumerate(stars) for _ in self._cores[s]]
        pieces = [piece for s in stars for piece in self._cores[s]]
        corners, shapes = _corners_and_sizes(pieces)
        parts = [
            [
                (slice(at, min(at + TILE, n)), _shared(corners[:, i], shapes[:, i], at, n))
                for at in range(0, n, TILE)
            ]
            for i, n in enumerate(self._grid)
        ]
        for rows, rows_of in parts[0]:
            for columns, columns_of in parts[1]:
                here = sorted(rows_of.keys() & columns_of.keys())
                if not here:
                    continue
                lighting = sorted({owners[i] for i in here})
                slots = {owner: slot for slot, owner in enumerate(lighting)}
                size = rows.stop - rows.start, columns.stop - columns.start
                images = np.zeros((len(lighting), self._k, *size))
                for i in here:
                    slot, values = slots[owners[i]], pieces[i].values
                    for to_y, from_y in rows_of[i]:
                        for to_x, from_x in columns_of[i]:
                            images[slot, : len(values), to_y, to_x] += values[:, from_y, from_x]
                yield (rows, columns), stars[lighting], images


def _corners_and_sizes(cutouts: Sequence[Cutout]) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Return where n cutouts begin and their shapes, rows before columns, shape (n, 2) each."""
    corners = [cutout[1:] for cutout in cutouts]
    sizes = [cutout.values.shape[-2:] for cutout in cutouts]
    return np.array(corners, int).reshape(-1, 2), np.array(sizes, int).reshape(-1, 2)


def _shared(
    firsts: NDArray[np.int_], sizes: NDArray[np.int_], at: int, n: int
) -> dict[int, list[tuple[slice, slice]]]:
    """Return which ranges of n points round a circle reach into a tile, and where.

    For each a list of slices: of the tile, which begins at a point, and of the range.
    """
    length = min(TILE, n - at)
    into, ahead = (at - firsts) % n, (firsts - at) % n
    shared: dict[int, list[tuple[slice, slice]]] = {}
    for i in np.flatnonzero((into < sizes) | (ahead < length)).tolist():
        skipped, first, size = int(into[i]), int(ahead[i]), int(sizes[i])
        shared[i] = []
        if skipped < size:
            count = min(size - skipped, length)
            shared[i].append((slice(0, count), slice(skipped, skipped + count)))
        if 0 < first < length:
            count = min(size, length - first)
            shared[i].append((slice(first, first + count), slice(0, count)))
    return shared


def order_of(
    stars: Array,
    images: Iterable[tuple[Array, Sequence[Cutout]]],
    grid: tuple[int, int],
    scales: Array | None = None,
) -> Order:
    """Return the order of stars along the axis that leaves the least of them between neighbours.

    Parameters
    ----------
    stars : ndarray of float64, shape (n, 2)
        Positions in the sky, pixels of the images.
    images : iterable of (ndarray of float64, shape (n, 2), sequence of n Cutout)
        For each image where the stars are in it, and what they may light there.
    grid : tuple of int
        Shape of the images' grid, which is periodic.
    scales : ndarray of float64, shape (p,), optional
        Pixels of the sky to one of each image, where images are turned, so that squares in them
        reach farther along the sky's axes.
    """
    n = len(stars)
    reach = np.zeros((n, 2))
    for j, (places_there, cutouts) in enumerate(images):
        scale = 1.0 if scales is None else scales[j]
        first, size = _corners_and_sizes(cutouts)
        away = places_there[:, ::-1] - first
        is_whole = size >= grid
        reach = np.maximum(reach, np.where(is_whole, grid, scale * np.maximum(away, size - away)))
    if scales is not None:
        farthest = np.minimum(math.sqrt(2.0) * reach.max(axis=1), max(grid))
        reach = np.stack([farthest, farthest], axis=1)
    orders = []
    for axis, length in enumerate(grid):
        at, far = stars[:, 1 - axis] % length, reach[:, axis].max(initial=0.0)
        goes_round = (at < far).any() or (at + far > length).any()
        keys = np.minimum(at, length - at) if goes_round else at
        by_key = np.argsort(keys, kind="stable")
        ends = np.searchsorted(keys[by_key], keys[by_key] + 2.0 * far + 1.0)
        places = np.empty(n, int)
        places[by_key] = np.arange(n)
        orders.append(Order(places, int((ends - np.arange(n)).max(initial=1)) - 1))
    return min(orders, key=lambda order: order.width)


class StarField:
    """Stars at their positions; the image of each through each PSF is made once.

    Parameters
    ----------
    psfs : sequence of p sequences of n MovablePsf or DetectorPsf
        That of each image at each star.
    observation : Observation
        The images.
    grid : tuple of int
        Shape (ny, nx) of the images' grid.
    positions : ndarray of float64, shape (n, 2)
        In the sky, pixels of the images.
    shown : ndarray of bool, shape (n + n_fixed, p)
        Which images show each star, and what is fixed; in the others it is 0.
    fixed : sequence of p sequences of n_fixed Cutout, optional
        Light of each image that lies where it is, as that of halos: it comes after the stars.

    Attributes
    ----------
    places : list of ndarray of float64, shape (n, 2)
        Where they are in each image.
    """

    def __init__(
        self,
        psfs: Sequence[Sequence[Movable]],
        observation: Observation,
        grid: tuple[int, int],
        positions: Array,
        shown: NDArray[np.bool_],
        fixed: Sequence[Sequence[Cutout]] = (),
    ) -> None:
        self.positions, self.shown, self._fixed = positions, shown, fixed
        self.psfs, self._grid = psfs, grid
        self._scales = observation.scales if observation.is_turned else None
        self._turns = observation.turns
        self.places = [observation.places(j, positions) for j in range(len(psfs))]

    def __len__(self) -> int:
        return len(self.shown)

    @cached_property
    def cutouts(self) -> list[list[Cutout]]:
        """P_js for each image j and star s, then what is fixed."""
        n = len(self.positions)
        stars = [
            [
                psf.at(*place).aligned(self._grid) if shown else _nothing_at(place)
                for psf, place, shown in zip(psfs, places_there, shown_there, strict=True)
            ]
            for psfs, places_there, shown_there in zip(
                self.psfs, self.places, self.shown[:n].T, strict=True
            )
        ]
        if not self._fixed:
            return stars
        return [[*of_stars, *others] for of_stars, others in zip(stars, self._fixed, strict=True)]

    def with_slopes(self, j: int, s: int) -> Cutout:
        """Return P_js, and its derivatives along the sky's x and y, (3, h, w)."""
        star = along_sky(self.psfs[j][s].with_slopes(*self.places[j][s]), self._turns[j])
        return star._replace(values=self.shown[s, j] * star.values)

    @cached_property
    def cores(self) -> list[list[Cutout]]:
        """The P_js without their faint outer pixels."""
        return [
            [cutout.trimmed(FAINT * float(abs(cutout.values).max())) for cutout in cutouts]
            for cutouts in self.cutouts
        ]

    @cached_property
    def order(self) -> Order:
        """The order of the stars, and of what is fixed, in matrices of their information."""
        if self._fixed:  # which fills the images, and so meets all stars
            return Order(np.arange(len(self)), len(self) - 1)
        images = zip(self.places, self.cores, strict=True)
        return order_of(self.positions, images, self._grid, self._scales)

    def light(self, j: int, fluxes: Array) -> Array:
        """Return ``sum_s c_s P_js``, shape (Ny, Nx)."""
        total = np.zeros(self._grid)
        for flux, cutout in zip(fluxes, self.cutouts[j], strict=True):
            if flux:
                total[cutout.window(self._grid)] += flux * cutout.values
        return total

    def covered(self, j: int) -> NDArray[np.bool_]:
        """Return the pixels of image j that the cutout of any star covers, shape (Ny, Nx)."""
        return covered_pixels(self.cutouts[j], self._grid)

    def reaching(self, j: int, first: tuple[int, int], shape: tuple[int, int]) -> list[int]:
        """Return the stars whose light in image j reaches into a window of the periodic grid."""
        firsts, sizes = self._windows[j]
        ahead, into = (firsts - first) % self._grid, (first - firsts) % self._grid
        is_there = ((ahead < shape) | (into < sizes)).all(axis=1)
        return np.flatnonzero(is_there & self.shown[:, j]).tolist()

    @cached_property
    def _windows(self) -> list[tuple[NDArray[np.int_], NDArray[np.int_]]]:
        """For each image the first pixels and the shapes of the cutouts, shape (n, 2) each."""
        return [_corners_and_sizes(cutouts) for cutouts in self.cutouts]

    def images(self, j: int, covered: NDArray[np.bool_]) -> StarImages:
        """Return the P_js over these pixels, which must include all that cutouts of stars cover."""
        pieces, cores = (
            [
                [cutout._replace(values=cutout.values[None])] if shown else []
                for cutout, shown in zip(cutouts, self.shown[:, j], strict=True)
            ]
            for cutouts in (self.cutouts[j], self.cores[j])
        )
        return StarImages(covered, pieces, self.order, cores)


def _nothing_at(place: Array) -> Cutout:
    """Return a pixel without light."""
    x, y = np.floor(place + 0.5).astype(int).tolist()
    return Cutout(np.zeros((1, 1)), y, x)


def along_sky(star: Cutout, turn: Array) -> Cutout:
    """Return a star with slopes along the sky's axes, (3, h, w), from those along an image's."""
    if (turn == np.eye(2)).all():
        return star
    slopes = np.tensordot(turn.T, star.values[1:], axes=1)
    return star._replace(values=np.concatenate([star.values[:1], slopes]))


def covered_pixels(cutouts: Sequence[Cutout], grid: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels of the grid that cutouts cover."""
    covered = np.zeros(grid, bool)
    for cutout in cutouts:
        covered[cutout.window(grid)] = True
    return covered


def places(covered: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the index of each covered pixel among them, -1 elsewhere."""
    place = np.full(covered.shape, -1)
    place[covered] = np.arange(np.count_nonzero(covered))
    return place


class Covered(NamedTuple):
    """Rows of the grid, shape (Ny,), and columns, shape (Nx,), that hold light."""

    rows: NDArray[np.bool_]
    columns: NDArray[np.bool_]


def covered_box(cutout: Cutout, grid: tuple[int, int], max_shift: float = 0.0) -> Covered:
    """Return the rows and columns that a cutout covers that moves by up to `max_shift`."""
    box = Covered(*(np.zeros(n, bool) for n in grid))
    distance = int(np.ceil(max_shift)) + MARGIN + 1 if max_shift else 0
    steps = np.arange(-distance, distance + 1)
    for axis, at in enumerate((cutout.rows(grid), cutout.columns(grid))):
        is_covered = (cutout.values != 0).any(axis=1 - axis) | (max_shift > 0)
        box[axis][(at[is_covered, None] + steps) % grid[axis]] = True
    return box


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
        positions = numbers("stars", stars, unit="pix")
    if positions.size == 0:
        return np.zeros((0, 2))
    if positions.ndim != 2 or positions.shape[1] != 2:
        raise InputError(f"stars has shape {positions.shape}; give pairs (x, y)")
    ny, nx = observation.shape
    for x, y in positions[~observation.shows(positions)]:
        raise InputError(
            f"the star at ({x:g}, {y:g}) lies outside the images: x must be in [0, {nx - 1}] and y "
            f"in [0, {ny - 1}]"
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
