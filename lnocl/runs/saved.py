"""The arrays of a checkpoint, each checked against what a run can hold before it is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import FileError

# The scaled numbers of a run stay far below it, and no product of two such overflows.
LARGEST = float(np.finfo(np.float32).max)

# A bound of numbers in units of the caller, which have none.
UNBOUNDED = float(np.finfo(np.float64).max)
FLOAT = np.dtype(np.float64)

# An axis has one length, or any of a range.
Shape = tuple[int | range, ...]


class Saved:
    """Arrays of a checkpoint, to be taken one by one by whoever knows what they must be.

    Parameters
    ----------
    path : str
        The checkpoint, for messages.
    arrays : mapping of str to ndarray
        Its arrays, by name.
    """

    def __init__(self, path: str, arrays: Mapping[str, NDArray]) -> None:
        self._path, self._arrays = path, dict(arrays)
        self._prefix = ""

    def __contains__(self, name: str) -> bool:
        return self._prefix + name in self._arrays

    def take(
        self,
        name: str,
        dtype: np.dtype,
        shape: Shape,
        low: ArrayLike = -LARGEST,
        high: ArrayLike = LARGEST,
    ) -> NDArray:
        """Return an array and remove it from those to be taken; an empty one may be missing.

        Parameters
        ----------
        name : str
            Its name.
        dtype : numpy.dtype
            Its type.
        shape : tuple of int or range
            Its shape, or the range of lengths that an axis may have.
        low, high : array_like, optional
            Bounds of its numbers, which broadcast to it.

        Raises
        ------
        FileError
            It is missing, of another type or shape, or holds a number out of bounds or NaN.
        """
        lengths = [axis if isinstance(axis, range) else range(axis, axis + 1) for axis in shape]
        array = self._arrays.pop(self._prefix + name, None)
        if array is None:
            array = np.zeros([axis[0] for axis in lengths], dtype)
            if array.size:
                self.refuse(f"{name} is missing")
        has_axes = array.ndim == len(lengths)
        if not (array.dtype == dtype and has_axes and all(map(_holds, lengths, array.shape))):
            self.refuse(
                f"{name} is {array.dtype} of shape ({', '.join(map(str, array.shape))}), and must "
                f"be {dtype} of shape ({', '.join(map(_in_words, lengths))})"
            )
        good = (low <= array) & (array <= high)
        if not good.all():
            at = np.argmin(good)
            least, most = (np.broadcast_to(bound, array.shape).flat[at] for bound in (low, high))
            allowed = f"{least:g}" if least == most else f"from {least:g} to {most:g}"
            self.refuse(f"{name} holds {array.flat[at]:g}, and must be {allowed}")
        return array

    @contextmanager
    def part(self, prefix: str) -> Iterator[None]:
        """Take only arrays whose names begin so, by what follows."""
        self._prefix = prefix
        try:
            yield
        finally:
            self._prefix = ""

    def refuse_unless(self, holds: bool, words: str) -> None:
        """Refuse the checkpoint unless a condition holds.

        Raises
        ------
        FileError
            It does not hold; the words say what is wrong.
        """
        if not holds:
            self.refuse(words)

    def refuse_others(self) -> None:
        """Refuse arrays that were not taken.

        Raises
        ------
        FileError
            There are some.
        """
        if self._arrays:
            self.refuse(f"{min(self._arrays)} is not an array of such a run")

    def refuse(self, words: str) -> NoReturn:
        """Refuse the checkpoint.

        Raises
        ------
        FileError
            Always; the words say what is wrong.
        """
        raise FileError(
            f"the checkpoint {self._path} is of no such run: {self._prefix}{words}; start anew"
        )


def is_whole(values: ArrayLike) -> bool:
    """Return whether numbers are whole, as those that count iterations are."""
    return bool((np.floor(values) == values).all())


def _holds(lengths: range, length: int) -> bool:
    return length in lengths


def _in_words(lengths: range) -> str:
    return f"{lengths[0]}" if len(lengths) == 1 else f"{lengths[0]} to {lengths[-1]}"
