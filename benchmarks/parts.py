"""What benchmarks share: the paper's iteration, and the tables of those that come in parts."""

from functools import partial

from astropy.table import Table

import lnocl
from lnocl.core.opencl.device import choose, describe
from lnocl.core.runs.options import PAPER

# The paper's iteration, but for what is given.
paper = partial(lnocl.deconvolve, **PAPER)


def report(rows, part, device, output):
    """Print rows one by one; with an output write them to OUTPUT-PART.ecsv, the device named."""
    kept = []
    for row in rows:
        words = (f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
        print("  ".join(words), flush=True)
        kept.append(row)
    table = Table(kept)
    table.meta |= {"device": describe(choose(device).device), "lnocl": lnocl.__version__}
    if output:
        table.write(f"{output}-{part}.ecsv", overwrite=True)
