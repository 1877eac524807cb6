"""The command ``errors``: errors of a result that is there, by replicas of its run."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
from typing import TYPE_CHECKING

import numpy as np

from lnocl.commands import bootstrap, checkpoints, deconvolve, messages, options
from lnocl.commands.options import option
from lnocl.commands.parser import Command, Parser
from lnocl.commands.signals import Terminated
from lnocl.errors import FileError, InputError
from lnocl.process import ignored_warnings

if TYPE_CHECKING:
    from lnocl.io.saved_results import SavedResult

# The run is taken for the same where pixels and fluxes are to this share of them, and pixels to
# this share of the brightest: another device rounds otherwise.
SAME, ROUNDING = 1e-3, 1e-5

OPTIONS = [
    option(
        "result",
        metavar="RESULT.fits",
        is_input=True,
        help="file that lnocl deconvolve has written; its errors are added to it, after those of "
        "replicas that it has",
    ),
    *bootstrap.OPTIONS,
    options.PARALLEL.but(
        help="replicas at once: a number of processes, or current-scheduler, the workers of the "
        "scheduler of Dask that DASK_SCHEDULER_ADDRESS names (default: one after the other)"
    ),
    options.OVERWRITE.but(help="begin anew, without the replicas that RESULT.fits has"),
    options.QUIET,
]


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.io import atomic
    from lnocl.io.saved_results import read_result

    saved = read_result(arguments.result)
    atomic.check_fits_output(arguments.result, overwrite=True)
    if saved.header.get("STOPPED") == "interrupt":
        raise InputError(
            f"the run of {arguments.result} was interrupted, and its command gives another result: "
            "deconvolve to the end"
        )
    folder, run = _run_of(saved)
    given = {name: getattr(arguments, name) for name in ("bootstrap", "seed")}
    for name, value in given.items():
        setattr(run, name, getattr(run, name) if value is None else value)
    for name in ("regions", "profiles"):
        if getattr(arguments, name) is not None:
            setattr(run, name, os.path.abspath(getattr(arguments, name)))
    run.bootstrap = bootstrap.DEFAULT if run.bootstrap is None else run.bootstrap
    run.parallel = arguments.parallel
    run.quiet, path = arguments.quiet, os.path.abspath(arguments.result)
    bootstrap.check(run)
    try:
        there = contextlib.chdir(folder)
        # What the run has to say it has lines.
        progress = messages.shown_log(run.quiet, name=messages.PROGRESS)
        with there, progress, ignored_warnings(), checkpoints.Interrupts() as interrupts:
            solved = deconvolve.solve(run, interrupts)
    except (FileNotFoundError, NotADirectoryError, PermissionError) as error:
        raise FileError(
            f"{folder}, where {arguments.result} was made, is not there: deconvolve again"
        ) from error
    if interrupts.caught:
        raise (
            KeyboardInterrupt
            if interrupts.caught == signal.SIGINT
            else Terminated(interrupts.caught)
        )
    found, frames = solved.result, solved.frames
    expected = saved.extended * frames.electrons
    fluxes = saved.star_fluxes * frames.electrons
    if (
        found.extended.shape != expected.shape
        or not np.allclose(found.extended, expected, SAME, ROUNDING * abs(expected).max())
        or not np.allclose(found.star_fluxes, fluxes, SAME)
    ):
        raise InputError(
            f"the run of {arguments.result} gives another result now: its images, PSFs or options "
            "have changed; deconvolve again"
        )
    with messages.shown_log(run.quiet, name=messages.PROGRESS):
        lines = bootstrap.add_errors(
            run, found, frames, solved.parts, path, not arguments.overwrite
        )
    if not arguments.quiet:
        messages.say([*lines, f"added to {arguments.result}"])


def _run_of(saved: SavedResult) -> tuple[str, argparse.Namespace]:
    """Return the folder that a result was made in, and the arguments of its run."""
    parser = Parser(prog="lnocl")
    deconvolve.COMMAND.add_arguments(parser)
    lines = saved.command_words()
    folder = next((words[1] for words in lines if words[:1] == ["cd"]), os.curdir)
    words = next((words for words in lines if words[:2] == ["lnocl", "deconvolve"]), None)
    if words is None:
        raise InputError(
            f"{saved.path} has no command of lnocl deconvolve in its header; in Python, "
            "Result.bootstrap gives errors"
        )
    return folder, parser.parse_args(words[2:])


COMMAND = Command(
    "add errors of stars, regions and pixels to a result, by replicas of its run",
    {"": OPTIONS},
    _run,
)
