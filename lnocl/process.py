"""What belongs to the whole process, and is changed by one thread at a time."""

from __future__ import annotations

import logging
import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

# Whether other processes like this one may share the devices of this machine.
is_worker = False

# One lock for all of it: threads that took one of several could wait for each other.
LOCK = threading.RLock()
# A process forked while another thread has it would wait for that thread forever.
if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(
        before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=LOCK.release
    )


def n_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def ignored_warnings(category: type[Warning] = Warning) -> Iterator[None]:
    """Leave warnings of a category unsaid."""
    with LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore", category)
        yield


@contextmanager
def ignored_notes(name: str = "lnocl", least: int = logging.WARNING) -> Iterator[None]:
    """Leave the notes of a log unsaid that are below a level."""
    log = logging.getLogger(name)
    with LOCK:
        level = log.level
        log.setLevel(least)
        try:
            yield
        finally:
            log.setLevel(level)


@contextmanager
def recorded_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Yield a list that all warnings go to."""
    with LOCK, warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        yield recorded
