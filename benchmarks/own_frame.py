"""A frame of one's own: star and disc by the route of the pages, where the truth is known.

    python benchmarks/own_frame.py [--seeds FIRST LAST] [--replicas 30] [--output FILE.ecsv]
    python benchmarks/own_frame.py --seeds 40 45 --options "--refine --refine-psfs jitter pixels"

Each seed draws a frame of 320 x 360 counts of a converter (1.6 electrons each, read noise 8), with
a PSF of its own (a Moffat profile, some with a wide halo), a star of 750,000 electrons in a disc of
75,000, and five field stars. `lnocl psf` makes the PSF from the field stars, and `lnocl deconvolve`
takes it, by the options of docs/start/own_frame.md. Compared are the flux of the star and that of
a region round the disc, with their errors.
"""

import argparse
import shlex
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.signal import fftconvolve

SHAPE, GAIN, READ_NOISE, SKY = (320, 360), 1.6, 8.0, 250.0
STAR, DISC, RADIUS = 7.5e5, 7.5e4, 30
COLUMNS = "seed star star_low star_high disc disc_truth disc_low disc_high verdict"


def profile(rng):
    """Return a function of (x, y) that is the PSF, of unit sum."""
    fwhm, beta, ratio = rng.uniform(2.6, 4.0), rng.uniform(2.5, 4.5), rng.uniform(0.9, 1.0)
    angle, halo = rng.uniform(0, np.pi), rng.choice([0.0, rng.uniform(0.05, 0.3)])

    def moffat(x, y, width, power):
        across = x * np.cos(angle) + y * np.sin(angle), (y * np.cos(angle) - x * np.sin(angle))
        scale = width / 2 / np.sqrt(2 ** (1 / power) - 1)
        square = (across[0] ** 2 + (across[1] / ratio) ** 2) / scale**2
        return (power - 1) / (np.pi * scale**2 * ratio) * (1 + square) ** -power

    return lambda x, y: (1 - halo) * moffat(x, y, fwhm, beta) + halo * moffat(x, y, 6 * fwhm, 3.0)


def draw(seed):
    """Return the frame, the positions of its stars, that of the target first, and the disc."""
    rng = np.random.default_rng([41, seed])
    psf, (rows, columns) = profile(rng), np.indices(SHAPE)
    target = np.array([180.0, 160.0]) + rng.uniform(-5, 5, 2)
    places = [target]
    while len(places) < 6:
        place = rng.uniform(45, np.array(SHAPE[::-1]) - 45)
        if min(np.hypot(*(place - other)) for other in places) > 80:
            places.append(place)
    fluxes = [STAR, *10 ** rng.uniform(4.9, 5.7, 5)]
    light = np.full(SHAPE, SKY)
    for (x, y), flux in zip(places, fluxes, strict=True):
        light += flux * psf(columns - x, rows - y)
    across, along = columns - target[0], (rows - target[1]) / rng.uniform(0.4, 0.9)
    radius = np.hypot(across, along)
    disc = np.exp(-radius / rng.uniform(4, 7)) * (radius > rng.choice([0.0, 4.0])) * (radius < 25)
    disc *= DISC / disc.sum()
    k = np.arange(-60, 61)
    kernel = psf(k[None, :], k[:, None])
    light += fftconvolve(disc, kernel, mode="same")
    electrons = rng.poisson(light) + rng.normal(0, READ_NOISE, SHAPE)
    return (electrons / GAIN).astype(np.float32), np.array(places), disc


def call(*words):
    """Run the command line, whose messages are left out."""
    subprocess.run(["lnocl", *map(str, words), "--quiet"], capture_output=True, check=True)


def measure(seed, n_replicas, options, folder):
    """Return a row."""
    frame, places, disc = draw(seed)
    image, psf, regions, out = (folder / f"{seed}{end}" for end in (
        "_frame.fits", "_psf.fits", "_disc.reg", "_out.fits"
    ))  # fmt: skip
    fits.writeto(image, frame)
    (x, y), others = places[0], places[1:]
    regions.write_text(f"image\ncircle({x + 1:.2f},{y + 1:.2f},{RADIUS})\n")
    stars = [word for a, b in others for word in ("--star", f"{a:.1f},{b:.1f}")]
    call("psf", image, *stars, "--size", 64, "-o", psf)
    noise = "--gain", GAIN, "--background", "auto", "--read-noise", READ_NOISE
    call("deconvolve", image, "--psf", psf, *noise, "--star", f"{x:.0f},{y:.0f}", *options,
         "-o", out)  # fmt: skip
    call("errors", out, "--bootstrap", n_replicas, "--regions", regions)
    errors = Table.read(out, hdu="ERRORS")
    star, there = (errors[errors["name"] == name][0] for name in ("star 1 flux", "region 1"))
    inside = np.hypot(*(np.indices(SHAPE)[::-1] - places[0][:, None, None])) < RADIUS
    values = [
        (row["value"] - row["bias"], truth, row["low95"], row["high95"])
        for row, truth in ((star, STAR), (there, disc[inside].sum()))
    ]
    row = seed, *values[0][:1], *values[0][2:], *values[1], fits.getheader(out)["VERDICT"]
    return dict(zip(COLUMNS.split(), row, strict=True))


def main():
    """Measure, and print the table and how often intervals hold the truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(20, 40), metavar=("FIRST", "LAST"))
    parser.add_argument("--replicas", type=int, default=30)
    parser.add_argument("--options", type=shlex.split, default=["--refine"])
    parser.add_argument("--output")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(*arguments.seeds):
            rows.append(measure(seed, arguments.replicas, arguments.options, Path(folder)))
            print(
                " ".join(f"{v:.0f}" if isinstance(v, float) else str(v) for v in rows[-1].values()),
                flush=True,
            )
    table = Table(rows)
    if arguments.output:
        table.write(arguments.output, overwrite=True)
    star = (table["star_low"] <= STAR) & (table["star_high"] >= STAR)
    disc = (table["disc_low"] <= table["disc_truth"]) & (table["disc_truth"] <= table["disc_high"])
    print(
        f"of {len(table)}: star within {star.sum()}, disc {disc.sum()}, both {(star & disc).sum()}"
    )


if __name__ == "__main__":
    main()
