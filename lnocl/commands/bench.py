"""The command ``bench``: time and compare the ways to run, and advise on one."""

from __future__ import annotations

import argparse

from lnocl.commands import messages
from lnocl.commands.arguments import Command, add_device, add_input_arguments, add_star


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Without IMAGE the demo's scene is taken, whose truth is known."
    add_input_arguments(parser, required=False)
    add_star(parser)
    parser.add_argument(
        "--mu",
        type=float,
        help="weight of the Tikhonov term on the extended source, per electron (default: 0; "
        "that of lnocl demo for its scene)",
    )
    parser.add_argument(
        "--size",
        type=int,
        metavar="N",
        help="pixels along each side of the demo's scene (default: 256)",
    )
    parser.add_argument(
        "--n-iter",
        type=int,
        default=400,
        metavar="N",
        help="most iterations, 8 or more; N/8, N/4 and N/2 are measured too (default: %(default)s)",
    )
    parser.add_argument(
        "--accuracy",
        type=float,
        default=1e-3,
        metavar="A",
        help="deviation from double precision that the advice may have, and excess of the "
        "objective over that of double precision that the table times (default: %(default)s)",
    )
    add_device(parser)
    parser.add_argument(
        "-o", "--output", metavar="STEM", help="write the table to STEM.ecsv, a plot to STEM.png"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace these files")
    parser.add_argument("--quiet", action="store_true", help="show no progress")


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
    _add_arguments,
    _run,
)
