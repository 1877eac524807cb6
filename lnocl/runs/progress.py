"""The progress bar of a run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from tqdm import tqdm

# Seconds between two looks at the objective: each look waits for the device.
PROGRESS_INTERVAL = 0.1


def make_bar(total: int, unit: str, progress: bool) -> tqdm:
    """Return a progress bar of so many steps, quiet where stderr is closed or no terminal."""
    # disable=None is tqdm's word for "quiet where stderr is no terminal".
    return tqdm(total=total, unit=unit, disable=None if progress and sys.stderr else True)


class Bar:
    """A progress bar that looks at what it shows at most every tenth of a second."""

    def __init__(self, n_iter: int, progress: bool) -> None:
        self._bar = make_bar(n_iter, "it", progress)
        self._shown = time.monotonic()

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.close()

    def expect(self, n_iter: int) -> None:
        """Count to another number of iterations."""
        self._bar.total = n_iter

    def show(self, iteration: int, quantity: Callable[[], str], last: bool = False) -> None:
        """Show how far it is, where it is time to, or at the end."""
        if self._bar.disable:
            return
        if last or time.monotonic() - self._shown > PROGRESS_INTERVAL:
            self._bar.set_postfix_str(quantity(), refresh=False)
            self._bar.update(iteration - self._bar.n)
            self._shown = time.monotonic()
