"""The command ``stars``: find the stars in an image, for ``lnocl deconvolve --stars``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from lnocl.commands import options, pictures
from lnocl.commands.declared import SATURATION
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.core.scene.arrays import Mask
from lnocl.errors import counted

if TYPE_CHECKING:
    from astropy.table import Table

OPTIONS = [
    option("image", metavar="IMAGE", is_input=True, help="FITS file with an image"),
    options.table_output("stars", metavar="STARS.ecsv", required=True),
    option(
        "--psf",
        metavar="PSF",
        is_input=True,
        help="FITS file with its PSF, which tells stars from side lobes and extended sources "
        "(default: a round one, as wide as the image's stars)",
    ),
    option(
        "--threshold",
        type=float,
        default=5.0,
        metavar="S",
        help="smallest significance of a star, in standard deviations (default: %(default)s)",
    ),
    option(
        "--mask",
        metavar="FILE",
        is_input=True,
        help="FITS file that is not 0 where a pixel is bad; or dq, the extension DQ of the image, "
        "or dq:16,64 where these flags are no fault, or wht, where its extension WHT is 0 "
        "(default: of JWST and HST what their files have); "
        "pixels that are NaN are bad too",
    ),
    SATURATION.but(help="pixels of this value and above are saturated, in the unit of the image"),
    options.PICTURE.but(help="picture of the image with the stars and their numbers"),
    options.OVERWRITE,
    *options.HOW_MUCH_IS_SAID,
]


def _run(arguments: argparse.Namespace) -> list[str]:
    from lnocl.detection import find_stars
    from lnocl.io import atomic, fitsread, sky, tables

    tables.format_of(arguments.output, "stars")
    atomic.check_output(arguments.output, arguments.overwrite)
    pictures.check(arguments)
    stack = fitsread.read_single(arguments.image)
    image = stack.data[0]
    psf = None if arguments.psf is None else fitsread.read_single(arguments.psf).data[0]
    mask, level = _mask(arguments), arguments.saturation
    stars = find_stars(image, psf, threshold=arguments.threshold, mask=mask, saturation=level)
    stars.add_column(np.arange(1, len(stars) + 1), name="star", index=0)
    if len(stars) and sky.has_celestial(stack.header):
        positions = np.array([stars["x"], stars["y"]]).T
        stars["ra"], stars["dec"] = sky.to_sky(positions, stack.header).T
        stars["ra"].unit = stars["dec"].unit = "deg"
    n_extended, n_sharp = stars.meta["n_extended"], stars.meta["n_sharp"]
    stars.meta = {"ORIGIN": "x and y begin at 0"}
    for name in ("x", "y"):
        stars[name].format, stars[name].unit = ".3f", "pix"
    for name in ("peak", "significance", "width"):
        stars[name].format = ".5g"
    tables.write_table(stars, arguments.output, "stars", arguments.overwrite)
    lines = [*_summary_lines(stars, n_extended, n_sharp), f"written to {arguments.output}"]
    if arguments.plot is not None:
        from lnocl.plotting.stars import draw_stars

        lines.append(pictures.draw(arguments, draw_stars(image, stars)))
    return lines


def _mask(arguments: argparse.Namespace) -> Mask | None:
    """Return which pixels are bad, by a file or an extension of the image; None without either."""
    from lnocl.io import fitsread, masks, missions

    word = arguments.mask or missions.mask_word(fitsread.read_contents(arguments.image))
    return masks.mask_of(arguments.image, word)[0] if word else None


def _summary_lines(stars: Table, n_extended: int, n_sharp: int) -> list[str]:
    """Return how many stars there are, how many sources were left out, and which are saturated."""
    n = len(stars)
    wider = f"{counted(n_extended, 'source')} wider than the PSF left out"
    sharper = (
        f"{counted(n_sharp, 'source')} sharper than the PSF left out, as cosmic rays and bad pixels"
    )
    left_out = [wider] * (n_extended > 0) + [sharper] * (n_sharp > 0)
    if not n:
        return [
            "no star is found: give --psf with the PSF of the image, or a lower --threshold, and "
            "look at the image",
            *left_out,
        ]
    saturated = [str(number) for number in stars["star"][stars["saturated"]]]
    lines = [
        f"{counted(n, 'star')} found, the brightest at ({stars['x'][0]:.2f}, {stars['y'][0]:.2f})",
        *left_out,
    ]
    if saturated:
        shown = ", ".join(saturated[:10]) + (", ..." if len(saturated) > 10 else "")
        lines.append(
            f"{counted(len(saturated), 'star')} saturated: {shown}; lnocl psf and lnocl deconvolve "
            "take their wings alone"
        )
    return lines


COMMAND = Command(
    "find the stars in an image: a table for lnocl deconvolve --stars, and a picture with numbers",
    {"": OPTIONS},
    _run,
    "Stars are found by a matched filter; photutils, which pip install photutils brings, finds the "
    "sky.",
)
