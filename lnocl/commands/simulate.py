"""The command ``simulate``: take images of a scene, and write them with the truth."""

from __future__ import annotations

import argparse
import shlex

from lnocl.commands import messages
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
    option("--strehl", type=float, metavar="S", help="Strehl ratio in (0, 1] (default: 0.7)"),
    option(
        "--throughput",
        type=float,
        metavar="T",
        help="electrons per photon that reaches the telescope, in (0, 1] (default: 0.3)",
    ),
    option(
        "--sky",
        type=float,
        dest="sky_brightness",
        metavar="MAG",
        help="brightness of the sky, magnitude per square arcsecond (default: 13.5)",
    ),
    option(
        "--read-noise",
        type=float,
        metavar="S",
        help="standard deviation in electrons (default: 10)",
    ),
]


def _run(arguments: argparse.Namespace) -> None:
    from astropy import units as u

    from lnocl.io import atomic
    from lnocl.simulation import Experiment, Star, load_target, simulate
    from lnocl.simulation.photometry import MAG_PER_ARCSEC2
    from lnocl.studies import files

    stars = arguments.stars and [Star(x, y, mag * u.mag) for x, y, mag in arguments.stars]
    with messages.shown_log():
        target = load_target(arguments.scene, arguments.size, stars)
    units = {
        "angles": u.deg,
        "extended_magnitude": u.mag,
        "sky_brightness": MAG_PER_ARCSEC2,
        "read_noise": u.electron,
    }
    names = (*units, "exposure_time", "strehl", "throughput", "seed")
    given = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    experiment = Experiment(
        **{name: value * units[name] if name in units else value for name, value in given.items()}
    )
    atomic.check_folder(arguments.output, arguments.overwrite, make=False)
    simulation = simulate(target, experiment)
    atomic.check_folder(arguments.output, arguments.overwrite)
    command = files.write_simulation(
        arguments.output, arguments.scene, simulation, arguments.overwrite
    )
    messages.say(
        [
            f"{len(simulation.images)} images, as many PSFs, truth.fits and record.json written "
            f"to {arguments.output}; to deconvolve them run",
            shlex.join(command),
        ]
    )


COMMAND = Command(
    "simulate images of a scene as the paper's interferometer would take them",
    {"": OPTIONS},
    _run,
)
