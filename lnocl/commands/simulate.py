"""The command ``simulate``: take images of a scene, and write them with the truth."""

from __future__ import annotations

import argparse
import os
import shlex

from lnocl.commands import options
from lnocl.commands.options import option, output_folder
from lnocl.commands.parser import Command


def _star(text: str) -> tuple[float, float, float]:
    try:
        x, y, magnitude = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y,MAG") from None
    return x, y, magnitude


OPTIONS = [
    option(
        "scene",
        metavar="SCENE",
        is_input=True,
        help="hh34, a jet like the paper's, or a FITS file whose first image is the extended "
        "source; its header keywords STARX and STARY, 0-based, give the position of a star",
    ),
    *output_folder("images, PSFs, truth and record.json", required=True),
    option("--size", type=int, metavar="N", help="pixels along each side of hh34 (default: 1024)"),
    option("--seed", type=int, metavar="N", help="seed of residual phases and noise (default: 0)"),
    option(
        "--star",
        action="append",
        type=_star,
        dest="stars",
        metavar="X,Y,MAG",
        help="whole pixels, 0-based, and magnitude of a star, instead of those of the scene; may "
        "be repeated",
    ),
    option(
        "--extended-magnitude",
        type=float,
        metavar="M",
        help="integrated magnitude of the extended source (default: 13)",
    ),
    option(
        "--exposure-time",
        metavar="TIME",
        help='exposure time of each image, with unit (default: "30 min")',
    ),
    option(
        "--angle",
        nargs="+",
        type=float,
        dest="angles",
        metavar="DEG",
        help="angle of the baseline in each image, from the x axis towards the y axis (default: "
        "0 45 90 135)",
    ),
    options.QUIET,
]


def write(arguments: argparse.Namespace) -> list[str]:
    """Simulate, write the files, and return the words of the command that deconvolves them."""
    from astropy import units as u

    from lnocl.io import atomic
    from lnocl.simulation import Experiment, Star, load_target, simulate
    from lnocl.studies.files import names_of, write_simulation

    stars = arguments.stars and [Star(x, y, mag * u.mag) for x, y, mag in arguments.stars]
    target = load_target(arguments.scene, arguments.size, stars)
    units = {"angles": u.deg, "extended_magnitude": u.mag, "exposure_time": 1, "seed": 1}
    given = {name: getattr(arguments, name) for name in units}
    experiment = Experiment(
        **{name: value * units[name] for name, value in given.items() if value is not None}
    )
    atomic.check_folder(arguments.output, arguments.overwrite, make=False)
    for name in names_of(len(experiment.angles)):
        atomic.refuse_input(os.path.join(arguments.output, name))
    simulation = simulate(target, experiment)
    atomic.check_folder(arguments.output, arguments.overwrite)
    return write_simulation(arguments.output, arguments.scene, simulation, arguments.overwrite)


def _run(arguments: argparse.Namespace) -> list[str]:
    words = write(arguments)
    written = f"images, PSFs, truth.fits and record.json written to {arguments.output}"
    return [f"{written}; to deconvolve them run", shlex.join(words)]


COMMAND = Command(
    "simulate images of a scene as the paper's interferometer would take them",
    {"": OPTIONS},
    _run,
)
