"""A simulation and its reconstructions as files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence

import numpy as np

from lnocl import __version__
from lnocl.io import atomic, fitswrite
from lnocl.residuals import residuals
from lnocl.scene.observation import Array, Observation
from lnocl.simulation import Simulation
from lnocl.studies.experiment import Reconstruction


def write_simulation(
    folder: str, scene: str, simulation: Simulation, overwrite: bool = False
) -> list[str]:
    """Write the images, PSFs, truth and record of a simulation.

    Parameters
    ----------
    folder : str
        An existing folder.
    scene : str
        Name or file of the target, for the record.
    simulation : Simulation
        It becomes ``image_1.fits``..., ``psf_1.fits``..., ``truth.fits`` and ``record.json``.
    overwrite : bool, optional
        Whether existing files may be replaced.

    Returns
    -------
    list of str
        Words of the command that deconvolves these files into ``result.fits`` in the folder.

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
        fitswrite.write_image(path_in(folder, f"image_{j}"), image, [*common, *taken], overwrite)
        fitswrite.write_image(path_in(folder, f"psf_{j}"), psf, common, overwrite)
    zero = ("MAGZERO", simulation.zero_magnitude_flux, "electrons of magnitude 0")
    fitswrite.write_result(
        path_in(folder, "truth"),
        simulation.extended,
        simulation.stars,
        simulation.star_fluxes,
        cards=[creator, scale, zero],
        overwrite=overwrite,
    )
    record = {"lnocl": __version__, "scene": scene, **simulation.record()}
    path = os.path.join(folder, "record.json")
    atomic.write_text(path, json.dumps(record, indent=2) + "\n", overwrite)
    # What leaves one edge of a simulation comes in at the opposite one.
    return command(folder, simulation, simulation.stars, "result", "--pad", "0")


def write_reconstruction(
    path: str,
    simulation: Simulation,
    found: Reconstruction,
    cards: Iterable[fitswrite.Card] = (),
    commands: Iterable[Sequence[str]] = (),
    overwrite: bool = False,
    observation: Observation | None = None,
) -> None:
    """Write a reconstruction like a result of `lnocl deconvolve`, with the curve of its errors.

    Parameters
    ----------
    path : str
        File to write.
    simulation : Simulation
        The simulation that was reconstructed, with its true source.
    found : Reconstruction
        The estimate at its smallest rho''.
    cards : iterable of (keyword, value, comment), optional
        Further cards of the primary header.
    commands : iterable of sequence of str, optional
        Shell commands that repeat the run, as words.
    overwrite : bool, optional
        Whether an existing file may be replaced.
    observation : Observation, optional
        What was reconstructed; with it models and residuals are written too.

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
        cubes={} if observation is None else _cubes(observation, found),
    )


def _cubes(observation: Observation, found: Reconstruction) -> dict[str, tuple[Array, str]]:
    images = zip(observation.images, observation.mask, found.models, strict=True)
    return {
        "MODELS": (found.models, "electron"),
        "RESIDUALS": (np.array([residuals(*each) for each in images]), ""),
    }


# The words of `lnocl.runs.options.PAPER`.
PAPER_WORDS = ("--solver", "sgm", "--stop", "none", "--smoothing", "0", "--pad", "0")


def command(
    folder: str, simulation: Simulation, stars: Sequence[tuple[int, int]], output: str, *more: str
) -> list[str]:
    """Return the words of the command that deconvolves a simulation in its folder.

    Parameters
    ----------
    folder : str
        Folder of `write_simulation`.
    simulation : Simulation
        The simulation there.
    stars : sequence of (x, y)
        Positions of the stars that are components of their own, in pixels, 0-based.
    output : str
        Name of the result without its ending.
    *more : str
        Further words.
    """
    numbers = range(1, len(simulation.images) + 1)
    inside = os.path.join(".", folder) if folder.startswith("-") else folder
    return [
        *("lnocl", "deconvolve"),
        *(path_in(inside, f"image_{j}") for j in numbers),
        "--psf",
        *(path_in(inside, f"psf_{j}") for j in numbers),
        *("--background", *(repr(b) for b in dict.fromkeys(simulation.background.tolist()))),
        *("--read-noise", repr(simulation.read_noise)),
        *(word for x, y in stars for word in ("--star", f"{x},{y}")),
        *more,
        *("-o", path_in(inside, output)),
    ]


def path_in(folder: str, name: str) -> str:
    """Return the path of a FITS file in a folder, from its name without the ending."""
    return os.path.join(folder, f"{name}.fits")
