"""Signals: what ends a command, once, and what it does then."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends whatever runs as Ctrl-C does."""


@contextlib.contextmanager
def first_handled(numbers: Iterable[int], handle: Callable[[int], None]) -> Iterator[None]:
    """Have the first of some signals handled; the next one does what it did before.

    Signals that are ignored stay so, as in the background of a script. Python sets handlers in the
    main thread only: elsewhere nothing is changed.

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
    raise Terminated
