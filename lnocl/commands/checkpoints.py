"""Long runs on the command line: checkpoints, and an orderly end on Ctrl-C, SIGTERM or SIGHUP."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal

from lnocl.commands.signals import ENDING, first_handled
from lnocl.errors import InputError, LnoclError, counted
from lnocl.io import atomic
from lnocl.result import Result

SIGNALS = (signal.SIGINT, *ENDING)


def check(arguments: argparse.Namespace) -> None:
    """Refuse a checkpoint that would take the place of an output or an input."""
    path, resume = arguments.checkpoint, arguments.resume
    if path is None:
        return
    outputs = {os.path.realpath(each) for each in (arguments.output, arguments.plot) if each}
    if os.path.realpath(path) in outputs:
        raise InputError(f"the checkpoint {path} is an output too; give it another name")
    if resume is None or os.path.realpath(resume) != os.path.realpath(path):
        atomic.refuse_input(path)


class RunInterruptedError(LnoclError):
    """A run that a signal has ended; its result is written."""


class Interrupts(contextlib.AbstractContextManager["Interrupts"]):
    """Listens for signals from the first iteration on: the first one ends the run, the second all.

    After the last iteration a signal changes nothing: the result is complete, and is written.

    Attributes
    ----------
    caught : int
        The signal that came, else 0.
    """

    def __init__(self) -> None:
        self.caught = 0
        self._listens = False
        self._listening = contextlib.ExitStack()

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
        """Raise an error that tells of a signal that came, with its exit status in shells.

        Raises
        ------
        RunInterruptedError
            A signal came.
        """
        if not self.caught:
            return
        if result.stop_reason == "interrupt":
            words = f"interrupted after {counted(result.n_iter, 'iteration')}; their result is in "
            words += arguments.output
            if arguments.checkpoint is not None:
                words += f"; continue with --resume {arguments.checkpoint}"
        else:
            words = f"interrupted after the last iteration; the result is in {arguments.output}"
        error = RunInterruptedError(words)
        error.exit_status = 128 + self.caught
        raise error

    def _catch(self, number: int) -> None:
        self.caught = number
