"""The demo: the paper's experiment, simulated, reconstructed by two methods, and drawn."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from lnocl import metrics
from lnocl.errors import LnoclError
from lnocl.io import atomic
from lnocl.plotting.figure import check_matplotlib
from lnocl.plotting.overview import draw_overview
from lnocl.plotting.sources import Frame, Source
from lnocl.scene.observation import Observation
from lnocl.simulation import Experiment, Simulation, load_target, simulate
from lnocl.studies import experiment, figures, files
from lnocl.studies.experiment import Reconstruction

SCENE = "hh34"
# Weight and iterations of the demo. At 256 x 256 and seed 0, rho'' of MC-RL is 6.6 % at mu 0,
# 1e-8 and 3e-8, 8.3 % at 1e-7 and 14 % at 3e-7; its rho' is smallest after 2300 iterations.
MU = 3e-8
N_ITER = 2000
EVERY = 20


def run(
    folder: str, size: int = 256, seed: int = 0, device: str | None = None, overwrite: bool = False
) -> Iterator[str]:
    """Simulate `SCENE`, reconstruct it by RLM and MC-RL, and write tables, files and figures.

    Parameters
    ----------
    folder : str
        Folder of the files, made where it does not exist.
    size : int, optional
        Pixels along each side of the images, even, 64 or more.
    seed : int, optional
        Seed of the noise, 0 or more.
    device : str, optional
        OpenCL device, as for `lnocl.deconvolve`.
    overwrite : bool, optional
        Whether files in the folder may be replaced.

    Yields
    ------
    str
        Lines for the terminal, each as soon as it is known.

    Raises
    ------
    InputError
        A size or seed out of its range, or a device that is not there.
    DeviceError
        No OpenCL device was found, or the device failed.
    FileError
        The folder holds files, or one cannot be written.
    """
    target = load_target(SCENE, size)
    atomic.check_folder(folder, overwrite, make=False)
    simulation = simulate(target, Experiment(seed=seed))
    atomic.check_folder(folder, overwrite)
    files.write_simulation(folder, SCENE, simulation, overwrite)
    yield (
        f"simulated {SCENE}: {len(simulation.images)} images of {size} x {size} pixels, a star of "
        f"{simulation.star_fluxes[0]:.3g} electrons on a jet whose brightest pixel holds "
        f"{simulation.extended.max():.3g}"
    )
    observation = experiment.observe(simulation)
    found = [
        _reconstruct(folder, simulation, observation, method, mu, device, overwrite)
        for method, mu in (("RLM", 0.0), ("MC-RL", MU))
    ]
    yield f"{N_ITER} iterations each of RLM and MC-RL on {found[0].device}"
    yield from _table(simulation, found)
    yield from _conclusion(found)
    yield from _pictures(folder, simulation, found, overwrite)
    yield f"written to {folder}: images, PSFs, truth.fits, record.json, rlm.fits, mc-rl.fits"


def _reconstruct(
    folder: str,
    simulation: Simulation,
    observation: Observation,
    method: str,
    mu: float,
    device: str | None,
    overwrite: bool,
) -> Reconstruction:
    """Reconstruct by one method, and write the result with the command that repeats it."""
    found = experiment.reconstruct(
        simulation, observation, method, mu, N_ITER, EVERY, device=device, progress=True
    )
    n_iter, _ = found.best("rho_star")
    options = ["--mu", repr(mu), "--n-iter", str(n_iter), *files.PAPER_WORDS]
    options += [] if device is None else ["--device", device]
    name, stars = method.lower(), [] if method == "RLM" else simulation.stars
    command = files.command(folder, simulation, stars, name, *options)
    files.write_reconstruction(
        files.path_in(folder, name),
        simulation,
        found,
        commands=[["cd", os.getcwd()], command],
        overwrite=overwrite,
        observation=observation,
    )
    return found


def _table(simulation: Simulation, found: Sequence[Reconstruction]) -> Iterator[str]:
    columns = ("method", "rho'", "at", "rho''", "at", "star", "flux error", "width error")
    yield "{:<15} {:>8} {:>5} {:>8} {:>5} {:>11} {:>11} {:>12}".format(*columns)
    for each in found:
        (at, rho), (at_star, rho_star) = each.best("rho"), each.best("rho_star")
        errors = experiment.profile_errors(simulation, each)
        star = metrics.magnitude(each.star_flux, simulation.zero_magnitude_flux)
        # As in the paper's table, an error that is still falling has its minimum later.
        last = each.curve["iteration"][-1]
        when, when_star = (f">{i}" if i == last else f"{i}" for i in (at, at_star))
        yield (
            f"{each.name:<15} {rho:>8.2%} {when:>5} {rho_star:>8.2%} {when_star:>5} "
            f"{star:>7.4f} mag {errors['flux']:>11.1%} {errors['width']:>12.1%}"
        )


def _conclusion(found: Sequence[Reconstruction]) -> Iterator[str]:
    rlm, mcrl = (each.best("rho_star")[1] for each in found)
    yield (
        "rho' is the error of the whole jet, rho'' of the 24 rows around the star, each at its "
        "smallest; flux and width: mean error of the 40 rows around the star"
    )
    yield f"near the star the error of MC-RL is {rlm / mcrl:.1f} times smaller than that of RLM"


def _pictures(
    folder: str, simulation: Simulation, found: Sequence[Reconstruction], overwrite: bool
) -> Iterator[str]:
    try:
        check_matplotlib()
    except LnoclError as error:
        yield f"no pictures: {error}"
        return
    scale = float(simulation.experiment.pixel_scale.value)
    figure = draw_overview(
        Source("truth", simulation.extended, note="the jet without its star"),
        Source(
            "one of the images",
            simulation.images[0] - simulation.background[0],
            note="sky subtracted",
        ),
        [
            Source(
                each.name,
                each.extended,
                each.method == "RLM",
                f"star {'in the image' if each.method == 'RLM' else 'apart'}\n"
                f"error near it {each.best('rho_star')[1]:.0%}",
            )
            for each in found
        ],
        Frame(simulation.stars[0], scale),
        experiment.NEAR_STAR,
    )
    yield figures.save(folder, "demo", figure, overwrite)
    results = [files.path_in(folder, each.method.lower()) for each in found]
    yield from figures.draw(folder, results, files.path_in(folder, "truth"), overwrite)
