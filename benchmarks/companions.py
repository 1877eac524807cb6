"""Companions that are not among the stars: what goes to the PSF, the star and the extended source.

    python benchmarks/companions.py [--distances D ...] [--contrasts C ...] [--wrong W ...]
        [--images P ...] [--seeds FIRST LAST] [--psf-error SHARE] [--output FILE.ecsv]

A star of 1e6 on a sky of 100 has a companion at some widths of the PSF, which is lopsided, and
given so many times too wide. Only the star is given. The summary has for each case the mean flux of
the star over the truth, less 1, and the median error stated; the light of the extended source
within 0.75 widths of the companion over its flux, mean, least and most; and how many companions
`significance` finds as points within 0.7 resolutions, with the mean of their fluxes over the truth.
"""

import argparse
import itertools
import warnings
import zlib

import honest
import numpy as np
from astropy.table import Table

import lnocl

FLUX, WIDTH, N = 1e6, 3.4, 64


def scene(rng, distance, contrast, wrong, p):
    """Return the observation's parts, and the places of star and companion."""
    star, turn = honest.middle(rng, N), rng.uniform(0, 2 * np.pi)
    place = star + distance * WIDTH * np.array([np.cos(turn), np.sin(turn)])
    widths = WIDTH * (np.linspace(0.92, 1.08, p) if p > 1 else np.ones(1))
    shape = {"skew": 0.1, "stretch": 1.1}
    images = [
        rng.poisson(
            100 + honest.seen(N, honest.psf(41, w, **shape), [star, place], [FLUX, contrast * FLUX])
        )
        for w in widths
    ]
    return images, [honest.psf(41, wrong * w, **shape) for w in widths], star, place


def measure(distance, contrast, wrong, p, seed, known):
    """Return a row of one run."""
    name = f"{distance:g} {contrast:g} {wrong:g} {p}"
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    images, psfs, star, place = scene(rng, distance, contrast, wrong, p)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        observation = lnocl.Observation(images, psfs, background=100.0, **known)
        result = lnocl.deconvolve(observation, [star])
        found = result.significance()
    y, x = np.indices((N, N))
    is_near = np.hypot(x - place[0], y - place[1]) <= 0.75 * WIDTH
    rows = found.detections
    away = np.hypot(rows["x"].value - place[0], rows["y"].value - place[1])
    is_point = (away < 0.7 * found.resolution) & (rows["kind"] == "point")
    fluxes = rows["flux"].value[is_point] / (contrast * FLUX)
    row = {
        "distance": distance,
        "contrast": contrast,
        "wrong": wrong,
        "p": p,
        "star": result.star_fluxes[0] / FLUX - 1,
        "stated": result.star_flux_errors[0] / FLUX,
        "extended": result.extended[is_near].sum() / (contrast * FLUX),
        "found": bool(is_point.any()),
        "flux": fluxes[0] if len(fluxes) else np.nan,
    }
    print(f"{seed} {name} " + " ".join(f"{row[k]:.4g}" for k in list(row)[4:]), flush=True)
    return row


def summarise(table):
    """Return a row for each case."""
    found = []
    for case in table.group_by(["distance", "contrast", "wrong", "p"]).groups:
        light, fluxes = case["extended"], case["flux"][case["found"]]
        found.append(
            {
                **{name: case[name][0] for name in ("distance", "contrast", "wrong", "p")},
                "star": np.mean(case["star"]),
                "stated": np.median(case["stated"]),
                "extended": np.mean(light),
                "least": np.min(light),
                "most": np.max(light),
                "found": f"{np.sum(case['found'])} of {len(case)}",
                "flux": np.mean(fluxes) if len(fluxes) else np.nan,
            }
        )
    rows = Table(found)
    for name in ("star", "stated", "extended", "least", "most", "flux"):
        rows[name].format = "%.3f"
    return rows


def main():
    """Print and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--distances", type=float, nargs="+", default=[1.0, 1.5, 2.0, 3.0, 6.0])
    parser.add_argument("--contrasts", type=float, nargs="+", default=[0.003, 0.02, 0.1])
    parser.add_argument("--wrong", type=float, nargs="+", default=[1.0, 1.03])
    parser.add_argument("--images", type=int, nargs="+", default=[1])
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 2), metavar=("FIRST", "LAST"))
    parser.add_argument("--psf-error", type=float)
    parser.add_argument("--output", metavar="FILE.ecsv")
    given, rows = parser.parse_args(), []
    known = {} if given.psf_error is None else {"psf_error": given.psf_error}
    seeds = range(given.seeds[0], given.seeds[1] + 1)
    cases = itertools.product(given.distances, given.contrasts, given.wrong, given.images, seeds)
    for case in cases:
        rows.append(measure(*case, known))
        if given.output:
            Table(rows).write(given.output, overwrite=True)
    summarise(Table(rows)).pprint(max_lines=-1, max_width=-1)


if __name__ == "__main__":
    main()
