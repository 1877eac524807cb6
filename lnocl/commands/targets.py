"""Tables of targets: a row is a command line of ``lnocl deconvolve``."""

from __future__ import annotations

import os
import shlex
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lnocl.commands import deconvolve
from lnocl.commands.options import EITHER, SWITCHES, Option
from lnocl.errors import FileError, InputError
from lnocl.io.names import file_of

if TYPE_CHECKING:
    from astropy.table import Row, Table

NAME = "name"
# What the batch gives itself.
OWN = ("output", "overwrite", "quiet", "resume", "checkpoint", "parallel")
# Bytes of a name that file systems take, but for an ending.
MAX_NAME = 255 - len(".fits")
YES, NO = ("true", "yes", "1"), ("false", "no", "0", "")


class Target(NamedTuple):
    """A row of a table of targets.

    Attributes
    ----------
    name : str
        Its outputs are called so.
    words : tuple of str
        The command line but for its output.
    inputs : tuple of str
        The files that it reads.
    fault : str
        Why there is no command line; else empty.
    """

    name: str
    words: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    fault: str = ""

    @property
    def command(self) -> str:
        """What would be typed for it, but for the output."""
        return shlex.join(["lnocl", "deconvolve", *self.words])


def read_targets(path: str) -> list[Target]:
    """Return the targets of a table, in its order.

    Parameters
    ----------
    path : str
        ECSV, CSV or FITS, by its ending. Columns are named as the options of ``lnocl deconvolve``,
        with images for its images, and name for that of the outputs, by default that of the first
        image. Several values of an option are separated by blanks, as in a shell; an empty cell
        gives none. An option that takes no value is true or false.

    Raises
    ------
    FileError
        The file cannot be read.
    InputError
        Its ending is another; it has no row, or no column of images; a column names no option, or
        has a unit; two targets have one name.
    """
    table = _read(path)
    options = _options_of(path, table)
    targets = [_target(row, options) for row in table]
    if not targets:
        raise InputError(f"{path} has no row; give one a target")
    [(name, count)] = Counter(target.name for target in targets).most_common(1)
    if count > 1:
        raise InputError(
            f"{path} has {count} targets called {name!r}, whose outputs would replace each other: "
            "give a column name that differs"
        )
    return targets


def _read(path: str) -> Table:
    from astropy.table import Table

    from lnocl.io.tables import format_of

    kind = format_of(path, "targets")
    try:
        # Excel begins them with a mark of the encoding.
        given = {} if kind == "fits" else {"encoding": "utf-8-sig"}
        return Table.read(path, format=kind, **given)
    except FileNotFoundError as error:
        raise FileError(f"{path} does not exist") from error
    except Exception as error:  # of its readers, which raise any
        raise FileError(f"{path} cannot be read as a table: {error}") from error


def _options_of(path: str, table: Table) -> dict[str, Option]:
    """Return the option of each column but that of names."""
    known = {
        _plain(each.flags[-1]): each for each in deconvolve.ALL_OPTIONS if each.name not in OWN
    }
    options = {}
    for column in table.colnames:
        if column == NAME:
            continue
        if _plain(column) not in known:
            raise InputError(
                f"column {column!r} of {path} is no option that a target may have; columns are "
                "called name or as options of lnocl deconvolve: images, psf, star, background, ..."
            )
        if table[column].unit is not None:
            raise InputError(
                f"column {column!r} of {path} has a unit, {table[column].unit}; give its values in "
                "that of the option, as lnocl deconvolve --help says, and no unit"
            )
        options[column] = known[_plain(column)]
    if not any(each.name == "images" for each in options.values()):
        raise InputError(f"{path} has no column images; give the files of each target there")
    # An option of several values would take images that follow it.
    return dict(sorted(options.items(), key=lambda item: item[1].name != "images"))


def _plain(flag: str) -> str:
    return flag.lstrip("-").replace("_", "-").lower()


def _target(row: Row, options: dict[str, Option]) -> Target:
    name, words, inputs, fault = "", [], [], ""
    try:
        for column, option in options.items():
            values = _values(row[column], option)
            words += option.words(values)
            inputs += [file_of(path) for path in option.inputs(values)]
            if option.name == "images" and isinstance(values, list) and values:
                name = os.path.basename(file_of(values[0])).partition(".")[0]
    except ValueError as error:
        fault = str(error)
    if NAME in row.colnames and (given := _text(row[NAME])):
        name = given
    if not _is_file_name(name):
        fault = fault or f"its name {name!r} cannot be that of a file; give another in column name"
        name = f"row{row.index + 1}"
    if "\0" in "".join([*words, *inputs]):
        fault = fault or "one of its values has a NUL character, which no command line can have"
        words, inputs = [], []
    return Target(name, tuple(words), tuple(inputs), fault)


def _is_file_name(name: str) -> bool:
    """Return whether outputs may be called so: it is visible, in no other folder, and not long."""
    is_plain = name == os.path.basename(name) and not name.startswith(".") and "\0" not in name
    return bool(name) and is_plain and len(os.fsencode(name)) <= MAX_NAME


def _values(cell: Any, option: Option) -> bool | list[str] | None:
    """Return the value of an option, as `Option.words` takes it."""
    text = _text(cell)
    action: Any = option.keywords.get("action")
    if action is EITHER and not text:
        return None
    if action in SWITCHES or action is EITHER:
        if text.lower() not in (*YES, *NO):
            raise ValueError(f"{option.flags[-1]} is true or false; {text!r} was given")
        is_set = SWITCHES.get(action, True)
        return is_set if text.lower() in YES else not is_set
    if not text:
        return None
    takes_several = action == "append" or option.keywords.get("nargs") in ("+", "*")
    return shlex.split(text) if takes_several else [text]


def _text(cell: Any) -> str:
    """Return a cell as it is typed; arrays are several values."""
    if cell is np.ma.masked:
        return ""
    if isinstance(cell, bytes):
        cell = cell.decode(errors="replace")
    if isinstance(cell, np.ndarray):
        return " ".join(",".join(map(_text, np.atleast_1d(each))) for each in cell)
    if isinstance(cell, np.generic):
        cell = cell.item()
    if isinstance(cell, float) and not np.isfinite(cell):
        return ""
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 1e15:
        cell = int(cell)  # which options of whole numbers take too
    return str(cell).strip()
