"""The progress bar of a run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from tqdm import tqdm

# Seconds between two updates: each reads the objective, and waits for the device.
PROGRESS_INTERVAL = 0.1


def make_bar(total: int, unit: str, progress: bool) -> tqdm:
    """Return a progress bar of so many steps: in a notebook, or on stderr if it is a terminal."""
    if not (progress and sys.stderr):
        return tqdm(total=total, unit=unit, disable=True)
    from tqdm.auto import tqdm as bar  # which takes its time to load

    # With disable=None, it is quiet where stderr is not a terminal.
    return bar(total=total, unit=unit, disable=None)


class Bar:
    """A progress bar that reads the objective at most every tenth of a second."""

    def __init__(self, n_iter: int, progress: bool) -> None:
        self._bar = make_bar(n_iter, "it", progress)
        self._shown = time.monotonic()

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.close()

    def expect(self, n_iter: int | None) -> None:
        """Change the number of iterations, which may be unknown."""
        self._bar.total = n_iter

    def show(self, iteration: int, quantity: Callable[[], str], last: bool = False) -> None:
        """Show the iteration and a quantity, where an update is due or this is the last."""
        if self._bar.disable:
            return
        if last or time.monotonic() - self._shown > PROGRESS_INTERVAL:
            self._bar.set_postfix_str(quantity(), refresh=False)
            self._bar.update(iteration - self._bar.n)
            self._shown = time.monotonic()
