"""Subcommands, and the parser of their command lines."""

from __future__ import annotations

import argparse
import logging
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, NoReturn

from lnocl.commands.messages import in_shell, shown_log
from lnocl.commands.options import Option, Options
from lnocl.errors import InputError
from lnocl.io.names import file_of
from lnocl.progress import Progress


class Command(NamedTuple):
    """A subcommand.

    Attributes
    ----------
    summary : str
        Its line in the help.
    options : Options
        Its arguments, by the headings of its help; those under no heading have an empty one.
    run : callable
        Runs it with the parsed arguments, and yields the lines that it says.
    epilog : str
        The last paragraph of its help.
    goes_on : str
        What is added to the word that it was interrupted.
    """

    summary: str
    options: Options
    run: Callable[[argparse.Namespace], Iterable[str]]
    epilog: str = ""
    goes_on: str = ""

    def carry_out(self, arguments: argparse.Namespace) -> Iterator[str]:
        """Run it, and yield the lines that it says, and show notes, unless it is to be quiet.

        One that cannot be told to be quiet shows no notes.
        """
        level = logging.DEBUG if _is(arguments, "verbose") else logging.INFO
        if not hasattr(arguments, "quiet") or arguments.quiet:
            level = logging.CRITICAL
        is_shown = not (_is(arguments, "quiet") or _is(arguments, "no_progress"))
        name = getattr(arguments, "command_name", "working")
        with shown_log(level, is_shown, self.flags()):
            lines = self._lines(arguments)
            line: str | None = ""
            while line is not None:
                with Progress(None, "", is_shown, name):  # which is gone where a line is shown
                    line = next(lines, None)
                if line is not None and not _is(arguments, "quiet"):
                    yield line

    def _lines(self, arguments: argparse.Namespace) -> Iterator[str]:
        yield from self.run(arguments)  # which may do all its work before the first

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add its options to its parser."""
        parser.epilog = self.epilog
        needed = [each.usage() for each in self.all_options() if each.is_needed]
        parser.usage = " ".join(["%(prog)s", *needed, "[options]"])
        flags = self.flags()
        for heading, options in self.options.items():
            group = parser.add_argument_group(heading) if heading else parser
            for each in options:
                words = in_shell(each.keywords["help"], flags)
                group.add_argument(*each.flags, **{**each.keywords, "help": words})

    def refuse_ignored(self, arguments: argparse.Namespace) -> None:
        """Refuse options that would be ignored, for others that are given or left out.

        Raises
        ------
        InputError
            There is one.
        """
        for each in self.all_options():
            each.refuse_ignored(vars(arguments))
        if _is(arguments, "quiet") and _is(arguments, "verbose"):
            raise InputError("`quiet` and `verbose` exclude each other: give one of them")

    def inputs(self, arguments: argparse.Namespace) -> list[str]:
        """Return the names in its arguments that may be those of files to read."""
        values = vars(arguments)
        found = (path for each in self.all_options() for path in each.inputs(values[each.name]))
        return [*map(file_of, found)]

    def all_options(self) -> list[Option]:
        """Return its arguments, whatever their headings."""
        return [each for group in self.options.values() for each in group]

    def flags(self) -> dict[str, str]:
        """Return the flag of each parameter that an option, or a kind of its values, stands for."""
        options = self.all_options()
        kinds = {
            parameter: f"{each.flags[-1]} {kind}"
            for each in options
            for kind, parameter in each.kinds.items()
        }
        return kinds | {each.name: each.flags[-1] for each in options if not each.is_positional}


def _is(arguments: argparse.Namespace, name: str) -> bool:
    """Return whether an option that a command may have is given."""
    return getattr(arguments, name, False)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ours, and that takes ``-1,3`` and ``-inf`` for values."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)[\d.,eainf+-]*$", re.I)
        self._words: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as `argparse` does, and remember the words for a message."""
        self._words = args or ()
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Raise the error with which argparse would end the program."""
        advice = self._swallowed() if "arguments are required" in message else ""
        raise InputError(f"{message}{advice}; see {self.prog} --help")

    def _swallowed(self) -> str:
        """Say which option has taken a file that was meant as a positional argument, if any."""
        taken: dict[str, list[str]] = {}
        flag = ""
        for word in self._words:
            action = self._option_string_actions.get(word)
            if action is not None or word == "--":
                flag = word if action is not None and action.nargs == "+" else ""
            elif flag:
                taken.setdefault(flag, []).append(word)
        for flag, values in reversed(taken.items()):
            if len(values) > 1 and os.path.exists(file_of(values[-1])):
                return (
                    f"; {flag} has taken {values[-1]}: put it before the options, or after --, as "
                    f"in {flag} {values[0]} -- {values[-1]}"
                )
        return ""
