"""The time and the deviation of the settings that ``lnocl bench`` compares, as table and figure.

``python benchmarks/trade.py --output STEM`` writes STEM.ecsv and STEM.png
(docs/validation/precision.md).
"""

import argparse

import numpy as np
from astropy.table import Table

from lnocl.core.opencl.device import choose, describe
from lnocl.plotting.figure import line_style, new_figure, save_figure
from lnocl.studies import bench


def draw(table):
    """Return the deviation of the settings from the reference against their time."""
    figure = new_figure(6.5, 4.5)
    axis = figure.subplots()
    for i, part in enumerate(table.group_by(["pad", "precision"]).groups):
        pad = f"pad {part['pad'][0]}" if part["pad"][0] else "no padding"
        seconds, deviation = np.array(part["seconds"]), np.array(part["deviation"])
        shown = deviation > 0
        name = f"{part['precision'][0]}, {pad}"
        axis.plot(seconds[shown], deviation[shown], **line_style(i), marker="o", label=name)
    axis.set(xscale="log", yscale="log", xlabel="time (s)", ylabel="deviation, 24 rows")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    return figure


def main():
    """Compare the settings on the demo's scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--n-iter", type=int, default=400)
    parser.add_argument("--output", required=True, metavar="STEM")
    arguments = parser.parse_args()
    rows = bench.compare(bench.simulated_case(arguments.size), arguments.n_iter, progress=True)
    table = Table(list(rows), meta={"device": describe(choose().device)})
    table.write(f"{arguments.output}.ecsv", overwrite=True)
    save_figure(draw(table), f"{arguments.output}.png", overwrite=True)


if __name__ == "__main__":
    main()
