"""The command ``demo``: simulate, reconstruct and draw a jet and its star."""

from __future__ import annotations

import argparse
import shlex

from lnocl.commands import deconvolve, messages, simulate
from lnocl.commands.declared import DEVICE
from lnocl.commands.options import option, output_folder
from lnocl.commands.parser import Command, Parser

OPTIONS = [
    *output_folder("images, results and pictures", default="lnocl_demo"),
    option(
        "--size",
        type=int,
        default=256,
        metavar="N",
        help="pixels along each side (default: %(default)s)",
    ),
    DEVICE,
]


def _parse(command: Command, words: list[str]) -> argparse.Namespace:
    parser = Parser(prog=shlex.join(words[:2]))
    command.add_arguments(parser)
    return parser.parse_args(words[2:])


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.opencl import device, trial
    from lnocl.studies import demo

    chosen = device.choose(arguments.device).device
    trial.check(chosen)  # before anything is written
    more = ["--overwrite"] if arguments.overwrite else []
    words = ["lnocl", "simulate", demo.SCENE, "--size", str(arguments.size), "-o"]
    words += [arguments.output, *more]
    found = simulate.write(_parse(simulate.COMMAND, words))
    messages.say([shlex.join(words)])
    for each in demo.commands(arguments.output, found):
        words = [*each, *more, "--device", device.spec_of(chosen)]
        messages.say([shlex.join(words)])
        deconvolve.COMMAND.run(_parse(deconvolve.COMMAND, words))
    for line in demo.compare(arguments.output, arguments.overwrite):
        messages.say([line])


COMMAND = Command(
    "simulate a jet and its star, reconstruct them with and without the star as a component, "
    "and show the difference in a table and a picture",
    {"": OPTIONS},
    _run,
)
