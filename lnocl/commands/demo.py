"""The command ``demo``: simulate, reconstruct and draw a jet and its star."""

from __future__ import annotations

import argparse

from lnocl.commands import messages, options
from lnocl.commands.options import option, output_folder
from lnocl.commands.parser import Command

OPTIONS = [
    *output_folder("images, results and pictures", default="lnocl_demo"),
    option(
        "--size",
        type=int,
        default=256,
        metavar="N",
        help="pixels along each side (default: %(default)s)",
    ),
    option(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="seed of residual phases and noise (default: %(default)s)",
    ),
    options.DEVICE,
]


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.opencl import device, trial
    from lnocl.studies import demo

    chosen = device.choose(arguments.device).device
    trial.check(chosen)  # before anything is written
    spec = device.spec_of(chosen)
    for line in demo.run(
        arguments.output, arguments.size, arguments.seed, spec, arguments.overwrite
    ):
        messages.say([line])


COMMAND = Command(
    "simulate a jet and its star, reconstruct them with and without the star as a component, "
    "and show the difference in a table and pictures",
    {"": OPTIONS},
    _run,
)
