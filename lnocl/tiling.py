"""Where the tiles of a sky lie, and what of the images is in each."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array, whole
from lnocl.core.scene.fields import is_dark
from lnocl.core.scene.geometry import Box
from lnocl.core.scene.grid import length_for, psf_shape
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.star_psfs import owned
from lnocl.core.scene.transforms import part as part_of
from lnocl.errors import InputError
from lnocl.process import ignored_warnings

# The side of a tile in those of the PSFs, where these vary: docs/validation/tiles.md.
SIDES = 5
# Where they do not.
LARGE_TILE = 2048


class Span(NamedTuple):
    """A tile along one axis, in pixels of an image without offset.

    Attributes
    ----------
    core : range
        What it stands for.
    window : range
        What it sees: the core and its margins.
    sky : range
        What all tiles stand for.
    margin : int
        Pixels round the core that are seen, at least.
    """

    core: range
    window: range
    sky: range
    margin: int

    def holds(self, places: Array) -> NDArray[np.bool_]:
        """Return which places lie in the core, or beyond the sky next to it."""
        nearest = np.clip(np.floor(places + 0.5), self.sky.start, self.sky.stop - 1)
        return np.asarray((nearest >= self.core.start) & (nearest < self.core.stop))

    def own(self, n: int, oversample: int) -> slice:
        """Return where in the window the core lies, of a frame of n pixels, each `oversample`."""
        ends = (min(max(end, 0), n) for end in (self.core.start, self.core.stop))
        first, last = (oversample * (end - self.window.start) for end in ends)
        return slice(first, last)

    def weights(self, oversample: int) -> Array:
        """Return the weights of the window's pixels, which fall across half of each margin.

        Those of neighbours sum to 1.
        """
        at = (np.arange(oversample * len(self.window)) + 0.5) / oversample + self.window.start
        weights = np.ones_like(at)
        if self.core.start > self.sky.start:
            weights *= np.clip(0.5 + (at - self.core.start) / self.margin, 0.0, 1.0)
        if self.core.stop < self.sky.stop:
            weights *= np.clip(0.5 + (self.core.stop - at) / self.margin, 0.0, 1.0)
        return weights


class Tile(NamedTuple):
    """What a tile sees, and which stars are its own.

    Attributes
    ----------
    spans : tuple of Span
        Along y and x.
    boxes : list of tuple of range
        Rows and columns of each image that are seen.
    observation : Observation
        What is in its window.
    stars : ndarray of float64, shape (k, 2)
        Positions in the window.
    own, numbers : ndarray of int
        Which of them lie in its core, and which those are of all stars.
    core : tuple of slice
        The pixels in the window of the extended source that it stands for.
    near_stars : ndarray of float64 or None
        As of `lnocl.core.scene.penalty.Penalty`, in its window.
    """

    spans: tuple[Span, Span]
    boxes: list[Box]
    observation: Observation
    stars: Array
    own: NDArray[np.intp]
    numbers: NDArray[np.intp]
    core: tuple[slice, slice]
    near_stars: Array | None

    def without_unseen_neighbours(self) -> Tile:
        """Return it without stars of its neighbours that it does not observe."""
        if not self.observation.mask.any() or len(self.own) == len(self.stars):
            return self
        with ignored_warnings():
            is_kept = Scene(self.observation).observes(self.stars)
        is_kept[self.own] = True
        own = np.cumsum(is_kept)[self.own] - 1
        return self._replace(stars=self.stars[is_kept], own=own)


def lay(observation: Observation, tile: int | None, pad: int) -> list[tuple[Span, Span]]:
    """Return the tiles of all that the images show along y and x, row by row."""
    # Of square PSFs that are turned the corners reach farther.
    turns = abs(observation.turns) * observation.scales[:, None, None]
    sides = np.ceil((turns @ psf_shape(observation)[::-1]).max(axis=0) / observation.oversample)
    margins = [max(int(k) // 2, 1) for k in sides[::-1]]
    if tile is None:
        tile = length_for(SIDES * int(max(sides))) if observation.psf_fields else LARGE_TILE
    least = 2 * (max(margins) + pad) + 16
    tile = whole(
        "tile",
        tile,
        least,
        f", for margins of half a PSF, {max(margins)} pixels, and a pad of {pad} on each side",
    )
    geometry, window = observation.geometry, tile - 2 * pad
    sky = geometry.covered([observation.good_box(j) for j in range(observation.n_images)])
    if all(len(at) <= window for at in sky):  # the images as they are
        windows = map(range, geometry.frame)
        y, x = (Span(at, seen, at, n) for at, seen, n in zip(sky, windows, margins, strict=True))
        return [(y, x)]
    rows, columns = (divide(at, window, n) for at, n in zip(sky, margins, strict=True))
    return list(itertools.product(rows, columns))


def divide(sky: range, window: int, margin: int) -> list[Span]:
    """Return tiles along an axis; their windows are of one size, so that programs serve all."""
    n = 1 if len(sky) <= window else math.ceil(len(sky) / (window - 2 * margin))
    window = min(window, len(sky))
    edges = np.round(np.linspace(sky.start, sky.stop, n + 1)).astype(int).tolist()
    first = [
        min(max((a + b - window) // 2, sky.start), sky.stop - window)
        for a, b in itertools.pairwise(edges)
    ]
    return [
        Span(range(a, b), range(at, at + window), sky, margin)
        for (a, b), at in zip(itertools.pairwise(edges), first, strict=True)
    ]


def cut(
    observation: Observation,
    positions: Array,
    near_stars: Array | None,
    spans: tuple[Span, Span],
) -> Tile | None:
    """Return a tile, or None where nothing of the sky was observed.

    Raises
    ------
    InputError
        It is behind a transmission of 0, and has a star with a PSF of its own.
    """
    q, (rows, columns) = observation.oversample, (span.window for span in spans)
    if all(span.core == span.sky for span in spans):  # one tile has the images as they are
        ny, nx = observation.shape
        part, boxes = observation, [(range(ny), range(nx))] * observation.n_images
    else:
        boxes = observation.geometry.windows(rows, columns)
        y, x = ((each.core.start + each.core.stop - 1) / 2.0 - each.window.start for each in spans)
        try:
            part = observation.window(rows, columns, (x, y), boxes)
        except InputError:  # no image has a good pixel there
            return None
    moved = positions - (columns.start, rows.start)
    is_seen = part.shows(moved)
    if is_dark(part):
        if (owned(part, moved[is_seen]) >= 0).any():
            y, x = (span.core.start for span in spans)
            raise InputError(
                f"the tile that begins at pixel ({x}, {y}) has a star with a PSF of its own, and "
                "`transmission` is 0 all over it; give a larger `tile`"
            )
        return None
    in_spans = [each.holds(at) for each, at in zip(spans, positions.T[::-1], strict=True)]
    is_own = np.all([is_seen, *in_spans], axis=0)
    own = np.flatnonzero(is_own[is_seen])
    ny, nx = observation.geometry.frame
    core = spans[0].own(ny, q), spans[1].own(nx, q)
    if near_stars is not None:
        down, along = (range(q * at.start, q * at.stop) for at in (rows, columns))
        near_stars = part_of(near_stars, down, along).copy()
    return Tile(spans, boxes, part, moved[is_seen], own, np.flatnonzero(is_own), core, near_stars)
