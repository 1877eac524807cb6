"""Coverage: how often intervals hold the truth, over simulated observations of random skies.

    python benchmarks/coverage.py [KIND...] [--seeds FIRST LAST] [--replicas 50] --output FOLDER
    python benchmarks/coverage.py --report --output FOLDER

Each kind of scene has a jet, or a disc, of random knots, or a ring thinner than a pixel, and stars,
on 64 x 64 pixels (`KINDS`).
Each observation is reconstructed by default, the stars' positions refined from up to 0.3 pixels
off; its errors are of so many replicas. Measured are fluxes and positions of stars, apertures of 5
to 20 pixels at random places of light, and the profile along y in strips of 2 pixels. Each
observation is a row of numbers in FOLDER; --report makes a table and the histogram of ranks.
"""

import argparse
import re
import warnings
from functools import cache
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import Table
from regions import CirclePixelRegion, PixCoord, RectanglePixelRegion
from scipy import stats
from scipy.special import expit

import lnocl
from lnocl.core.scene.shifting import place
from lnocl.io.regions import read_apertures
from lnocl.plotting.figure import new_figure, save_figure
from lnocl.simulation.fizeau import fizeau_psf

N = 64
READ_NOISE = 5.0
STAR = 32.0, 14.0
# Electrons of the extended source in each image, contrast, images, PSF, sky and number of stars.
KINDS = {
    "contrast 1": (1e6, 1.0, 4, "fizeau", "jet", 1),
    "contrast 0.3": (1e6, 0.3, 4, "fizeau", "jet", 1),
    "contrast 30": (1e6, 30.0, 4, "fizeau", "jet", 1),
    "one image": (1e6, 1.0, 1, "fizeau", "jet", 1),
    "sharp jet": (1e6, 1.0, 4, "fizeau", "sharp", 1),
    "several stars": (1e6, 1.0, 4, "fizeau", "jet", 4),
    "faint": (3e4, 1.0, 4, "fizeau", "jet", 1),
    "bright": (2e7, 1.0, 4, "fizeau", "jet", 1),
    "disc": (1e6, 1.0, 1, "gaussian", "disc", 1),
    "ring": (3e4, 30.0, 1, "gaussian", "ring", 1),
}
DIAMETERS = 5, 5, 8, 8, 12, 12, 20, 20
STRIPS = range(14, 54, 2)
GROUPS = {
    "star flux": "star flux",
    "star position": "star position",
    "apertures 5, 8": "aperture of [58]",
    "apertures 12, 20": "aperture of (12|20)",
    "strips": "strip",
}
# The last is the error over the standard error, as a normal deviate has it 1 in the median.
COLUMNS = "kind", "quantity", "observations", "intervals", "68", "95", "fisher68", "fisher95", "z"


@cache
def psfs(kind, p, seed):
    """Return p PSFs of the Large Binocular Telescope, or Gaussians of 6 pixels."""
    if kind == "gaussian":
        y, x = np.indices((N, N)) - N // 2
        return np.exp(-0.5 * (x**2 + y**2) / (6.0 / 2.3548) ** 2)[None]
    angles = np.arange(p) * 45.0 * u.deg
    kernels = [
        fizeau_psf((N, N), angle, 2.12 * u.um, 5 * u.mas, 0.7, 10 * seed + k)
        for k, angle in enumerate(angles)
    ]
    return np.array(kernels)


def knots(rng, y, t, width, first, length):
    """Return light along y, and knots in it, at distances t from an axis."""
    decay = rng.uniform(0.5, 2.0)
    across = np.exp(-0.5 * (t / width) ** 2)
    sky = expit((y - first) / 1.0) * expit(length - y) * np.exp(-decay * y / length) * across
    for _ in range(rng.integers(2, 6)):
        at, thick = rng.uniform(first, 0.9 * length), rng.uniform(1.2, 3.0)
        front = (y - at + t**2 / (6.0 * width)) / thick
        brightness = rng.lognormal(0.3, 0.6) * np.exp(-decay * at / length)
        sky = sky + brightness * np.exp(-0.5 * front**2) * across
    return sky


def make_sky(kind, rng, star):
    """Return an extended source of unit sum round or beside a star."""
    y, x = np.indices((N, N), float)
    if kind == "ring":
        r = np.hypot(x - star[0], (y - star[1]) / rng.uniform(0.7, 1.0)) - rng.uniform(7, 12)
        sky = np.exp(-0.5 * (r / 0.5) ** 2) * (1 + 0.5 * np.tanh((x - star[0]) / 6))
    elif kind == "disc":
        r, angle = np.hypot(x - star[0], (y - star[1]) / rng.uniform(0.5, 1.0)), rng.uniform(0, 6)
        phi = np.arctan2(y - star[1], x - star[0])
        sky = knots(rng, r, 0.5 * np.sin(3 * phi + angle), 1.5, rng.uniform(0, 6), 16.0)
    else:
        along = y - star[1]
        width = rng.uniform(1.0, 1.5) if kind == "sharp" else rng.uniform(2.5, 4.0)
        width = width + 0.02 * np.clip(along, 0, None)
        wave = np.sin(along / rng.uniform(5, 12) + rng.uniform(0, 6)) * expit((along - 4) / 2)
        t = x - star[0] - rng.uniform(0, 1) * width * wave
        sky = knots(rng, along, t, width, 0.0 if kind == "sharp" else 2.0, 0.62 * N)
    return sky / sky.sum()


def observe(name, seed):
    """Return an observation, where its stars are said to be, and the truth."""
    light, contrast, p, psf, kind, n_stars = KINDS[name]
    rng = np.random.default_rng([seed, list(KINDS).index(name)])
    kernels = psfs(psf, p, seed % 4)
    middle = np.array(STAR if kind in ("jet", "sharp") else [32.0, 32.0])
    stars = [middle + rng.uniform(-0.5, 0.5, 2)]
    sky = light * make_sky(kind, rng, stars[0])
    while len(stars) < n_stars:
        other = rng.uniform(8, 56, 2)
        if min(np.hypot(*(other - each)) for each in stars) > 8:
            stars.append(other)
    fluxes = contrast * light * np.r_[1.0, 10 ** rng.uniform(-1.5, 0.0, n_stars - 1)]
    background = light / 1e6 * 25.0 + 10.0
    kernels = kernels / kernels.sum(axis=(1, 2), keepdims=True)
    otfs = np.fft.rfft2(np.fft.ifftshift(kernels, axes=(1, 2)))
    images = np.fft.irfft2(otfs * np.fft.rfft2(sky), (N, N)).clip(0)
    for image, kernel in zip(images, kernels, strict=True):
        for flux, star in zip(fluxes, stars, strict=True):
            image += flux * place(kernel, (N, N), *star).on_grid((N, N))
    counts = rng.poisson(images.clip(0) + background) + rng.normal(0, READ_NOISE, images.shape)
    observation = lnocl.Observation(
        counts, kernels, background=background, read_noise=READ_NOISE, psf_centre="given"
    )
    given = np.array(stars) + rng.uniform(-0.3, 0.3, (n_stars, 2))
    return observation, given, sky, fluxes, np.array(stars), rng


def make_regions(sky, rng):
    """Return circles at random places of light, and strips along y."""
    places, found = (sky / sky.sum()).ravel(), []
    for diameter in DIAMETERS:
        while True:
            y, x = divmod(int(rng.choice(N * N, p=places)), N)
            if min(x, y, N - 1 - x, N - 1 - y) > diameter / 2:
                break
        found.append(CirclePixelRegion(PixCoord(x, y), diameter / 2))
    strips = [RectanglePixelRegion(PixCoord(31.5, y + 0.5), 32, 2) for y in STRIPS]
    return found + strips


def measure(name, seed, n):
    """Return a table: kind of quantity, truth, value, errors, and those of each replica."""
    observation, given, sky, fluxes, stars, rng = observe(name, seed)
    regions = make_regions(sky, rng)
    result = lnocl.deconvolve(observation, given, pad=0, n_iter=2000, refine_positions=True)
    found = result.bootstrap(n, regions=regions, seed=seed)
    truth = [*fluxes, *stars.ravel()]
    truth += [each.flux(sky) for each in read_apertures(regions, None, (N, N))]
    kinds = ["star flux"] * len(fluxes) + ["star position"] * (2 * len(fluxes))
    kinds += [f"aperture of {d}" for d in DIAMETERS] + ["strip"] * len(STRIPS)
    schur = np.full(len(kinds), np.nan)
    schur[: 3 * len(fluxes)] = *result.star_flux_errors, *result.star_position_errors.ravel()
    return Table(
        {
            "quantity": kinds,
            "note": [each.note for each in found.quantities],
            "truth": truth,
            "value": found.values,
            "schur": schur,
            "errors": found.errors.T,
            "error": found.standard_errors,
            "n_iter": np.full(len(kinds), result.n_iter),
        }
    )


def score(rows):
    """Return how often the intervals of these rows hold the truth, and the ranks of the truth."""
    n = rows["errors"].shape[1]
    z = (rows["value"] - rows["errors"].mean(axis=1) - rows["truth"]) / rows["error"]
    widths = stats.t.ppf((1.0 + np.array([0.68, 0.95])) / 2.0, n - 1) * np.sqrt(1.0 + 1.0 / n)
    holds = [(abs(z) <= width).mean() for width in widths]
    of_star = abs(rows["value"] - rows["truth"]) / rows["schur"]
    is_star = np.isfinite(of_star).all()
    holds += [(of_star <= width).mean() if is_star else np.nan for width in (0.994, 1.96)]
    ranks = (rows["value"][:, None] - rows["errors"] < rows["truth"][:, None]).sum(axis=1)
    return [*holds, np.sqrt(np.median(z**2) / 0.455)], (ranks + 0.5) / (n + 1)


def pick(tables, pattern):
    """Return the rows of all tables whose quantity has such a name, as arrays."""
    columns = {name: [] for name in ("truth", "value", "schur", "errors", "error")}
    for table in tables:
        rows = table[[re.match(pattern, str(name)) is not None for name in table["quantity"]]]
        for name, values in columns.items():
            values.append(np.asarray(rows[name]))
    return {name: np.concatenate(values) for name, values in columns.items()}


def report(folder):
    """Write the table of coverage by kind and quantity, and draw the ranks."""
    tables = {
        name: [Table.read(path) for path in sorted(folder.glob(f"{name.replace(' ', '_')}-*.fits"))]
        for name in KINDS
    }
    tables["all"] = [table for each in list(tables.values()) for table in each]
    lines, ranks = [], {}
    for name, found in tables.items():
        for group, pattern in GROUPS.items():
            rows = pick(found, pattern)
            shares, ranks[group] = score(rows)
            lines.append((name, group, len(found), len(rows["truth"]), *np.round(shares, 3)))
    table = Table(rows=lines, names=COLUMNS)
    table.write(folder / "coverage.ecsv", overwrite=True)
    table.pprint(max_lines=-1, max_width=-1)
    figure = new_figure(12.0, 3.0)
    axes = figure.subplots(1, len(ranks), sharey=True)
    for axis, (group, each) in zip(axes, ranks.items(), strict=True):
        axis.hist(each, bins=np.linspace(0, 1, 11), density=True, color="0.6", edgecolor="white")
        axis.axhline(1, color="black", lw=1)
        axis.set(title=group, xlabel="rank of the truth", xlim=(0, 1))
    save_figure(figure, str(folder / "ranks.png"), True)


def main():
    """Measure what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--seeds", type=int, nargs=2, default=(1000, 1024))
    parser.add_argument("--replicas", type=int, default=50)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    given.output.mkdir(exist_ok=True)
    if given.report:
        report(given.output)
        return
    warnings.simplefilter("ignore")
    for seed in range(*given.seeds):
        for name in given.kinds or KINDS:
            path = given.output / f"{name.replace(' ', '_')}-{seed}.fits"
            if not path.exists():
                measure(name, seed, given.replicas).write(path)
                print(path, flush=True)


if __name__ == "__main__":
    main()
