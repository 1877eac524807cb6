"""The command ``deconvolve``: load images and PSFs, run, write the result."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from lnocl import __version__
from lnocl.commands import checkpoints, messages
from lnocl.commands.arguments import (
    Arguments,
    Command,
    add_device,
    add_frame_arguments,
    add_input_arguments,
    add_star,
    as_path,
    finite,
    number_or_word,
)
from lnocl.deconvolution import deconvolve
from lnocl.result import Result
from lnocl.runs.options import ENGINES, PRECISIONS
from lnocl.solvers import SOLVERS

if TYPE_CHECKING:
    from astropy.io import fits

    from lnocl.io.fitsread import Stack
    from lnocl.io.fitswrite import StarColumn
    from lnocl.io.frames import Frames
    from lnocl.scene.observation import Observation


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_input_arguments(parser.add_argument_group("images"), required=True)
    add_frame_arguments(parser.add_argument_group("what real images need besides"))
    stars = parser.add_argument_group("stars")
    add_star(stars)
    _add_star_arguments(stars)
    _add_run_arguments(parser.add_argument_group("reconstruction"))
    _add_output_arguments(parser.add_argument_group("output"))
    checkpoints.add_arguments(parser.add_argument_group("long runs"))


def _add_star_arguments(parser: Arguments) -> None:
    parser.add_argument(
        "--star-sky",
        action="append",
        default=[],
        metavar="RA,DEC",
        help="position of a star on the sky (ICRS), in degrees or as hh:mm:ss,dd:mm:ss; may be "
        "repeated",
    )
    parser.add_argument(
        "--stars",
        metavar="FILE",
        dest="star_table",
        help="table of stars, any that astropy reads: columns x and y, or ra and dec",
    )
    parser.add_argument(
        "--refine",
        action="store_true",
        help="move the stars to where they are most likely, at most 3 pixels away",
    )
    parser.add_argument(
        "--zero-point",
        type=finite,
        metavar="MAG",
        help="magnitude of one electron, or of one per second where exposures are given: adds a "
        "column mag to the table of stars",
    )


def _add_run_arguments(parser: Arguments) -> None:
    parser.add_argument(
        "--mu",
        type=number_or_word,
        default=0.0,
        metavar="MU",
        help="weight of the Tikhonov term on the extended source, per electron, or auto: chosen by "
        "held-out counts (default: %(default)s)",
    )
    parser.add_argument(
        "--smoothing",
        type=number_or_word,
        default=0.0,
        metavar="WEIGHT",
        help="weight of an edge-preserving term that keeps noise down, 1e-4 to 1e-3 beside bright "
        "stars, or auto: chosen by held-out counts (default: %(default)s)",
    )
    parser.add_argument(
        "--solver",
        choices=tuple(SOLVERS),
        default="sgm",
        help="split-gradient method, or scaled gradient projection, which needs a tenth of the "
        "iterations and less (default: %(default)s)",
    )
    parser.add_argument(
        "--n-iter",
        type=int,
        default=1000,
        metavar="N",
        help="iterations to do, at most (default: %(default)s)",
    )
    parser.add_argument(
        "--stop",
        type=number_or_word,
        metavar="RULE",
        help="stop before N: held-out, at the iteration that held-out counts choose; discrepancy, "
        "when the data are fitted as well as noise allows; or a number below 1, when an iteration "
        "changes the objective by a smaller share of it",
    )
    parser.add_argument(
        "--pad",
        type=_whole_or_word,
        default=0,
        metavar="N",
        help="unobserved pixels kept round the images, at least; auto, where sources run over the "
        "edge: as many as the PSFs need (default: %(default)s)",
    )
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        default="single",
        help="arithmetic on the OpenCL device (default: %(default)s)",
    )
    parser.add_argument(
        "--engine",
        choices=ENGINES,
        default="opencl",
        help="OpenCL, or the plain NumPy reference, which computes in double "
        "(default: %(default)s)",
    )
    add_device(parser)


def _add_output_arguments(parser: Arguments) -> None:
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT.fits",
        help="file for the extended source, the stars and the history of the objective",
    )
    parser.add_argument(
        "--models",
        action="store_true",
        help="write a cube with the model of each image too, in electrons",
    )
    parser.add_argument(
        "--residuals",
        action="store_true",
        help="write a cube with (image - model) / sqrt(model) of each image too",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.fits if it exists")
    parser.add_argument("--quiet", action="store_true", help="show warnings and errors only")


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.io import atomic, fitsread, fitswrite

    inputs = _input_paths(arguments)
    atomic.check_output(
        arguments.output, arguments.overwrite, [*inputs, *_if_given(arguments.resume)]
    )
    checkpoints.check(arguments, inputs)
    folder = os.getcwd()
    device = _device_spec(arguments)
    log = contextlib.nullcontext() if arguments.quiet else messages.shown_log()
    with log, checkpoints.Interrupts() as interrupts:
        frames = _read_frames(arguments)
        stars = _stars(arguments, frames.images)
        wcs = fitsread.wcs_cards(frames.images.header)
        result = deconvolve(
            frames.observation,
            stars=stars,
            mu=arguments.mu,
            smoothing=arguments.smoothing,
            solver=arguments.solver,
            n_iter=arguments.n_iter,
            stop=arguments.stop,
            precision=arguments.precision,
            engine=arguments.engine,
            device=device,
            pad=arguments.pad,
            progress=not arguments.quiet,
            refine_positions=arguments.refine,
            callback=interrupts.callback,
            checkpoint=arguments.checkpoint,
            checkpoint_every=arguments.checkpoint_every,
            resume=arguments.resume,
        )
        interrupts.listen()  # where no iteration was left to do it has not begun to
        if result.stop_reason == "callback":
            result = dataclasses.replace(result, stop_reason="interrupt")
        fitswrite.write_result(
            arguments.output,
            result.extended,
            result.star_positions,
            result.star_fluxes,
            result.history,
            wcs=wcs,
            cards=_cards(arguments, result, frames),
            commands=[["cd", folder], _repeating_command(arguments, stars, frames, device)],
            overwrite=arguments.overwrite,
            held_out=result.held_out if result.held_out.size else None,
            per_second=bool(arguments.exposure),
            star_columns=_star_columns(arguments, result, frames.images.header),
            cubes=_cubes(arguments, result),
        )
        if not arguments.quiet:
            messages.say(_summary(arguments, result))
    interrupts.explain(arguments, result)


def _input_paths(arguments: argparse.Namespace) -> list[str]:
    """Return what is named on the command line and may be a file to read."""
    return [
        *arguments.images,
        *arguments.psfs,
        *arguments.inverse_variance,
        *arguments.mask,
        *(
            word
            for words in (arguments.background, arguments.read_noise, arguments.exposure)
            for word in words or ()
            if isinstance(word, str)
        ),
        *([] if arguments.star_table is None else [arguments.star_table]),
    ]


def _read_frames(arguments: argparse.Namespace) -> Frames:
    from lnocl.io.frames import Calibration, read_frames

    return read_frames(
        arguments.images,
        arguments.psfs,
        Calibration(
            background=arguments.background or [0.0],
            read_noise=arguments.read_noise or [0.0],
            inverse_variance=arguments.inverse_variance,
            exposure=arguments.exposure or [],
            mask=arguments.mask,
            saturation=arguments.saturation,
            gain=arguments.gain,
            align=arguments.align,
        ),
    )


def _stars(arguments: argparse.Namespace, images: Stack) -> list[tuple[float, float]]:
    """Return the positions of all stars, in pixels: of --star, --star-sky and --stars."""
    positions = list(arguments.stars)
    if arguments.star_sky or arguments.star_table:
        from lnocl.io import sky

        if arguments.star_sky:
            wcs = sky.celestial_wcs(images.header, arguments.images[0])
            coordinates = sky.parse_sky(arguments.star_sky)
            positions += sky.to_pixels(coordinates, wcs, arguments.images[0]).tolist()
        if arguments.star_table:
            positions += sky.read_stars(
                arguments.star_table, images.header, arguments.images[0]
            ).tolist()
    return [(x, y) for x, y in positions]


def _star_columns(
    arguments: argparse.Namespace, result: Result, header: fits.Header
) -> list[StarColumn]:
    """Return what the table of stars holds besides positions and fluxes."""
    from lnocl.io import sky
    from lnocl.io.fitswrite import StarColumn
    from lnocl.metrics import magnitude

    columns = []
    if arguments.refine:
        x_error, y_error = result.star_position_errors.T
        unit = "ct/s" if arguments.exposure else "ct"
        columns += [
            StarColumn("x_error", x_error, "pix", "standard error"),
            StarColumn("y_error", y_error, "pix", "standard error"),
            StarColumn("flux_error", result.star_flux_errors, unit, "standard error"),
        ]
    if arguments.zero_point is not None:
        magnitudes = [magnitude(flux, 1.0) + arguments.zero_point for flux in result.star_fluxes]
        columns.append(StarColumn("mag", magnitudes, "mag", "by the zero point"))
    if sky.has_celestial(header):
        ra, dec = sky.to_sky(result.star_positions, header).T
        columns += [
            StarColumn("ra", ra, "deg", "right ascension, ICRS"),
            StarColumn("dec", dec, "deg", "declination, ICRS"),
        ]
    return columns


def _cubes(arguments: argparse.Namespace, result: Result) -> dict[str, tuple[Any, str]]:
    return {
        **({"MODELS": (result.models(), "electron")} if arguments.models else {}),
        **({"RESIDUALS": (result.residuals(), "")} if arguments.residuals else {}),
    }


def _device_spec(arguments: argparse.Namespace) -> str | None:
    """Return the OpenCL device as indices, so that the run can be repeated on the same."""
    if arguments.engine != "opencl":
        return arguments.device
    from lnocl.opencl import device

    return device.spec_of(device.choose(arguments.device).device)


# Keywords of the cards that hold the checksum of each file, by what the files are.
CHECKSUM_KEYWORDS = {
    "images": "ISUM",
    "psfs": "PSUM",
    "background": "BSUM",
    "read_noise": "RSUM",
    "inverse_variance": "VSUM",
    "exposure": "ESUM",
    "mask": "MSUM",
}


def _cards(
    arguments: argparse.Namespace, result: Result, frames: Frames
) -> list[tuple[str, str | int | float, str]]:
    """Return the cards that say what was run; a checksum leaves no room for a comment."""
    observation = frames.observation
    return [
        ("CREATOR", f"lnocl {__version__}", "program that wrote this file"),
        ("SOLVER", arguments.solver, "iteration"),
        ("NITER", result.n_iter, "iterations done"),
        ("STOPPED", result.stop_reason, "why it stopped"),
        ("MU", result.mu, "weight of the Tikhonov term, per electron"),
        ("SMOOTHIN", result.smoothing, "weight of the edge-preserving term"),
        ("PAD", _pad(arguments, observation), "least unobserved pixels round the images"),
        ("PRECISIO", _precision(arguments), "precision of the arithmetic"),
        ("ENGINE", arguments.engine, "engine"),
        ("DEVICE", result.device, "device"),
        *_numbered("BKG", frames.background, "background, electrons"),
        *_numbered("RON", arguments.read_noise or [0.0], "read noise, electrons"),
        *_numbered("EXP", _exposures(arguments, frames), "exposure, seconds"),
        *_given("GAIN", arguments.gain, "electrons for each unit of the images"),
        *_given("SATLEVEL", arguments.saturation, "saturation, in units of the images"),
        *_given("ZEROPT", arguments.zero_point, "magnitude of one electron (per second)"),
        *([("REFINED", True, "star positions")] if arguments.refine else []),
        *(
            (f"OFF{axis}{j}", float(offset), "offset of the image, pixels")
            for j, offsets in enumerate(observation.offsets if arguments.align else [], 1)
            for axis, offset in zip("XY", offsets, strict=True)
        ),
        *(
            (f"{CHECKSUM_KEYWORDS[what]}{j}", digest, "")
            for what, digests in frames.sha256.items()
            for j, digest in enumerate(digests, 1)
        ),
    ]


def _pad(arguments: argparse.Namespace, observation: Observation) -> int:
    from lnocl.scene.padding import recommend_pad

    return recommend_pad(observation) if arguments.pad == "auto" else arguments.pad


def _exposures(arguments: argparse.Namespace, frames: Frames) -> Sequence[float | str]:
    """Return the exposure of each image, or the files of maps."""
    if not arguments.exposure or frames.observation.exposure.ndim == 3:
        return arguments.exposure or []
    return [float(exposure) for exposure in frames.observation.exposure]


def _numbered(
    keyword: str, values: Sequence[float | str], comment: str
) -> list[tuple[str, float | str, str]]:
    """Return a card for each value; of a file its name."""
    return [
        (f"{keyword}{j}", value if isinstance(value, float) else os.path.basename(value), comment)
        for j, value in enumerate(values, 1)
    ]


def _given(keyword: str, value: float | None, comment: str) -> list[tuple[str, float, str]]:
    return [] if value is None else [(keyword, value, comment)]


def _repeating_command(
    arguments: argparse.Namespace,
    stars: Sequence[tuple[float, float]],
    frames: Frames,
    device: str | None,
) -> list[str]:
    """Return the words of the command that makes the same result, every parameter spelled out."""
    return [
        "lnocl",
        "deconvolve",
        *map(as_path, arguments.images),
        *_option("--psf", map(as_path, arguments.psfs)),
        *_option("--background", map(_as_word, frames.background)),
        *_option("--read-noise", map(_as_word, arguments.read_noise or [0.0])),
        *_option("--exposure", map(_as_word, arguments.exposure or [])),
        *_option("--gain", _if_given(arguments.gain)),
        *_option("--inverse-variance", map(as_path, arguments.inverse_variance)),
        *_option("--mask", map(as_path, arguments.mask)),
        *_option("--saturation", _if_given(arguments.saturation)),
        *_option("--align", _if_given(arguments.align)),
        *(word for x, y in stars for word in ("--star", f"{x!r},{y!r}")),
        *(["--refine"] if arguments.refine else []),
        *_option("--mu", [str(arguments.mu)]),
        *_option("--smoothing", [str(arguments.smoothing)]),
        *_option("--solver", [arguments.solver]),
        *_option("--n-iter", [str(arguments.n_iter)]),
        *_option("--stop", _if_given(arguments.stop)),
        *_option("--pad", [str(arguments.pad)]),
        *_option("--precision", [_precision(arguments)]),
        *_option("--engine", [arguments.engine]),
        *_option("--device", _if_given(device)),
        *_option("--zero-point", _if_given(arguments.zero_point)),
        *(["--models"] if arguments.models else []),
        *(["--residuals"] if arguments.residuals else []),
        *_option("-o", [as_path(arguments.output)]),
    ]


def _option(name: str, values: Iterable[str]) -> list[str]:
    """Return the words of an option; none where it has no value."""
    words = list(values)
    return [name, *words] if words else []


def _if_given(value: object) -> list[str]:
    return [] if value is None else [str(value)]


def _as_word(value: float | str) -> str:
    return repr(value) if isinstance(value, float) else as_path(value)


def _precision(arguments: argparse.Namespace) -> str:
    return arguments.precision if arguments.engine == "opencl" else "double"


def _summary(arguments: argparse.Namespace, result: Result) -> list[str]:
    objective = result.history["objective"][-1]
    electrons = "electrons per second" if arguments.exposure else "electrons"
    stars = (
        f"star at ({x:.7g}, {y:.7g}): {flux:.6g} {electrons}"
        for (x, y), flux in zip(result.star_positions, result.star_fluxes, strict=True)
    )
    reason = f"stopped by {result.stop_reason}"
    return [
        f"{result.n_iter} iterations on {result.device}, objective {objective:.6g}",
        *([] if result.stop_reason == "n_iter" else [reason]),
        *([f"mu chosen: {result.mu:.3g}"] if arguments.mu == "auto" else []),
        *([f"smoothing chosen: {result.smoothing:.3g}"] if arguments.smoothing == "auto" else []),
        *stars,
        f"extended source: {result.extended.sum():.6g} {electrons}",
        f"written to {arguments.output}",
    ]


def _whole_or_word(text: str) -> int | str:
    try:
        return int(text)
    except ValueError:
        return text


COMMAND = Command(
    "reconstruct the sky from images of it, as stars plus an extended source",
    _add_arguments,
    _run,
)
