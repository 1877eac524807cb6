"""How an output was made: its header cards and the commands that make it again."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lnocl import __version__
from lnocl.commands.options import Option

if TYPE_CHECKING:
    from lnocl.io.fitswrite import Card

OUTPUT = "output"


def make_cards(
    options: Iterable[Option],
    used: Mapping[str, Any],
    sha256: Mapping[str, Sequence[str]],
    results: Iterable[Card] = (),
) -> list[Card]:
    """Return the header cards that say how an output was made.

    Parameters
    ----------
    options : iterable of Option
        The arguments of the command.
    used : mapping of str to value
        The values that were used, by the names of the options.
    sha256 : mapping of str to sequence of str
        Checksums of the files of an option, by its name.
    results : iterable of (keyword, value, comment), optional
        Cards of measured quantities.
    """
    options = list(options)
    return [
        ("CREATOR", f"lnocl {__version__}", "program that wrote this file"),
        *(card for each in options for card in _option_cards(each, used[each.name])),
        *results,
        # A checksum leaves no room for a comment.
        *(
            (f"{each.checksum}{j}", checksum, "")
            for each in options
            for j, checksum in enumerate(sha256.get(each.name, ()), 1)
        ),
    ]


def make_commands(
    command: str, options: Iterable[Option], values: Mapping[str, Any], folder: str
) -> list[list[str]]:
    """Return the words of the shell commands that repeat a run; the output comes last.

    Parameters
    ----------
    command : str
        The subcommand.
    options : iterable of Option
        Its arguments.
    values : mapping of str to value
        Their values, by their names.
    folder : str
        Folder in which the run was started.
    """
    repeated = sorted(
        (each for each in options if each.is_repeated),
        key=lambda each: (not each.is_positional, each.name == OUTPUT),
    )
    words = (word for each in repeated for word in each.words(values[each.name]))
    return [["cd", folder], ["lnocl", command, *words]]


def _option_cards(option: Option, value: Any) -> list[Card]:
    if option.card is None or value is None:
        return []
    keyword, comment = option.card
    if not isinstance(value, list):
        return [(keyword, _in_card(option, value), comment)]
    return [(f"{keyword}{j}", _in_card(option, each), comment) for j, each in enumerate(value, 1)]


def _in_card(option: Option, value: Any) -> Any:
    """Return a value as a card holds it: of a file its name without the folder."""
    return os.path.basename(value) if option.inputs(value) else value
