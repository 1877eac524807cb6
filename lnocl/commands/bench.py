"""The command ``bench``: time and compare the ways to run, and advise on one."""

from __future__ import annotations

import argparse

from lnocl.commands import messages, options
from lnocl.commands.options import option
from lnocl.commands.parser import Command

OPTIONS = [
    options.IMAGES.but(nargs="*"),
    options.PSFS,
    options.BACKGROUND,
    options.READ_NOISE,
    options.STARS,
    option(
        "--n-iter",
        type=int,
        default=400,
        metavar="N",
        help="largest number of iterations, 8 or more; N/8, N/4 and N/2 are measured too "
        "(default: %(default)s)",
    ),
    option(
        "--mu",
        type=float,
        help="weight of the Tikhonov term on the extended source, per electron (default: 0; "
        "that of lnocl demo for its scene)",
    ),
    option(
        "--accuracy",
        type=float,
        default=1e-3,
        metavar="A",
        help="deviation from double precision that the advice may have, and excess of the "
        "objective over that of double precision that the table times (default: %(default)s)",
    ),
    option(
        "--size",
        type=int,
        metavar="N",
        help="pixels along each side of the demo's scene (default: 256)",
    ),
    options.DEVICE,
    option(
        "-o", "--output", metavar="STEM", help="write the table to STEM.ecsv, a plot to STEM.png"
    ),
    options.OVERWRITE.but(help="replace these files"),
    options.QUIET.but(help="show no progress"),
]


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.opencl import device
    from lnocl.studies import bench

    source = bench.choose_source(
        arguments.images,
        arguments.psfs,
        arguments.background,
        arguments.read_noise,
        arguments.stars,
        arguments.mu,
        arguments.size,
    )
    for line in bench.run(
        source,
        arguments.n_iter,
        arguments.accuracy,
        device.spec_of(device.choose(arguments.device).device),
        arguments.output,
        arguments.overwrite,
        progress=not arguments.quiet,
    ):
        messages.say([line])


COMMAND = Command(
    "time single and double precision, padding and iterations, measure how far each strays "
    "from double precision, and say which to take",
    {"": OPTIONS},
    _run,
    "Without IMAGE the demo's scene is taken, whose truth is known.",
)
