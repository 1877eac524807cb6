"""The command ``psf``: make PSFs from a frame of a star, and say what was done to it."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl import __version__
from lnocl.commands import messages
from lnocl.commands.arguments import Command, as_path, number_or_word, position
from lnocl.errors import InputError

# Rows of a picture that can still be looked at.
MAX_DRAWN = 16

if TYPE_CHECKING:
    from lnocl.io.fitswrite import Card
    from lnocl.psf.make import StarPsf


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "The PSFs have unit sum and are what lnocl deconvolve --psf takes. Background and centre "
        "are what any frame of a star needs, so they are dealt with unless declined; the other "
        "steps are done if asked for. Each says what it did."
    )
    parser.add_argument(
        "frame", metavar="FRAME", help="FITS file with an image of a star, in any linear unit"
    )
    parser.add_argument(
        "-o", "--output", required=True, metavar="PSF.fits", help="file for the PSF or the PSFs"
    )
    parser.add_argument(
        "--star",
        action="append",
        default=[],
        type=position,
        dest="stars",
        metavar="X,Y",
        help="where the star is, in pixels, 0-based, x along columns, to some pixels (default: at "
        "the brightest pixel, single hot pixels apart)",
    )
    parser.add_argument(
        "--mask",
        metavar="FILE",
        help="FITS file of the frame's shape, not 0 where a pixel is bad; bad pixels are "
        "interpolated (those that are NaN in the frame are bad without it)",
    )
    parser.add_argument(
        "--saturation",
        type=float,
        metavar="VALUE",
        help="pixels of this value and above, in the unit of the frame, are bad too",
    )
    parser.add_argument(
        "--background",
        type=number_or_word,
        default="auto",
        metavar="VALUE",
        help="what to subtract, in the unit of the frame; or auto, which measures it around the "
        "crop, or at the frame's border where no size is given (default: %(default)s)",
    )
    parser.add_argument(
        "--no-recentre",
        action="store_false",
        dest="recentre",
        help="leave pixels as they are; otherwise the star's centre is found and shifted to the "
        "middle of a pixel",
    )
    parser.add_argument(
        "--rotate",
        nargs="+",
        type=float,
        default=[0.0],
        dest="angles",
        metavar="DEG",
        help="rotate by this angle from the x axis towards the y axis; several give a cube with "
        "a PSF for each, so 0 45 90 135 mimics four baselines (default: 0)",
    )
    parser.add_argument(
        "--size",
        type=int,
        metavar="K",
        help="side of the PSF in pixels; the star's centre comes to (K // 2, K // 2) (default: "
        "the largest that the frame has around the star)",
    )
    parser.add_argument(
        "--clip-negative", action="store_true", help="set negative pixels of the PSF to 0"
    )
    parser.add_argument(
        "--plot", metavar="FILE.png", help="picture of frame, PSFs and profiles, to look at"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    parser.add_argument("--quiet", action="store_true", help="show warnings and errors only")


def _run(arguments: argparse.Namespace) -> None:
    _check_outputs(arguments)
    folder = os.getcwd()

    from lnocl import psf
    from lnocl.io import fitswrite

    frame, frame_sum = _read_image(arguments.frame)
    mask, mask_sum = None, None
    if arguments.mask is not None:
        mask, mask_sum = _read_mask(arguments.mask, arguments.frame, frame.shape)
    stars = psf.make_psfs(
        frame,
        arguments.angles,
        position=arguments.stars[0] if arguments.stars else None,
        size=arguments.size,
        background=arguments.background,
        mask=mask,
        saturation=arguments.saturation,
        recentre=arguments.recentre,
        clip_negative=arguments.clip_negative,
    )
    lines = _lines(stars, arguments.angles)
    psfs = np.array([star.psf for star in stars])
    fitswrite.write_image(
        arguments.output,
        psfs if len(psfs) > 1 else psfs[0],
        cards=_cards(arguments, stars, frame_sum, mask_sum),
        overwrite=arguments.overwrite,
        notes=lines,
        commands=[["cd", folder], _repeating_command(arguments)],
    )
    k = psfs.shape[-1]
    what = f"{len(psfs)} PSFs" if len(psfs) > 1 else "a PSF"
    lines.append(
        f"written to {arguments.output}: {what} of {k} x {k} pixels, the star's centre at "
        f"({k // 2}, {k // 2})"
    )
    if arguments.plot is not None:
        _draw(arguments, stars)
        lines.append(f"drew {arguments.plot}")
    if not arguments.quiet:
        messages.say(lines)


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Check all that can be told before the frame is read."""
    from lnocl.io import atomic

    if len(arguments.stars) > 1:
        raise InputError(
            f"a PSF is made of one star, and {len(arguments.stars)} were given; give --star once"
        )
    inputs = [arguments.frame, *([] if arguments.mask is None else [arguments.mask])]
    atomic.check_output(arguments.output, arguments.overwrite, inputs)
    if arguments.plot is None:
        return

    from lnocl.plotting.figure import check_matplotlib

    if not arguments.plot.lower().endswith(".png"):
        raise InputError(
            f"the picture is a PNG file; give --plot a name ending in .png, not {arguments.plot}"
        )
    if os.path.realpath(arguments.plot) == os.path.realpath(arguments.output):
        raise InputError(f"the picture {arguments.plot} is the output too; give it another name")
    if len(arguments.angles) > MAX_DRAWN:
        raise InputError(
            f"--plot draws {MAX_DRAWN} PSFs at most, and {len(arguments.angles)} angles were given"
        )
    atomic.check_output(arguments.plot, arguments.overwrite, inputs)
    check_matplotlib()


def _read_image(path: str) -> tuple[NDArray[np.float64], str]:
    """Return the one image of a file, and the file's checksum."""
    from lnocl.io import fitsread

    stack = fitsread.read_single(path)
    return stack.data[0], stack.sha256[0]


def _read_mask(path: str, frame_path: str, shape: tuple[int, ...]) -> tuple[NDArray[np.bool_], str]:
    """Return where a mask is not 0, NaN included, and the file's checksum."""
    values, checksum = _read_image(path)
    if values.shape != shape:
        raise InputError(
            f"the mask {path} has the shape {values.shape} and {frame_path} {shape}; they must be "
            "the same"
        )
    bad = values != 0
    if bad.all():
        raise InputError(
            f"the mask {path} leaves no good pixel: it is 0 nowhere; give one that is 0 where the "
            "frame is good"
        )
    return bad, checksum


def _lines(stars: Sequence[StarPsf], angles: Sequence[float]) -> list[str]:
    """Return the steps: those that all PSFs share once, the others of each."""
    from lnocl.psf.make import N_SHARED_STEPS

    if len(stars) == 1:
        return list(stars[0].steps)
    lines = list(stars[0].steps[:N_SHARED_STEPS])
    for j, (star, angle) in enumerate(zip(stars, angles, strict=True), 1):
        lines.append(f"PSF {j} of {len(stars)}, at {angle:g} degrees:")
        lines += star.steps[N_SHARED_STEPS:]
    return lines


def _cards(
    arguments: argparse.Namespace,
    stars: Sequence[StarPsf],
    frame_sum: str,
    mask_sum: str | None,
) -> list[Card]:
    """Return the cards that say what was done; a checksum leaves no room for a comment."""
    first = stars[0]
    saturation, angles = arguments.saturation, arguments.angles
    return [
        ("CREATOR", f"lnocl {__version__}", "program that wrote this file"),
        ("CENTREX", first.centre[0], "star's centre in the frame, x, 0-based"),
        ("CENTREY", first.centre[1], "star's centre in the frame, y, 0-based"),
        ("BKG", first.background, "background subtracted, unit of the frame"),
        ("NBAD", int(first.bad.sum()), "bad pixels of the frame"),
        *(
            []
            if saturation is None
            else [("SATURATE", saturation, "bad from here on, frame's unit")]
        ),
        ("RECENTRE", arguments.recentre, "centre shifted to the middle of a pixel"),
        ("CLIPPED", arguments.clip_negative, "negative pixels set to 0"),
        *((f"ANGLE{j}", angle, "rotated by, degrees") for j, angle in enumerate(angles, 1)),
        *(
            (f"FLUX{j}", star.flux, "set to 1, unit of the frame")
            for j, star in enumerate(stars, 1)
        ),
        ("ISUM1", frame_sum, ""),
        *([] if mask_sum is None else [("MSUM1", mask_sum, "")]),
    ]


def _repeating_command(arguments: argparse.Namespace) -> list[str]:
    """Return the words of the command that makes the same PSFs."""
    return [
        *("lnocl", "psf", as_path(arguments.frame)),
        *(word for x, y in arguments.stars for word in ("--star", f"{x!r},{y!r}")),
        *([] if arguments.mask is None else ["--mask", as_path(arguments.mask)]),
        *([] if arguments.saturation is None else ["--saturation", repr(arguments.saturation)]),
        *("--background", str(arguments.background)),
        *([] if arguments.recentre else ["--no-recentre"]),
        *("--rotate", *map(repr, arguments.angles)),
        *([] if arguments.size is None else ["--size", str(arguments.size)]),
        *(["--clip-negative"] if arguments.clip_negative else []),
        *("-o", as_path(arguments.output)),
    ]


def _draw(arguments: argparse.Namespace, stars: Sequence[StarPsf]) -> None:
    from lnocl.plotting.figure import save_figure
    from lnocl.plotting.psf import draw_star_psf

    first = stars[0]
    figure = draw_star_psf(
        first.frame - first.background,
        first.bad,
        first.centre,
        [star.psf for star in stars],
        arguments.angles,
    )
    save_figure(figure, arguments.plot, arguments.overwrite)


COMMAND = Command(
    "make a PSF, or one for each of several angles, from a frame of a star",
    _add_arguments,
    _run,
)
