"""Stars found by lnocl stars: completeness and false detections, where the truth is known.

    python benchmarks/stars.py [--seeds FIRST LAST] [--data FOLDER]

Scenes: six stars, one or none of 20 to 1600 standard deviations on 128 x 128 pixels, through Moffat
PSFs, the fringed ones of the Large Binocular Telescope and speckled ones, on a flat sky, a nebula
(lognormal, with a power law), clumps, or twelve galaxies. Crowded: 250 stars of 300 to 1e6
electrons, a Moffat PSF 3 pixels wide, on 384 x 384 pixels with a sky of 100 electrons, a diffuse
source of 80 and read noise of 5. Spitzer: 200 Gaussian stars of the field's own width are put into
a real field for each seed, and are complete where they are found within a pixel and were not there
before; detections in the field turned upside down say how many are false.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.stats import sigma_clipped_stats
from scipy import ndimage
from scipy.signal import fftconvolve

from lnocl.detection import find_stars
from lnocl.simulation import fizeau_psf

N_STARS, SIDE, WIDTH, BETA = 250, 384, 3.0, 3.0
INJECTED = 200
# Of a Gaussian on pixels.
SPITZER_SIGMA = 0.75


def moffat(shape, x, y, width=WIDTH, beta=BETA):
    """Return a Moffat profile of peak 1."""
    rows, columns = np.indices(shape)
    scale = width / (2.0 * np.sqrt(2.0 ** (1.0 / beta) - 1.0))
    return (1.0 + ((columns - x) ** 2 + (rows - y) ** 2) / scale**2) ** -beta


def make_psf(kind, seed, rng):
    """Return a PSF of unit sum, 256 x 256 pixels."""
    if kind == "fringed":
        angle, strehl = 60 * (seed % 3) * u.deg, (0.9, 0.5, 0.75)[seed % 3]
        return fizeau_psf((256, 256), angle, 2.12 * u.um, 5.11 * u.mas, strehl, seed)
    if kind == "speckled":  # three phase screens of 1.1 rad, 2.6 pixels a resolution element
        radius = np.hypot(*np.mgrid[-128:128, -128:128])
        pupil = radius < 256 / 5.2
        spectrum = (np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(256)])) ** 2 + 80**-2) ** (-11 / 12)
        psf = 0
        for _ in range(3):
            phase = np.fft.ifft2(spectrum * np.fft.fft2(rng.normal(size=pupil.shape))).real
            phase *= 1.1 / phase[pupil].std()
            psf = psf + abs(np.fft.fftshift(np.fft.fft2(pupil * np.exp(1j * phase)))) ** 2
        y, x = np.unravel_index(psf.argmax(), psf.shape)
        psf = np.roll(psf, (128 - y, 128 - x), (0, 1))
    else:
        psf = moffat((256, 256), 128, 128, rng.uniform(2.2, 4.0), rng.uniform(2.3, 4.5))
    return psf / psf.sum()


def make_source(kind, rng, side=128):
    """Return an extended source, electrons a pixel."""
    rows, columns = np.indices((side, side))
    if kind == "nebula":
        frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(2 * side)]))
        frequency[0, 0] = np.inf
        noise = np.fft.fft2(rng.normal(size=frequency.shape))
        field = np.fft.ifft2(frequency ** -rng.uniform(1.2, 1.8) * noise).real[:side, :side]
        light = np.exp(rng.uniform(0.8, 1.5) * field / field.std())
        return light / light.mean() * 10 ** rng.uniform(1.5, 3.3)
    light = np.zeros((side, side))
    if kind == "clumps":
        for _ in range(40):
            (x, y), sigma = rng.uniform(0, side, 2), rng.uniform(1.0, 6.0)
            square = (columns - x) ** 2 + (rows - y) ** 2
            light += 10 ** rng.uniform(0, 1.5) * np.exp(-square / (2 * sigma**2))
        light *= 10 ** rng.uniform(1.5, 3) / light.mean()
    if kind == "galaxies":  # of Sersic's profile
        for _ in range(12):
            (x, y), angle = rng.uniform(8, side - 8, 2), rng.uniform(0, np.pi)
            dx, dy, index = columns - x, rows - y, rng.uniform(0.7, 3.0)
            along = dx * np.cos(angle) + dy * np.sin(angle)
            across = (dy * np.cos(angle) - dx * np.sin(angle)) / rng.uniform(0.4, 1.0)
            radius = np.sqrt(along**2 + across**2 + 0.1) / rng.uniform(1.5, 6.0)
            profile = np.exp(-(2 * index - 1 / 3) * (radius ** (1 / index) - 1))
            light += 10 ** rng.uniform(3.3, 5) * profile / profile.sum()
    return light


def scene(psf_kind, source_kind, n_stars, seed, side=128):
    """Return counts, their PSF, and the places and significance of the stars."""
    rng = np.random.default_rng([45, seed, n_stars, *map(ord, psf_kind[:2] + source_kind[:2])])
    psf = make_psf(psf_kind, seed, rng)
    light = fftconvolve(make_source(source_kind, rng), psf, mode="same").clip(0)
    light += 10 ** rng.uniform(1, 3)
    noise = np.sqrt(light.mean() + 25)
    places = rng.uniform(12, side - 13, (n_stars, 2))
    significance = 10 ** rng.uniform(1.3, 3.2, n_stars)
    spectrum = np.fft.fftn(np.fft.ifftshift(psf))
    for place, value in zip(places, significance, strict=True):
        moved = ndimage.fourier_shift(spectrum, place[::-1])
        light += value * noise / np.sqrt((psf**2).sum()) * np.fft.ifftn(moved).real[:side, :side]
    counts = rng.poisson(light.clip(0)) + rng.normal(0, 5, light.shape)
    return counts, psf, places, significance


def of_scenes(seeds):
    """Print the table of scenes."""
    cells = [("moffat", "flat", 6), ("fringed", "flat", 6), ("speckled", "flat", 6)]
    cells += [("moffat", kind, n) for kind in ("nebula", "clumps", "galaxies") for n in (6, 0)]
    cells += [(psf, "nebula", n) for psf in ("fringed", "speckled") for n in (1, 0)]
    print("share of stars found, and false detections a field, with and without PSF")
    for psf_kind, source_kind, n_stars in cells:
        row = f"{psf_kind:9} {source_kind:9} {n_stars} stars"
        for is_given in (True, False):
            found, false = [], 0
            for seed in seeds:
                counts, psf, places, _ = scene(psf_kind, source_kind, n_stars, seed)
                with warnings.catch_warnings(action="ignore"):
                    table = find_stars(counts, psf if is_given else None)
                was_found, wrong = matches(table, places)
                found, false = [*found, *was_found], false + wrong
            share = f"{np.mean(found):.2f}" if found else "    "
            row += f"    {share} {false / len(seeds):6.2f}"
        print(row, flush=True)


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
        nearest = distances.argmin() if len(places) else 0
        if len(places) and distances[nearest] < reach:
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
    print("\ncrowded; share of stars found by electrons, and false detections a field")
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
    rough = field - ndimage.gaussian_filter(field, 2.0)
    noise = sigma_clipped_stats(rough[np.isfinite(rough)])[2]
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
    of_scenes(seeds)
    of_crowded(seeds)
    field = given.data / "spitzer-glimpse/spitzer_glimpse_irac2_l18.fits"
    if field.exists():
        of_spitzer(fits.getdata(field).astype(float), seeds)
    quasar = given.data / "hst-lensed-quasar"
    if quasar.exists():
        image = fits.getdata(quasar / "quasar_F814W_sci.fits").astype(float)
        print("\nlensed quasar")
        find_stars(image).pprint_all()


if __name__ == "__main__":
    main()
