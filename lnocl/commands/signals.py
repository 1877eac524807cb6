"""Signals that end a command, the first of them in an orderly way."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any

# Those that end a process; Windows has no SIGHUP, of a terminal that is closed.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, its argument, which ends whatever runs as Ctrl-C does."""


@contextlib.contextmanager
def first_handled(numbers: Iterable[int], handle: Callable[[int], None]) -> Iterator[None]:
    """Handle the first of some signals; the next one has its former effect.

    Ignored signals stay ignored, as in the background of a script. In other threads than the main
    one, where Python sets no handlers, this has no effect.

    Parameters
    ----------
    numbers : iterable of int
        The signals.
    handle : callable
        Given the one that came.
    """
    before: dict[int, Any] = {}

    def release() -> None:
        with contextlib.suppress(KeyError):  # a signal may come in between, and release the last
            while before:
                signal.signal(*before.popitem())

    def catch(number: int, frame: object) -> None:
        release()
        handle(number)

    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            handler = signal.getsignal(number)
            if handler not in (signal.SIG_IGN, None):  # None is that of another language
                before[number] = handler
                signal.signal(number, catch)
    try:
        yield
    finally:
        release()


def terminate(number: int) -> None:
    """Raise `Terminated`.

    Raises
    ------
    Terminated
        Always.
    """
    raise Terminated(number)
