"""Progress: a bar on a terminal or in a notebook, else lines in the log."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable

LOG = logging.getLogger("lnocl.progress")

# Seconds between two updates: each reads the objective, and waits for the device.
PROGRESS_INTERVAL = 0.1
# Seconds between two lines of the log, and between two looks at the clock of a bar.
LINE_INTERVAL, CLOCK_INTERVAL = 60.0, 1.0


class Progress:
    """The progress of one phase; its clock also ticks while a step takes long.

    Parameters
    ----------
    total : int or None
        Steps, where their number is known.
    unit : str
        What a step is, in the singular; empty where none is counted.
    is_shown : bool
        Whether it is shown: by tqdm where stderr is a terminal or in a notebook, else by a line in
        the log each minute.
    name : str, optional
        What is done.
    stays : bool, optional
        Whether the bar stays on the screen after its end.

    Attributes
    ----------
    n : int
        Steps done.
    total : int or None
        As given; it may be changed.
    """

    def __init__(
        self, total: int | None, unit: str, is_shown: bool, name: str = "", stays: bool = True
    ) -> None:
        self.n, self.total, self._unit, self._name = 0, total, unit, name
        self._bar, self._is_lines, self._start = None, False, time.monotonic()
        self._shown = self._start
        self._is_ended = threading.Event()
        if not (is_shown and sys.stderr):
            return
        from tqdm.auto import tqdm  # which takes its time to load

        # With disable=None, it is quiet where stderr is not a terminal.
        clock = None if unit else "{desc}: {elapsed}"
        bar = tqdm(
            total=total, unit=unit, desc=name or None, disable=None, leave=stays, bar_format=clock
        )
        self._is_lines = bool(bar.disable)
        self._bar = None if bar.disable else bar
        if self._is_lines or sys.stderr.isatty():  # a notebook is not drawn by other threads
            threading.Thread(target=self._go_on, daemon=True).start()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def update(self, n: int = 1, words: str = "") -> None:
        """Count steps that are done, and show a few words beside the bar."""
        self.n += n
        if self._bar is not None:
            self._bar.total = self.total
            if words:
                self._bar.set_postfix_str(words, refresh=False)
            self._bar.update(n)

    def show(self, n: int, quantity: Callable[[], str], last: bool = False) -> None:
        """Show so many steps and a quantity, where an update is due or this is the last.

        Each tenth of a second the quantity is asked for, which may wait for the device.
        """
        is_due = last or time.monotonic() - self._shown > PROGRESS_INTERVAL
        if self._is_lines or (self._bar is not None and is_due):
            self.update(n - self.n, "" if self._bar is None else quantity())
            self._shown = time.monotonic()

    def close(self) -> None:
        """End it."""
        self._is_ended.set()
        if self._bar is not None:
            self._bar.close()

    def _go_on(self) -> None:
        while not self._is_ended.wait(LINE_INTERVAL if self._is_lines else CLOCK_INTERVAL):
            if self._bar is not None:
                self._bar.refresh()
            else:
                LOG.info(self._line())

    def _line(self) -> str:
        minutes = (time.monotonic() - self._start) / 60.0
        of = "" if self.total is None else f" of {self.total}"
        unit = "iteration" if self._unit == "it" else self._unit
        steps = f"{unit} {self.n}{of}, " if self.n or of else ""
        return f"{self._name or 'running'}: {steps}{minutes:.0f} min"
