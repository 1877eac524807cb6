"""Tables out, in a format by the ending of their file."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from lnocl.errors import InputError
from lnocl.io.atomic import whole_file
from lnocl.process import ignored_warnings

if TYPE_CHECKING:
    from astropy.table import Table

# The formats by their endings, as astropy names them.
FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits"}


def format_of(path: str, content: str) -> str:
    """Return the format of a table by the name of its file, as astropy names it.

    Raises
    ------
    InputError
        The name has no such ending; the message says what the table is of.
    """
    ending = next((end for end in FORMATS if path.lower().endswith(end)), None)
    if ending is None:
        raise InputError(
            f"the table of {content} is ECSV, CSV or FITS; give it a name ending in .ecsv, .csv or "
            f".fits, not {path}"
        )
    return FORMATS[ending]


def write_table(table: Table, path: str, content: str, overwrite: bool) -> None:
    """Write a table, complete or not at all.

    Raises
    ------
    InputError
        As `format_of`.
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    kind = format_of(path, content)
    with whole_file(path, overwrite) as stream:
        if kind == "fits":
            with ignored_warnings():  # FITS has no name for electrons
                table.write(stream, format=kind)
            return
        text = io.StringIO()  # astropy writes texts to text streams
        table.write(text, format=kind)
        stream.write(text.getvalue().encode("utf-8", "backslashreplace"))
