"""How far single precision strays from double: against contrast, iterations, size, background.

    python benchmarks/precision.py [--device SPEC] [--output STEM] [--solver sgp]

The scene is that of `lnocl demo`, four images of a jet and its star, with the star's flux, the
number of iterations, the grid, or the background changed; no Tikhonov term. Deviations are those
of the estimate of single precision from that of double after as many iterations: of the extended
source ||f_s - f_d|| / ||f_d||, over all pixels and over the 24 rows round the star, and of the
star's flux. With --output the table goes to STEM.ecsv and four plots to STEM.png.
The solver is sgm; of sgp the iterations alone are printed.
"""

import argparse

import numpy as np
from astropy.table import Table
from parts import paper

import lnocl
from lnocl.core.opencl.device import choose, describe
from lnocl.metrics import star_rows
from lnocl.simulation import Experiment, hh34, simulate

SIZE, CONTRAST, ITERATIONS = 256, 1.0, 10_000
CONTRASTS = 10.0 ** np.arange(9)
CHECKPOINTS = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)
SIZES = (64, 128, 256, 512, 1024)
SIZE_ITERATIONS = 1000
BACKGROUNDS = 10.0 ** np.arange(-3.0, 5.0)


def convolve(sky, psf):
    """Return the sky through a PSF of its own shape, periodic."""
    centred = np.fft.ifftshift(psf)
    return np.fft.irfft2(np.fft.rfft2(sky) * np.fft.rfft2(centred), sky.shape)


def scene(size=SIZE, contrast=CONTRAST, background=None):
    """Return an observation of the demo's jet with another star or background, and the star.

    `contrast` is the star's flux over the jet's; `background` a share of the jet's mean, by default
    the demo's own.
    """
    made = simulate(hh34(size), Experiment())
    (star,) = made.stars
    sky = made.extended.copy()
    sky[star[1], star[0]] += contrast * made.extended.sum()
    level = made.background[0] if background is None else background * made.extended.mean()
    means = np.array([convolve(sky, psf) for psf in made.psfs]) + level
    images = np.random.default_rng(0).poisson(np.maximum(means, 0.0))
    return lnocl.Observation(images, made.psfs, background=level), star


def deviations(observation, star, checkpoints, device, **options):
    """Yield iterations and deviations: all rows, rows round the star, star flux."""
    estimates = {}
    for precision in ("double", "single"):
        kept = estimates[precision] = {}

        def keep(iteration, estimate, kept=kept):
            if iteration in checkpoints:
                kept[iteration] = estimate.extended.copy(), estimate.star_fluxes[0]

        paper(
            observation,
            stars=[star],
            n_iter=max(checkpoints),
            precision=precision,
            device=device,
            callback=keep,
            **options,
        )
    near = star_rows(star, observation.shape)
    for iteration in checkpoints:
        (double, double_flux), (single, flux) = (
            estimates[precision][iteration] for precision in ("double", "single")
        )
        yield (
            iteration,
            np.linalg.norm(single - double) / np.linalg.norm(double),
            np.linalg.norm((single - double)[near]) / np.linalg.norm(double[near]),
            abs(flux / double_flux - 1),
        )


def sweeps(device):
    """Yield rows: sweep, its variable, then what `deviations` yields."""
    for iteration, *found in deviations(*scene(), CHECKPOINTS, device):
        yield "iterations", iteration, iteration, *found
    for contrast in CONTRASTS:
        for found in deviations(*scene(contrast=contrast), (ITERATIONS,), device):
            yield "contrast", contrast, *found
    for background in BACKGROUNDS:
        for found in deviations(*scene(background=background), (ITERATIONS,), device):
            yield "background", background, *found
    for size in SIZES:
        for found in deviations(*scene(size=size), (SIZE_ITERATIONS,), device):
            yield "size", size, *found


LABELS = {
    "contrast": f"star's flux / jet's flux, {ITERATIONS} iterations",
    "iterations": "iterations",
    "size": f"size of the images, {SIZE_ITERATIONS} iterations",
    "background": f"background / mean of the jet, {ITERATIONS} iterations",
}


def plot(table, path):
    """Plot the deviations, one panel a sweep."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(10, 7), layout="constrained", sharey=True)
    names = {"all": "extended source", "near": "24 rows round the star", "star": "star's flux"}
    for axis, (sweep, label) in zip(axes.flat, LABELS.items(), strict=True):
        part = table[table["sweep"] == sweep]
        for column, name in names.items():
            axis.loglog(part["value"], part[column], "o-", ms=4, label=name)
        axis.axhline(1e-3, color="0.6", lw=0.8)
        axis.set(xlabel=label, ylabel="single against double")
    axes[0, 0].legend()
    figure.suptitle(table.meta["device"])
    figure.savefig(path, dpi=120)


def main():
    """Run all sweeps."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device")
    parser.add_argument("--output")
    parser.add_argument("--solver", choices=("sgm", "sgp"), default="sgm")
    given = parser.parse_args()
    if given.solver == "sgp":
        for found in deviations(*scene(), (30, 100, 300), given.device, solver="sgp"):
            print(f"{found[0]:6d} ", *(f"{x:8.1e}" for x in found[1:]))
        return
    rows = []
    for row in sweeps(given.device):
        print(
            f"{row[0]:10}  {row[1]:8g}  {row[2]:6d} ", *(f"{x:8.1e}" for x in row[3:]), flush=True
        )
        rows.append(row)
    names = ("sweep", "value", "iterations", "all", "near", "star")
    table = Table(rows=rows, names=names)
    table.meta |= {"device": describe(choose(given.device).device), "size": SIZE}
    if given.output:
        table.write(f"{given.output}.ecsv", overwrite=True)
        plot(table, f"{given.output}.png")


if __name__ == "__main__":
    main()
