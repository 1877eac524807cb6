"""The OpenCL source of all kernels, and where it lies."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

# In the order in which they build on each other.
SOURCES = (
    "precision.cl",
    "complex.cl",
    "odd.cl",
    "fft.cl",
    "scratch.cl",
    "registers.cl",
    "tiles.cl",
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

# Kernels that one program has: those that a run needs first, and those that it needs last; a third
# has all others. What a run has no use for is not compiled, and two may be compiled at once.
FIRST = ("rfft_rows", "otf_columns", "convolve_columns", "correlate_columns", "ratio_rows")
LAST = "smooth", "collect_sums", "gradient_rows", "step_rows", "follow_stars"
KERNEL = re.compile(r"^KERNEL void (\w+)\(([^)]*)\).*?^}\n", re.MULTILINE | re.DOTALL)


@cache
def source() -> str:
    """Return the OpenCL source of all kernels."""
    return "".join(
        f'#line 1 "{name}"\n{(folder() / name).read_text(encoding="ascii")}' for name in SOURCES
    )


@cache
def beside(kernel: str, text: str) -> str:
    """Return the source of the program that has a kernel: others leave their lines empty."""
    parts = {each: part for part in (FIRST, LAST) for each in part}
    own = parts.get(kernel)
    return KERNEL.sub(
        lambda found: found[0] if parts.get(found[1]) == own else "\n" * found[0].count("\n"), text
    )


@cache
def arguments(text: str) -> dict[str, dict[str, str]]:
    """Return the types of each kernel's arguments, by their names and in their order."""
    declared = re.compile(r"([^,]*?)(\w+)\s*(?:,|$)")
    return {
        kernel: {name: kind for kind, name in declared.findall(among)}
        for kernel, among in KERNEL.findall(text)
    }


def folder() -> Path:
    """Return the folder of the kernels: inside the package, or beside it in a clone."""
    package = Path(__file__).parents[2]
    inside = package / "kernels"
    return inside if inside.is_dir() else package.parent / "kernels"
