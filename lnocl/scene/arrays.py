"""Arrays of numbers from whatever a caller gives, masked or not, with a unit or not."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import InputError, counted
from lnocl.scene.quantities import in_unit

Array = NDArray[np.float64]

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

    A unit is refused: whoever knows what it may be has converted it (`lnocl.scene.quantities`).
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
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < least:
        raise InputError(
            f"`{name}` must be a whole number, {least} or more{more}; {value} was given"
        )
    return number


def darker_noise(values: Array) -> float:
    """Return the standard deviation of values by their darker half: the brighter may have light."""
    return float(np.median(values) - np.quantile(values, DARKER))
