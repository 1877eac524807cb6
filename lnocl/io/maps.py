"""Quantities of each image, as numbers, as words for numbers or as maps from FITS files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np

from lnocl.core.scene import units
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.transforms import enlarged
from lnocl.errors import InputError, counted
from lnocl.io.calibration import Word
from lnocl.io.fitsread import read_stack
from lnocl.io.names import file_of

# Units that maps are taken in.
UNITS = {"background": units.COUNTS, "read_noise": units.COUNTS, "exposure": ("second",)}

# The words that a quantity may be, besides a number and a file.
OTHER_WORDS = {
    "background": "auto, ",
    "read_noise": "auto, a keyword of the images' headers, ",
    "exposure": "a keyword of the images' headers, ",
}


class Maps:
    """Reader of maps for images, with the checksums of their files.

    Parameters
    ----------
    shape : tuple of int
        (p, ny, nx) of the images.
    shapes : sequence of tuple of int
        Of each of them, where some are smaller.

    Attributes
    ----------
    sha256 : dict of str to list of str
        Checksums of the files read, by quantity.
    """

    def __init__(self, shape: tuple[int, int, int], shapes: Sequence[tuple[int, int]] = ()) -> None:
        self._shape, self._shapes = shape, list(shapes) or [(shape[1], shape[2])] * shape[0]
        self.sha256: dict[str, list[str]] = {}

    def fill(
        self, name: str, words: Sequence[Word], number_of: Callable[[int, str], float | None]
    ) -> list[Word]:
        """Return words with numbers in the place of those that mean one in each image.

        Parameters
        ----------
        name : str
            The quantity.
        words : sequence of Word
            One for all images, or one for each.
        number_of : callable
            ``number_of(j, word)`` returns the number that a word means in image j, counted from
            0, or None.

        Raises
        ------
        InputError
            Neither one word nor one for each image; a word without a number in some of the images.
        """
        self._check_count(name, words)
        each = list(words) * self._shape[0] if len(words) == 1 else words
        filled = [_number(j, word, number_of) for j, word in enumerate(each)]
        if len(words) > 1:
            return filled
        are_numbers = [isinstance(word, float) for word in filled]
        if any(are_numbers) and not all(are_numbers):
            raise InputError(
                f"`images[{are_numbers.index(False)}]` has no {words[0]}; give `{name}` as numbers"
            )
        return filled if all(are_numbers) else list(words)

    def combine(self, name: str, words: Sequence[Word]) -> Array:
        """Return numbers as they are, shape (n,), or maps with numbers spread over theirs.

        Raises
        ------
        FileError, InputError
            As `read`; a word that is not the name of a file.
        """
        if all(isinstance(word, float) for word in words):
            return np.array(words, float)
        for word in words:
            if isinstance(word, str) and not os.path.exists(file_of(word)):
                raise InputError(
                    f"`{name}` {word!r} is not a number, {OTHER_WORDS.get(name, '')}or a file that "
                    "exists"
                )
        self._check_count(name, words)
        if all(isinstance(word, str) for word in words):
            return self.read(name, [str(word) for word in words])
        each = list(words) * self._shape[0] if len(words) == 1 else list(words)
        return np.array([self._spread(name, j, word) for j, word in enumerate(each)])

    def _check_count(self, name: str, words: Sequence[Word]) -> None:
        """Refuse several words, not all of them numbers, that are not one for each image."""
        if len(words) not in (1, self._shape[0]) and any(isinstance(word, str) for word in words):
            raise InputError(
                f"`{name}` has {len(words)} values for {counted(self._shape[0], 'image')}; give "
                "one, or one for each"
            )

    def _spread(self, name: str, j: int, word: Word) -> Array:
        """Return the map of image j."""
        if isinstance(word, float):
            return np.full(self._shape[1:], word)
        return self._read(name, [word], [self._shapes[j]])[0]

    def read(self, name: str, paths: Sequence[str]) -> Array:
        """Return maps for all images, shape (p, ny, nx), from files with one, or one for each.

        Raises
        ------
        FileError, InputError
            As `fitsread.read_stack`; maps that do not fit the images.
        """
        is_one = len(set(self._shapes)) == 1 and len(paths) == 1
        maps = self._read(name, paths, self._shapes, is_one)
        return np.broadcast_to(maps, self._shape)

    def _read(
        self,
        name: str,
        paths: Sequence[str],
        shapes: Sequence[tuple[int, int]],
        may_be_one: bool = False,
    ) -> Array:
        """Return maps in the shapes of images, or perhaps one for all, enlarged to one shape."""
        stack = read_stack(paths, len(set(self._shapes)) > 1)
        found = stack.shapes
        if found != list(shapes) and not (may_be_one and found == list(shapes[:1])):
            raise InputError(self._misfit(name, paths, found, shapes))
        self.sha256.setdefault(name, []).extend(stack.sha256)
        for path, header in zip(paths, stack.headers, strict=True):
            _refuse_other_unit(name, path, str(header.get("BUNIT", "")))
        if len(set(self._shapes)) == 1:
            return stack.data
        own = zip(stack.data, found, strict=True)
        ny, nx = self._shape[1:]
        return np.array([enlarged(each[:h, :w], (ny, nx)) for each, (h, w) in own])

    def _misfit(
        self,
        name: str,
        paths: Sequence[str],
        found: Sequence[tuple[int, int]],
        shapes: Sequence[tuple[int, int]],
    ) -> str:
        """Say which map does not fit its image."""
        if len(found) == len(shapes) == len(paths):
            pairs = zip(paths, found, shapes, strict=True)
            path, own, shape = next(each for each in pairs if each[1] != each[2])
            return f"`{name}` {path} has the shape {own} and its image {shape}; give one that fits"
        ny, nx = found[0]
        return (
            f"`{name}` {paths[0]} has the shape {(len(found), ny, nx)} and the images "
            f"{self._shape}; give one map that fits all images, or one for each"
        )


def _refuse_other_unit(name: str, path: str, bunit: str) -> None:
    """Refuse a map whose header has another unit than the one in which it is taken."""
    unit = units.parse(bunit)
    if unit is None or name not in UNITS:
        return
    if units.count_of(unit, UNITS[name]) != (1.0, False):
        raise InputError(
            f"`{name}` {path} is in {bunit}, and taken in {UNITS[name][0]}s: convert it, or leave "
            "BUNIT out of its header"
        )


def _number(j: int, word: Word, number_of: Callable[[int, str], float | None]) -> Word:
    number = number_of(j, word) if isinstance(word, str) else word
    return word if number is None else number
