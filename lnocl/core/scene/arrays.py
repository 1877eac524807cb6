"""Arrays of numbers from whatever a caller gives, masked or not, with a unit or not."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.quantities import in_unit
from lnocl.errors import InputError, counted

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# An array whose last axis is so short, and the others so long, has its channels last.
MAX_CHANNELS = 4
MIN_SIDE = 8

# The advice where these have masked values, which only images and frames of stars may have.
UNMASK = {
    "psfs": "repair {them} first, as lnocl.psf.make_psf does",
    "background": "fill {them} and add {their} mask to `mask`",
    "read_noise": "fill {them} and add {their} mask to `mask`",
    "exposure": "fill {them} and add {their} mask to `mask`",
}
# A Gaussian is one standard deviation below its median in this share of all.
DARKER = 0.1587


def values_and_mask(name: str, values: ArrayLike) -> tuple[NDArray, NDArray[np.bool_]]:
    """Return values as an array, and where they are masked, by whatever class or in a list.

    A unit is refused: whoever knows what it may be has converted it
    (`lnocl.core.scene.quantities`).
    """
    values = in_unit(name, values, "")
    try:
        array: NDArray = np.ma.asanyarray(values)
    except (TypeError, ValueError) as error:
        if "inhomogeneous" not in str(error):
            raise InputError(f"`{name}` cannot be read as an array: {error}") from error
        raise InputError(f"`{name}` cannot be read as an array: its rows differ") from None
    except MemoryError:
        raise
    except Exception as error:  # the caller's own __array__ may raise any
        words = f"{type(error).__name__}: {error}"
        raise InputError(f"`{name}` cannot be read as an array: {words}") from error
    return np.ma.getdata(array, subok=False), np.ma.getmaskarray(array)


def unmasked(name: str, values: ArrayLike) -> NDArray:
    """Return values as an array; refuse masked ones."""
    array, masked = values_and_mask(name, values)
    refuse_masked(name, masked)
    return array


def refuse_masked(name: str, masked: NDArray[np.bool_]) -> None:
    """Refuse masked values: below a mask there may be anything."""
    if n_masked := int(np.count_nonzero(masked)):
        them, their = ("it", "its") if n_masked == 1 else ("them", "their")
        advice = UNMASK.get(name, "fill {them} or leave {them} out")
        raise InputError(
            f"`{name}` has {counted(n_masked, 'masked value')}; "
            f"{advice.format(them=them, their=their)}"
        )


def numbers(name: str, values: ArrayLike, copy: bool = True, unit: str = "") -> Array:
    """Return real numbers as float64, none of them masked; a copy unless that is not asked for.

    Quantities are taken in a unit; by default they must have none.
    """
    array = unmasked(name, in_unit(name, values, unit))
    if array.dtype.kind not in "biuf":
        raise InputError(f"`{name}` holds {array.dtype}; give real numbers")
    return array.astype(np.float64, copy=copy)


def booleans(name: str, values: ArrayLike) -> NDArray[np.bool_]:
    """Return a mask, none of it masked itself."""
    given = unmasked(name, values)
    if given.dtype != np.bool_:
        raise InputError(
            f"`{name}` is of type {given.dtype}; give booleans, True where a pixel is bad"
        )
    return given


def stack(name: str, values: ArrayLike, n_images: int = 0) -> Array:
    """Return one or several two-dimensional arrays as a stack; several may be one for each image.

    They are in float64, and not copied where they are already.
    """
    array = numbers(name, values, copy=False)
    if array.ndim not in (2, 3):
        raise InputError(
            f"`{name}` has {counted(array.ndim, 'dimension')}; give two, or three for several "
            f"`{name}`"
        )
    if array.size == 0:
        raise InputError(f"`{name}` is empty: its shape is {array.shape}")
    if are_colours(array.shape) and len(array) != n_images:
        raise InputError(
            f"`{name}` has shape {array.shape}, but its axes are (p, ny, nx): of colours give one, "
            f"{name}[:, :, 0]; if they are of one sky, np.moveaxis({name}, -1, 0)"
        )
    return array.reshape((-1, *array.shape[-2:]))


def are_colours(shape: tuple[int, ...]) -> bool:
    """Return whether a shape is that of one image in several colours, which are the last axis."""
    return len(shape) == 3 and shape[2] <= MAX_CHANNELS and min(shape[:2]) >= MIN_SIDE


def together(*levels: Array) -> list[Array]:
    """Return numbers (p,) and maps (p, ny, nx) so that they broadcast over each other."""
    are_maps = any(each.ndim == 3 for each in levels)
    return [each[:, None, None] if are_maps and each.ndim < 3 else each for each in levels]


def refuse_unless(name: str, values: Array, requirement: str, holds: NDArray[np.bool_]) -> None:
    """Refuse values that are not finite, or do not hold a requirement."""
    good = holds & np.isfinite(values)
    if not good.all():
        raise InputError(f"{name} must be {requirement}; {values[~good].flat[0]:g} was given")


def pixels(n: int, kind: str, state: str, remedy: str) -> str:
    """Return a sentence on pixels that agrees in number."""
    noun, are, were = ("pixel", "is", "was") if n == 1 else ("pixels", "are", "were")
    return f"{n} {kind} {noun} {are} {state} and {were} {remedy}"


def flag(name: str, value: object) -> bool:
    """Return True or False; refuse anything else."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"`{name}` must be True or False; {value!r} was given")
    return bool(value)


def whole(name: str, value: Any, least: int, more: str = "") -> int:
    """Return a whole number; refuse one below the least, and anything else.

    `more` is what the message says of it besides.
    """
    try:
        number = None if isinstance(value, (bool, np.bool_)) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < least:
        raise InputError(
            f"`{name}` must be a whole number, {least} or more{more}; {value} was given"
        )
    return number


def number_in(
    name: str, value: Any, requirement: str, holds: Callable[[Any], bool | np.bool_]
) -> None:
    """Refuse what is no number, or does not hold a requirement."""
    if not (isinstance(value, (int, float, np.number)) and holds(value)):
        raise InputError(f"`{name}` must be {requirement}; {value} was given")


def darker_noise(values: Array) -> float:
    """Return the standard deviation of values by their darker half: the brighter may have light."""
    return float(np.median(values) - np.quantile(values, DARKER))
