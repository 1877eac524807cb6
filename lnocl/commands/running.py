"""Running a command line: its parser, and what becomes of errors, warnings and signals."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

from lnocl import __version__
from lnocl.commands import messages
from lnocl.commands.parser import Command, Parser
from lnocl.commands.signals import ENDING, Terminated, first_handled, terminate
from lnocl.errors import LnoclError, LnoclWarning
from lnocl.io.atomic import kept

# Seconds between two writings of what is done so far.
WRITE_EVERY = 10.0

FAILED = 1
INTERRUPTED = 130


def run(commands: Mapping[str, Command], words: Sequence[str]) -> int:
    """Run a command line, and return its exit status: that of `lnocl.commands.cli.main`.

    Parameters
    ----------
    commands : mapping of str to Command
        The subcommands, in the order of the help.
    words : sequence of str
        The command line without the program's name.
    """
    flags: dict[str, str] = {}
    goes_on = ""
    try:
        with first_handled(ENDING, terminate), warnings.catch_warnings():
            warnings.simplefilter("always", LnoclWarning)
            warnings.showwarning = partial(messages.show_warning, flags)
            parsed = make_parser(commands).parse_args(words)
            flags |= parsed.command.flags()
            goes_on = parsed.command.goes_on
            parsed.command.refuse_ignored(parsed)
            with (
                kept(parsed.command.inputs(parsed)),
                contextlib.closing(parsed.command.carry_out(parsed)) as lines,
            ):
                messages.say(lines)
    except LnoclError as error:
        return messages.fail(messages.in_shell(error.message, flags), error.exit_status)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "start new thread" not in str(error):
            raise
        return messages.fail("not enough memory; cut the images, or give fewer at a time", FAILED)
    except Terminated as error:
        return messages.fail(f"terminated{goes_on}", 128 + error.args[0])
    except KeyboardInterrupt:
        return messages.fail(f"interrupted{goes_on}", INTERRUPTED)
    except OSError as error:
        return messages.fail(str(error), FAILED)
    return 0


def make_parser(commands: Mapping[str, Command]) -> Parser:
    """Return the parser of the whole command line."""
    parser = Parser(
        prog="lnocl",
        description="Multi-component Richardson-Lucy deconvolution of astronomical images.",
        epilog="Try lnocl demo first. lnocl COMMAND --help has the options of a command. Exit "
        "status: 0 done, 1 failed, 2 wrong use, 130 interrupted, 129 or 143 terminated.",
    )
    parser.add_argument("--version", action="version", version=f"lnocl {__version__}")
    subparsers = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, dest="command_name"
    )
    for name, command in commands.items():
        subparser = subparsers.add_parser(name, help=command.summary, description=command.summary)
        command.add_arguments(subparser)
        subparser.set_defaults(command=command)
    return parser


@contextlib.contextmanager
def written_as_done(write: Callable[[], object]) -> Iterator[Callable[[], None]]:
    """Yield a function that writes what is done, where that is due; it is written at the end too.

    So it is where an error or a signal ends the work.
    """
    written = time.monotonic()

    def look() -> None:
        nonlocal written
        if time.monotonic() - written > WRITE_EVERY:
            write()
            written = time.monotonic()

    try:
        yield look
    except BaseException:
        with contextlib.suppress(Exception):  # a library may have been cut short while it loaded
            write()
        raise
    write()
