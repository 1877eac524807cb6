"""Sources that are put in and found, over the share that the limit states.

    python benchmarks/completeness.py [--kinds sky star jet crowded] [--errors 0 0.03]
        [--completeness 0.5 0.9 0.95] [--widths 0 4] [--sources N] [--alarms A] [--first SEED]
        [--output TABLE.ecsv]

The fields are those of benchmarks/false_alarms.py. N sources are put into several fields of each
kind, forty into each, by `lnocl.significance.Significance.inject`: each has the flux that its place
asks for, and the reconstruction is made again. The columns are the share found and its standard
error, and the same of those within ten pixels of a star.
"""

import argparse
import warnings

import numpy as np
from astropy.table import Table
from false_alarms import KINDS, PSF, SKY, field

import lnocl

EACH, NEAR = 40, 10.0


def measure(kind, error, width, completeness, n, alarms, first):
    """Return whether each source is found, and whether it lies near a star."""
    found, near = [], []
    for k in range(-(-n // EACH)):
        counts, stars, _ = field(kind, error, first + k)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = lnocl.deconvolve(lnocl.Observation(counts, PSF, background=SKY), stars)
            maps = result.significance(width, alarms)
            sources = maps.inject(EACH, completeness, seed=k)
        found += sources["found"].tolist()
        for x, y in zip(sources["x"].value, sources["y"].value, strict=True):
            away = np.hypot(*(np.reshape(stars, (-1, 2)) - (x, y)).T)
            near.append(bool((away < NEAR).any()))
    return np.array(found), np.array(near)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--errors", nargs="+", type=float, default=[0.0])
    parser.add_argument("--widths", nargs="+", type=float, default=[0.0])
    parser.add_argument("--completeness", nargs="+", type=float, default=[0.5, 0.9])
    parser.add_argument("--sources", type=int, default=2000)
    parser.add_argument("--alarms", type=float, default=0.01)
    parser.add_argument("--first", type=int, default=20000)
    parser.add_argument("--output")
    given = parser.parse_args()
    rows = []
    for error in given.errors:
        for kind in given.kinds:
            for width in given.widths:
                for stated in given.completeness:
                    found, near = measure(
                        kind, error, width, stated, given.sources, given.alarms, given.first
                    )
                    share, close = found.mean(), found[near].mean() if near.any() else np.nan
                    rows.append({
                        "kind": kind, "psf_error": error, "width": width, "stated": stated,
                        "sources": len(found), "found": share,
                        "error": np.sqrt(share * (1 - share) / len(found)),
                        "near": int(near.sum()), "found_near": close,
                    })  # fmt: skip
                    print(rows[-1], flush=True)
    table = Table(rows)
    for name in ("found", "error", "found_near"):
        table[name].format = ".3f"
    print(table)
    if given.output:
        table.write(given.output, overwrite=True)


if __name__ == "__main__":
    main()
