"""The OpenCL source of all kernels, and where it lies."""

from __future__ import annotations

from functools import cache
from pathlib import Path

# In the order in which they build on each other.
SOURCES = (
    "precision.cl",
    "complex.cl",
    "odd.cl",
    "fft.cl",
    "rows.cl",
    "transmit.cl",
    "columns.cl",
    "convolve.cl",
    "sums.cl",
    "stars.cl",
    "decide.cl",
    "ratio.cl",
    "turn.cl",
    "smooth.cl",
    "scale.cl",
    "step.cl",
)


@cache
def source() -> str:
    """Return the OpenCL source of all kernels."""
    return "".join(
        f'#line 1 "{name}"\n{(folder() / name).read_text(encoding="ascii")}' for name in SOURCES
    )


def folder() -> Path:
    """Return the folder of the kernels: inside the package, or beside it in a clone."""
    package = Path(__file__).parents[2]
    inside = package / "kernels"
    return inside if inside.is_dir() else package.parent / "kernels"
