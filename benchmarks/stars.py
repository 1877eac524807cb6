"""Stars found by lnocl stars: completeness and false detections, where the truth is known.

    python benchmarks/stars.py [--seeds FIRST LAST] [--data FOLDER]

Crowded: 250 stars of 300 to 1e6 electrons, a Moffat PSF 3 pixels wide, on 384 x 384 pixels with a
sky of 100 electrons, a diffuse source of 80 and read noise of 5. Spitzer: 200 Gaussian stars of the
field's own width are put into a real field for each seed, and are complete where they are found
within a pixel and were not there before; detections in the field turned upside down say how many
are false. A star is as bright as its filtered image over the noise that the field has without it.
"""

import argparse
from pathlib import Path

import numpy as np
from astropy.io import fits

from lnocl.detection import find_stars

N_STARS, SIDE, WIDTH, BETA = 250, 384, 3.0, 3.0
INJECTED = 200
# Of a Gaussian on pixels.
SPITZER_SIGMA = 0.75


def moffat(shape, x, y):
    """Return a Moffat profile of peak 1."""
    rows, columns = np.indices(shape)
    scale = WIDTH / (2.0 * np.sqrt(2.0 ** (1.0 / BETA) - 1.0))
    return (1.0 + ((columns - x) ** 2 + (rows - y) ** 2) / scale**2) ** -BETA


def crowded(seed):
    """Return counts, the true positions and fluxes."""
    chance = np.random.default_rng(seed)
    places = chance.uniform(4, SIDE - 5, (N_STARS, 2))
    fluxes = 10 ** chance.uniform(2.5, 6, N_STARS)
    unit = moffat((201, 201), 100, 100).sum()
    rows, columns = np.indices((SIDE, SIDE))
    distance = (columns - SIDE / 2) ** 2 + (rows - SIDE / 3) ** 2
    light = 100.0 + 80.0 * np.exp(-distance / (2 * 60.0**2))
    for (x, y), flux in zip(places, fluxes, strict=True):
        light += flux / unit * moffat(light.shape, x, y)
    return chance.poisson(light) + chance.normal(0, 5, light.shape), places, fluxes


def matches(found, places, reach=1.5):
    """Return which of the places were found, and the number of false detections."""
    was_found, false = np.zeros(len(places), bool), 0
    for position in np.array([found["x"], found["y"]]).T:
        distances = np.hypot(*(places - position).T)
        distances[was_found] = np.inf
        nearest = distances.argmin()
        if distances[nearest] < reach:
            was_found[nearest] = True
        else:
            false += 1
    return was_found, false


def shares(edges, values, was_found):
    """Return the share found between each two edges."""
    which = np.digitize(values, edges) - 1
    cells = (was_found[which == i] for i in range(len(edges) - 1))
    return "  ".join(f"{cell.mean():7.2f}" if cell.size else "      -" for cell in cells)


def of_crowded(seeds):
    """Print the table of crowded fields."""
    edges = 10 ** np.arange(2.5, 6.1, 0.5)
    psf = moffat((61, 61), 30, 30)
    print("crowded; share of stars found by electrons, and false detections a field")
    print(" " * 8, "  ".join(f"{edge:7.3g}" for edge in edges[:-1]), "   all   false")
    for name, given in (("no PSF", None), ("PSF", psf)):
        found, false, bright = [], 0, []
        for seed in seeds:
            counts, places, fluxes = crowded(seed)
            was_found, wrong = matches(find_stars(counts, given), places)
            found.append(was_found)
            bright.append(fluxes)
            false += wrong
        found, bright = np.concatenate(found), np.concatenate(bright)
        row = shares(edges, bright, found)
        print(f"{name:8}", row, f"  {found.mean():.2f}  {false / len(seeds):6.1f}")


def of_spitzer(field, seeds):
    """Print the table of stars put into the Spitzer field."""
    edges = np.array([3, 5, 7, 10, 20, 50, 200, 1000])
    before = find_stars(field)
    upside_down = len(find_stars(2 * np.nanmedian(field) - field))
    there = np.array([before["x"], before["y"]]).T
    sky = np.nanmedian(field)
    noise = np.median(before["peak"] / before["significance"])
    found, bright = [], []
    for seed in seeds:
        chance = np.random.default_rng(seed)
        places = chance.uniform(5, np.array(field.shape[::-1]) - 6, (INJECTED, 2))
        apart = [np.hypot(*(there - place).T).min() > 4 for place in places]
        places = places[apart]
        peaks = noise * 10 ** chance.uniform(np.log10(3), 3, len(places))
        rows, columns = np.indices(field.shape)
        light = field.copy()
        for (x, y), peak in zip(places, peaks, strict=True):
            part = np.s_[int(y) - 5 : int(y) + 7, int(x) - 5 : int(x) + 7]
            distance = (columns[part] - x) ** 2 + (rows[part] - y) ** 2
            light[part] += peak * np.exp(-distance / (2 * SPITZER_SIGMA**2))
        was_found, _ = matches(find_stars(light), places, 1.0)
        found.append(was_found)
        bright.append(peaks / noise)
    found, bright = np.concatenate(found), np.concatenate(bright)
    print(f"\nSpitzer: {len(before)} stars; {upside_down} detections upside down; sky {sky:.3g}")
    print("share found of stars put more than 4 pixels from others, by peak over the sky's noise")
    print(" " * 8, "  ".join(f"{edge:7.3g}" for edge in edges[:-1]))
    print(" " * 8, shares(edges, bright, found))


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=[0, 10], metavar=("FIRST", "LAST"))
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared/data")
    given = parser.parse_args()
    seeds = range(*given.seeds)
    of_crowded(seeds)
    field = given.data / "spitzer-glimpse/spitzer_glimpse_irac2_l18.fits"
    if field.exists():
        of_spitzer(fits.getdata(field).astype(float), seeds)
    quasar = given.data / "hst-lensed-quasar"
    if quasar.exists():
        image, psf = (
            fits.getdata(quasar / f"quasar_F814W_{name}.fits").astype(float)
            for name in ("sci", "psf")
        )
        print("\nlensed quasar, with the PSF of its file")
        find_stars(image, psf).pprint_all()


if __name__ == "__main__":
    main()
