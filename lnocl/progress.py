"""Progress: a bar on a terminal or in a notebook, else lines in the log."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import Any

from lnocl.process import ignored_warnings

LOG = logging.getLogger("lnocl.progress")

# Seconds between two updates: each reads the objective, and waits for the device.
PROGRESS_INTERVAL = 0.1
# Seconds before the first line of the log, between two of them, and between two looks at the clock.
FIRST_LINE, LINE_INTERVAL, CLOCK_INTERVAL = 1.5, 60.0, 0.5
# Whether phases are not shown, as parts of another one.
HIDDEN = ContextVar("hidden", default=False)


class Progress(AbstractContextManager["Progress"]):
    """The progress of one phase; its clock also ticks while a step takes long.

    Parameters
    ----------
    total : int or None
        Steps, where their number is known.
    unit : str
        What a step is, in the singular; empty where none is counted.
    is_shown : bool
        Whether it is shown: by tqdm where stderr is a terminal or in a notebook, else by lines in
        the log, the first after 1.5 s and then one each minute, of the phase that began last.
    name : str, optional
        What is done.

    Attributes
    ----------
    n : int
        Steps done.
    total : int or None
        As given; it may be changed.
    """

    def __init__(self, total: int | None, unit: str, is_shown: bool, name: str = "") -> None:
        self.n, self.total, self._unit, self._name = 0, total, unit, name
        self._start = self._shown = time.monotonic()
        is_shown = is_shown and bool(sys.stderr) and not HIDDEN.get()
        self._bar = _bar(total, unit, name) if is_shown else None
        self._is_lines = self._bar is not None and self._bar.disable
        # A notebook is drawn by its own thread alone. Later stderr may be another.
        self._is_terminal = self._bar is not None and getattr(sys.stderr, "isatty", bool)()
        if self._bar is not None:
            _CLOCK.begin(self)

    def __exit__(self, *exception: object) -> None:
        if self._bar is not None:
            _CLOCK.end(self)
            self._bar.close()

    def update(self, n: int = 1, words: str = "") -> None:
        """Count steps that are done, and show a few words beside the bar."""
        self.n += n
        if self._bar is not None and not self._is_lines:
            self._bar.total = self.total
            if words:
                self._bar.set_postfix_str(words, refresh=False)
            self._bar.update(n)

    def show(self, n: int, quantity: Callable[[], str]) -> None:
        """Show so many steps and a quantity, where an update is due.

        Each tenth of a second the quantity is asked for, which may wait for the device.
        """
        is_due = time.monotonic() - self._shown > PROGRESS_INTERVAL
        if self._is_lines or (self._bar is not None and is_due):
            self.update(n - self.n, "" if self._is_lines else quantity())
            self._shown = time.monotonic()

    def tick(self, is_due: bool) -> bool:
        """Show the time that has passed; return whether a line was due, and is in the log."""
        if self._is_lines and is_due:
            LOG.info(self._line())
        elif self._is_terminal and self._bar is not None and self._unit:
            self._bar.refresh()
        elif self._is_terminal and self._bar is not None:
            self._bar.update(0)  # which shows it for the first time, after its delay
        return self._is_lines and is_due

    def _line(self) -> str:
        seconds = time.monotonic() - self._start
        passed = f"{seconds:.0f} s" if seconds < 60.0 else f"{seconds / 60.0:.0f} min"
        of = "" if self.total is None else f" of {self.total}"
        unit = "iteration" if self._unit == "it" else self._unit
        steps = f"{unit} {self.n}{of}, " if self.n or of else ""
        return f"{self._name or 'running'}: {steps}{passed}"


class _Clock:
    """The phases that go on, the last within the others, and a thread that tells of the last."""

    def __init__(self) -> None:
        self._phases: list[Progress] = []
        self._lock, self._is_idle = threading.Lock(), threading.Event()
        self._due = -LINE_INTERVAL

    def begin(self, phase: Progress) -> None:
        """Tell of a phase from now on."""
        with self._lock:
            now = time.monotonic()
            if now > self._due + LINE_INTERVAL:  # long after the last line
                self._due = now + FIRST_LINE
            self._phases.append(phase)
            if len(self._phases) == 1:
                self._is_idle = threading.Event()
                threading.Thread(target=self._run, args=[self._is_idle], daemon=True).start()

    def end(self, phase: Progress) -> None:
        """Tell of it no more."""
        with self._lock:
            if phase in self._phases:  # it may be ended twice
                self._phases.remove(phase)
                if not self._phases:
                    self._is_idle.set()

    def _run(self, is_idle: threading.Event) -> None:
        while not is_idle.wait(min(CLOCK_INTERVAL, LINE_INTERVAL)):
            with self._lock:
                phases = [*self._phases]
            now = time.monotonic()
            for k, phase in enumerate(phases, 1 - len(phases)):
                if phase.tick(k == 0 and now > self._due):
                    self._due = now + LINE_INTERVAL


_CLOCK = _Clock()


def _bar(total: int | None, unit: str, name: str) -> Any:
    """Return a bar of tqdm, which is disabled where nobody would see it."""
    with ignored_warnings():  # of a notebook without ipywidgets, which has a plain bar
        from tqdm.auto import tqdm  # which takes its time to load

    # With None a bar is disabled where stderr is not a terminal; that of a notebook is none.
    is_notebook = "ipykernel" in sys.modules
    clock = None if unit else "{desc}: {elapsed}"
    return tqdm(
        total=total,
        unit=unit,
        desc=name or None,
        disable=False if is_notebook else None,
        leave=False,
        bar_format=clock,
        delay=0.0 if unit else CLOCK_INTERVAL,
    )
