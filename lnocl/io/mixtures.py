"""The components that images show, by words of the shell: their names and weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lnocl.errors import InputError, counted
from lnocl.io.calibration import EACH
from lnocl.io.image_files import ImageFiles
from lnocl.io.names import parse_kind

# Between a weight and its error.
PLUS_MINUS = "+-"
# Before a keyword of which the weight is the inverse.
OVER = "1/"


def read_components(files: ImageFiles, words: Sequence[str]) -> dict[str, Any]:
    """Return `components` and `component_errors` of an observation; nothing without words.

    Raises
    ------
    InputError
        A component is named twice; its weights are not one for all images, or one for each; a
        header lacks a keyword, or its value is no number above 0.
    """
    weights, errors = dict[str, list[float]](), dict[str, list[float]]()
    p = len(files.stack.data)
    if EACH in words:
        if len(words) > 1:
            raise InputError("`components` each names all of them; leave the others out")
        return {"components": {f"image {j + 1}": row for j, row in enumerate(np.eye(p))}}
    for word in words:
        name, texts = parse_kind(word)
        if name in weights:
            raise InputError(f"`components` has {name!r} twice; give each component once")
        given = texts.split(",")
        if len(given) not in (1, p):
            raise InputError(
                f"`components` {name!r} has {counted(len(given), 'weight')} for "
                f"{counted(p, 'image')}; give one for each, or one for all"
            )
        each = given * p if len(given) == 1 else given
        pairs = [_weight(files, name, j, text) for j, text in enumerate(each)]
        most = max((value for value, _, is_read in pairs if is_read), default=1.0)
        weights[name] = [value / most if is_read else value for value, _, is_read in pairs]
        errors[name] = [error for _, error, _ in pairs]
    return {"components": weights, "component_errors": errors} if weights else {}


def _weight(files: ImageFiles, name: str, j: int, text: str) -> tuple[float, float, bool]:
    """Return the weight of a component in image j, its error, and whether a header has it."""
    value, _, error = text.strip().partition(PLUS_MINUS)
    weight, deviation = _number(value), _number(error or "0")
    if deviation is None or not 0.0 <= deviation < float("inf"):
        raise InputError(
            f"`components` {name!r} has the error {error!r}; give a number, zero or more"
        )
    if weight is not None:
        return weight, deviation, False
    keyword = value.strip().removeprefix(OVER)
    path, found = files.stack.file_of(j)[0], files.stack.number("components", j, keyword)
    if found is None:
        raise InputError(
            f"`components` {name!r} has the weight {value!r}, and {path} has no {keyword} in its "
            "header; give a number, or another keyword"
        )
    if not 0.0 < found < float("inf"):
        raise InputError(f"{keyword} of {path} is {found:g}; a weight of `components` is above 0")
    return (1.0 / found if value.strip().startswith(OVER) else found), deviation, True


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
