"""The parser of the shell as the reference shows it: helps of ``--help``, with flags as code."""

import argparse
import re

from lnocl.commands import cli

# Quoted names, commands, flags and some values in a text, which a page shows as code.
CODE = re.compile(
    r"'[^' ]*'|lnocl [a-z]+(?: --[a-z-]+)*|(?<![\w-])--?[a-z][a-z-]*|\b(?:hh34|sgp|sgm|mc-rl)\b"
)
TITLES = {"positional arguments": "Arguments", "options": "Options"}


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of `lnocl.commands.cli`, its texts as reStructuredText."""
    parser = cli.make_parser()
    commands = next(
        each for each in parser._actions if isinstance(each, argparse._SubParsersAction)
    )
    for each in (parser, *commands.choices.values()):
        each.color = False  # no escape codes, which Python 3.14 would add
    for command in commands.choices.values():
        command.epilog = _code(command.epilog or "")
        formatter = command._get_formatter()
        for action in command._actions:
            if isinstance(action, argparse._HelpAction):
                continue
            text = formatter._expand_help(action)
            action.help = _sentence(_code(text)).replace("%", "%%")
            if action.option_strings:
                action.option_strings = [formatter._format_action_invocation(action)]
            action.choices = None
        for group in command._action_groups:
            group.title = TITLES.get(group.title or "", (group.title or "").capitalize())
    return parser


def _code(text: str) -> str:
    parts = CODE.split(text.replace("\\", r"\\").replace("*", r"\*"))
    found = [each.strip("'") for each in CODE.findall(text)]
    return parts[0] + "".join(
        f"``{code}``{part}" for code, part in zip(found, parts[1:], strict=True)
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:].removesuffix(".") + "."
