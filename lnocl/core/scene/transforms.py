"""Maps from the sky to its images: rotation, flip, scale, shift; what is done by index."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, numbers
from lnocl.errors import InputError

# The farthest, pixels, that a map of an image may be from a rotation or flip, and one scale.
MAX_DISTORTION = 0.05
# By this share a pixel may be larger than the sky's where it counts as one.
MAX_BRIGHTER = 2e-3
# Rotations may be so far from a scale of 1.
ROUNDING = 1e-12
# Angles that move no pixel of an image farther than this, pixels, are 0.
MIN_MOVE = 1e-6

# What has no unit and no meaning beyond its numbers.
PLAIN = np.ndarray, np.ma.MaskedArray

# Quarter turns, and those of the flipped x axis.
QUARTERS = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
QUARTERS += [quarter @ np.diag([-1, 1]) for quarter in QUARTERS]


def rotations(angles: ArrayLike, centre: ArrayLike) -> Array:
    """Return the `transforms` of images that are turned about one place.

    Parameters
    ----------
    angles : array_like, shape (p,)
        By how much each image shows the sky turned, degrees, from the x axis towards the y axis. A
        Quantity or Angle of `astropy` may be in any unit of angle.
        Where north is to be up, and east left, that is minus the position angle of the images' y
        axis.
    centre : array_like, shape (2,)
        (x, y) of the place, pixels, in the sky and in all images. It may be a Quantity in pixels.

    Returns
    -------
    ndarray of float64, shape (p, 2, 3)
        For `lnocl.Observation`.

    Raises
    ------
    InputError
        Angles or centre are no finite numbers, or of the wrong shape or unit.

    Examples
    --------
    >>> import lnocl
    >>> lnocl.rotations([0.0, 90.0], centre=(10, 5)).round(12) + 0.0
    array([[[ 1.,  0.,  0.],
            [ 0.,  1.,  0.]],
    <BLANKLINE>
           [[ 0., -1., 15.],
            [ 1.,  0., -5.]]])
    """
    turned = np.radians(numbers("angles", angles, unit="deg"))
    middle = numbers("centre", centre, unit="pix")
    if turned.ndim != 1 or middle.shape != (2,):
        raise InputError("give `angles` of shape (p,), and a `centre` (x, y)")
    if not (np.isfinite(turned).all() and np.isfinite(middle).all()):
        raise InputError("`angles` and `centre` must be finite")
    linear = np.array([rotation(angle) for angle in turned]).reshape(-1, 2, 2)
    return np.concatenate([linear, (middle - linear @ middle)[:, :, None]], axis=2)


def rotation(angle: float) -> Array:
    """Return the matrix of a rotation by an angle, radians, from the x axis towards the y axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def scale_of(transform: Array) -> float:
    """Return how many pixels of the sky, along each axis, are one of an image."""
    scale = 1.0 / math.sqrt(abs(np.linalg.det(transform[:, :2])))
    return 1.0 if abs(scale - 1.0) < ROUNDING else scale


def check_transforms(transforms: ArrayLike, boxes: Sequence[tuple[range, range]]) -> Array:
    """Return maps of images, shape (p, 2, 3), made exact: rotation, flip, scale and shift.

    Parameters
    ----------
    transforms : array_like
        As given.
    boxes : sequence of p pairs of range
        The rows and the columns that hold each image.

    Raises
    ------
    InputError
        They have the wrong shape, are not finite, shear an image, or ask of it for finer pixels
        than the sky has.
    """
    given = numbers("transforms", transforms)
    if given.shape != (len(boxes), 2, 3):
        raise InputError(
            f"`transforms` has shape {given.shape}; give 2 x 3 numbers for each of the "
            f"{len(boxes)} images"
        )
    if not np.isfinite(given).all():
        raise InputError("`transforms` must be finite")
    exact = given.copy()
    for j, (each, (rows, columns)) in enumerate(zip(given, boxes, strict=True)):
        linear, shift = each[:, :2], each[:, 2]
        middle = np.array([columns[0] + columns[-1], rows[0] + rows[-1]]) / 2.0
        reach = math.hypot(len(columns) - 1, len(rows) - 1) / 2.0
        turn, scale, left = _nearest_similarity(linear, reach)
        if left > MAX_DISTORTION:
            raise InputError(
                f"`transforms[{j}]` shears an image of {len(columns)} x {len(rows)} pixels by "
                f"{left:.2g} pixels at its corners; {MAX_DISTORTION:g} are allowed: rotations, "
                "flips, one scale and shifts are modelled"
            )
        if scale > 1.0:
            raise InputError(
                f"`transforms[{j}]` is for pixels of {1 / scale:.4g} of the sky's side; the sky's "
                "must be the smallest: take those of this image, and divide all maps by their scale"
            )
        nearest = scale * _without_rounding(turn, reach)
        # The middle of the image stays where it is.
        at = np.linalg.solve(linear, middle - shift)
        moved = middle - nearest @ at
        whole = np.round(moved)
        exact[j, :, :2] = nearest
        exact[j, :, 2] = np.where(abs(moved - whole) < MIN_MOVE, whole, moved)
    return exact


def _nearest_similarity(linear: Array, reach: float) -> tuple[Array, float, float]:
    """Return the nearest rotation or flip, its scale, and how far off it is at such a distance.

    The scale is 1 where that moves nothing by more than `MAX_DISTORTION`, and brightens nothing.
    """
    u, stretches, v = np.linalg.svd(linear)
    scale = math.sqrt(stretches[0] * stretches[1])
    is_near = abs(stretches - 1.0).max() * reach <= MAX_DISTORTION
    if is_near and abs(scale**2 - 1.0) <= MAX_BRIGHTER:
        scale = 1.0
    left = math.inf if scale == 0 else float(abs(stretches / scale - 1.0).max() * reach)
    return u @ v, scale, left


def _without_rounding(linear: Array, reach: float) -> Array:
    for quarter in QUARTERS:
        if abs(linear - quarter).max() * reach < MIN_MOVE:
            return quarter.astype(float)
    return linear


class Orientation(NamedTuple):
    """A quarter turn or a flip of an image: whether its axes are exchanged, which are reversed.

    Attributes
    ----------
    swaps : bool
        Whether rows become columns, before axes are reversed.
    reversed : tuple of bool
        Whether y is, and x.
    """

    swaps: bool
    reversed: tuple[bool, bool]

    @classmethod
    def nearest(cls, linear: Array) -> tuple[Orientation, float]:
        """Return the nearest quarter turn or flip, and the remaining rotation, radians."""
        # Of both that leave half a right angle, the first.
        quarter = max(QUARTERS, key=lambda each: round(float((each * linear).sum()), 9))
        back = quarter.T
        left = back @ linear
        x_sign, y_sign = back.sum(axis=1)
        nearest = cls(bool(back[0, 0] == 0), (bool(y_sign < 0), bool(x_sign < 0)))
        return nearest, float(np.arctan2(left[1, 0], left[0, 0]))

    def of(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return a view of an array whose last axes are (y, x)."""
        return self._reversed(array.swapaxes(-1, -2) if self.swaps else array)

    def back(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return the inverse of `of`."""
        array = self._reversed(array)
        return array.swapaxes(-1, -2) if self.swaps else array

    def _reversed(self, array: NDArray[Any]) -> NDArray[Any]:
        y, x = (slice(None, None, -1 if each else 1) for each in self.reversed)
        return array[..., y, x]

    def map(self, shape: tuple[int, int]) -> Array:
        """Return where places (x, y) of an image of a shape are in `of` it, shape (2, 3)."""
        ny, nx = shape[::-1] if self.swaps else shape
        is_y, is_x = self.reversed
        x = (-1.0, 0.0, nx - 1) if is_x else (1.0, 0.0, 0.0)
        y = (0.0, -1.0, ny - 1) if is_y else (0.0, 1.0, 0.0)
        return np.array([x, y])[:, [1, 0, 2] if self.swaps else [0, 1, 2]]


def followed(maps: Array, by: Array) -> Array:
    """Return maps of places, shape (p, 2, 3), each followed by another."""
    found = by[:, :, :2] @ maps
    found[:, :, 2] += by[:, :, 2]
    return found


def undone(maps: Array) -> Array:
    """Return the inverses of maps by quarter turns, flips and shifts, shape (p, 2, 3)."""
    back = maps[:, :, :2].swapaxes(1, 2)
    return np.concatenate([back, -back @ maps[:, :, 2:]], axis=2)


def shapes_of(values: Any) -> list[tuple[int, int]]:
    """Return the shapes of two-dimensional arrays in a sequence; none of anything else."""
    is_sequence = isinstance(values, (list, tuple))
    if not is_sequence or any(type(each) not in PLAIN or each.ndim != 2 for each in values):
        return []
    return [each.shape for each in values]


def of_one_shape(values: Any, fill: float = 0.0, about_centre: bool = False) -> Any:
    """Return two-dimensional arrays of several shapes as a stack; all else as it is.

    Smaller ones get rows and columns at their ends, or about their centre ``n // 2``. These hold a
    value, and are masked where that is not a number.
    """
    if len(set(shapes_of(values))) < 2:
        return values
    shape = np.max([each.shape for each in values], axis=0)
    dtype = np.result_type(*values, np.min_scalar_type(fill))
    stack = np.ma.array(np.full((len(values), *shape), fill, dtype), mask=np.isnan(fill))
    for whole, each in zip(stack, values, strict=True):
        corner = shape // 2 - np.array(each.shape) // 2 if about_centre else (0, 0)
        rows, columns = (slice(at, at + n) for at, n in zip(corner, each.shape, strict=True))
        whole[rows, columns] = each
    return stack if stack.mask.any() else stack.data


def refuse_other_shapes(name: str, values: Any, shapes: Sequence[tuple[int, int]]) -> None:
    """Refuse maps in a list that have not the shapes of their images."""
    for j, (found, shape) in enumerate(zip(shapes_of(values), shapes, strict=False)):
        if found != shape:
            raise InputError(
                f"`{name}[{j}]` has shape {found}, and `images[{j}]` {shape}; give each map in the "
                "shape of its image"
            )


def enlarged(
    array: NDArray[Any], shape: tuple[int, int], fill: float = 0.0, is_centred: bool = False
) -> NDArray[Any]:
    """Return an array with rows and columns added at its end, or about its centre ``n // 2``.

    Where it is to be smaller, it is a view of its part.
    """
    sizes = zip(shape, array.shape[-2:], strict=True)
    before = [n // 2 - k // 2 if is_centred else 0 for n, k in sizes]
    rows, columns = (range(-at, n - at) for n, at in zip(shape, before, strict=True))
    return part(array, rows, columns, fill)


def part(array: NDArray[Any], rows: range, columns: range, fill: float = 0.0) -> NDArray[Any]:
    """Return rows and columns of an array, its last axes; beyond its ends they hold a value."""
    inside: list[slice] = []
    widths = [(0, 0)] * (array.ndim - 2)
    for n, at in zip(array.shape[-2:], (rows, columns), strict=True):
        first, last = (min(max(end, 0), n) for end in (at.start, at.stop))
        before = min(max(-at.start, 0), len(at))
        inside.append(slice(first, last))
        widths.append((before, len(at) - before - (last - first)))
    y, x = inside
    held = array[..., y, x]
    return np.pad(held, widths, constant_values=fill) if any(map(any, widths)) else held
