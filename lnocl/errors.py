"""The errors that lnocl raises, its warning, and the ways to warn and to note.

Messages name parameters between grave accents, and images and PSFs by their index, as in
`` `n_iter` `` and `` `psfs[0]` ``: so the shell knows what is a flag there, and counts from 1.
"""

import logging
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from pathlib import Path
from typing import Any

PACKAGE = str(Path(__file__).parent) + os.sep
NAMED = re.compile(r"`([\w ]+?)(?:\[(\d+)\])?`")
LOG = logging.getLogger("lnocl")


# Images that messages are of, by their numbers among all, and what these show.
_PART: ContextVar[tuple[Sequence[int], str] | None] = ContextVar("part", default=None)


@contextmanager
def of_images(which: Sequence[int], name: str) -> Iterator[None]:
    """Have messages count images among all of which these are some, and name what these show."""
    token = _PART.set((which, name))
    try:
        yield
    finally:
        _PART.reset(token)


def _among_all(message: str) -> str:
    """Return a message of `of_images` with the numbers of images among all."""
    if (part := _PART.get()) is None:
        return message
    which, name = part

    def replace(found: re.Match[str]) -> str:
        parameter, index = found.groups()
        return f"`{parameter}[{which[int(index)]}]`" if index else found[0]

    return f"{name}: {NAMED.sub(replace, message)}"


def with_names(message: str, named: Callable[[str], str] = str, first: int = 0) -> str:
    """Return a message with a name for each parameter, and images and PSFs counted from `first`."""

    def replace(found: re.Match[str]) -> str:
        name, index = found.groups()
        return f"{name.removesuffix('s')} {int(index) + first}" if index else named(name)

    return NAMED.sub(replace, message)


class LnoclError(Exception):
    """Base class of all errors that lnocl raises.

    The message is one line: what is wrong, and mostly what to do.

    Parameters
    ----------
    message : str
        Text of the error. Line breaks and repeated blanks in it become single blanks.

    Attributes
    ----------
    exit_status : int
        Exit status of the command line after this error: 1 for a failure, 2 for wrong use.
    message : str
        The text with the names of parameters between grave accents.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> try:
    ...     lnocl.Observation(np.ones((8, 8)), np.full((3, 3), np.nan))
    ... except lnocl.LnoclError as error:
    ...     print(type(error).__name__, error.exit_status)
    InputError 2
    """

    exit_status = 1

    def __init__(self, message: str) -> None:
        self.message = " ".join(message.split())
        super().__init__(with_names(self.message))


class InputError(LnoclError, ValueError):
    """A value that cannot be used: an argument, an image, a PSF, a mask.

    It is a `ValueError` too.

    Parameters
    ----------
    message : str
        Text of the error, as for `LnoclError`.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> try:
    ...     lnocl.Observation(np.ones((8, 8)), np.ones((3, 3)), oversample=3)
    ... except lnocl.InputError as error:
    ...     print(error)
    oversample must be 1, 2 or 4; 3 was given
    """

    exit_status = 2


class FileError(LnoclError, OSError):
    """A file that cannot be read or written.

    It is an `OSError` too.

    Parameters
    ----------
    message : str
        Text of the error, as for `LnoclError`.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> observation = lnocl.Observation(np.ones((8, 8)), np.ones((3, 3)))
    >>> try:
    ...     lnocl.deconvolve(observation, resume="lost.fits", engine="numpy")
    ... except lnocl.FileError as error:
    ...     print(error)
    lost.fits cannot be opened: No such file or directory
    """


class DeviceError(LnoclError, RuntimeError):
    """No usable OpenCL device, or one that cannot do as it was asked.

    It is a `RuntimeError` too. ``engine="numpy"`` of `lnocl.deconvolve` needs no device.

    Parameters
    ----------
    message : str
        Text of the error, as for `LnoclError`.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> observation = lnocl.Observation(np.ones((8, 8)), np.ones((3, 3)))
    >>> try:
    ...     result = lnocl.deconvolve(observation, n_iter=9, stop=None, engine="numpy")
    ... except lnocl.DeviceError as error:
    ...     print("no OpenCL:", error)
    >>> result.device
    'numpy'
    """


class DivergedError(LnoclError):
    """The objective rises where each iteration must lower it.

    PSFs with many negative pixels do that. Held-out counts raise it; other runs return the estimate
    of the least objective, with ``stop_reason`` "diverged" and a warning.

    Parameters
    ----------
    message : str
        Text of the error, as for `LnoclError`.

    Examples
    --------
    >>> from lnocl.errors import DivergedError
    >>> DivergedError("the objective rises").exit_status
    1
    """


class NotFiniteError(DeviceError):
    """A sum that steers an iteration is infinite or not a number."""


def refuse_not_finite(*sums: float) -> None:
    """Raise NotFiniteError unless all sums are finite."""
    if not all(map(math.isfinite, sums)):
        raise NotFiniteError(
            "the objective is infinite or not a number: scale the scene where its values are large "
            "beyond measure; else see what lnocl selftest says of the device"
        )


def installed(module: str, why: str) -> Any:
    """Return a module that is not part of every installation.

    Raises
    ------
    LnoclError
        It is missing; the message says why it is needed, and how to install it.
    """
    try:
        return import_module(module)
    except ImportError:
        raise LnoclError(f"{why}: pip install {module.partition('.')[0]}") from None


def counted(n: int, noun: str) -> str:
    """Return a number with a noun that agrees with it: ``1 image``, ``2 images``."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def in_words(place: Iterable[float]) -> str:
    """Return a place as messages have it: ``(20.35, 7)``."""
    x, y = place
    return f"({round(x, 2):.7g}, {round(y, 2):.7g})"


class LnoclWarning(UserWarning):
    """Something was changed or left out of the data, or the result may be wrong.

    The warning names the line of the caller. Filters of `warnings` apply to it as to any other.

    Examples
    --------
    Make each warning an error:

    >>> import warnings
    >>> import numpy as np
    >>> import lnocl
    >>> image = np.ones((8, 8))
    >>> image[3, 4] = np.nan
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", lnocl.LnoclWarning)
    ...     try:
    ...         lnocl.Observation(image, np.ones((3, 3)))
    ...     except lnocl.LnoclWarning as warning:
    ...         print(warning)
    1 image pixel is not finite and was masked

    Show no warning of lnocl:

    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", lnocl.LnoclWarning)
    ...     observation = lnocl.Observation(image, np.ones((3, 3)))
    >>> bool(observation.mask[0, 3, 4])
    True
    """

    def __init__(self, message: str) -> None:
        self.message = message
        super().__init__(with_names(message))


class MisfitWarning(LnoclWarning):
    """The model that a run has ended with does not fit its images.

    `lnocl.deconvolve` and `lnocl.deconvolve_tiles` warn with one for each line of
    `~lnocl.Result.verdict`, which says where the model does not fit and what to do.

    Parameters
    ----------
    message : str
        Text of the warning, a line of the verdict.

    Examples
    --------
    One iteration is too few, as is known:

    >>> import warnings
    >>> import numpy as np
    >>> import lnocl
    >>> image = np.full((16, 16), 9.0)
    >>> image[8, 8] = 900.0
    >>> observation = lnocl.Observation(image, np.ones((3, 3)))
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", lnocl.errors.MisfitWarning)
    ...     result = lnocl.deconvolve(
    ...         observation, n_iter=1, stop=None, engine="numpy", mend_images=False
    ...     )
    >>> result.verdict()
    ['the model does not fit: see to background, noise and gain']
    """


def warn(message: str, category: type[LnoclWarning] = LnoclWarning) -> None:
    """Warn with an `LnoclWarning` that points to the caller's line, the nearest outside lnocl."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(category(_among_all(message)), stacklevel=level)


def note(message: str, *values: Any) -> None:
    """Log what was changed in the data or the model, as information; `values` are as for %."""
    _log(logging.INFO, message, values)


def detail(message: str, *values: Any) -> None:
    """Log what was measured or chosen, for debugging; `values` are as for %."""
    _log(logging.DEBUG, message, values)


def _log(level: int, message: str, values: tuple[Any, ...]) -> None:
    whole = _among_all(message % values if values else message)
    LOG.log(level, "%s", with_names(whole), extra={"named": whole})
