"""The option ``--plot`` of several subcommands: a picture beside what they write."""

from __future__ import annotations

import argparse
import os

from lnocl.errors import InputError
from lnocl.io import atomic
from lnocl.plotting.figure import Figure, check_matplotlib, save_figure


def check(arguments: argparse.Namespace) -> None:
    """Check that the picture can be drawn and written, where one is asked for.

    Raises
    ------
    InputError
        Its name does not end in .png, or is that of the output or an input.
    FileError
        It exists and must not be overwritten, or cannot be written.
    LnoclError
        matplotlib is missing.
    """
    if arguments.plot is None:
        return
    if not arguments.plot.lower().endswith(".png"):
        raise InputError(
            f"the picture is a PNG file; give --plot a name ending in .png, not {arguments.plot}"
        )
    output = arguments.output
    if output is not None and os.path.realpath(arguments.plot) == os.path.realpath(output):
        raise InputError(f"the picture {arguments.plot} is the output too; give it another name")
    atomic.check_output(arguments.plot, arguments.overwrite)
    check_matplotlib()


def draw(arguments: argparse.Namespace, figure: Figure) -> str:
    """Write the picture, and return a line that names its file."""
    save_figure(figure, arguments.plot, arguments.overwrite)
    return f"drew {arguments.plot}"
