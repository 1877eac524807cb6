"""What several subcommands share of the command line: the parser, arguments, their types."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

from lnocl.errors import InputError


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


def add_input_arguments(parser: argparse.ArgumentParser, required: bool) -> None:
    """Add the images and what is known of them: PSFs, background, read noise, stars."""
    parser.add_argument(
        "images",
        nargs="+" if required else "*",
        metavar="IMAGE",
        help="FITS file with an image, in electrons per pixel, or one file with a cube of them",
    )
    parser.add_argument(
        "--psf",
        nargs="+",
        action="extend",
        required=required,
        dest="psfs",
        metavar="PSF",
        help="FITS file with a PSF, its peak at (ky // 2, kx // 2): one for all images or one "
        "for each, or one file with a cube of them",
    )
    parser.add_argument(
        "--background",
        nargs="+",
        action="extend",
        type=float,
        metavar="B",
        help="electrons per pixel, one for all images or one for each (default: 0)",
    )
    parser.add_argument(
        "--read-noise",
        nargs="+",
        action="extend",
        type=float,
        metavar="S",
        help="standard deviation in electrons, one for all images or one for each (default: 0)",
    )
    parser.add_argument(
        "--star",
        action="append",
        default=[],
        type=_position,
        dest="stars",
        metavar="X,Y",
        help="position of a point source in pixels, 0-based, x along columns; may be repeated",
    )


def add_folder(parser: argparse.ArgumentParser, content: str, **keywords: Any) -> None:
    """Add the option for the folder of the output, and that to replace files in it."""
    default = " (default: %(default)s)" if "default" in keywords else ""
    parser.add_argument(
        "-o", "--output", metavar="DIR", help=f"folder for {content}{default}", **keywords
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files in DIR")


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the option for the OpenCL device."""
    parser.add_argument(
        "--device",
        metavar="SPEC",
        help="OpenCL device as PLATFORM[:DEVICE], each an index or a part of the name; see "
        "lnocl devices (default: that of PYOPENCL_CTX, else the first GPU, else the first CPU)",
    )


def _position(text: str) -> tuple[float, float]:
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y") from None
    return x, y
