"""Everything that the command line writes to stdout and stderr."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TextIO

from lnocl.errors import LnoclWarning, with_names

# Rows of a table that are printed, unless more were asked for.
MAX_LISTED = 12


def replace_closed_streams() -> None:
    """Replace a closed stdin, stdout or stderr, as after ``2>&-``, by one that discards output.

    Otherwise a file opened later would get its number, and the output of libraries.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r+"))  # noqa: SIM115


def say(lines: Iterable[str]) -> None:
    """Write lines to stdout as they come; a reader that has left early is not an error."""
    for line in lines:
        try:
            sys.stdout.write(_one_line(line, sys.stdout) + "\n")
            sys.stdout.flush()
        except OSError as error:
            # The rest of the buffer would fail again when the interpreter ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            if not isinstance(error, BrokenPipeError):
                raise


def fail(message: str, exit_status: int) -> int:
    """Write an error to stderr, and return the exit status."""
    _note(f"error: {message}")
    return exit_status


def in_shell(message: str, flags: Mapping[str, str]) -> str:
    """Return a message of the library as it is meant in a shell.

    Options are named as they are typed; images and PSFs are counted from 1.

    Parameters
    ----------
    message : str
        It names parameters between grave accents, such as `` `n_iter` `` and `` `images[0]` ``.
    flags : mapping of str to str
        The flag of each parameter, such as ``--n-iter``. Others keep their name.
    """
    typed = with_names(message, lambda name: flags.get(name, name), first=1)
    return re.sub(r"(--[\w-]+)=", r"\1 ", typed)


def show_warning(
    flags: Mapping[str, str],
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Write a warning to stderr, with `in_shell`, in place of `warnings.showwarning`."""
    _note(f"warning: {in_shell(_message_of(message), flags)}")


def _message_of(warning: Warning | str) -> str:
    return warning.message if isinstance(warning, LnoclWarning) else str(warning)


@contextlib.contextmanager
def recorded_warnings(flags: Mapping[str, str]) -> Iterator[list[str]]:
    """Yield a list to which each warning that is shown is added, as it is meant in a shell."""
    lines: list[str] = []
    show = warnings.showwarning

    def record(message: Warning | str, *where: Any, **more: Any) -> None:
        lines.append(f"warning: {in_shell(_message_of(message), flags)}")
        show(message, *where, **more)

    warnings.showwarning = record
    try:
        yield lines
    finally:
        warnings.showwarning = show


@contextlib.contextmanager
def shown_log(quiet: bool, flags: Mapping[str, str]) -> Iterator[None]:
    """Show the notes that the library logs on stderr, with `in_shell`, unless it is quiet.

    Inside that of another command it takes its place.
    """
    log = logging.getLogger("lnocl")
    handlers, levels = log.handlers, {each: each.level for each in (log, log.getChild("progress"))}
    log.handlers = [each for each in handlers if not isinstance(each, _Notes)]
    if not quiet:
        log.addHandler(_Notes(flags))
        for each in levels:
            each.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.handlers = handlers
        for each, level in levels.items():
            each.setLevel(level)


def _note(message: str) -> None:
    tqdm = sys.modules.get("tqdm")
    above = tqdm.tqdm.external_write_mode(sys.stderr) if tqdm else contextlib.nullcontext()
    with contextlib.suppress(OSError), above:  # of bars that are shown
        sys.stderr.write(_one_line(f"lnocl: {message}", sys.stderr) + "\n")
        sys.stderr.flush()


class _Notes(logging.Handler):
    """Handler that shows each note once, where several runs log the same."""

    def __init__(self, flags: Mapping[str, str]) -> None:
        super().__init__()
        self._flags = flags
        self._shown: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        message = in_shell(getattr(record, "named", record.getMessage()), self._flags)
        if message not in self._shown:
            self._shown.add(message)
            _note(message)


def _one_line(text: str, stream: TextIO) -> str:
    """Return text in one line, with escapes for characters that a terminal cannot show."""
    joined = " ".join(part.strip() for part in text.splitlines())
    shown = "".join(c if c.isprintable() else _escape(c) for c in joined)
    encoding = stream.encoding or "ascii"
    return shown.encode(encoding, "backslashreplace").decode(encoding)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
