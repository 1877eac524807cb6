"""What the command line does for long runs: checkpoints, and an end on Ctrl-C or SIGTERM."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
from collections.abc import Iterable
from typing import TYPE_CHECKING

from lnocl.commands.arguments import Arguments, finite
from lnocl.commands.signals import first_handled
from lnocl.errors import InputError, LnoclError

if TYPE_CHECKING:
    from lnocl.result import Result

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def add_arguments(parser: Arguments) -> None:
    """Add the options of checkpoints."""
    parser.add_argument(
        "--checkpoint",
        metavar="FILE",
        help="write what the run has come to, every so many seconds, at the end and on Ctrl-C",
    )
    parser.add_argument(
        "--checkpoint-every",
        type=finite,
        default=60.0,
        metavar="SECONDS",
        help="time between checkpoints (default: %(default)s)",
    )
    parser.add_argument(
        "--resume",
        metavar="FILE",
        help="go on from a checkpoint of the same inputs and parameters; the result is bit for bit "
        "that of a run that was never interrupted",
    )


def check(arguments: argparse.Namespace, inputs: Iterable[str]) -> None:
    """Refuse a checkpoint that would take the place of the output or an input."""
    if arguments.checkpoint is None:
        return
    named = os.path.realpath(arguments.checkpoint)
    if named in [os.path.realpath(path) for path in (arguments.output, *inputs)]:
        raise InputError(
            f"the checkpoint {arguments.checkpoint} is the output or an input; give it another name"
        )


class RunInterruptedError(LnoclError):
    """A run that a signal has ended; its result is written."""


class Interrupts:
    """Listens for signals from the first iteration on: the first one ends the run, the second all.

    One that comes after the last iteration ends nothing: the result is there, and is written.

    Attributes
    ----------
    caught : int
        The signal that came, else 0.
    """

    def __init__(self) -> None:
        self.caught = 0
        self._listens = False
        self._listening = contextlib.ExitStack()

    def __enter__(self) -> Interrupts:
        return self

    def __exit__(self, *exception: object) -> None:
        self._listening.close()

    def listen(self) -> None:
        """Listen from now on."""
        if not self._listens:
            self._listens = True
            self._listening.enter_context(first_handled(SIGNALS, self._catch))

    def callback(self, iteration: int, estimate: object) -> bool:
        """Return whether the run should end, as `lnocl.deconvolve` asks after each iteration."""
        self.listen()
        return self.caught != 0

    def explain(self, arguments: argparse.Namespace, result: Result) -> None:
        """Raise what tells of a signal that came, with the status that shells give it.

        Raises
        ------
        RunInterruptedError
            A signal came.
        """
        if not self.caught:
            return
        if result.stop_reason == "interrupt":
            words = f"interrupted after {result.n_iter} iterations; what they gave is in "
            words += arguments.output
            if arguments.checkpoint is not None:
                words += f"; go on with --resume {arguments.checkpoint}"
        else:
            words = f"interrupted after the last iteration; the result is in {arguments.output}"
        error = RunInterruptedError(words)
        error.exit_status = 128 + self.caught
        raise error

    def _catch(self, number: int) -> None:
        self.caught = number
