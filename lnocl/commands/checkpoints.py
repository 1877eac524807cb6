"""What the command line does for long runs: checkpoints, and an end on Ctrl-C or SIGTERM."""

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Iterable

from lnocl.commands.arguments import Arguments, finite
from lnocl.errors import InputError, LnoclError

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

    Attributes
    ----------
    caught : int
        The signal that came, else 0.
    """

    def __init__(self) -> None:
        self.caught = 0
        self._before: dict[int, object] = {}

    def __enter__(self) -> Interrupts:
        return self

    def __exit__(self, *exception: object) -> None:
        self._release()

    def callback(self, iteration: int, estimate: object) -> bool:
        """Return whether the run should end, as `lnocl.deconvolve` asks after each iteration."""
        if not (self._before or self.caught):
            for number in SIGNALS:
                if signal.getsignal(number) != signal.SIG_IGN:  # as in the background of a script
                    self._before[number] = signal.signal(number, self._catch)
        return self.caught != 0

    def explain(self, arguments: argparse.Namespace, n_iter: int) -> None:
        """Raise what tells of a run that was interrupted, with the status that shells give it.

        Raises
        ------
        RunInterruptedError
            A signal came.
        """
        if not self.caught:
            return
        words = f"interrupted after {n_iter} iterations; what they gave is in {arguments.output}"
        if arguments.checkpoint is not None:
            words += f"; go on with --resume {arguments.checkpoint}"
        error = RunInterruptedError(words)
        error.exit_status = 128 + self.caught
        raise error

    def _catch(self, number: int, frame: object) -> None:
        self.caught = number
        self._release()

    def _release(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before = {}
