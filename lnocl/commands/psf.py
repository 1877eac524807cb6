"""The command ``psf``: make PSFs from a frame of stars, and report each step; or check a PSF."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lnocl.commands import options, pictures, record
from lnocl.commands.declared import SATURATION
from lnocl.commands.options import option, or_word
from lnocl.commands.parser import Command
from lnocl.errors import InputError, counted, in_words

if TYPE_CHECKING:
    from astropy.io import fits

    from lnocl.io.fitswrite import Card
    from lnocl.psf.make import StarPsf

# A star that is left out lies so near to its place, pixels.
NEAR = 5
# Rows of a picture that can still be looked at.
MAX_DRAWN = 16


OPTIONS = [
    option(
        "frames",
        nargs="+",
        metavar="FRAME",
        checksum="ISUM",
        help="FITS file with an image of stars, in any linear unit, or several with a star each, "
        "whose effective PSF is made; with --check, with a PSF or a cube of them",
    ),
    option("-o", "--output", metavar="PSF.fits", help="FITS file for the PSF or PSFs"),
    option(
        "--check",
        action="store_true",
        is_repeated=False,
        help="make nothing: say where the centre of a PSF is, how wide it is, and what lies in its "
        "wings",
    ),
    options.STARS.but(
        dest="position",
        help="position of the star to a few pixels, 0-based, x along columns, or on the sky, as "
        "in 65d,19.5d (default: the brightest pixel that is not a single hot one); several give "
        "the PSF that they share",
    ),
    options.STAR_TABLE,
    options.STARS.but(
        "--without",
        needs=("star_table",),
        dest="without",
        help="position of a star of --stars that is not taken, such as your target with what "
        "surrounds it; may be repeated",
    ),
    option(
        "--modes",
        type=int,
        metavar="N",
        card=("NMODES", "ways in which the PSFs differ"),
        help="FRAME is a cube of frames of a star: make the mean of their PSFs, with extensions "
        "MODES, the N ways in which they differ most, one standard deviation each, and SCATTER, "
        "the standard deviation of each pixel",
    ),
    option(
        "--size",
        type=int,
        metavar="K",
        help="side of the PSF in pixels, whose centre is (K // 2, K // 2) (default: the largest "
        "that fits round the star)",
    ),
    option(
        "--background",
        type=partial(or_word, float),
        default="auto",
        metavar="VALUE",
        card=("BKG", "background subtracted, unit of the frame"),
        help="background to subtract, in the unit of the frame; or auto, measured around the "
        "crop, or at the frame's border where no size is given (default: %(default)s)",
    ),
    option(
        "--mask",
        metavar="FILE",
        checksum="MSUM",
        help="FITS file of the frame's shape, not 0 where a pixel is bad, or dq or wht, extensions "
        "of FRAME, as in lnocl deconvolve; bad pixels are interpolated, and so are those that are "
        "NaN in the frame",
    ),
    SATURATION.but(help="pixels of this value and above, in the unit of the frame, are bad too"),
    option(
        "--rotate",
        nargs="+",
        type=float,
        default=[0.0],
        metavar="DEG",
        card=("ANGLE", "rotated by, degrees"),
        help="rotate by this angle from the x axis towards the y axis; several give a cube with "
        "a PSF for each, so 0 45 90 135 mimics four baselines (default: 0)",
    ),
    option(
        "--no-recentre",
        action="store_false",
        dest="recentre",
        card=("RECENTRE", "centre shifted to the middle of a pixel"),
        help="leave pixels as they are; otherwise the star's centre is found and shifted to the "
        "middle of a pixel",
    ),
    option(
        "--clip-negative",
        action="store_true",
        card=("CLIPPED", "negative pixels set to 0"),
        help="set negative pixels of the PSF to 0",
    ),
    options.PICTURE.but(help="picture of frame, PSFs and profiles"),
    options.OVERWRITE,
    *options.HOW_MUCH_IS_SAID,
]


def _run(arguments: argparse.Namespace) -> list[str]:
    if arguments.check:
        return _report(arguments)
    _check_outputs(arguments)
    if arguments.modes is not None:
        return _make_modes(arguments)

    from lnocl import psf
    from lnocl.io import fitsread
    from lnocl.io.masks import mask_of

    sha256: dict[str, list[str]] = {}
    mask = None
    stack = fitsread.read_single(arguments.frames[0])
    frame, sha256["frames"], background = stack.data[0], stack.sha256, arguments.background
    positions = _positions(arguments, stack.header)
    if arguments.mask is not None:
        mask, sha256["mask"] = mask_of(arguments.frames[0], arguments.mask)
    if len(arguments.frames) > 1:
        frame, positions, sha256["frames"] = _joined(arguments)
        background = 0.0
    stars = psf.make_psfs(
        frame,
        arguments.rotate,
        position=positions,
        background=background,
        mask=mask,
        **_parameters(arguments),
    )
    lines = _lines(stars, arguments.rotate)
    if len(arguments.frames) > 1:
        lines.insert(0, f"{len(arguments.frames)} frames: their stars are laid side by side")
    others = {"SCATTER": _squeezed([star.scatter for star in stars])}
    psfs = _squeezed([star.psf for star in stars])
    used = {"background": stars[0].background}
    _write(arguments, psfs, others, sha256, lines, used, _result_cards(stars))
    k = psfs.shape[-1]
    made = counted(len(stars), "PSF") if len(stars) > 1 else "a PSF"
    lines.append(
        f"written to {arguments.output}: {made} of {k} x {k} pixels, the star's centre at "
        f"({k // 2}, {k // 2})"
    )
    if arguments.plot is not None:
        from lnocl.plotting.psf import draw_star_psf

        star, each = stars[0], [star.psf for star in stars]
        light = star.frame - star.background
        drawn = draw_star_psf(light, star.bad, star.centres, each, arguments.rotate)
        lines.append(pictures.draw(arguments, drawn))
    return lines


def _parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of all functions that make PSFs."""
    names = "size", "saturation", "recentre", "clip_negative"
    return {name: getattr(arguments, name) for name in names}


def _write(
    arguments: argparse.Namespace,
    image: NDArray[np.float64],
    others: Mapping[str, NDArray[np.float64]],
    sha256: Mapping[str, Sequence[str]],
    lines: Sequence[str],
    used: Mapping[str, Any] = MappingProxyType({}),
    results: Sequence[Card] = (),
) -> None:
    """Write PSFs with the lines said of them, and the command that makes them again."""
    from lnocl.io import fitswrite

    given = vars(arguments)
    fitswrite.write_image(
        arguments.output,
        image,
        cards=record.make_cards(OPTIONS, {**given, **used}, sha256, results),
        overwrite=arguments.overwrite,
        notes=lines,
        commands=record.make_commands("psf", OPTIONS, given, os.getcwd()),
        others=others,
    )


def _joined(
    arguments: argparse.Namespace,
) -> tuple[NDArray[np.float64], list[tuple[float, float]], list[str]]:
    """Return the stars of several frames side by side, their places and the files' checksums."""
    from lnocl.io import fitsread
    from lnocl.psf import effective

    if arguments.position or arguments.star_table or arguments.mask or not arguments.recentre:
        raise InputError(
            "of several frames the brightest star of each is taken, and centred; leave --star, "
            "--stars, --mask and --no-recentre out (bad pixels may be NaN)"
        )
    if arguments.background != "auto":
        raise InputError("several frames have a background each; leave --background auto")
    stacks = [fitsread.read_single(path) for path in arguments.frames]
    frames = [stack.data[0] for stack in stacks]
    level = np.inf if arguments.saturation is None else arguments.saturation
    bad = [~np.isfinite(frame) | (frame >= level) for frame in frames]
    return *effective.join(frames, bad), [sha for stack in stacks for sha in stack.sha256]


def _make_modes(arguments: argparse.Namespace) -> list[str]:
    """Make the mean of the PSFs of several frames, and say how they differ."""
    if arguments.plot is not None or len(arguments.rotate) > 1 or arguments.mask is not None:
        raise InputError(
            "--modes makes one PSF of all frames; leave --plot, --rotate and --mask out"
        )

    from lnocl import psf
    from lnocl.io import fitsread

    stack = fitsread.read_stack(arguments.frames)
    positions = _positions(arguments, stack.header)
    stars = [
        psf.make_psf(
            frame,
            rotate=arguments.rotate[0],
            position=positions,
            background=arguments.background,
            **_parameters(arguments),
        )
        for frame in stack.data
    ]
    sizes = sorted({len(star.psf) for star in stars})
    if len(sizes) > 1:
        raise InputError(
            f"the PSFs of the frames would have {sizes[0]} to {sizes[-1]} pixels; give --size "
            f"{sizes[0]} or less"
        )
    found = psf.find_modes([star.psf for star in stars], arguments.modes)
    lines = [
        f"frame {j}: the star at ({star.centre[0]:.2f}, {star.centre[1]:.2f}), flux {star.flux:.6g}"
        for j, star in enumerate(stars, 1)
    ]
    scatter = np.linalg.norm(found.scatter) / np.linalg.norm(found.mean)
    lines.append(
        f"the PSFs differ from their mean by {100 * scatter:.2g} %; "
        f"{counted(arguments.modes, 'mode')} of {100 * found.share:.3g} % of that variance"
    )
    others = {"MODES": found.modes, "SCATTER": found.scatter}
    _write(arguments, found.mean, others, {"frames": stack.sha256}, lines)
    k = len(found.mean)
    lines.append(
        f"written to {arguments.output}: the mean of {len(stars)} PSFs of {k} x {k} pixels"
    )
    return lines


def _positions(
    arguments: argparse.Namespace, header: fits.Header
) -> list[tuple[float, float]] | None:
    """Return the positions of the stars that are given, by --star and --stars."""
    image = arguments.frames[0]
    places = options.star_places(arguments.position, arguments.star_table, header, image)
    for place in options.star_places(arguments.without, None, header, image):
        away = [math.dist(place, star) for star in places]
        if min(away, default=math.inf) > NEAR:
            raise InputError(
                f"{arguments.star_table} has no star within {NEAR} pixels of {in_words(place)}, "
                "which --without names: see its places, or leave that out"
            )
        del places[int(np.argmin(away))]
    if arguments.without and not places:
        raise InputError("--without leaves no star: give other stars")
    return places or None


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Check the arguments that need no frame, before it is read."""
    from lnocl.io import atomic

    if arguments.output is None:
        raise InputError("give -o PSF.fits for the PSF, or --check to look at one")
    atomic.check_fits_output(arguments.output, arguments.overwrite)
    if arguments.plot is not None and len(arguments.rotate) > MAX_DRAWN:
        raise InputError(
            f"--plot draws {MAX_DRAWN} PSFs at most, and {len(arguments.rotate)} angles were given"
        )
    pictures.check(arguments)


def _report(arguments: argparse.Namespace) -> list[str]:
    """Say how each PSF of a file looks by itself, and what speaks against it."""
    from lnocl.io import fitsread, sky
    from lnocl.psf.report import examine

    for each in OPTIONS:
        is_given = each.words(vars(arguments)[each.name]) != each.words(each.default)
        if each.name not in ("frames", "check") and is_given:
            raise InputError(f"--check makes nothing; leave {each.flags[0]} out")
    stack = fitsread.read_stack(arguments.frames)
    scale, finer = sky.pixel_scale(stack.headers[0]), sky.oversampling(stack.headers[0])
    lines = [f"pixels: {scale:.4g} arcsec, by its header"] if scale else []
    if finer:
        lines.append(f"its header has OVERSAMP {finer:g}: bin it to pixels of the detector")
    for j, report in enumerate(map(examine, stack.data), 1):
        lines += [f"PSF {j} of {len(stack.data)}:"] * (len(stack.data) > 1)
        lines += [*report.lines(), *(report.faults() or ["nothing speaks against it by itself"])]
    return lines


def _squeezed(images: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return a cube, or the one image in it."""
    return np.array(images) if len(images) > 1 else images[0]


def _lines(stars: Sequence[StarPsf], angles: Sequence[float]) -> list[str]:
    """Return the steps: those that all PSFs share once, the others of each."""
    if len(stars) == 1:
        return list(stars[0].steps)
    lines = list(stars[0].shared_steps)
    for j, (star, angle) in enumerate(zip(stars, angles, strict=True), 1):
        lines.append(f"PSF {j} of {len(stars)}, at {angle:g} degrees:")
        lines += star.own_steps
    return lines


def _result_cards(stars: Sequence[StarPsf]) -> list[Card]:
    first = stars[0]
    return [
        ("CENTREX", first.centre[0], "star's centre in the frame, x, 0-based"),
        ("CENTREY", first.centre[1], "star's centre in the frame, y, 0-based"),
        ("NSTARS", len(first.centres), "stars that the PSF is made of"),
        ("PSFERROR", first.error, "standard error of the width of the PSF over it"),
        ("NBAD", int(first.bad.sum()), "bad pixels of the frame"),
        *(
            (f"FLUX{j}", star.flux, "set to 1, unit of the frame")
            for j, star in enumerate(stars, 1)
        ),
    ]


COMMAND = Command(
    "make a PSF, or one for each of several angles, from a frame of stars; or check one",
    {"": OPTIONS},
    _run,
    "The PSFs have unit sum and are for lnocl deconvolve --psf. An extension SCATTER has the "
    "standard deviation of their pixels, by noise and by how stars differ, which lnocl deconvolve "
    "reads with them unless --psf-error is 0. The background is subtracted and "
    "the star centred unless you say otherwise; the other steps are done only if you ask for them.",
)
