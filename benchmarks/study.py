"""Grids of simulated observations, each reconstructed and measured against its truth.

    python benchmarks/study.py --contrast 1 10 --n-images 1 4 -o study.ecsv [--plot study.png]

Each axis takes one value or more; what is left out is the paper's experiment, by the defaults.
Rows that the table has are not done again. `--parallel N` does N at once, on Dask.
"""

import argparse
import itertools
import time
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import Table

import lnocl
from lnocl import metrics
from lnocl.parallel import work
from lnocl.simulation import Experiment, Star, Target, fizeau_psf, hh34, simulate

# The Strehl ratio of the PSFs that those given are mixed with, in that of the true ones.
WRONG_STREHL = 0.7
AXES = {
    "size": (256, "pixels along each side"),
    "contrast": (1.0, "flux of the star in that of the jet"),
    "extended_magnitude": (13.0, "magnitude of the jet, from which that of the star follows"),
    "strehl": (0.7, "Strehl ratio"),
    "n_images": (4, "images, their baselines evenly over 180 degrees"),
    "exposure": (30.0, "exposure of each image, minutes"),
    "psf_error": (
        0.0,
        "relative error of PSFs, others of 0.7 of the Strehl mixed in",
    ),
    "position_error": (0.0, "pixels by which the star is off, in a direction of the seed's"),
    "refine": ("no", "whether its position is refined, yes or no"),
    "method": ("mc-rl", "with the star as a component, mc-rl, or without, rl"),
    "solver": ("sgp", "sgp or sgm"),
    "stop": ("held-out", "as for lnocl deconvolve"),
    "smoothing": ("auto", "as for lnocl deconvolve"),
    "mu": (0.0, "as for lnocl deconvolve"),
    "n_iter": (1000, "largest number of iterations"),
    "seed": (0, "of residual phases, noise and directions"),
}
OBSERVED = "size", "contrast", "extended_magnitude", "strehl", "n_images", "exposure", "seed"
SHOWN = {
    "rho_star": (100.0, r"error near the star, $\rho''$ (%)"),
    "magnitude_error": (1e3, "error of the star (mmag)"),
}


@lru_cache(maxsize=2)
def observe(size, contrast, extended_magnitude, strehl, n_images, exposure, seed):
    """Return the simulated images of a case."""
    target = hh34(size)
    star, magnitude = target.stars[0], extended_magnitude - 2.5 * np.log10(contrast)
    how = Experiment(
        angles=np.arange(n_images) * 180.0 / n_images * u.deg,
        exposure_time=exposure * u.min,
        strehl=strehl,
        extended_magnitude=extended_magnitude * u.mag,
        seed=seed,
    )
    return simulate(Target(target.extended, [Star(star.x, star.y, magnitude * u.mag)]), how)


def wrong_psfs(simulation, case):
    """Return PSFs with the relative error ``||K' - K|| / ||K||`` of the case, of unit sum."""
    if not case["psf_error"]:
        return simulation.psfs
    how, mixed = simulation.experiment, []
    seeds = np.random.SeedSequence([case["seed"], 2]).spawn(case["n_images"])
    for psf, angle, seed in zip(simulation.psfs, how.angles, seeds, strict=True):
        strehl = WRONG_STREHL * case["strehl"]
        other = fizeau_psf(psf.shape, angle, how.wavelength, how.pixel_scale, strehl, seed)
        share = case["psf_error"] * np.linalg.norm(psf) / np.linalg.norm(other - psf)
        mixed.append(psf + share * (other - psf))
    return np.array(mixed)


def read(text):
    """Return a number, None or a word."""
    try:
        return None if text == "none" else float(text)
    except ValueError:
        return text


def measure(case):
    """Return the row of a case."""
    simulation = observe(*(case[name] for name in OBSERVED))
    star, is_plain = simulation.stars[0], case["method"] == "rl"
    observation = lnocl.Observation(
        simulation.images,
        wrong_psfs(simulation, case),
        background=simulation.background,
        read_noise=simulation.read_noise,
        psf_centre="given",
    )
    angle = np.random.default_rng([case["seed"], 1]).uniform(0.0, 2.0 * np.pi)
    off = case["position_error"] * np.array([np.cos(angle), np.sin(angle)])
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)  # that PSFs and places are wrong
        result = lnocl.deconvolve(
            observation,
            [] if is_plain else [tuple(star + off)],
            stop=read(case["stop"]),
            smoothing=read(case["smoothing"]),
            pad=0,
            refine_positions=case["refine"] == "yes",
            **{name: case[name] for name in ("solver", "mu", "n_iter")},
        )
    seconds = time.perf_counter() - began
    truth, flux = simulation.extended, simulation.star_fluxes[0]
    box = result.extended[star[1] - 1 : star[1] + 2, star[0] - 1 : star[0] + 2]
    found = box.sum() if is_plain else result.star_fluxes[0]
    masked, rows = star if is_plain else None, metrics.star_rows(star, truth.shape)
    return case | {
        "rho": metrics.restoration_error(result.extended, truth, star=masked),
        "rho_star": metrics.restoration_error(result.extended, truth, rows, masked),
        "magnitude_error": -2.5 * np.log10(max(found / flux, 1e-3)),
        "iterations": result.n_iter,
        "chosen_smoothing": result.smoothing,
        "stopped": result.stop_reason,
        "seconds": seconds,
    }


def make_measure():
    """Return what measures a case, in each process."""
    return measure


def draw(table, path):
    """Draw medians over seeds against each axis that has several numbers, a line a setting."""
    from matplotlib import pyplot

    varied = [name for name in AXES if name != "seed" and len(set(table[name])) > 1]
    numbers = [name for name in varied if table[name].dtype.kind in "if"] or ["seed"]
    figure, panels = pyplot.subplots(
        len(numbers), len(SHOWN), figsize=(9.5, 3.4 * len(numbers)), squeeze=False
    )
    for row, name in zip(panels, numbers, strict=True):
        others = [each for each in varied if each != name]
        groups = table.group_by(others).groups if others else [table]
        for panel, (column, (factor, label)) in zip(row, SHOWN.items(), strict=True):
            for group in groups:
                values = factor * abs(np.array(group[column]))
                places = np.unique(group[name])
                of_place = [values[group[name] == place] for place in places]
                middle = np.array([np.median(each) for each in of_place])
                spread = [middle - [each.min() for each in of_place]]
                spread.append([each.max() for each in of_place] - middle)
                words = ", ".join(f"{other} {group[other][0]}" for other in others)
                panel.errorbar(places, middle, spread, label=words, marker="o", capsize=2)
            if (np.array(table[name], float) > 0).all():
                panel.set_xscale("log")
            panel.set(xlabel=name.replace("_", " "), ylabel=label, yscale="log")
            panel.grid(alpha=0.3)
        if others:
            row[1].legend(fontsize=6)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main():
    """Measure the cases that the table lacks, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="TABLE.ecsv")
    parser.add_argument("--plot", metavar="FILE.png")
    parser.add_argument("--parallel", type=int, default=False, metavar="N")
    for name, (default, words) in AXES.items():
        flag = f"--{name.replace('_', '-')}"
        text = f"{words} (default: {default})"
        parser.add_argument(flag, nargs="+", type=type(default), default=[default], help=text)
    arguments = parser.parse_args()
    table = Table.read(arguments.output) if arguments.output.exists() else Table()
    rows = [dict(zip(table.colnames, row, strict=True)) for row in table]
    done = {tuple(row[name] for name in AXES) for row in rows}
    cases = set(itertools.product(*(getattr(arguments, name) for name in AXES))) - done
    cases = [dict(zip(AXES, case, strict=True)) for case in cases]
    cases.sort(key=lambda case: [case[name] for name in OBSERVED])  # one observation after another
    for row in work(make_measure, cases, arguments.parallel):
        rows.append(row)
        Table(rows).write(arguments.output, overwrite=True)
    print(f"{len(cases)} cases done, {len(rows)} in {arguments.output}")
    if arguments.plot:
        draw(Table(rows), arguments.plot)


if __name__ == "__main__":
    main()
