"""The command ``demo``: simulate, reconstruct and draw a jet and its star."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator

from lnocl.commands import deconvolve, simulate
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


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    from lnocl.core.opencl import device, trial
    from lnocl.studies import demo

    chosen = device.choose(arguments.device).device
    trial.check(chosen)  # before anything is written
    more = ["--overwrite"] if arguments.overwrite else []
    words = ["lnocl", "simulate", demo.SCENE, "--size", str(arguments.size), "-o"]
    words += [arguments.output, *more]
    found = simulate.write(_parse(simulate.COMMAND, words))
    yield shlex.join(words)
    for each in demo.commands(arguments.output, found):
        words = [*each, *more, "--device", device.spec_of(chosen)]
        yield shlex.join(words)
        yield from deconvolve.COMMAND.carry_out(_parse(deconvolve.COMMAND, words))
    yield from demo.compare(arguments.output, arguments.overwrite)


COMMAND = Command(
    "simulate a jet and its star, reconstruct them with and without the star as a component, "
    "and show the difference in a table and a picture",
    {"": OPTIONS},
    _run,
)
