"""Where the images of an observation lie: the maps from the sky to each of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, numbers, refuse_unless
from lnocl.core.scene.transforms import (
    Orientation,
    check_transforms,
    enlarged,
    followed,
    part,
    rotation,
    scale_of,
    undone,
)
from lnocl.errors import InputError

if TYPE_CHECKING:
    from lnocl.core.scene.observation import Observation
    from lnocl.core.scene.psf_field import PsfField

MOVES = "offsets", "transforms"

Shape = tuple[int, int]
Box = tuple[range, range]


@dataclass(frozen=True, eq=False)
class Geometry:
    """Maps from the sky to p images of one shape: (x, y) is at ``turns[j] @ (x, y) + offsets[j]``.

    Attributes
    ----------
    maps : ndarray of float64, shape (p, 2, 3)
        The maps before they were fitted to good pixels.
    turns : ndarray of float64, shape (p, 2, 2)
        Rotation or flip, and scale.
    offsets : ndarray of float64, shape (p, 2)
        Shifts along x and y, pixels.
    shape : tuple of int
        (ny, nx) of the images.
    frame : tuple of int
        That of the image whose pixels the sky has.
    given_shape : tuple of int
        (ny, nx) of the images before quarter turns and flips were undone.
    orientations : tuple of Orientation
        What was undone of each image; empty where nothing was.
    """

    maps: Array
    turns: Array
    offsets: Array
    shape: Shape
    frame: Shape
    given_shape: Shape
    orientations: tuple[Orientation, ...] = ()

    def __post_init__(self) -> None:
        for values in (self.turns, self.offsets):
            values.flags.writeable = False

    @classmethod
    def shifted(cls, offsets: ArrayLike | None, n_images: int, shape: Shape) -> Geometry:
        """Return that of images which are shifted alone, by `offsets` (p, 2) or not at all."""
        held = np.zeros((n_images, 2)) if offsets is None else _offsets(offsets, n_images, shape)
        turns = np.broadcast_to(np.eye(2), (n_images, 2, 2)).copy()
        return cls(_maps(turns, held), turns, held, shape, shape, shape)

    @classmethod
    def mapped(
        cls, maps: ArrayLike, boxes: Sequence[Box], shape: Shape, shapes: Sequence[Shape] = ()
    ) -> Geometry:
        """Return that of images by their maps, fitted to what the boxes hold of each image.

        Of images of several shapes, `shapes`, the sky has that of which the map changes nothing.
        """
        exact = check_transforms(maps, boxes)
        own = (of for of, each in zip(shapes, exact, strict=False) if (each == np.eye(2, 3)).all())
        turns, offsets = exact[:, :, :2].copy(), exact[:, :, 2].copy()
        given = numbers("transforms", maps)
        return cls(given, turns, offsets, shape, next(own, shape), shape)

    @property
    def is_turned(self) -> bool:
        """Whether any image is turned against the sky, or has other pixels."""
        return bool((self.turns != np.eye(2)).any())

    @property
    def is_mapped(self) -> bool:
        """Whether any image is turned or flipped against the sky, as given."""
        return self.is_turned or bool(self.orientations)

    @property
    def scales(self) -> Array:
        """Pixels of the sky to one of each image, along each axis; shape (p,)."""
        return np.array([scale_of(turn) for turn in self.turns])

    @property
    def transforms(self) -> Array:
        """The map from the sky to each image as given, shape (p, 2, 3), pixels."""
        held = _maps(self.turns, self.offsets)
        if not self.orientations:
            return held
        return followed(held, undone(_each(self.orientations, self.shape)))

    def places(self, j: int, positions: Array) -> Array:
        """Return where positions (..., 2) of the sky are in image j."""
        if (self.turns[j] == np.eye(2)).all():
            return positions + self.offsets[j]
        return np.asarray(positions @ self.turns[j].T + self.offsets[j])

    def moved(self, by: Array) -> Geometry:
        """Return that of images moved by so many of their pixels, shape (p, 2)."""
        maps = self.maps + _maps(np.zeros_like(self.turns), by)
        return replace(self, maps=maps, offsets=self.offsets + by)

    def of_images(self, which: Sequence[int]) -> Geometry:
        """Return that of some of the images."""
        held = "maps", "turns", "offsets"
        changes: dict[str, Any] = {name: getattr(self, name)[which] for name in held}
        if self.orientations:
            changes["orientations"] = tuple(self.orientations[j] for j in which)
        return replace(self, **changes)

    def shows(self, positions: Array) -> NDArray[np.bool_]:
        """Return which positions, shape (n, 2), lie within any image."""
        places = np.stack([self.places(j, positions) for j in range(len(self.turns))], axis=1)
        size = np.array(self.shape[::-1])
        return np.asarray(np.any(np.all((places >= -0.5) & (places < size - 0.5), axis=2), axis=1))

    def on_sky(self, j: int, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the places of the sky, x and y, that are at these of image j."""
        (a, b), (c, d) = np.linalg.inv(self.turns[j])
        dx, dy = x - self.offsets[j, 0], y - self.offsets[j, 1]
        return a * dx + b * dy, c * dx + d * dy

    def corners(self, j: int, box: Box) -> Array:
        """Return the places of the sky, shape (4, 2), of the corners of a box of image j."""
        rows, columns = box
        x, y = np.meshgrid((columns[0], columns[-1]), (rows[0], rows[-1]))
        return np.stack(self.on_sky(j, x.ravel(), y.ravel()), axis=1)

    def covered(self, boxes: Sequence[Box]) -> Box:
        """Return the rows and columns of the sky that its frame has, or boxes of the images."""
        sky = np.concatenate([self.corners(j, box) for j, box in enumerate(boxes)])[:, ::-1]
        low, high = np.floor(sky.min(axis=0) + 0.5), np.floor(sky.max(axis=0) + 0.5)
        ends = zip(low.astype(int).tolist(), high.astype(int).tolist(), self.frame, strict=True)
        rows, columns = (range(min(a, 0), max(b + 1, n)) for a, b, n in ends)
        return rows, columns

    def windows(self, rows: range, columns: range) -> list[Box]:
        """Return the rows and columns of each image that show these of the sky.

        Their number is that of an image of the sky's box in any place, so that programs serve all.
        """
        sky, boxes = (columns, rows), []
        middle = np.array([(at.start + at.stop - 1) / 2.0 for at in sky])
        for j, turn in enumerate(self.turns):
            size = abs(turn) @ [len(at) for at in sky]
            first = np.ceil(self.places(j, middle) - size / 2.0).astype(int).tolist()
            x, y = (range(a, a + math.ceil(n)) for a, n in zip(first, size, strict=True))
            boxes.append((y, x))
        return boxes

    def window(self, rows: range, columns: range, boxes: Sequence[Box]) -> Geometry:
        """Return that of a sky that is cut to rows and columns, and images that are to boxes.

        Images are of one shape, which holds all of them and the sky. They are upright ones.
        """
        first, frame = np.array([columns.start, rows.start]), (len(rows), len(columns))
        corners = np.array([(x.start, y.start) for y, x in boxes])
        moved = (self.turns - np.eye(2)) @ first + (first - corners)
        offsets, maps = self.offsets + moved, _maps(self.turns, self.offsets + moved)
        shapes = [frame, *((len(y), len(x)) for y, x in boxes)]
        ny, nx = np.max(shapes, axis=0).tolist()
        return Geometry(maps, self.turns, offsets, (ny, nx), frame, (ny, nx))

    def cut(
        self, values: NDArray[Any], boxes: Sequence[Box], fill: float, axis: int
    ) -> NDArray[Any]:
        """Return the boxes of arrays, one for each image along an axis, in the shape of images.

        Boxes that are one, and have this shape, are views.
        """
        if set(boxes) == {boxes[0]} and self.shape == (len(boxes[0][0]), len(boxes[0][1])):
            return part(values, *boxes[0], fill)
        pairs = zip(np.moveaxis(values, axis, 0), boxes, strict=True)
        each = [enlarged(part(array, *box, fill), self.shape, fill) for array, box in pairs]
        return np.stack(each, axis)

    def upright(self) -> Geometry:
        """Return that of images without quarter turns and flips; itself where there are none."""
        orientations, angles = zip(*map(Orientation.nearest, self.turns), strict=True)
        if not any(each.swaps or any(each.reversed) for each in orientations):
            return self
        swaps = any(orientation.swaps for orientation in orientations)
        shape = (max(self.shape),) * 2 if swaps else self.shape
        by = _each(orientations, shape)
        return replace(
            self,
            maps=followed(self.maps, by),
            turns=np.array(list(map(rotation, angles))) / self.scales[:, None, None],
            offsets=followed(_maps(self.turns, self.offsets), by)[:, :, 2].copy(),
            shape=shape,
            orientations=orientations,
        )

    def middle(self, j: int) -> Array:
        """Return where the middle (x, y) of image j as given is, as the images lie."""
        ny, nx = self.given_shape
        middle = (nx - 1) / 2.0, (ny - 1) / 2.0
        if not self.orientations:
            return np.array(middle)
        return self.orientations[j].map(self.shape) @ (*middle, 1.0)

    def turned(self, values: NDArray[Any], fill: float | None, axis: int = 0) -> NDArray[Any]:
        """Return arrays of the images as given, or of their PSFs, by index as `upright` has them.

        Parameters
        ----------
        values : ndarray, shape (..., ny, nx)
            One for each image along an axis.
        fill : float or None
            What pixels hold that images get at their ends; None for PSFs, which are enlarged about
            their centres.
        axis : int, optional
            The axis of the images.
        """
        each = self._enlarged(np.moveaxis(values, axis, 0), fill)
        pairs = zip(self.orientations, each, strict=True)
        return np.moveaxis(np.array([by.of(array) for by, array in pairs]), 0, axis)

    def turned_fields(self, fields: Sequence[PsfField]) -> tuple[PsfField, ...]:
        """Return the fields of PSFs of the images as given as `upright` has them."""
        enlarged = (field.mapped(partial(self._enlarged, fill=None)) for field in fields)
        pairs = zip(enlarged, self.orientations, strict=bool(fields))
        return tuple(field.turned(by.of, by.map(self.shape)) for field, by in pairs)

    def _enlarged(self, values: NDArray[Any], fill: float | None) -> NDArray[Any]:
        if fill is not None:
            return enlarged(values, self.shape, fill)
        sides = values.shape[-2:]
        if any(orientation.swaps for orientation in self.orientations):
            sides = (max(sides),) * 2
        ny, nx = (side + 1 - side % 2 for side in sides)  # odd, so that centres stay
        return enlarged(values, (ny, nx), is_centred=True)

    def as_given(self, images: NDArray[Any], cut: bool) -> NDArray[Any]:
        """Return images (p, ny, nx) in the orientation of those given, cut to their shape."""
        if not self.orientations:
            return images
        ny, nx = self.given_shape if cut else images.shape[1:]
        pairs = zip(self.orientations, images, strict=True)
        return np.array([orientation.back(image)[:ny, :nx] for orientation, image in pairs])


def read_geometry(
    given: Mapping[str, Any],
    held: Observation,
    before: Observation | None,
    shapes: Sequence[Shape] = (),
) -> Geometry:
    """Return where the images lie by `offsets` or `transforms`, given or held before.

    Parameters
    ----------
    given : mapping of str to array_like or None
        May have either.
    held : Observation
        Its images, mask and PSFs, as they are now.
    before : Observation or None
        What the rest is kept of.
    shapes : sequence of tuple of int, optional
        Those of the images as they were given, where these differ.
    """
    known = None if before is None else before.geometry
    images, is_kept = held.images.shape, not given.keys() & set(MOVES)
    if known and known.orientations and "transforms" in given:
        raise InputError("the images were turned upright; give `transforms` to an Observation")
    offsets = given.get("offsets", known.offsets if known and is_kept else None)
    maps = given.get("transforms", known.maps if known and known.is_mapped else None)
    if maps is not None and given.get("offsets") is not None:
        raise InputError("`transforms` are not taken beside offsets, which they hold")
    if before is not None and known and is_kept and held.mask is before.mask:
        found = known
    elif maps is None:
        found = Geometry.shifted(offsets, images[0], held.shape)
    else:
        boxes = [good_box(mask) for mask in held.mask]
        found = Geometry.mapped(maps, boxes, held.shape, shapes)
    if known and (known.orientations or held.shape == known.shape):
        kept = "frame", "given_shape", "orientations"
        found = replace(found, **{name: getattr(known, name) for name in kept})
    low, high = min(found.scales), max(found.scales)
    fields = [field.numbers() for field in held.psf_fields]
    are_one = all(np.array_equal(each, fields[0]) for each in fields[1:])
    is_one = are_one if fields else held.psfs.strides[0] == 0
    if images[0] > 1 and is_one and low < high:
        raise InputError(
            f"one PSF is given for images whose pixels are {low:.4g} and {high:.4g} times the "
            "sky's; give one for each image, on its own pixels"
        )
    return found


def good_box(mask: NDArray[np.bool_]) -> Box:
    """Return the rows and columns that hold the good pixels of an image; all if it has none."""
    if mask.all():
        return range(mask.shape[0]), range(mask.shape[1])
    held = (np.flatnonzero(~mask.all(axis=axis)) for axis in (1, 0))
    rows, columns = (range(int(at[0]), int(at[-1]) + 1) for at in held)
    return rows, columns


def _offsets(offsets: ArrayLike, n_images: int, shape: Shape) -> Array:
    values = numbers("offsets", offsets, unit="pix")
    if values.shape != (n_images, 2):
        raise InputError(
            f"offsets has shape {values.shape}; give (dx, dy) for each of the {n_images} images"
        )
    size = np.array(shape[::-1])
    refuse_unless(
        "`offsets`",
        values,
        f"finite, and less than the images' {size[0]} by {size[1]} pixels",
        abs(values) < size,
    )
    return values


def _maps(turns: Array, offsets: Array) -> Array:
    return np.concatenate([turns, offsets[:, :, None]], axis=2)


def _each(orientations: Sequence[Orientation], shape: Shape) -> Array:
    return np.array([orientation.map(shape) for orientation in orientations])
