"""Ctrl-C while the command line loads its modules: one line and a status, as later.

The package imports this first, and all else takes a quarter of a second or more.
"""

import contextlib
import os
import signal
import sys


def _end(*_: object) -> None:
    with contextlib.suppress(OSError):  # stderr may be closed
        os.write(2, b"lnocl: error: interrupted\n")
    os._exit(130)  # an exception may be lost in a module of C that is being loaded


def begin() -> None:
    """Hear Ctrl-C where this process is the command line; a library leaves it to its user."""
    words = sys.orig_argv[1:3]
    is_command = words == ["-m", "lnocl"] or os.path.basename(words[0] if words else "") == "lnocl"
    # Scripts in the background ignore it.
    if is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def end() -> None:
    """Leave Ctrl-C to the command, which is loaded."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
