"""What several subcommands share of the command line: the parser, arguments, their types."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

from lnocl.errors import InputError

# What arguments are added to: a parser, or a group of it that has a heading of its own.
Arguments = argparse._ActionsContainer


class Command(NamedTuple):
    """A subcommand: its line in the help, what adds its arguments, and what runs it."""

    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], None]


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ours, and that takes ``-1,3`` and ``-inf`` for values."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)[\d.,eainf+-]*$", re.I)

    def error(self, message: str) -> NoReturn:
        """Raise what argparse would print before it ends the program."""
        raise InputError(f"{message}; see {self.prog} --help")


def add_input_arguments(parser: Arguments, required: bool) -> None:
    """Add the images and what is known of them: PSFs, background, read noise."""
    parser.add_argument(
        "images",
        nargs="+" if required else "*",
        metavar="IMAGE",
        help="FITS file with an image, or one file with a cube of them; in electrons per pixel, "
        "unless its header says otherwise (BUNIT)",
    )
    parser.add_argument(
        "--psf",
        nargs="+",
        action="extend",
        required=required,
        dest="psfs",
        metavar="PSF",
        help="FITS file with a PSF, its centre at (ky // 2, kx // 2): one for all images or one "
        "for each, or one file with a cube of them",
    )
    _add_values(
        parser,
        "--background",
        "B",
        "electrons per pixel, or a FITS file with a map of them, or auto: the sigma-clipped median "
        "of the image; one for all images or one for each (default: 0)",
    )
    _add_values(
        parser,
        "--read-noise",
        "S",
        "standard deviation in electrons, or a FITS file with a map of it, one for all images or "
        "one for each (default: 0)",
    )


def add_star(parser: Arguments) -> None:
    """Add the positions of stars in pixels."""
    parser.add_argument(
        "--star",
        action="append",
        default=[],
        type=position,
        dest="stars",
        metavar="X,Y",
        help="position of a star in pixels, 0-based, x along columns; may be repeated",
    )


def add_frame_arguments(parser: Arguments) -> None:
    """Add what real frames need besides: exposures, gain, bad pixels, offsets."""
    _add_values(
        parser,
        "--exposure",
        "T",
        "seconds, or a FITS file with a map of them, one for all images or one for each, or a "
        "keyword of the images' headers such as EXPTIME; the result is then in electrons per "
        "second",
    )
    parser.add_argument(
        "--gain",
        type=finite,
        metavar="G",
        help="electrons for each adu or count, or whatever else the images are in",
    )
    parser.add_argument(
        "--inverse-variance",
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="FITS file with 1 / variance of sky and read noise, in units of the images, one for "
        "all images or one for each; 0 where a pixel is bad",
    )
    parser.add_argument(
        "--mask",
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="FITS file that is not 0 where a pixel is bad, one for all images or one for each; or "
        "dq, the extension DQ of each image",
    )
    parser.add_argument(
        "--saturation",
        type=finite,
        metavar="V",
        help="pixels of this value and above are bad, in units of the images",
    )
    parser.add_argument(
        "--align",
        choices=("wcs",),
        help="the images are not on one grid: take the offsets between them from their sky "
        "coordinates",
    )


def _add_values(parser: Arguments, option: str, metavar: str, words: str) -> None:
    """Add an option of numbers or words, one or several."""
    parser.add_argument(
        option, nargs="+", action="extend", type=number_or_word, metavar=metavar, help=words
    )


def number_or_word(text: str) -> float | str:
    """Return a number where a text is one, else the text."""
    try:
        return float(text)
    except ValueError:
        return text


def finite(text: str) -> float:
    """Return a number that a header can hold."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is no finite number")
    return number


def add_folder(parser: argparse.ArgumentParser, content: str, **keywords: Any) -> None:
    """Add the option for the folder of the output, and that to replace files in it."""
    default = " (default: %(default)s)" if "default" in keywords else ""
    parser.add_argument(
        "-o", "--output", metavar="DIR", help=f"folder for {content}{default}", **keywords
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files in DIR")


def add_device(parser: Arguments) -> None:
    """Add the option for the OpenCL device."""
    parser.add_argument(
        "--device",
        metavar="SPEC",
        help="OpenCL device as PLATFORM[:DEVICE], each an index or a part of the name; see "
        "lnocl devices (default: that of PYOPENCL_CTX, else the first GPU, else the first CPU)",
    )


def position(text: str) -> tuple[float, float]:
    """Return the numbers of ``X,Y``."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y") from None
    return x, y


def as_path(path: str) -> str:
    """Return a path that is not taken for an option, for a command to be repeated."""
    return f"./{path}" if path.startswith("-") else path
