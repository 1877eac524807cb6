"""A simulation as files."""

from __future__ import annotations

import json
import os

from astropy.utils.misc import JsonCustomEncoder

from lnocl import __version__
from lnocl.io import atomic, fitswrite
from lnocl.simulation import Simulation


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
        both: list[fitswrite.Card] = [creator, scale, ("ANGLE", angle, "of the baseline, degrees")]
        taken: list[fitswrite.Card] = [
            ("BUNIT", "electron", "per pixel"),
            ("EXPTIME", float(how.exposure_time.to_value("s")), "seconds"),
            ("BKG", float(simulation.background[j - 1]), "background, electrons"),
            ("RON", simulation.read_noise, "read noise, electrons"),
        ]
        fitswrite.write_image(path_in(folder, f"image_{j}"), image, [*both, *taken], overwrite)
        fitswrite.write_image(path_in(folder, f"psf_{j}"), psf, both, overwrite)
    fitswrite.write_result(
        path_in(folder, "truth"),
        simulation.extended,
        simulation.stars,
        simulation.star_fluxes,
        cards=[creator, scale],
        overwrite=overwrite,
    )
    record = {"lnocl": __version__, "scene": scene, "experiment": vars(how)}
    text = json.dumps(record, indent=2, cls=JsonCustomEncoder) + "\n"
    atomic.write_text(os.path.join(folder, "record.json"), text, overwrite)
    numbers = range(1, len(simulation.images) + 1)
    inside = os.path.join(".", folder) if folder.startswith("-") else folder
    return [
        *("lnocl", "deconvolve"),
        *(path_in(inside, f"image_{j}") for j in numbers),
        "--psf",
        *(path_in(inside, f"psf_{j}") for j in numbers),
        *("--background", *(repr(b) for b in dict.fromkeys(simulation.background.tolist()))),
        *("--read-noise", repr(simulation.read_noise)),
        *(word for x, y in simulation.stars for word in ("--star", f"{x},{y}")),
        # PSFs are exact; what leaves one edge of a simulation comes in at the opposite one.
        *("--psf-error", "0", "--pad", "0", "-o", path_in(inside, "result")),
    ]


def names_of(n_images: int) -> list[str]:
    """Return the names of the files of a simulation."""
    each = [f"{kind}_{j}.fits" for kind in ("image", "psf") for j in range(1, n_images + 1)]
    return [*each, "truth.fits", "record.json"]


def path_in(folder: str, name: str) -> str:
    """Return the path of a FITS file in a folder, from its name without the ending."""
    return os.path.join(folder, f"{name}.fits")
