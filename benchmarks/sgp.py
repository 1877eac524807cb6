"""The scaled gradient projection method beside the split-gradient method, and when to stop.

    python benchmarks/sgp.py PART [--data DIR] [--device SPEC] [--output STEM]

Parts, each a table, written to STEM-PART.ecsv with --output:

scenes   on the paper's experiment (hh34, and HH 211 from DIR, at 512 and 1024): the smallest error
         of the split-gradient method (SGM), and when SGP comes within 5 % of it
starts   the best rho'' of SGP from star fluxes of 0.01 to 0.9 of the truth, at contrast 1 and 30
bright   rho'' at contrast 30 and 1000: SGP after 500 iterations, without smoothing and with that
         which suits the noise; SGM after 20,000
stops    twenty seeded scenes of random flux, contrast and number of images: errors where a rule
         stops SGP, relative to the best that the truth would choose without smoothing
costs    a run that held-out counts end beside one of as many iterations, by the clock
choices  what was chosen by measuring: the share of the shift
ngc7027  relative error on the published benchmark, from DIR
answer   the paper's case from FITS to FITS: `lnocl deconvolve --solver sgp`, four times before and
         four times after the paper's iteration in SciPy until it is as good

Errors are restoration errors: rho' of all rows, rho'' of the 24 round the star.
"""

import argparse
import subprocess
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path
from unittest.mock import patch

import astropy.units as u
import experiment
import numpy as np
import parts
import sides
from astropy.io import fits
from parts import paper

import lnocl
from lnocl.core.runs.thinning import split_counts
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.metrics import restoration_error, star_rows
from lnocl.simulation import Experiment, Star, Target, hh34, load_target, simulate
from lnocl.studies.files import write_simulation

SGM_ITERATIONS = {"hh34": 8000, "hh211": 2000}
STARTS = (0.01, 0.1, 0.5, 0.9)
SEEDS = range(520, 540)


def make(name, size, data, contrast=1.0, **settings):
    """Return a simulation of the experiment's scene with a star so many times as bright."""
    target = (
        hh34(size) if name == "hh34" else load_target(data / f"hh211/hh211_scene_{size}.fits.gz")
    )
    (star,) = target.stars
    magnitude = settings.get("extended_magnitude", 13.0 * u.mag) - 2.5 * np.log10(contrast) * u.mag
    target = Target(target.extended, [Star(star.x, star.y, magnitude)])
    return simulate(target, Experiment(**settings))


def follow(simulation, solver, n_iter, every=1, within=None, **settings):
    """Return iterations, rho' and rho'' of a run; `within` ends it once rho'' is so small."""
    truth, (star,) = simulation.extended, simulation.stars
    rows = star_rows(star, truth.shape)
    curve = []

    def look(iteration, estimate):
        if iteration % every:
            return False
        found = estimate.extended
        curve.append(
            (iteration, restoration_error(found, truth), restoration_error(found, truth, rows))
        )
        return within is not None and curve[-1][2] <= within

    paper(
        experiment.observe(simulation),
        [star],
        solver=solver,
        n_iter=n_iter,
        callback=look,
        **settings,
    )
    return np.array(curve)


def timed(simulation, solver, n_iter, **settings):
    """Return the seconds that so many iterations take, start-up not counted."""
    times = []

    def look(iteration, estimate):
        if iteration in (1, n_iter):
            _ = estimate.star_fluxes  # waits for the device
            times.append(time.perf_counter())

    observation = experiment.observe(simulation)
    paper(observation, simulation.stars, solver=solver, n_iter=n_iter, callback=look, **settings)
    return (times[1] - times[0]) / (n_iter - 1)


def scenes(data, device):
    """Yield rows of the part "scenes"."""
    for name in ("hh34", "hh211"):
        for size in (512, 1024):
            simulation = make(name, size, data)
            sgm = follow(simulation, "sgm", SGM_ITERATIONS[name], every=20, device=device)
            best = sgm[np.argmin(sgm[:, 2])]
            sgp = follow(simulation, "sgp", 250, device=device)
            near = sgp[np.argmax(sgp[:, 2] <= 1.05 * best[2])]
            least = sgp[np.argmin(sgp[:, 2])]
            seconds = [
                count * timed(simulation, solver, n, device=device)
                for solver, count, n in (("sgm", best[0], 100), ("sgp", near[0], 40))
            ]
            yield {
                "scene": name,
                "size": size,
                "SGM rho''": best[2],
                "SGM at": int(best[0]),
                "SGM s": seconds[0],
                "SGP within 5 %": bool(near[2] <= 1.05 * best[2]),
                "SGP at": int(near[0]),
                "SGP s": seconds[1],
                "fewer": best[0] / near[0],
                "faster": seconds[0] / seconds[1],
                "SGP best rho''": least[2],
                "best at": int(least[0]),
                "paper at": 10972,
            }


def starts(data, device):
    """Yield rows of the part "starts"."""
    for contrast in (1.0, 30.0):
        simulation = make("hh34", 256, data, contrast)
        for share in STARTS:
            initial = [share * flux for flux in simulation.star_fluxes]
            curve = follow(simulation, "sgp", 500, initial_star_fluxes=initial, device=device)
            best = curve[np.argmin(curve[:, 2])]
            yield {"contrast": contrast, "start": share, "rho''": best[2], "at": int(best[0])}


def bright(data, device):
    """Yield rows of the part "bright"."""
    for name in ("hh34", "hh211"):
        for contrast in (30.0, 1000.0):
            simulation = make(name, 512, data, contrast)
            sgp = follow(simulation, "sgp", 500, device=device)
            chosen = paper(
                experiment.observe(simulation),
                simulation.stars,
                solver="sgp",
                n_iter=500,
                smoothing="auto",
                device=device,
            ).smoothing
            smoothed = follow(simulation, "sgp", 500, smoothing=chosen, device=device)
            sgm = follow(simulation, "sgm", 20_000, every=500, device=device)
            yield {
                "scene": name,
                "contrast": contrast,
                "SGP rho''": sgp[-1, 2],
                "SGP at": int(sgp[-1, 0]),
                "SGP best rho''": sgp[:, 2].min(),
                "smoothing": chosen,
                "smoothed rho''": smoothed[-1, 2],
                "smoothed at": int(smoothed[-1, 0]),
                "smoothed best rho''": smoothed[:, 2].min(),
                "SGM rho''": sgm[-1, 2],
                "SGM at": int(sgm[-1, 0]),
            }


def random_scene(seed, data):
    """Return a scene of 1 to 4 images, of magnitude 12 to 16, its star 0.3 to 300 as bright."""
    rng = np.random.default_rng(seed)
    p = int(rng.integers(1, 5))
    settings = {
        "seed": seed,
        "extended_magnitude": rng.uniform(12.0, 16.0) * u.mag,
        "angles": np.arange(p) * 180.0 / p * u.deg,
    }
    contrast = 10.0 ** rng.uniform(-0.5, 2.5)
    return (
        make("hh34", 256, data, contrast, **settings),
        p,
        settings["extended_magnitude"],
        contrast,
    )


def likelihood_choice(simulation, device, n_iter=400, every=2):
    """Return the iteration at which the likelihood of a held-out half is best."""
    first, second = split_counts(experiment.observe(simulation))
    scene = Scene(first, simulation.stars)
    model = Model(scene)
    curve = []

    def look(iteration, estimate):
        if iteration % every == 0:
            found, fluxes = estimate.extended / scene.scale, estimate.star_fluxes / scene.scale
            means = model.images(found, fluxes) * scene.scale
            curve.append((means - second.images * np.log(means)).sum())

    paper(first, simulation.stars, solver="sgp", n_iter=n_iter, callback=look, device=device)
    return every * (int(np.argmin(curve)) + 1)


def stops(data, device):
    """Yield rows of the part "stops"."""
    warnings.simplefilter("ignore", lnocl.LnoclWarning)
    for seed in SEEDS:
        simulation, p, magnitude, contrast = random_scene(seed, data)
        observation, (star,) = experiment.observe(simulation), simulation.stars
        rows = star_rows(star, simulation.extended.shape)
        curve = follow(simulation, "sgp", 800, device=device)
        best = curve[:, 1:].min(axis=0)
        row = {"seed": seed, "p": p, "magnitude": magnitude.value, "contrast": contrast}
        row |= {"best rho'": best[0], "best rho''": best[1]}
        for name, smoothing, stop in (
            ("held-out", 0.0, "held-out"),
            ("default", "auto", "held-out"),
            ("discrepancy", 0.0, "discrepancy"),
        ):
            found, seconds = _timed_run(
                observation, star, device, n_iter=1500, stop=stop, smoothing=smoothing
            )
            errors = [
                restoration_error(found.extended, simulation.extended, *where)
                for where in ((), (rows,))
            ]
            row |= {f"{name} at": found.n_iter, f"{name} smoothing": found.smoothing}
            row |= {f"{name} rho'": errors[0] / best[0], f"{name} rho''": errors[1] / best[1]}
            if stop == "held-out":
                given = {"n_iter": found.n_iter, "smoothing": found.smoothing}
                alone = [_timed_run(observation, star, device, **given)[1] for _ in range(3)]
                row[f"{name} cost"] = seconds / float(np.median(alone))
        at = likelihood_choice(simulation, device)
        row |= {"likelihood at": at, "likelihood rho'": curve[at - 1, 1] / best[0]}
        row["likelihood rho''"] = curve[at - 1, 2] / best[1]
        yield row


def _timed_run(observation, star, device, **settings):
    start = time.perf_counter()
    found = paper(observation, [star], solver="sgp", device=device, **settings)
    return found, time.perf_counter() - start


def costs(data, device):
    """Yield rows of the part "costs"."""
    warnings.simplefilter("ignore", lnocl.LnoclWarning)
    for size in (512, 1024):
        simulation = make("hh34", size, data)
        observation, (star,) = experiment.observe(simulation), simulation.stars
        for smoothing in (0.0, "auto"):
            held = {"stop": "held-out", "n_iter": 1500, "smoothing": smoothing}
            chosen, _ = _timed_run(observation, star, device, **held)  # builds the kernels
            given = {"n_iter": chosen.n_iter, "smoothing": chosen.smoothing}
            turns = [
                (
                    _timed_run(observation, star, device, **given)[1],
                    _timed_run(observation, star, device, **held)[1],
                )
                for _ in range(5)
            ]
            alone, held_out = np.median(turns, axis=0)
            yield {
                "size": size,
                "smoothing": str(smoothing),
                "chosen": chosen.smoothing,
                "iterations": chosen.n_iter,
                "run s": alone,
                "held-out s": held_out,
                "times as long": float(np.median([b / a for a, b in turns])),
            }


def choices(data, device):
    """Yield rows of the part "choices"."""
    cases = [("hh34", 256, contrast, 400) for contrast in (1.0, 30.0, 1000.0)]
    for name, size, contrast, n_iter in [*cases, ("hh211", 1024, 1.0, 80)]:
        simulation = make(name, size, data, contrast)
        for shift in (1.0, 0.3, 0.1, 0.03, 0.0):
            with patch("lnocl.core.solvers.scaling.SHIFT", shift):
                curve = follow(simulation, "sgp", n_iter, device=device)
            best = curve[np.argmin(curve[:, 2])]
            yield {
                "scene": name,
                "contrast": contrast,
                "shift": shift,
                "best rho'": curve[:, 1].min(),
                "best rho''": best[2],
                "at": int(best[0]),
            }


def ngc7027(data, device):
    """Yield rows of the part "ngc7027"."""
    image, psf, truth = (
        fits.getdata(data / f"ngc7027/NGC7027_255_{name}.fits") for name in ("gn", "psf", "obj")
    )
    observation = lnocl.Observation(image, psf, background=1.0)
    for solver, n_iter in (("sgm", 500), ("sgp", 100)):
        errors = []
        paper(
            observation,
            solver=solver,
            n_iter=n_iter,
            device=device,
            callback=lambda _, found, errors=errors: errors.append(
                restoration_error(found.extended, truth)
            ),
        )
        yield {
            "solver": solver,
            "error": min(errors),
            "at": int(np.argmin(errors)) + 1,
            "0.138 at": int(np.argmax(np.array(errors) <= 0.138)) + 1,
            "least in 30": min(errors[:30]),
        }


def _seconds(work):
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def answer(data, device):
    """Yield rows of the part "answer"."""
    simulation = make("hh34", 1024, data)
    truth, (star,) = simulation.extended, simulation.stars
    rows = star_rows(star, truth.shape)
    sgm = follow(simulation, "sgm", SGM_ITERATIONS["hh34"], every=20, device=device)
    best = sgm[np.argmin(sgm[:, 2])]
    n_sgp = int(follow(simulation, "sgp", 250, within=best[2], device=device)[-1, 0])
    with tempfile.TemporaryDirectory() as folder:
        write_simulation(folder, "hh34", simulation)
        images, psfs = (
            sorted(map(str, Path(folder).glob(f"{kind}_*.fits"))) for kind in ("image", "psf")
        )
        command = [
            *(sys.executable, "-m", "lnocl", "deconvolve", *images, "--psf", *psfs, "--background"),
            *(repr(float(b)) for b in simulation.background),
            *("--read-noise", str(float(np.ravel(simulation.read_noise)[0]))),
            *("--star", f"{star[0]},{star[1]}", "--solver", "sgp", "--n-iter", str(n_sgp)),
            *("--stop", "none", "--smoothing", "0", "--pad", "0"),
            *(() if device is None else ("--device", device)),
            *("-o", f"{folder}/found.fits", "--overwrite", "--quiet"),
        ]
        subprocess.run(command, check=True)  # fills the kernel cache
        times = [_seconds(partial(subprocess.run, command, check=True)) for _ in range(4)]
        scene = Scene(experiment.observe(simulation), simulation.stars)
        peer = sides.MultiComponent(scene)
        peer_seconds = _seconds(partial(peer, int(best[0])))
        times += [_seconds(partial(subprocess.run, command, check=True)) for _ in range(4)]
        found = fits.getdata(f"{folder}/found.fits")
    seconds = float(np.median(times))
    yield {
        "lnocl s": seconds,
        "least": min(times),
        "most": max(times),
        "lnocl iterations": n_sgp,
        "lnocl rho''": restoration_error(found, truth, rows),
        "SciPy s": peer_seconds,
        "SciPy iterations": int(best[0]),
        "SciPy rho''": restoration_error(peer.extended * scene.scale, truth, rows),
        "faster": peer_seconds / seconds,
    }


PARTS = {
    part.__name__: part for part in (scenes, starts, bright, stops, costs, choices, ngc7027, answer)
}


def main():
    """Run one part."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    parts.report(
        PARTS[given.part](given.data, given.device), given.part, given.device, given.output
    )


if __name__ == "__main__":
    main()
