"""The command ``study``: simulate and reconstruct a grid of observations, and measure them."""

from __future__ import annotations

import argparse
import io
import os
from typing import TYPE_CHECKING, Any

from lnocl.commands import messages, options, pictures
from lnocl.commands.options import Option, option
from lnocl.commands.parser import Command
from lnocl.errors import FileError, InputError

if TYPE_CHECKING:
    from astropy.table import Table


def _axis(name: str, kind: Any, help: str, **keywords: Any) -> Option:
    flag = f"--{name.replace('_', '-')}"
    metavar = keywords.pop("metavar", "V")
    return option(flag, nargs="+", type=kind, metavar=metavar, help=help, **keywords)


AXES = [
    _axis("size", int, "pixels along each side (default: 256)"),
    _axis("contrast", float, "flux of the star in that of the jet (default: 1)"),
    _axis(
        "extended_magnitude",
        float,
        "magnitude of the jet, from which that of the star follows (default: 13)",
    ),
    _axis("strehl", float, "Strehl ratio (default: 0.7)"),
    _axis("n_images", int, "images, their baselines evenly over 180 degrees (default: 4)"),
    _axis("exposure", float, "exposure of each image, minutes (default: 30)"),
    _axis("psf_error", float, "relative error of the PSFs that are given (default: 0)"),
    _axis("position_error", float, "pixels by which the star's position is off (default: 0)"),
    _axis("method", str, "with the star as a component, mc-rl, or without, rl (default: mc-rl)"),
    _axis("solver", str, "sgp or sgm (default: sgp)"),
    _axis("stop", str, "as for lnocl deconvolve (default: held-out)"),
    _axis("smoothing", str, "as for lnocl deconvolve (default: auto)"),
    _axis("mu", float, "as for lnocl deconvolve (default: 0)"),
    _axis("n_iter", int, "largest number of iterations (default: 1000)"),
    _axis("seed", int, "of residual phases, noise and directions (default: 0)"),
    option(
        "--refine",
        nargs="+",
        choices=("no", "yes"),
        metavar="no|yes",
        help="whether the star's position is refined (default: no)",
    ),
]
OPTIONS = {
    "": [
        option(
            "-o",
            "--output",
            required=True,
            metavar="TABLE.ecsv",
            help="table of a row for each combination of values; rows that it has are not done "
            "again",
        ),
        options.PICTURE.but(help="picture of the errors along each axis"),
        options.OVERWRITE.but(help="begin the table anew; replace FILE.png"),
        options.PARALLEL.but(
            help="reconstructions at once: a number of processes, or current-scheduler, the "
            "workers of the scheduler of Dask that DASK_SCHEDULER_ADDRESS names (default: one "
            "after the other)"
        ),
        options.DEVICE,
        options.QUIET,
    ],
    "axes, each with one value or more": AXES,
}


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.io import atomic
    from lnocl.parallel import check_parallel
    from lnocl.runs.progress import make_bar
    from lnocl.studies import study

    check_parallel(arguments.parallel)
    path = arguments.output
    if not path.lower().endswith(".ecsv"):
        raise InputError(f"the table is ECSV; give it a name ending in .ecsv, not {path}")
    given = {each.name: getattr(arguments, each.name) for each in AXES}
    axes = {name: values for name, values in given.items() if values is not None}
    if "refine" in axes:
        axes["refine"] = [word == "yes" for word in axes["refine"]]
    cases = study.make_cases(axes)
    earlier = None if arguments.overwrite or not os.path.exists(path) else _read(path)
    atomic.check_output(path, overwrite=True)
    pictures.check(arguments, [])
    table = earlier
    n_before = 0 if earlier is None else len(earlier)
    with make_bar(len(cases), "case", not arguments.quiet) as bar:
        for table in study.run(
            cases, device=arguments.device, parallel=arguments.parallel, earlier=earlier
        ):
            _write(path, table)
            bar.update()
    if table is None:
        raise InputError("there is nothing to do")
    said = [f"{len(table) - n_before} cases done, {len(table)} in {path}"]
    if arguments.plot is not None:
        from lnocl.plotting.study import draw_study

        said.append(pictures.draw(arguments, draw_study(table, list(study.AXES))))
    if not arguments.quiet:
        messages.say(said)


def _read(path: str) -> Table:
    from astropy.table import Table

    from lnocl.studies import study

    try:
        table = Table.read(path, format="ascii.ecsv")
    except Exception as error:  # of its readers, which raise any
        raise FileError(f"{path} cannot be read as a table: {error}") from error
    if table.colnames != [*study.AXES, *study.MEASURES]:
        raise InputError(f"{path} is not a table of lnocl study: give another name, or --overwrite")
    return table


def _write(path: str, table: Table) -> None:
    from lnocl.io.atomic import write_text

    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    write_text(path, text.getvalue(), overwrite=True)


COMMAND = Command(
    "reconstruct a grid of simulated observations, and measure each against its truth",
    OPTIONS,
    _run,
)
