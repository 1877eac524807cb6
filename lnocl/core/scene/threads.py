"""How many threads the Fourier transforms of the host take."""

from __future__ import annotations

import math
from collections.abc import Sequence

# Waking threads costs 50 us, and on two cores they slow transforms of up to 512 x 512 down.
THREADED = 2**19


def threads(shape: Sequence[int]) -> int:
    """Return the number of threads for a transform of this shape, as SciPy's `workers`; -1: all."""
    return -1 if math.prod(shape) >= THREADED else 1
