"""Functions of arrays that are asked for the same again and again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import wraps
from hashlib import blake2b
from threading import Lock
from typing import Any, ParamSpec, TypeVar

import numpy as np

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

# Bytes that an answer counts for besides its arrays.
LEAST = 1024


def remembered(most: int) -> Callable[[Callable[Given, Answer]], Callable[Given, Answer]]:
    """Return a decorator that keeps the last answers of a function, by what it is given.

    Arrays are told apart by a digest of their values, and objects that have `contents` by these, so
    that nothing given is kept. Arrays in an answer cannot be written to.

    Parameters
    ----------
    most : int
        Bytes of the answers that are kept, at most.
    """

    def decorate(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
        answers: OrderedDict[Hashable, tuple[Answer, int]] = OrderedDict()
        lock = Lock()

        @wraps(function)
        def asked(*given: Given.args, **named: Given.kwargs) -> Answer:
            key = *map(_digest, given), *((name, _digest(named[name])) for name in sorted(named))
            with lock:
                if key in answers:
                    answers.move_to_end(key)
                    return answers[key][0]
            answer = function(*given, **named)
            with lock:
                answers[key] = answer, LEAST + _protected(answer)
                while sum(size for _, size in answers.values()) > most:
                    answers.popitem(last=False)
            return answer

        return asked

    return decorate


def _digest(value: Any) -> Hashable:
    if isinstance(value, np.ndarray):
        content = blake2b(value.ravel().data, digest_size=16).digest()
        return value.shape, value.dtype.str, content
    contents = getattr(value, "contents", None)
    return value if contents is None else (type(value), *map(_digest, contents))


def _protected(answer: Any) -> int:
    """Return the bytes of an answer, whose arrays cannot be written to from now on."""
    if isinstance(answer, tuple):
        return sum(map(_protected, answer))
    if isinstance(answer, np.ndarray):
        answer.flags.writeable = False
    return int(getattr(answer, "nbytes", 0))
