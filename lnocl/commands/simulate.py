"""The command ``simulate``: take images of a scene, and write them with the truth."""

from __future__ import annotations

import argparse
import shlex

from lnocl.commands import messages
from lnocl.commands.arguments import Command, add_folder


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene",
        metavar="SCENE",
        help="hh34, a jet like the paper's, or a FITS file whose first image is the extended "
        "source; the header keywords STARX and STARY, 0-based, name its star",
    )
    add_folder(parser, "images, PSFs, truth and record.json", required=True)
    parser.add_argument(
        "--size", type=int, metavar="N", help="pixels along each side of hh34 (default: 1024)"
    )
    parser.add_argument(
        "--angle",
        nargs="+",
        type=float,
        dest="angles",
        metavar="DEG",
        help="angles of the baseline from the x axis towards the y axis, one for each image "
        "(default: 0 45 90 135)",
    )
    parser.add_argument(
        "--exposure-time", metavar="TIME", help='of each image, with unit (default: "30 min")'
    )
    parser.add_argument(
        "--strehl", type=float, metavar="S", help="Strehl ratio in (0, 1] (default: 0.7)"
    )
    parser.add_argument(
        "--throughput",
        type=float,
        metavar="T",
        help="electrons per photon that reaches the telescope, in (0, 1] (default: 0.3)",
    )
    parser.add_argument(
        "--star",
        action="append",
        type=_star,
        dest="stars",
        metavar="X,Y,MAG",
        help="whole pixels, 0-based, and magnitude of a star, instead of those of the scene; may "
        "be repeated",
    )
    parser.add_argument(
        "--extended-magnitude",
        type=float,
        metavar="M",
        help="integrated magnitude of the extended source (default: 13)",
    )
    parser.add_argument(
        "--sky",
        type=float,
        dest="sky_brightness",
        metavar="MAG",
        help="brightness of the sky, magnitude per square arcsecond (default: 13.5)",
    )
    parser.add_argument(
        "--read-noise",
        type=float,
        metavar="S",
        help="standard deviation in electrons (default: 10)",
    )
    parser.add_argument(
        "--seed", type=int, metavar="N", help="of residual phases and noise (default: 0)"
    )


def _run(arguments: argparse.Namespace) -> None:
    from astropy import units as u

    from lnocl.io import atomic
    from lnocl.simulation import Experiment, Star, load_target, simulate
    from lnocl.simulation.photometry import MAG_PER_ARCSEC2
    from lnocl.studies import demo

    stars = arguments.stars and [Star(x, y, mag * u.mag) for x, y, mag in arguments.stars]
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
    command = demo.write_simulation(
        arguments.output, arguments.scene, simulation, arguments.overwrite
    )
    messages.say(
        [
            f"{len(simulation.images)} images, as many PSFs, truth.fits and record.json written "
            f"to {arguments.output}; to deconvolve them run",
            shlex.join(command),
        ]
    )


def _star(text: str) -> tuple[float, float, float]:
    try:
        x, y, magnitude = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y,MAG") from None
    return x, y, magnitude


COMMAND = Command(
    "simulate images of a scene as the paper's interferometer would take them",
    _add_arguments,
    _run,
)
