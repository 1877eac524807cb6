"""The command ``bench``: time and compare the ways to run, and advise on one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from lnocl.commands import options
from lnocl.commands.declared import BACKGROUND, DEVICE, READ_NOISE
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.errors import InputError

OF_IMAGES = options.PSFS, BACKGROUND, READ_NOISE, options.STARS
OPTIONS = [
    options.IMAGES.but(nargs="*"),
    *(each.but(needs=("images",)) for each in OF_IMAGES),
    option(
        "--n-iter",
        type=int,
        default=400,
        metavar="N",
        help="largest number of iterations, 8 or more; N/8, N/4 and N/2 are measured too "
        "(default: %(default)s)",
    ),
    option(
        "--accuracy",
        type=float,
        default=1e-3,
        metavar="A",
        help="deviation from double precision that the advice may have (default: %(default)s)",
    ),
    option(
        "--size",
        type=int,
        metavar="N",
        help="pixels along each side of the demo's scene (default: 256)",
    ),
    DEVICE,
    options.QUIET.but(dest="no_progress", help="show no progress"),
]


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    from lnocl.core.opencl import device
    from lnocl.io.calibration import Calibration
    from lnocl.io.frames import read_frames
    from lnocl.studies import bench

    images, psfs, size = arguments.images, arguments.psfs or [], arguments.size
    if images and not psfs:
        raise InputError("images need their PSFs: give --psf")
    if images and size is not None:
        raise InputError("--size is of the demo's scene, and images are given; leave one out")
    n_iter, accuracy = arguments.n_iter, arguments.accuracy
    bench.check(n_iter, accuracy)
    spec = device.spec_of(device.choose(arguments.device).device)
    if images:
        levels = arguments.background or [0.0], arguments.read_noise or [0.0]
        read = read_frames(images, psfs, Calibration(*levels))
        stars = options.star_places(arguments.stars, None, read.header, images[0])
        case = bench.Case(read.observation, stars)
    else:
        case = bench.simulated_case(256 if size is None else size)
    return bench.run(case, n_iter, accuracy, spec, not arguments.no_progress)


COMMAND = Command(
    "time single and double precision, padding and iterations, measure how far each strays "
    "from double precision, and say which to take",
    {"": OPTIONS},
    _run,
    "Without IMAGE the demo's scene is taken, whose truth is known.",
)
