"""The command line: the entry and the table of its subcommands; nothing numerical."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from functools import partial

from lnocl import __version__
from lnocl.commands import (
    bench,
    deconvolve,
    demo,
    devices,
    environment,
    errors,
    messages,
    plot,
    psf,
    report,
    selftest,
    simulate,
    stars,
)
from lnocl.commands.parser import Parser
from lnocl.commands.signals import ENDING, Terminated, first_handled, terminate
from lnocl.errors import InputError, LnoclError, LnoclWarning

FAILED = 1
INTERRUPTED = 130

# In the order of the help.
COMMANDS = {
    "deconvolve": deconvolve.COMMAND,
    "errors": errors.COMMAND,
    "psf": psf.COMMAND,
    "stars": stars.COMMAND,
    "plot": plot.COMMAND,
    "report": report.COMMAND,
    "demo": demo.COMMAND,
    "simulate": simulate.COMMAND,
    "bench": bench.COMMAND,
    "devices": devices.COMMAND,
    "selftest": selftest.COMMAND,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments without the program's name; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted, 129 (SIGHUP) or 143
        (SIGTERM) terminated.
    """
    messages.replace_closed_streams()
    environment.prepare()
    words = sys.argv[1:] if arguments is None else arguments
    flags: dict[str, str] = {}
    try:
        with first_handled(ENDING, terminate), warnings.catch_warnings():
            warnings.simplefilter("always", LnoclWarning)
            warnings.showwarning = partial(messages.show_warning, flags)
            parsed = _make_parser().parse_args(words)
            flags |= parsed.command.flags(words)
            parsed.command.run(parsed)
    except InputError as error:
        return messages.fail(messages.in_shell(str(error), flags), error.exit_status)
    except LnoclError as error:
        return messages.fail(str(error), error.exit_status)
    except MemoryError:
        return messages.fail("not enough memory; cut the images, or give fewer at a time", FAILED)
    except Terminated as error:
        return messages.fail("terminated", 128 + error.args[0])
    except KeyboardInterrupt:
        return messages.fail("interrupted", INTERRUPTED)
    except OSError as error:
        return messages.fail(str(error), FAILED)
    return 0


def _make_parser() -> Parser:
    parser = Parser(
        prog="lnocl",
        description="Multi-component Richardson-Lucy deconvolution of astronomical images.",
        epilog="Exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted, 129 or 143 "
        "terminated.",
    )
    parser.add_argument("--version", action="version", version=f"lnocl {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=command.summary, description=command.summary)
        command.add_arguments(subparser)
        subparser.set_defaults(command=command)
    return parser
