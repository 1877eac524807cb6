"""Everything that the command line writes to stdout and stderr."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TextIO

from lnocl.errors import LOG, LnoclWarning, with_names
from lnocl.progress import LOG as PROGRESS

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
            with _above_bars(sys.stdout):
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
    typed = re.sub(r"--([\w-]+) False\b", r"--no-\1", typed)
    return re.sub(r"(--[\w-]+)=(True\b)?", lambda found: found[1] + " " * (not found[2]), typed)


def show_warning(flags: Mapping[str, str], message: Warning | str, *_: object) -> None:
    """Write a warning to stderr, with `in_shell`, in place of `warnings.showwarning`."""
    _note(f"warning: {in_shell(_message_of(message), flags)}")


def _message_of(warning: Warning | str) -> str:
    return warning.message if isinstance(warning, LnoclWarning) else str(warning)


@contextlib.contextmanager
def recorded(flags: Mapping[str, str], shows: Callable[[Warning], bool]) -> Iterator[list[str]]:
    """Yield a list of each note, detail and warning, as in a shell; show the warnings that match.

    Parameters
    ----------
    flags : mapping of str to str
        As for `in_shell`.
    shows : callable
        Given a warning, returns whether it is shown too.
    """
    lines: list[str] = []

    def record(message: Warning | str, *where: Any, **more: Any) -> None:
        lines.append(f"warning: {in_shell(_message_of(message), flags)}")
        if isinstance(message, str) or shows(message):
            show(message, *where, **more)

    notes = _Notes(flags, lines.append, logging.DEBUG)
    notes.addFilter(lambda record: not getattr(record, "is_passing", False))
    with warnings.catch_warnings(), _handled(LOG, notes):
        show, warnings.showwarning = warnings.showwarning, record
        yield lines


@contextlib.contextmanager
def shown_log(level: int, has_progress: bool, flags: Mapping[str, str]) -> Iterator[None]:
    """Show the notes that the library logs on stderr, with `in_shell`.

    At the level of information they come at the end, below the answer; that of debugging shows
    details too, and each at once. Inside that of another command it takes its place.

    Parameters
    ----------
    level : int
        ``logging.INFO`` or ``logging.DEBUG``; ``logging.CRITICAL`` shows no notes.
    has_progress : bool
        Whether lines on progress are shown.
    flags : mapping of str to str
        As for `in_shell`.
    """
    held: list[str] = []
    show = held.append if level > logging.DEBUG else _note
    # Commands in another one may write elsewhere; its own lines on progress go on.
    progress = _Notes(flags, partial(_note, stream=sys.stderr), logging.INFO)
    is_first = has_progress and not PROGRESS.handlers
    try:
        with (
            _handled(LOG, _Notes(flags, show, level), takes_place=True),
            _handled(PROGRESS, progress) if is_first else contextlib.nullcontext(),
        ):
            yield
    finally:
        for each in _without_likes(held):
            _note(each)


@contextlib.contextmanager
def _handled(log: logging.Logger, handler: _Notes, takes_place: bool = False) -> Iterator[None]:
    """Give a logger a handler, and its level, beside or in place of those of other commands."""
    level, handlers = log.level, log.handlers
    others = [each for each in handlers if not (takes_place and isinstance(each, _Notes))]
    handler.addFilter(lambda record: record.name == log.name)
    log.handlers = [*others, handler]
    log.setLevel(min(handler.level, level or handler.level))
    try:
        yield
    finally:
        log.handlers = handlers
        log.setLevel(level)


def _without_likes(lines: Sequence[str]) -> Iterator[str]:
    """Yield lines, of those that differ in numbers alone the first, with how many follow."""
    groups: dict[str, list[str]] = {}
    for line in lines:
        groups.setdefault(re.sub(r"[-+]?\d[\d.e+-]*", "0", line), []).append(line)
    for first, *others in groups.values():
        yield f"{first}; {len(others)} more like this: --verbose" if others else first


def _note(message: str, stream: TextIO | None = None) -> None:
    stream = stream or sys.stderr
    with contextlib.suppress(OSError), _above_bars(stream):
        stream.write(_one_line(f"lnocl: {message}", stream) + "\n")
        stream.flush()


def _above_bars(stream: TextIO) -> contextlib.AbstractContextManager[object]:
    """Return a context in which bars that are shown make place for what is written."""
    tqdm = sys.modules.get("tqdm")
    return tqdm.tqdm.external_write_mode(stream) if tqdm else contextlib.nullcontext()


class _Notes(logging.Handler):
    """Handler that passes on each note of its logger once, where several runs log the same."""

    def __init__(self, flags: Mapping[str, str], show: Callable[[str], None], level: int) -> None:
        super().__init__(level)
        self._flags, self._show = flags, show
        self._seen: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        named = getattr(record, "named", None)
        message = record.getMessage() if named is None else in_shell(named, self._flags)
        if message not in self._seen:
            self._seen.add(message)
            self._show(message)


def _one_line(text: str, stream: TextIO) -> str:
    """Return text in one line, with escapes for characters that a terminal cannot show."""
    joined = " ".join(part.strip() for part in text.splitlines())
    joined = " " * (len(text) - len(text.lstrip(" "))) + joined
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in joined)
    encoding = stream.encoding or "ascii"
    return shown.encode(encoding, "backslashreplace").decode(encoding)
