"""PSFs a little too narrow or too wide: star fluxes by default, and what is said.

    python benchmarks/widths.py [--seeds FIRST LAST] --output FILE.ecsv
    python benchmarks/widths.py --report FILE.ecsv

Stars of 6e4 electrons lie on a flat sky of 50, seen through a Gaussian of 3 pixels; the PSF given
is 2, 5 or 10 % narrower or wider. One star, two, or 15 at random places at least 6 pixels apart.
Columns: the factor of the width, stars, seed, the median and the worst relative error of the
fluxes, the share of stars within two standard errors, the largest error in standard errors, whether
PSFs were refined, and whether a warning was given.
"""

import argparse
import warnings

import numpy as np
from astropy.table import Table

import lnocl

N, WIDTH, FLUX, BACKGROUND = 96, 3.0, 6e4, 50.0
FACTORS = 0.90, 0.95, 0.98, 1.02, 1.05, 1.10
COLUMNS = "factor stars seed median worst within1 within2 z refined warned"


def gaussian(width, x=N // 2, y=N // 2, n=N):
    """Return a Gaussian of unit sum, centred at (x, y)."""
    rows, columns = np.indices((n, n))
    psf = np.exp(-4 * np.log(2) * ((columns - x) ** 2 + (rows - y) ** 2) / width**2)
    return psf / psf.sum()


def places(n, rng):
    """Return n places, none nearer to another than 6 pixels."""
    found = []
    while len(found) < n:
        place = rng.uniform(10, N - 11, 2)
        if all(np.hypot(*(place - other)) >= 6 for other in found):
            found.append(place)
    return found


def measure(factor, n, seed):
    """Return a row."""
    rng = np.random.default_rng([seed, n])
    stars = places(n, rng)
    image = rng.poisson(BACKGROUND + FLUX * sum(gaussian(WIDTH, *star) for star in stars))
    psf = gaussian(factor * WIDTH, 20, 20, 41)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        observation = lnocl.Observation(image, psf, background=BACKGROUND)
        result = lnocl.deconvolve(observation, stars)
        errors = result.star_flux_errors
    off = result.star_fluxes - FLUX
    z, refinement = abs(off) / errors, result.psf_refinement
    return (
        factor, n, seed, np.median(off) / FLUX, off[np.argmax(abs(off))] / FLUX,
        np.mean(z < 1), np.mean(z < 2), z.max(),
        refinement is not None and refinement.is_accepted, len(said) > 0,
    )  # fmt: skip


def report(table):
    """Print a line for each factor and number of stars."""
    print("factor stars  runs  refined  said  median  worst   within 1, 2 errors  z at most")
    for n in np.unique(table["stars"]):
        for factor in FACTORS:
            rows = table[(table["stars"] == n) & (table["factor"] == factor)]
            if len(rows):
                said = (rows["refined"] | rows["warned"]).sum()
                worst = rows["worst"][np.argmax(abs(rows["worst"]))]
                print(
                    f"{factor:6} {n:5} {len(rows):5} {rows['refined'].sum():8} "
                    f"{said:5} {np.median(rows['median']):7.4f} "
                    f"{worst:7.3f} {rows['within1'].mean():8.2f} {rows['within2'].mean():5.2f} "
                    f"{rows['z'].max():12.1f}"
                )


def main():
    """Measure, or report what was measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 20), metavar=("FIRST", "LAST"))
    parser.add_argument("--output")
    parser.add_argument("--report")
    arguments = parser.parse_args()
    if arguments.report:
        report(Table.read(arguments.report))
        return
    rows = []
    for seed in range(*arguments.seeds):
        rows += [measure(factor, n, seed) for n in (1, 2, 15) for factor in FACTORS]
        if arguments.output:
            Table(rows=rows, names=COLUMNS.split()).write(arguments.output, overwrite=True)
    report(Table(rows=rows, names=COLUMNS.split()))


if __name__ == "__main__":
    main()
