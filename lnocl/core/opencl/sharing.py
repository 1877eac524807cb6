"""Several processes on one machine: which of its like devices each of them takes."""

from __future__ import annotations

import functools
import os
import tempfile
from typing import IO

from lnocl.errors import DeviceError

# The lock is held while its file is open: until the process ends, however it does.
_held: list[IO[bytes]] = []


@functools.cache
def claim(n: int) -> int:
    """Return which of n devices this process takes, in all its life: one that the fewest others do.

    Raises
    ------
    DeviceError
        The folder for temporary files cannot be written to.
    """
    folder = os.path.join(tempfile.gettempdir(), f"lnocl-devices-{os.getuid()}")
    try:
        os.makedirs(folder, mode=0o700, exist_ok=True)
        number = 0
        while not _lock(os.path.join(folder, str(number))):
            number += 1
    except OSError as error:
        raise DeviceError(
            f"devices cannot be shared among processes: {folder}: {error.strerror}; give `device`"
        ) from error
    return number % n


def _lock(path: str) -> bool:
    """Lock a file, and return whether that was done: no other process has it."""
    import fcntl

    file = open(path, "wb")  # noqa: SIM115
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return False
    _held.append(file)
    return True
