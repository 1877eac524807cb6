"""What is known of each image, as numbers or as maps from FITS files that fit the images."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from lnocl.errors import InputError
from lnocl.io.fitsread import read_stack
from lnocl.scene.observation import Array

Word = str | float

# What a word may be besides a number and a file.
OTHER_WORDS = {"background": "auto, ", "exposure": "a keyword of the images' headers, "}


class Maps:
    """Reads maps for images, and keeps the checksums of their files.

    Parameters
    ----------
    shape : tuple of int
        (p, ny, nx) of the images.

    Attributes
    ----------
    sha256 : dict of str to list of str
        Checksums of the files read, by what they are.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self.sha256: dict[str, list[str]] = {}

    def combine(self, name: str, words: Sequence[Word]) -> Array:
        """Return numbers as they are, shape (n,), or maps with numbers spread over theirs.

        Raises
        ------
        FileError, InputError
            As `read`; a word that is no file.
        """
        if all(isinstance(word, float) for word in words):
            return np.array(words, float)
        for word in words:
            if isinstance(word, str) and not os.path.exists(word):
                raise InputError(
                    f"{_say(name)} {word!r} is not a number, {OTHER_WORDS.get(name, '')}or a file "
                    "that exists"
                )
        if len(words) == 1:
            return self.read(name, [str(words[0])])
        if len(words) != self._shape[0]:
            raise InputError(
                f"{len(words)} values of {_say(name)} for {self._shape[0]} images; give one, or "
                "one for each"
            )
        if all(isinstance(word, str) for word in words):
            return self.read(name, [str(word) for word in words])
        return np.array([self._spread(name, word) for word in words])

    def _spread(self, name: str, word: Word) -> Array:
        if isinstance(word, float):
            return np.full(self._shape[1:], word)
        return self._read(name, [word], (1,))[0]

    def read(self, name: str, paths: Sequence[str]) -> Array:
        """Return maps of the images' shape, of which files may hold one, or one for each.

        Raises
        ------
        FileError, InputError
            As `fitsread.read_stack`; maps that do not fit the images.
        """
        maps = self._read(name, paths, (1, self._shape[0]))
        return np.broadcast_to(maps, self._shape)

    def _read(self, name: str, paths: Sequence[str], numbers: Sequence[int]) -> Array:
        stack = read_stack(paths)
        n, *shape = stack.data.shape
        if tuple(shape) != self._shape[1:] or n not in numbers:
            raise InputError(
                f"{_say(name)} {paths[0]} has the shape {stack.data.shape} and the images "
                f"{self._shape}; give one map that fits all images, or one for each"
            )
        self.sha256.setdefault(name, []).extend(stack.sha256)
        return stack.data


def _say(name: str) -> str:
    return name.replace("_", " ")
