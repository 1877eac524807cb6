"""The errors that lnocl raises, its warning, and the one way to warn."""

import math
import os
import sys
import warnings
from pathlib import Path

PACKAGE = str(Path(__file__).parent) + os.sep


class LnoclError(Exception):
    """Anything that lnocl refuses or fails at; its message is one line, meant for the user.

    Attributes
    ----------
    exit_status : int
        What the command line returns for it: 1 failed, 2 wrong use.
    """

    exit_status = 1

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class InputError(LnoclError, ValueError):
    """A value that cannot be used: an argument, an image, a PSF, a mask."""

    exit_status = 2


class FileError(LnoclError, OSError):
    """A file that cannot be read or written."""


class DeviceError(LnoclError, RuntimeError):
    """No usable OpenCL device, or the device cannot do what was asked of it."""


class DivergedError(LnoclError):
    """The objective rises where each iteration must lower it."""


class NotFiniteError(DeviceError):
    """A sum that steers an iteration is infinite or not a number."""


def refuse_not_finite(*sums: float) -> None:
    """Raise NotFiniteError unless all sums are finite."""
    if not all(map(math.isfinite, sums)):
        raise NotFiniteError(
            "the objective is infinite or not a number: scale the scene where its values are large "
            "beyond measure; else see what lnocl selftest says of the device"
        )


def counted(n: int, noun: str) -> str:
    """Return a number with a noun that agrees with it: ``1 image``, ``2 images``."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


class LnoclWarning(UserWarning):
    """Something was changed or left out of the data, and the user should know."""


def warn(message: str) -> None:
    """Warn with an `LnoclWarning` that points to the caller's line, the nearest outside lnocl."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, LnoclWarning, stacklevel=level)
