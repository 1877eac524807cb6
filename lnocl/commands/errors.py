"""The command ``errors``: errors of a result that is there, by replicas of its run."""

from __future__ import annotations

import argparse
import contextlib
import os
from typing import TYPE_CHECKING

import numpy as np

from lnocl.commands import bootstrap, deconvolve, messages, options
from lnocl.commands.options import option
from lnocl.commands.parser import Command, Parser
from lnocl.errors import FileError, InputError, note
from lnocl.process import ignored_warnings

if TYPE_CHECKING:
    from lnocl.io.frames import Frames
    from lnocl.io.saved_results import SavedResult
    from lnocl.runs.bootstrap import Part

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
    option(
        "--bootstrap",
        type=int,
        default=50,
        metavar="N",
        help="replicas, each about as long as the run, for the errors of stars, regions and "
        "pixels; ten or more (default: %(default)s)",
    ),
    option(
        "--regions",
        metavar="FILE",
        is_input=True,
        help="circles, ellipses, boxes, annuli or polygons whose light is measured: a file such as "
        "DS9 writes, in pixels of the extended source or on the sky",
    ),
    option(
        "--profiles",
        metavar="FILE",
        is_input=True,
        help="boxes along whose longer sides light and width are measured, pixel by pixel: such a "
        "file; lnocl plot draws them with their errors",
    ),
    option(
        "--seed",
        type=int,
        default=0,
        metavar="S",
        help="of the replicas, 0 or more (default: %(default)s); the same seed gives the same "
        "errors",
    ),
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
    from lnocl.parallel import check_parallel
    from lnocl.runs.bootstrap import check_number

    check_parallel(arguments.parallel)
    check_number(arguments.bootstrap, arguments.seed)
    saved = read_result(arguments.result)
    atomic.check_fits_output(arguments.result, overwrite=True)
    if saved.header.get("STOPPED") == "interrupt":
        raise InputError(
            f"the run of {arguments.result} was interrupted, and its command gives another result: "
            "deconvolve to the end"
        )
    folder, run = _run_of(saved)
    run.quiet = arguments.quiet
    try:
        with contextlib.chdir(folder), ignored_warnings():  # which were shown once
            frames, given = deconvolve.read(run)
    except (FileNotFoundError, NotADirectoryError, PermissionError) as error:
        raise FileError(
            f"{folder}, where {arguments.result} was made, is not there: deconvolve again"
        ) from error
    if run.tile is not None or frames.observation.psf_fields:
        raise InputError(
            f"{arguments.result} was made in tiles, and replicas are of one run: deconvolve a "
            "cut-out without tiles"
        )
    with messages.shown_log(run.quiet, COMMAND.flags()):
        parts = _parts(arguments, frames)
        if not arguments.overwrite:
            bootstrap.check_earlier(arguments.result, arguments.seed, parts)
    with messages.shown_log(run.quiet, name=messages.PROGRESS), ignored_warnings():
        found = deconvolve.solve(run, frames, given)
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
        lines = bootstrap.add_errors(arguments, found, frames, parts)
    if not arguments.quiet:
        messages.say([*lines, f"added to {arguments.result}"])


def _parts(arguments: argparse.Namespace, frames: Frames) -> list[Part]:
    """Return the regions and profiles that were given."""
    if arguments.regions is None and arguments.profiles is None:
        return []
    from lnocl.io.fitsread import sky_header
    from lnocl.io.regions import read_apertures, read_profiles

    oversample = frames.observation.oversample
    if oversample > 1:
        note(
            "`regions` in pixels are in those of the extended source, %d to one of the images",
            oversample,
        )
    where = sky_header(frames.header, oversample), frames.observation.sky_shape
    apertures = [] if arguments.regions is None else read_apertures(arguments.regions, *where)
    profiles = [] if arguments.profiles is None else read_profiles(arguments.profiles, *where)
    return [*apertures, *profiles]


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
