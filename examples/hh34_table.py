"""The paper's table: RLM and MC-RL at several mu, to the smallest restoration errors.

    python examples/hh34_table.py [--scene hh34|FILE.fits] [--size 1024] [--mu 1e-8 3e-8 ...] -o DIR

Each row is written to DIR as soon as it is done and is not computed again, so that the script
can be stopped and started; DIR/table.ecsv has the table, and lnocl plot draws the rest:
lnocl plot DIR/rlm_0.fits DIR/mc-rl_*.fits --truth DIR/truth.fits -o DIR. --quick is a small run.
"""

import argparse
import time
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import Table

from lnocl import experiment, fitsio, metrics, simulate

# La Camera et al. (2012), Table 1: rho' and rho'' in percent, with their iterations.
PAPER = {
    ("RLM", 0.0): (11.67, 4251, 72.87, 5000),
    ("MC-RL", 1e-8): (8.82, 26614, 24.80, 33483),
    ("MC-RL", 3e-8): (7.68, 9503, 23.81, 10972),
    ("MC-RL", 8e-8): (7.91, 3776, 24.42, 4198),
    ("MC-RL", 2e-7): (9.49, 1496, 25.34, 1630),
}
COLUMNS = (
    "method",
    "mu",
    "rho [%]",
    "at",
    "rho'' [%]",
    "at ",
    "magnitude",
    "flux error [%]",
    "width error [%]",
    "paper rho [%]",
    "paper rho'' [%]",
    "minutes",
)


def compute(path, simulation, observation, method, mu, n_iter, every, patience):
    """Compute one reconstruction and save it as a result that lnocl plot reads."""
    start = time.monotonic()
    patience = None if method == "RLM" else patience
    found = experiment.reconstruct(
        simulation, observation, method, mu, n_iter, every, patience, progress=True
    )
    is_mcrl = method == "MC-RL"
    fitsio.write_result(
        str(path),
        found.extended,
        simulation.stars if is_mcrl else [],
        [found.star_flux] if is_mcrl else [],
        found.history,
        curve=found.curve,
        cards=[
            ("METHOD", method, "star in the image, or a component"),
            ("MU", mu, "weight of the Tikhonov term, per electron"),
            ("PIXSCALE", float(simulation.experiment.pixel_scale.value), "mas per pixel"),
            ("DEVICE", found.device, "device"),
            ("MINUTES", (time.monotonic() - start) / 60, "that it took"),
        ],
    )


def row(simulation, path):
    """Return the table's row of a saved reconstruction."""
    saved = fitsio.read_result(str(path))
    method, mu = saved.header["METHOD"], saved.header["MU"]
    curve = np.zeros(len(saved.curve["iteration"]), experiment.CURVE_DTYPE)
    for name, values in saved.curve.items():
        curve[name] = values
    if method == "MC-RL":
        flux = float(saved.star_fluxes[0])
    else:
        flux = metrics.box_flux(saved.extended, simulation.stars[0])
    found = experiment.Reconstruction(method, mu, curve, saved.extended, flux)
    errors = experiment.profile_errors(simulation, found)
    at, rho = found.best("rho")
    at_star, rho_star = found.best("rho_star")
    paper = PAPER.get((method, mu), (np.nan, 0, np.nan, 0))
    return (
        method,
        mu,
        100 * rho,
        at,
        100 * rho_star,
        at_star,
        metrics.magnitude(flux, simulation.zero_magnitude_flux),
        100 * errors["flux"],
        100 * errors["width"],
        paper[0],
        paper[2],
        saved.header["MINUTES"],
    )


def main():
    """Compute the rows that are missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="hh34")
    parser.add_argument("--size", type=int, help="of hh34 (default: 1024); a file has its own")
    parser.add_argument("--mu", type=float, nargs="+", default=[1e-8, 3e-8, 8e-8, 2e-7, 5e-7])
    parser.add_argument("--rlm-iterations", type=int, default=5000)
    parser.add_argument("--n-iter", type=int, default=40_000)
    parser.add_argument("--every", type=int, default=20)
    parser.add_argument("--patience", type=float, default=1.15)
    parser.add_argument("--quick", action="store_true", help="64 x 64 and 60 iterations")
    parser.add_argument("-o", "--output", type=Path, default=Path("hh34_table"))
    given = parser.parse_args()
    if given.quick:
        given.size, given.rlm_iterations, given.n_iter = 64, 60, 60

    # The jet and the star at magnitude 13: any scene is brought to the paper's photometry.
    target = simulate.load_target(given.scene, given.size)
    simulation = simulate.simulate(target, simulate.Experiment(extended_magnitude=13 * u.mag))
    observation = experiment.observe(simulation)
    given.output.mkdir(parents=True, exist_ok=True)
    fitsio.write_result(
        str(given.output / "truth.fits"),
        simulation.extended,
        simulation.stars,
        simulation.star_fluxes,
        cards=[("MAGZERO", simulation.zero_magnitude_flux, "electrons of magnitude 0")],
        overwrite=True,
    )
    table = Table(names=COLUMNS, dtype=[str, *[float] * 2, int, float, int, *[float] * 6])
    table["mu"].format = ".0e"
    for name in (name for name in COLUMNS if "%" in name or name == "minutes"):
        table[name].format = ".2f"
    table["magnitude"].format = ".4f"
    for method, mu in [("RLM", 0.0), *(("MC-RL", mu) for mu in given.mu)]:
        path = given.output / f"{method.lower()}_{mu:g}.fits"
        if not path.exists():
            n_iter = given.rlm_iterations if method == "RLM" else given.n_iter
            compute(path, simulation, observation, method, mu, n_iter, given.every, given.patience)
        table.add_row(row(simulation, path))
        table[-1:].pprint(max_width=-1, show_unit=False)
    table.write(given.output / "table.ecsv", overwrite=True)
    print()
    table.pprint_all()


if __name__ == "__main__":
    main()
