"""Light where there is none: fluxes of regions on empty skies, and on blobs, discs and jets.

    python benchmarks/light.py [--seeds FIRST LAST] [--replicas 50] --output FILE.ecsv
    python benchmarks/light.py --report FILE.ecsv

Each seed draws a scene of each kind (`KINDS`), with one of four backgrounds, as one image and as
four. PSFs and background are right, and all is by default. Measured are circles at random places,
at places of light and round the star, the whole frame by replicas, and the flux of the extended
source with the error that is printed. Each is a row; --report makes a table.
"""

import argparse
import warnings

import numpy as np
from astropy.table import Table, vstack
from regions import CirclePixelRegion, PixCoord, RectanglePixelRegion
from scipy.signal import fftconvolve

import lnocl

N = 96
KINDS = "flat", "star", "blob", "disc", "jet"
BACKGROUNDS = 1.0, 50.0, 1000.0, 3e4
WIDTHS = 3.0, 3.5, 4.0, 2.7
RADII = 4, 8, 16, 32
COLUMNS = "kind background images seed place radius truth sum value error low68 high68 low95 high95"


def gaussian(width, x=0.0, y=0.0, n=N):
    """Return a Gaussian of unit sum, centred at (x, y) from the middle."""
    rows, columns = np.indices((n, n)) - n // 2
    psf = np.exp(-4 * np.log(2) * ((columns - x) ** 2 + (rows - y) ** 2) / width**2)
    return psf / psf.sum()


def make_sky(kind, noise, rng):
    """Return an extended source whose signal-to-noise ratio is 5 to 100."""
    y, x = np.indices((N, N)) - N / 2
    if kind == "blob":
        width, (dx, dy) = rng.uniform(2, 16), rng.uniform(-15, 15, 2)
        sky = np.exp(-((x - dx) ** 2 + (y - dy) ** 2) / 2 / width**2)
    elif kind == "disc":
        radius, r = rng.uniform(8, 25), np.hypot(x, y / rng.uniform(0.4, 1))
        sky = np.exp(-3 * r / radius) * (r < radius)
    elif kind == "jet":
        across = np.exp(-((x / rng.uniform(1.2, 3)) ** 2) / 2)
        sky = across * (y > 0) * np.exp(-y / 15) * (1 + np.cos(y / 2.5))
    else:
        return np.zeros((N, N))
    area = sky.sum() ** 2 / (sky**2).sum()
    ratio = 10 ** rng.uniform(0.7, 2.0)
    return sky / sky.sum() * ratio * np.sqrt(area * noise**2 + ratio**2)


def observe(kind, background, p, seed):
    """Return an observation, its stars, the sky and where regions are."""
    rng = np.random.default_rng([seed, KINDS.index(kind), BACKGROUNDS.index(background), p])
    sky = make_sky(kind, np.sqrt(background / p), rng)
    stars, flux = [], 0.0
    if kind in ("star", "disc", "jet"):
        stars = [N / 2 + rng.uniform(-0.5, 0.5, 2)]
        flux = 10 ** rng.uniform(3.5, 5.5) * max(1.0, np.sqrt(background / 50))
    images = []
    for width in WIDTHS[:p]:
        model = fftconvolve(sky, gaussian(width, n=41), mode="same").clip(0) + background
        if stars:
            model += flux * gaussian(width, *(stars[0] - N // 2))
        images.append(rng.poisson(model))
    psfs = [gaussian(width, n=41) for width in WIDTHS[:p]]
    observation = lnocl.Observation(images, psfs, background=background)
    return observation, stars, sky, list(place(sky, stars, rng))


def place(sky, stars, rng):
    """Yield circles: what is there, and centre and radius."""
    for radius in RADII:
        inside = radius, N - 1 - radius
        yield "anywhere", *rng.uniform(*inside, 2), radius
        if sky.any():
            y, x = divmod(int(rng.choice(N * N, p=sky.ravel() / sky.sum())), N)
            yield "on light", *np.clip((x, y), *inside), radius
        if stars:
            yield "round a star", *stars[0], radius


def measure(kind, background, p, seed, n):
    """Return a row for each region, and the last for the printed flux."""
    observation, stars, sky, circles = observe(kind, background, p, seed)
    result = lnocl.deconvolve(observation, stars)
    regions = [CirclePixelRegion(PixCoord(x, y), r) for _, x, y, r in circles]
    regions.append(RectanglePixelRegion(PixCoord((N - 1) / 2, (N - 1) / 2), N, N))
    labels = [*((name, r) for name, *_, r in circles), ("whole", 0)]
    rows, about = [], (kind, background, p, seed)
    masks = [region.to_mask("exact").to_image((N, N)) for region in regions]
    if n:
        table = result.bootstrap(n, regions=regions, seed=seed).to_table()[-len(regions) :]
        names = "low68", "high68", "low95", "high95"
        for label, mask, row in zip(labels, masks, table, strict=True):
            truth, plain = (mask * sky).sum(), (mask * result.extended).sum()
            value = row["value"] - row["bias"]
            bounds = [row[name] for name in names]
            rows.append((*about, *label, truth, plain, value, row["error"], *bounds))
    flux, error = result.extended_flux
    bounds = [flux + k * error for k in (-0.994, 0.994, -1.96, 1.96)]
    rows.append((*about, "printed", 0, sky.sum(), result.extended.sum(), flux, error, *bounds))
    return Table(rows=rows, names=COLUMNS.split())


def report(table):
    """Print the bias in errors and the shares of intervals that hold the truth."""
    kinds = {"flat, star": ("flat", "star"), "blob, disc, jet": ("blob", "disc", "jet")}
    print(
        f"{'':16}{'':14}{'r':>3}{'n':>5}{'plain':>8}{'bias':>7}{'scatter':>9}{'68 %':>7}{'95 %':>7}"
    )
    for name, members in kinds.items():
        of_kind = table[np.isin(table["kind"], members)]
        for where in ("anywhere", "on light", "round a star", "whole", "printed", "all"):
            there = of_kind["place"] == where
            if where == "all":
                there = of_kind["place"] != "printed"
            radii = np.unique(of_kind["radius"][there])
            for radius in radii if where != "all" else [-1] * bool(len(radii)):
                rows = of_kind[there & ((of_kind["radius"] == radius) | (radius < 0))]
                z = (rows["value"] - rows["truth"]) / rows["error"]
                plain = (rows["sum"] - rows["truth"]) / rows["error"]
                held = [
                    np.mean(
                        (rows[f"low{x}"] <= rows["truth"]) & (rows["truth"] <= rows[f"high{x}"])
                    )
                    for x in (68, 95)
                ]
                print(
                    f"{name:16}{where:14}{max(radius, 0):3}{len(rows):5}{plain.mean():8.2f}"
                    f"{z.mean():7.2f}{z.std():9.2f}{held[0]:7.2f}{held[1]:7.2f}"
                )


def main():
    """Measure scenes, or report those that were measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(800, 806), metavar=("FIRST", "LAST"))
    parser.add_argument("--replicas", type=int, default=50)
    parser.add_argument("--output")
    parser.add_argument("--report")
    arguments = parser.parse_args()
    if arguments.report:
        report(Table.read(arguments.report))
        return
    warnings.simplefilter("ignore", lnocl.LnoclWarning)
    tables = []
    for seed in range(*arguments.seeds):
        for kind in KINDS:
            for background in BACKGROUNDS:
                for p in (1, 4):
                    tables.append(measure(kind, background, p, seed, arguments.replicas))
        if arguments.output:
            vstack(tables).write(arguments.output, overwrite=True)
    report(vstack(tables))


if __name__ == "__main__":
    main()
