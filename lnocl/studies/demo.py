"""The paper's experiment on disk: simulate to files, reconstruct to files, draw from files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl import __version__, metrics
from lnocl.errors import InputError, LnoclError
from lnocl.io import atomic, fitsread, fitswrite
from lnocl.plotting.curves import (
    draw_errors,
    draw_held_out_errors,
    draw_magnitudes,
    draw_objectives,
)
from lnocl.plotting.figure import check_matplotlib, save_figure
from lnocl.plotting.overview import draw_overview
from lnocl.plotting.profiles import draw_profiles
from lnocl.plotting.sources import Frame, Source, draw_objects
from lnocl.simulation import Experiment, Simulation, load_target, simulate
from lnocl.studies import experiment
from lnocl.studies.experiment import Reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCENE = "hh34"
# Weight and iterations of the demo. At 256 x 256 and seed 0, rho'' of MC-RL is 6.6 % at mu 0,
# 1e-8 and 3e-8, 8.3 % at 1e-7 and 14 % at 3e-7; its rho' is smallest after 2300 iterations.
MU = 3e-8
N_ITER = 2000
EVERY = 20

FIGURES = ("objects", "errors", "magnitude", "objective", "held-out", "flux", "width")
FIGURE_FILES = tuple(f"{name}.png" for name in FIGURES)


def write_simulation(
    folder: str, scene: str, simulation: Simulation, overwrite: bool = False
) -> list[str]:
    """Write images, PSFs, truth and record of a simulation.

    Parameters
    ----------
    folder : str
        An existing folder.
    scene : str
        Where the target came from, for the record.
    simulation : Simulation
        What to write: ``image_1.fits``..., ``psf_1.fits``..., ``truth.fits``, ``record.json``.
    overwrite : bool, optional
        Whether existing files may be replaced.

    Returns
    -------
    list of str
        Words of the command that deconvolves it, into ``result.fits`` in the folder.

    Raises
    ------
    FileError
        A file cannot be written, or exists and must not be overwritten.
    """
    how = simulation.experiment
    creator = ("CREATOR", f"lnocl {__version__}", "program that wrote this file")
    scale = ("PIXSCALE", float(how.pixel_scale.value), "mas per pixel")
    angles = how.angles.value.tolist()
    for j, (image, psf, angle) in enumerate(
        zip(simulation.images, simulation.psfs, angles, strict=True), 1
    ):
        common: list[fitswrite.Card] = [
            creator,
            scale,
            ("ANGLE", angle, "of the baseline, degrees"),
        ]
        taken: list[fitswrite.Card] = [
            ("BUNIT", "electron", "per pixel"),
            ("EXPTIME", float(how.exposure_time.to_value("s")), "seconds"),
            ("BKG", float(simulation.background[j - 1]), "background, electrons"),
            ("RON", simulation.read_noise, "read noise, electrons"),
        ]
        fitswrite.write_image(_in(folder, f"image_{j}"), image, [*common, *taken], overwrite)
        fitswrite.write_image(_in(folder, f"psf_{j}"), psf, common, overwrite)
    zero = ("MAGZERO", simulation.zero_magnitude_flux, "electrons of magnitude 0")
    fitswrite.write_result(
        _in(folder, "truth"),
        simulation.extended,
        simulation.stars,
        simulation.star_fluxes,
        cards=[creator, scale, zero],
        overwrite=overwrite,
    )
    record = {"lnocl": __version__, "scene": scene, **simulation.record()}
    path = os.path.join(folder, "record.json")
    atomic.write_text(path, json.dumps(record, indent=2) + "\n", overwrite)
    return _command(folder, simulation, simulation.stars, "result")


def run(
    folder: str, size: int = 256, seed: int = 0, device: str | None = None, overwrite: bool = False
) -> Iterator[str]:
    """Simulate `SCENE`, reconstruct it by RLM and MC-RL, and write tables, files and pictures.

    Parameters
    ----------
    folder : str
        Made where it does not exist.
    size, seed : int, optional
        Of the simulation.
    device : str, optional
        OpenCL device, as for `lnocl.deconvolve`.
    overwrite : bool, optional
        Whether files in the folder may be replaced.

    Yields
    ------
    str
        Lines for the terminal, as they come.

    Raises
    ------
    InputError
        A size or seed out of its range, or a device that is not there.
    DeviceError
        No OpenCL device at all, or one that cannot do what was asked of it.
    FileError
        The folder holds files, or one cannot be written.
    """
    experiment_at = Experiment(seed=seed)
    target = load_target(SCENE, size)
    atomic.check_folder(folder, overwrite, make=False)
    simulation = simulate(target, experiment_at)
    atomic.check_folder(folder, overwrite)
    write_simulation(folder, SCENE, simulation, overwrite)
    yield (
        f"simulated {SCENE}: {len(simulation.images)} images of {size} x {size} pixels, a star of "
        f"{simulation.star_fluxes[0]:.3g} electrons on a jet whose brightest pixel holds "
        f"{simulation.extended.max():.3g}"
    )
    observation = experiment.observe(simulation)
    found = []
    for method, mu in (("RLM", 0.0), ("MC-RL", MU)):
        each = experiment.reconstruct(
            simulation, observation, method, mu, N_ITER, EVERY, device=device, progress=True
        )
        name = method.lower()
        n_iter, _ = each.best("rho_star")
        options = ["--mu", repr(mu), "--n-iter", str(n_iter)]
        options += [] if device is None else ["--device", device]
        stars = [] if method == "RLM" else simulation.stars
        command = _command(folder, simulation, stars, name, *options)
        write_reconstruction(
            _in(folder, name),
            simulation,
            each,
            commands=[["cd", os.getcwd()], command],
            overwrite=overwrite,
        )
        found.append(each)
    yield f"{N_ITER} iterations each of RLM and MC-RL on {found[0].device}"
    yield from _table(simulation, found)
    yield from _conclusion(found)
    yield from _pictures(folder, simulation, found, overwrite)
    yield f"written to {folder}: images, PSFs, truth.fits, record.json, rlm.fits, mc-rl.fits"


def write_reconstruction(
    path: str,
    simulation: Simulation,
    found: Reconstruction,
    cards: Iterable[fitswrite.Card] = (),
    commands: Iterable[Sequence[str]] = (),
    overwrite: bool = False,
) -> None:
    """Write a reconstruction as `lnocl deconvolve` with as many iterations would, and its curve.

    Parameters
    ----------
    path : str
        File to write.
    simulation : Simulation
        What was reconstructed.
    found : Reconstruction
        At its smallest rho''.
    cards : iterable of (keyword, value, comment), optional
        Further cards of the primary header.
    commands : iterable of sequence of str, optional
        Shell commands that repeat the run, as words.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    stars = [] if found.method == "RLM" else simulation.stars
    n_iter, _ = found.best("rho_star")
    fitswrite.write_result(
        path,
        found.extended,
        stars,
        [found.star_flux] if stars else [],
        found.history[: n_iter + 1],
        cards=[
            ("CREATOR", f"lnocl {__version__}", "program that wrote this file"),
            ("METHOD", found.method, "star in the image, or a component"),
            ("SOLVER", "sgm", "iteration"),
            ("NITER", n_iter, "iterations done, to the smallest rho''"),
            ("MU", found.mu, "weight of the Tikhonov term, per electron"),
            ("PRECISIO", "single", "precision of the arithmetic"),
            ("ENGINE", "opencl", "engine"),
            ("DEVICE", found.device, "device"),
            ("PIXSCALE", float(simulation.experiment.pixel_scale.value), "mas per pixel"),
            *cards,
        ],
        commands=commands,
        overwrite=overwrite,
        curve=found.curve,
    )


def draw(
    folder: str, results: Sequence[str], truth: str | None = None, overwrite: bool = False
) -> Iterator[str]:
    """Draw the paper's figures from result files, as far as their data allow.

    Parameters
    ----------
    folder : str
        Made where it does not exist; figures are written to it.
    results : sequence of str
        Files that `fitswrite.write_result` has written. Without stars: RLM.
    truth : str, optional
        File with the true source and one star.
    overwrite : bool, optional
        Whether figures in the folder may be replaced.

    Yields
    ------
    str
        A line for each figure: its file, or why it was skipped.

    Raises
    ------
    LnoclError
        Where matplotlib is missing.
    FileError
        A file cannot be read or written, or a figure exists.
    InputError
        Where the shapes of the files differ, or one holds no flux or values that are not finite.
    """
    check_matplotlib()
    atomic.check_folder(folder, overwrite, FIGURE_FILES, make=False)
    results = list(dict.fromkeys(results))
    saved = [fitsread.read_result(path) for path in results]
    true = None if truth is None else fitsread.read_result(truth)
    _check_saved([*([] if true is None else [true]), *saved])
    names = _names(results, saved)
    sources = [
        Source(name, each.extended, holds_star=not each.stars)
        for name, each in zip(names, saved, strict=True)
    ]
    frame = _frame([*([] if true is None else [true]), *saved])
    original = None if true is None else Source("truth", true.extended)
    curves = _tables(names, [each.curve for each in saved])
    histories = _tables(names, [each.history for each in saved])
    atomic.check_folder(folder, overwrite, FIGURE_FILES)
    yield _draw(folder, "objects", draw_objects(original, sources, frame), overwrite)
    if curves:
        yield _draw(folder, "errors", draw_errors(curves), overwrite)
        yield _draw(folder, "magnitude", draw_magnitudes(curves, _true_magnitude(true)), overwrite)
    else:
        yield "errors and magnitude skipped: no file has a table CURVE (lnocl demo writes it)"
        if histories:
            yield _draw(folder, "objective", draw_objectives(histories), overwrite)
    held_out = _tables(names, [each.held_out for each in saved])
    if held_out:
        yield _draw(folder, "held-out", draw_held_out_errors(held_out), overwrite)
    if original is None or frame.star is None:
        yield "flux and width skipped: they need --truth with a star"
        return
    threshold = experiment.width_threshold(original.extended)
    for kind in ("flux", "width"):
        figure = draw_profiles(kind, original, sources, frame, experiment.NEAR_STAR, threshold)
        yield _draw(folder, kind, figure, overwrite)


def _check_saved(saved: Sequence[fitsread.SavedResult]) -> None:
    first = saved[0]
    ny, nx = first.extended.shape
    for each in saved:
        if each.extended.shape != (ny, nx):
            raise InputError(
                f"{each.path} has the shape {each.extended.shape} and {first.path} {(ny, nx)}; "
                "they must be the same"
            )
        if not (np.isfinite(each.extended).all() and each.extended.max() > 0):
            raise InputError(f"{each.path} holds values that are not finite, or no flux")
        for x, y in each.stars:
            if not (-0.5 <= x < nx - 0.5 and -0.5 <= y < ny - 0.5):
                raise InputError(f"{each.path} has a star at ({x:g}, {y:g}), outside its image")


def _in(folder: str, name: str) -> str:
    return os.path.join(folder, f"{name}.fits")


def _command(
    folder: str, simulation: Simulation, stars: Sequence[tuple[int, int]], output: str, *more: str
) -> list[str]:
    """Return the words of the command that deconvolves a simulation in its folder."""
    numbers = range(1, len(simulation.images) + 1)
    inside = os.path.join(".", folder) if folder.startswith("-") else folder
    return [
        *("lnocl", "deconvolve"),
        *(_in(inside, f"image_{j}") for j in numbers),
        "--psf",
        *(_in(inside, f"psf_{j}") for j in numbers),
        *("--background", *(repr(b) for b in dict.fromkeys(simulation.background.tolist()))),
        *("--read-noise", repr(simulation.read_noise)),
        *(word for x, y in stars for word in ("--star", f"{x},{y}")),
        *more,
        *("-o", _in(inside, output)),
    ]


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
    yield _draw(folder, "demo", figure, overwrite)
    results = [_in(folder, each.method.lower()) for each in found]
    yield from draw(folder, results, _in(folder, "truth"), overwrite)


def _draw(folder: str, name: str, figure: Figure, overwrite: bool) -> str:
    path = os.path.join(folder, f"{name}.png")
    save_figure(figure, path, overwrite)
    return f"drew {path}"


def _names(paths: Sequence[str], saved: Sequence[fitsread.SavedResult]) -> list[str]:
    """Return the method and mu of each result, with its file where that leaves two alike."""
    names = []
    for each in saved:
        mu = each.number("MU") or 0.0
        method = "MC-RL" if each.stars else "RLM"
        names.append(f"{method} mu={mu:g}" if each.stars or mu else method)
    return [
        f"{name} ({path})" if names.count(name) > 1 else name
        for name, path in zip(names, paths, strict=True)
    ]


def _tables(
    names: Sequence[str], tables: Sequence[dict[str, NDArray[np.float64]] | None]
) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return the tables that are there and have rows, by name."""
    return {
        name: table
        for name, table in zip(names, tables, strict=True)
        if table is not None and table["iteration"].size
    }


def _frame(saved: Sequence[fitsread.SavedResult]) -> Frame:
    star = next((each.stars[0] for each in saved if each.stars), None)
    scale = next((each.number("PIXSCALE") for each in saved if "PIXSCALE" in each.header), None)
    return Frame(star, scale)


def _true_magnitude(true: fitsread.SavedResult | None) -> float | None:
    if true is None or not true.stars:
        return None
    zero = true.number("MAGZERO")
    return None if zero is None else metrics.magnitude(float(true.star_fluxes[0]), zero)
