"""The command ``batch``: deconvolve each row of a table, and sum up what became of them."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import math
import os
import shlex
import socket
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from contextvars import copy_context
from functools import partial
from typing import TYPE_CHECKING, Any

from lnocl.commands import deconvolve, environment, options, pictures, running
from lnocl.commands.options import option
from lnocl.commands.parser import Command
from lnocl.commands.signals import Terminated
from lnocl.commands.targets import Target, read_targets
from lnocl.errors import FileError, InputError, LnoclError, counted
from lnocl.io import atomic
from lnocl.parallel import Parallel, check_parallel, work
from lnocl.progress import HIDDEN, Progress
from lnocl.residuals import MUCH_HALO
from lnocl.result.verdict import FITS

if TYPE_CHECKING:
    from astropy.table import Table

SUMMARY = "summary.ecsv"
# Lines of the table that is shown; the summary has all.
MAX_ROWS = 40

WAITING, STARTED, DONE, FAILED = "waiting", "started", "done", "failed"


def _part(text: str) -> tuple[int, int]:
    """Return the numbers of ``I/N``.

    Raises
    ------
    argparse.ArgumentTypeError
        A text that is not two whole numbers, 1 <= I <= N.
    """
    try:
        i, n = map(int, text.split("/"))
    except ValueError:
        i, n = 0, 0
    if not 1 <= i <= n:
        raise argparse.ArgumentTypeError(f"{text!r} is not I/N with 1 <= I <= N")
    return i, n


OPTIONS = [
    option(
        "targets",
        metavar="TARGETS",
        is_input=True,
        help="table, .ecsv, .csv or .fits, with a row a target; its columns are named as the "
        "options of lnocl deconvolve (images, psf, star, background, ...), and name, that of the "
        "outputs; several values are separated by blanks",
    ),
    option(
        "-o",
        "--output",
        required=True,
        metavar="DIR",
        help=f"folder for NAME.fits, NAME.log and NAME.json of each target, and {SUMMARY}; "
        "targets that are done there with the same row are not done again",
    ),
    options.OVERWRITE.but(help="do all targets anew, and replace files in DIR"),
    options.parallel("targets"),
    option(
        "--array",
        type=_part,
        metavar="I/N",
        help="do each N-th target from the I-th, counted from 1: for job arrays",
    ),
    options.PICTURE.but(help="picture of the extended source of each target that is done"),
    options.QUIET,
]


@dataclasses.dataclass(frozen=True)
class Record:
    """What became of a target: a row of the summary, and its file NAME.json.

    The star is the first of the row; of more, and of their fits, its file has a table.
    """

    name: str
    status: str
    message: str = ""
    n_iter: int = 0
    stopped: str = ""
    star_flux: float = math.nan
    star_flux_error: float = math.nan
    star_halo: float = math.nan
    extended_flux: float = math.nan
    extended_flux_error: float = math.nan
    unit: str = ""
    residual_rms: float = math.nan
    verdict: str = ""
    warnings: int = 0
    seconds: float = 0.0
    device: str = ""
    process: str = ""
    command: str = ""
    folder: str = ""


@dataclasses.dataclass(frozen=True)
class Folder:
    """The folder of the outputs, and that in which commands are run."""

    path: str
    start: str

    def file(self, name: str, ending: str) -> str:
        """Return the path of an output of a target."""
        return os.path.join(self.path, name + ending)

    def read(self, name: str) -> Record | None:
        """Return the record of a target, where it has one."""
        try:
            with open(self.file(name, ".json"), encoding="utf-8") as file:
                return Record(**json.load(file))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError) as error:
            raise FileError(
                f"{self.file(name, '.json')} is no record of a target: {error}; remove it"
            ) from error

    def write(self, record: Record) -> None:
        """Write the record of a target."""
        text = json.dumps(dataclasses.asdict(record), indent=1)
        atomic.write_text(self.file(record.name, ".json"), text + "\n", overwrite=True)

    def new(self, target: Target, status: str, message: str = "") -> Record:
        """Return a record for the command of a target's row."""
        return Record(target.name, status, message, command=target.command, folder=self.start)

    def state(self, target: Target) -> Record:
        """Return the record of a target for the command of its row.

        That is its record; that it fails, where its outputs are of something else; or that it is
        waiting.
        """
        if target.fault:
            return self.new(target, FAILED, target.fault)
        new, record = self.new(target, WAITING), self.read(target.name)
        there = [e for e in (".fits", ".log") if os.path.exists(self.file(target.name, e))]
        if record and (record.command, record.folder) == (new.command, new.folder):
            return new if record.status == DONE and ".fits" not in there else record
        if not there or (record and ".fits" not in there):
            return new
        of = "is of another command" if record else "exists"
        output = self.file(target.name, there[0])
        return self.new(target, FAILED, f"{output} {of}; give another name, or --overwrite")


def _make_worker(folder: Folder) -> Callable[[Target], Record]:
    """Return the function of a target."""
    environment.prepare()
    return partial(_do, folder)


def _do(folder: Folder, target: Target) -> Record:
    """Deconvolve a target, with its log and its record; return that."""
    process = f"{socket.gethostname()}:{os.getpid()}"
    new = dataclasses.replace(folder.new(target, STARTED), process=process)
    folder.write(new)
    output, log = folder.file(target.name, ".fits"), io.StringIO()
    words = ["deconvolve", *target.words, "-o", output, "--overwrite"]
    begun = time.perf_counter()
    with (
        contextlib.chdir(folder.start),
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        try:
            context = copy_context()
            context.run(HIDDEN.set, True)
            status = context.run(running.run, {"deconvolve": deconvolve.COMMAND}, words)
        except Exception as error:  # which stops no other target
            status = 1
            log.write(f"{traceback.format_exc()}lnocl: error: {type(error).__name__}: {error}\n")
    if status == running.INTERRUPTED:
        raise KeyboardInterrupt
    if status > 128:
        raise Terminated(status - 128)
    record = dataclasses.replace(
        new,
        status=FAILED if status else DONE,
        seconds=round(time.perf_counter() - begun, 3),
        **_found(log.getvalue(), output, status),
    )
    text = f"$ cd {shlex.quote(record.folder)}; {record.command}\n{log.getvalue()}"
    atomic.write_text(folder.file(record.name, ".log"), text, overwrite=True)
    folder.write(record)
    return record


def _found(log: str, output: str, status: int) -> dict[str, Any]:
    """Return the fields of the record that the outcome gives."""
    lines = log.splitlines()
    errors = [line.partition("error: ")[2] for line in lines if line.startswith("lnocl: error: ")]
    warnings = sum(line.startswith("lnocl: warning: ") for line in lines)
    if status:
        return {"message": errors[-1] if errors else f"exit status {status}", "warnings": warnings}
    from astropy.io import fits

    with fits.open(output) as hdus:
        header, stars = hdus[0].header, hdus["STARS"].data
        of_star = {
            f"star_{name}": float(stars[name][0])
            for name in ("flux", "flux_error", "halo")
            if len(stars)
        }
    return {
        "n_iter": header["NITER"],
        "stopped": header["STOPPED"],
        **of_star,
        "extended_flux": header.get("EXTFLUX", math.nan),
        "extended_flux_error": header.get("EXTERROR", math.nan),
        "unit": header["BUNIT"],
        "residual_rms": header.get("RESIDRMS", math.nan),
        "verdict": header["VERDICT"],
        "device": header["DEVICE"],
        "warnings": warnings,
    }


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    check_parallel(arguments.parallel)
    targets = read_targets(arguments.targets)
    atomic.check_folder(arguments.output, overwrite=True)
    folder = Folder(os.path.abspath(arguments.output), os.getcwd())
    with atomic.kept(path for each in targets for path in each.inputs):
        atomic.check_output(os.path.join(folder.path, SUMMARY), True)
        pictures.check(arguments)
        targets = [_apart(each, folder) for each in targets]
    i, n = arguments.array or (1, 1)
    own = targets[i - 1 :: n]
    before = [folder.state(each) for each in own]
    n_old = sum(record.status == DONE for record in before)
    if arguments.overwrite:
        due, n_old = [each for each in own if not each.fault], 0
    else:
        # What has failed by its own command is tried again.
        due = [
            each
            for each, record in zip(own, before, strict=True)
            if record.status != DONE and (record.status != FAILED or record.process)
        ]
    with (
        running.written_as_done(partial(_write_summary, folder, targets)) as write_where_due,
        Progress(len(due), "target", not arguments.quiet) as bar,
    ):
        for record in _records(folder, due, arguments.parallel):
            bar.update(words=f"{record.name} {record.status}")
            write_where_due()
    summary = _summary(folder, targets)
    yield from _summarise(summary, n_old, folder)
    if arguments.plot is not None:
        from lnocl.plotting.batch import draw_batch

        done = [name for name, status in summary.iterrows("name", "status") if status == DONE]
        drawn = draw_batch({name: folder.file(name, ".fits") for name in done})
        yield pictures.draw(arguments, drawn)
    _explain_failures(summary, own)


def _apart(target: Target, folder: Folder) -> Target:
    """Return a target; one whose files would replace an input of any fails."""
    try:
        for ending in (".fits", ".log", ".json"):
            atomic.refuse_input(folder.file(target.name, ending))
    except InputError as error:
        return target._replace(fault=target.fault or error.message)
    return target


def _records(folder: Folder, targets: Sequence[Target], parallel: Parallel) -> Iterator[Record]:
    """Yield the record of each target as it is done."""
    if not targets:
        return
    make = partial(_make_worker, folder)

    def give_up(target: Target, why: str) -> Record:
        record = folder.state(target)
        record = dataclasses.replace(record, status=FAILED, message=why, process="lost")
        folder.write(record)
        return record

    with closing(work(make, targets, parallel, give_up)) as records:
        yield from records


def _summary(folder: Folder, targets: Sequence[Target]) -> Table:
    """Return what became of all targets, those of other processes too."""
    from astropy.table import Table

    records = [folder.state(each) for each in targets]
    summary = Table([dataclasses.asdict(each) for each in records])
    summary["seconds"].unit = "s"
    return summary


def _write_summary(folder: Folder, targets: Sequence[Target]) -> None:
    from lnocl.io.tables import write_table

    write_table(_summary(folder, targets), folder.file(SUMMARY, ""), "targets", True)


def _summarise(summary: Table, n_old: int, folder: Folder) -> list[str]:
    """Return the lines that sum up the targets."""
    statuses = summary["status"].tolist()
    counts = ", ".join(
        f"{statuses.count(each)} {each}"
        for each in (DONE, FAILED, STARTED, WAITING)
        if each in statuses
    )
    before = f" ({n_old} of them before)" if n_old else ""
    verdicts = [verdict for verdict in summary["verdict"].tolist() if verdict]
    n_faults = sum(not verdict.startswith(FITS) for verdict in verdicts)
    faults = [
        f"in {n_faults} of the {len(verdicts)} that are done the model has faults, which the "
        "column verdict says"
    ]
    n_lit = int((summary["star_halo"] > MUCH_HALO).sum())
    halos = [
        f"in {counted(n_lit, 'target')} light lies all round the star, star_halo times its flux, "
        "and its error does not hold"
    ]
    return [
        *_rows(summary),
        f"{counted(len(summary), 'target')}: {counts}{before}",
        *(faults if n_faults else []),
        *(halos if n_lit else []),
        f"written to {os.path.join(folder.path, SUMMARY)}",
    ]


def _rows(summary: Table) -> list[str]:
    """Return the fluxes of the targets that are done as a table in text."""
    done = summary[summary["status"] == DONE]
    if not done:
        return []
    shown = done["name", "star_flux", "star_halo", "extended_flux", "unit"]
    for name, after in (("star_flux", 2), ("extended_flux", 5)):
        shown[name].info.format = ".6g"
        errors = done[f"{name}_error"]
        errors.info.format = ".2g"
        shown.add_column(errors, after)
    shown["star_halo"].info.format = ".2f"
    shown["model"] = [
        "fits" if verdict.startswith(FITS) else "has faults" for verdict in done["verdict"]
    ]
    lines: list[str] = shown.pformat(max_lines=MAX_ROWS, max_width=-1, show_unit=False)
    return lines


def _explain_failures(summary: Table, own: Sequence[Target]) -> None:
    """Raise an error where targets of this process have failed."""
    names = {each.name for each in own}
    failed = [row for row in summary if row["status"] == FAILED and row["name"] in names]
    if failed:
        raise LnoclError(
            f"{counted(len(failed), 'target')} of {len(own)} failed, the first, "
            f"{failed[0]['name']}: {failed[0]['message']}"
        )


COMMAND = Command(
    "deconvolve many targets, each a row of a table, and sum up what became of them",
    {"": OPTIONS},
    _run,
    goes_on=": the same command goes on with the targets that are left",
)
