"""The paper's table: RLM and MC-RL at several mu, to the smallest restoration errors.

    python benchmarks/hh34_table.py [--scene hh34|FILE.fits] [--size 1024] [--mu 1e-8 ...] -o DIR

Each row is written to DIR as soon as it is done and is not computed again, so that the script
can be stopped and started; a row of another scene or of other parameters is refused.
DIR/table.ecsv has the table. The paper's figures of these rows are DIR/objects.png, errors.png,
magnitude.png, flux.png and width.png. --quick is a small run.
"""

import argparse
import sys
import time
from pathlib import Path

import astropy.units as u
import experiment
import numpy as np
import paper_figures
from astropy.table import Table
from paper_figures import Source

from lnocl import __version__, metrics
from lnocl.errors import InputError, LnoclError
from lnocl.io import atomic, fitswrite, saved_results
from lnocl.plotting.figure import save_figure
from lnocl.simulation import Experiment, load_target, simulate
from lnocl.simulation.targets import SCENES

# La Camera et al. (2012), Table 1: rho' and rho'' in percent, with their iterations.
PAPER = {
    ("RLM", 0.0): (11.67, 4251, 72.87, 5000),
    ("MC-RL", 1e-8): (8.82, 26614, 24.80, 33483),
    ("MC-RL", 3e-8): (7.68, 9503, 23.81, 10972),
    ("MC-RL", 8e-8): (7.91, 3776, 24.42, 4198),
    ("MC-RL", 2e-7): (9.49, 1496, 25.34, 1630),
}
PERCENT = ("rho'", "rho''", "flux error", "width error", "paper rho'", "paper rho''")
COLUMNS = (
    "method",
    "mu",
    "rho'",
    "rho' at",
    "rho''",
    "rho'' at",
    "magnitude",
    "flux error",
    "width error",
    "paper rho'",
    "paper rho''",
    "minutes",
)


def identity(scene, simulation, n_iter, every, patience):
    """Return the cards that bind a row to its experiment."""
    ny, nx = simulation.extended.shape
    name = scene if scene in SCENES else Path(scene).name
    return [
        ("SCENE", name.encode("unicode_escape").decode("ascii"), "target"),
        ("SIZEX", nx, "pixels along x"),
        ("SIZEY", ny, "pixels along y"),
        ("SEED", int(simulation.experiment.seed), "of residual phases and noise"),
        ("EVERY", every, "iterations between two looks"),
        ("MAXITER", n_iter, "iterations at most"),
        ("PATIENCE", patience or 0.0, "of the best iteration, then stopped; 0 never"),
    ]


def compute(path, simulation, method, mu, n_iter, every, patience, cards):
    """Compute one reconstruction and save it as a result that lnocl plot reads."""
    start = time.monotonic()
    found = experiment.reconstruct(simulation, method, mu, n_iter, every, patience, progress=True)
    stars = [] if method == "RLM" else simulation.stars
    best, _ = found.best("rho_star")
    fitswrite.write_result(
        str(path),
        found.extended,
        stars,
        [found.star_flux] if stars else [],
        {"HISTORY": found.history[: best + 1], "CURVE": found.curve},
        cards=[
            ("CREATOR", f"lnocl {__version__}", "program that wrote this file"),
            ("METHOD", method, "star in the image, or a component"),
            ("SOLVER", "sgm", "iteration"),
            ("NITER", best, "iterations done, to the smallest rho''"),
            ("MU", mu, "weight of the Tikhonov term, per electron"),
            ("DEVICE", found.device, "device"),
            ("PIXSCALE", float(simulation.experiment.pixel_scale.value), "mas per pixel"),
            *cards,
            ("MINUTES", (time.monotonic() - start) / 60, "that it took"),
        ],
    )


def read_row(path, method, mu, cards):
    """Return a saved reconstruction; refuse one of another experiment."""
    saved = saved_results.read_result(str(path))
    for keyword, value, _ in [("METHOD", method, ""), ("MU", mu, ""), *cards]:
        if saved.header.get(keyword) != value:
            raise InputError(
                f"{path} is of another experiment: its {keyword} is {saved.header.get(keyword)} "
                f"and {value} is asked for; give another folder"
            )
    if "CURVE" not in saved.tables or "MINUTES" not in saved.header:
        raise InputError(f"{path} was not written by this script; give another folder")
    return saved


def reconstruction(simulation, saved):
    """Return a saved reconstruction as it was before."""
    method, mu = saved.header["METHOD"], saved.header["MU"]
    curve = np.zeros(len(saved.tables["CURVE"]["iteration"]), experiment.CURVE_DTYPE)
    for name, values in saved.tables["CURVE"].items():
        curve[name] = values
    if method == "MC-RL":
        flux = float(saved.star_fluxes[0])
    else:
        flux = experiment.box_flux(saved.extended, simulation.stars[0])
    return experiment.Reconstruction(method, mu, curve, saved.extended, flux)


def row(simulation, found, minutes):
    """Return the table's row of a reconstruction."""
    errors = experiment.profile_errors(simulation.extended, simulation.stars[0], found)
    at, rho = found.best("rho")
    at_star, rho_star = found.best("rho_star")
    paper = PAPER.get((found.method, found.mu), (np.nan, 0, np.nan, 0))
    zero = experiment.zero_magnitude_flux(simulation)
    return (
        found.method,
        found.mu,
        100 * rho,
        at,
        100 * rho_star,
        at_star,
        metrics.magnitude(found.star_flux, zero),
        100 * errors["flux"],
        100 * errors["width"],
        paper[0],
        paper[2],
        minutes,
    )


def keep_truth(path, simulation):
    """Write the truth, or check that the one that is there is the same."""
    if not path.exists():
        scale = float(simulation.experiment.pixel_scale.value)
        fitswrite.write_result(
            str(path),
            simulation.extended,
            simulation.stars,
            simulation.star_fluxes,
            cards=[("PIXSCALE", scale, "mas per pixel")],
        )
        return
    saved = saved_results.read_result(str(path))
    same = (
        saved.extended.shape == simulation.extended.shape
        and saved.stars == simulation.stars
        and np.allclose(saved.extended, simulation.extended, rtol=1e-9, atol=0)
        and np.allclose(saved.star_fluxes, simulation.star_fluxes, rtol=1e-9, atol=0)
    )
    if not same:
        raise InputError(f"{path} is the truth of another experiment; give another folder")


def draw(folder, simulation, found):
    """Draw the paper's figures."""
    (star,), scale = simulation.stars, float(simulation.experiment.pixel_scale.value)
    zero = experiment.zero_magnitude_flux(simulation)
    true = metrics.magnitude(float(simulation.star_fluxes[0]), zero)
    curves = {name: each.curve for name, each in found.items()}
    truth = Source("truth", simulation.extended)
    sources = [Source(name, each.extended, name == "RLM") for name, each in found.items()]
    figures = {
        "objects": paper_figures.draw_objects(truth, sources, star, scale),
        "errors": paper_figures.draw_errors(curves),
        "magnitude": paper_figures.draw_magnitudes(curves, true),
        "flux": paper_figures.draw_profiles("flux", truth, sources, star, scale),
        "width": paper_figures.draw_profiles("width", truth, sources, star, scale),
    }
    for name, figure in figures.items():
        save_figure(figure, str(folder / f"{name}.png"), overwrite=True)


def make_table():
    """Return the table without rows."""
    table = Table(names=COLUMNS, dtype=[str, *[float] * 2, int, float, int, *[float] * 6])
    table["mu"].format = ".0e"
    table["magnitude"].format = ".4f"
    table["minutes"].format = ".2f"
    for name in PERCENT:
        table[name].format = ".2f"
        table[name].unit = u.percent
    return table


def run(given):
    """Compute the rows that are missing and print the table."""
    if given.quick:
        given.rlm_iterations, given.n_iter = 60, 60
        given.size = 64 if given.scene in SCENES else given.size

    # The jet and the star at magnitude 13: any scene is brought to the paper's photometry.
    target = load_target(given.scene, given.size)
    simulation = simulate(target, Experiment(extended_magnitude=13 * u.mag))
    atomic.check_folder(str(given.output), overwrite=True)
    keep_truth(given.output / "truth.fits", simulation)
    jobs = []
    for method, mu in [("RLM", 0.0), *(("MC-RL", mu) for mu in given.mu)]:
        is_rlm = method == "RLM"
        n_iter = given.rlm_iterations if is_rlm else given.n_iter
        how = n_iter, given.every, None if is_rlm else given.patience
        path = given.output / f"{method.lower()}_{mu:g}.fits"
        cards = identity(given.scene, simulation, *how)
        jobs.append((path, method, mu, how, cards))
        if path.exists():  # refused now, not after hours of the rows before it
            read_row(path, method, mu, cards)
    table, found = make_table(), {}
    for path, method, mu, how, cards in jobs:
        if not path.exists():
            compute(path, simulation, method, mu, *how, cards)
        saved = read_row(path, method, mu, cards)
        name = method if method == "RLM" else f"{method} mu={mu:g}"
        found[name] = reconstruction(simulation, saved)
        table.add_row(row(simulation, found[name], saved.header["MINUTES"]))
        table[-1:].pprint(max_width=-1)
    table.write(given.output / "table.ecsv", overwrite=True)
    draw(given.output, simulation, found)
    print()
    table.pprint_all()


def main(arguments=None):
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="hh34")
    parser.add_argument("--size", type=int, help="of hh34 (default: 1024); a file has its own")
    parser.add_argument("--mu", type=float, nargs="+", default=[1e-8, 3e-8, 8e-8, 2e-7, 5e-7])
    parser.add_argument("--rlm-iterations", type=int, default=5000)
    parser.add_argument("--n-iter", type=int, default=40_000)
    parser.add_argument("--every", type=int, default=20)
    parser.add_argument("--patience", type=float, default=1.15)
    parser.add_argument("--quick", action="store_true", help="60 iterations, hh34 at 64 x 64")
    parser.add_argument("-o", "--output", type=Path, default=Path("hh34_table"))
    try:
        run(parser.parse_args(arguments))
    except (LnoclError, OSError) as error:
        print(f"hh34_table: error: {error}", file=sys.stderr)
        return getattr(error, "exit_status", 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
