"""Ctrl-C and too little memory while the command line loads its modules: one line, as later.

The package imports this first, and all else takes a quarter of a second or more.
"""

import contextlib
import os
import signal
import sys

# Address space, MiB, that libraries take as they are loaded, and each thread of OpenBLAS in those
# of NumPy and SciPy; and its most threads.
MEBIBYTES, OF_A_THREAD, MOST_THREADS = 384, 80, 64


def _fail(message: str, status: int) -> None:
    with contextlib.suppress(OSError):  # stderr may be closed
        os.write(2, f"lnocl: error: {message}\n".encode())
    os._exit(status)  # an exception may be lost in a module of C that is being loaded


def _end(*_: object) -> None:
    _fail("interrupted", 130)


def begin() -> None:
    """Hear Ctrl-C where this process is the command line; a library leaves it to its user."""
    words = sys.orig_argv[1:3]
    is_command = words == ["-m", "lnocl"] or os.path.basename(words[0] if words else "") == "lnocl"
    if not is_command:
        return
    # Scripts in the background ignore it.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    _load_where_memory_is_limited()


def _load_where_memory_is_limited() -> None:
    """Load OpenBLAS, and have it take its memory, before data do: it asks for that for ever."""
    try:
        import resource
    except ImportError:  # Windows
        return
    if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        return
    import mmap

    given = os.environ.get("OPENBLAS_NUM_THREADS", "")
    threads = int(given) if given.isdecimal() else MOST_THREADS
    threads = min(threads, os.cpu_count() or 1, MOST_THREADS)
    needed = MEBIBYTES + OF_A_THREAD * threads
    try:
        mmap.mmap(-1, needed * 2**20).close()
    except (OSError, MemoryError):
        fewer = "" if threads < 2 else ", or give OPENBLAS_NUM_THREADS=1"
        _fail(f"not enough memory: {needed} MiB are needed; raise ulimit -v{fewer}", 1)
    import numpy as np
    import scipy.linalg

    matrix = np.eye(64)
    _ = matrix @ matrix, scipy.linalg.inv(matrix)
    _ = scipy.linalg.solveh_banded(np.ones((1, 64)), np.ones(64))


def end() -> None:
    """Leave Ctrl-C to the command, which is loaded."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
