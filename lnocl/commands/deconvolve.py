"""The command ``deconvolve``: load images and PSFs, run, write the result."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Sequence

from lnocl import __version__
from lnocl.commands import messages
from lnocl.commands.arguments import Command, add_device, add_input_arguments
from lnocl.deconvolution import ENGINES, PRECISIONS, SOLVERS, Result, deconvolve
from lnocl.observation import Observation


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_input_arguments(parser, required=True)
    parser.add_argument(
        "--mu",
        type=_number_or_word,
        default=0.0,
        metavar="MU",
        help="weight of the Tikhonov term on the extended source, per electron, or auto: chosen by "
        "held-out counts (default: %(default)s)",
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
        type=_number_or_word,
        metavar="RULE",
        help="stop before N: held-out, at the iteration that held-out counts choose; discrepancy, "
        "when the data are fitted as well as noise allows; or a number, when the objective changes "
        "relatively by less an iteration",
    )
    parser.add_argument(
        "--pad",
        type=int,
        default=0,
        metavar="N",
        help="unobserved pixels kept round the images, at least (default: %(default)s)",
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
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT.fits",
        help="file for the extended source, the stars and the history of the objective",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.fits if it exists")
    parser.add_argument("--quiet", action="store_true", help="show warnings and errors only")


def _run(arguments: argparse.Namespace) -> None:
    from lnocl import fitsread, fitswrite

    fitswrite.check_output(
        arguments.output, arguments.overwrite, [*arguments.images, *arguments.psfs]
    )
    folder = os.getcwd()
    device = _device_spec(arguments)
    images = fitsread.read_stack(arguments.images)
    psfs = fitsread.read_stack(arguments.psfs)
    wcs = fitsread.wcs_cards(images.header)
    background = arguments.background or [0.0]
    read_noise = arguments.read_noise or [0.0]
    with contextlib.nullcontext() if arguments.quiet else messages.shown_log():
        result = deconvolve(
            Observation(images.data, psfs.data, background, read_noise),
            stars=arguments.stars,
            mu=arguments.mu,
            solver=arguments.solver,
            n_iter=arguments.n_iter,
            stop=arguments.stop,
            precision=arguments.precision,
            engine=arguments.engine,
            device=device,
            pad=arguments.pad,
            progress=not arguments.quiet,
        )
    fitswrite.write_result(
        arguments.output,
        result.extended,
        arguments.stars,
        result.star_fluxes,
        result.history,
        wcs=wcs,
        cards=_cards(arguments, result, background, read_noise, images.sha256, psfs.sha256),
        commands=[["cd", folder], _repeating_command(arguments, background, read_noise, device)],
        overwrite=arguments.overwrite,
        held_out=result.held_out if result.held_out.size else None,
    )
    if not arguments.quiet:
        messages.say(_summary(arguments, result))


def _device_spec(arguments: argparse.Namespace) -> str | None:
    """Return the OpenCL device as indices, so that the run can be repeated on the same."""
    if arguments.engine != "opencl":
        return arguments.device
    from lnocl import device

    return device.spec_of(device.choose(arguments.device).device)


def _cards(
    arguments: argparse.Namespace,
    result: Result,
    background: Sequence[float],
    read_noise: Sequence[float],
    image_sums: Sequence[str],
    psf_sums: Sequence[str],
) -> list[tuple[str, str | int | float, str]]:
    """Return the cards that say what was run; a checksum leaves no room for a comment."""
    return [
        ("CREATOR", f"lnocl {__version__}", "program that wrote this file"),
        ("SOLVER", arguments.solver, "iteration"),
        ("NITER", result.n_iter, "iterations done"),
        ("STOPPED", result.stop_reason, "why it stopped"),
        ("MU", result.mu, "weight of the Tikhonov term, per electron"),
        ("PAD", arguments.pad, "least unobserved pixels round the images"),
        ("PRECISIO", _precision(arguments), "precision of the arithmetic"),
        ("ENGINE", arguments.engine, "engine"),
        ("DEVICE", result.device, "device"),
        *((f"BKG{j}", b, "background, electrons") for j, b in enumerate(background, 1)),
        *((f"RON{j}", s, "read noise, electrons") for j, s in enumerate(read_noise, 1)),
        *((f"ISUM{j}", digest, "") for j, digest in enumerate(image_sums, 1)),
        *((f"PSUM{j}", digest, "") for j, digest in enumerate(psf_sums, 1)),
    ]


def _repeating_command(
    arguments: argparse.Namespace,
    background: Sequence[float],
    read_noise: Sequence[float],
    device: str | None,
) -> list[str]:
    """Return the words of the command that makes the same result, every parameter spelled out."""
    return [
        "lnocl",
        "deconvolve",
        *map(_as_path, arguments.images),
        "--psf",
        *map(_as_path, arguments.psfs),
        "--background",
        *map(repr, background),
        "--read-noise",
        *map(repr, read_noise),
        *(word for x, y in arguments.stars for word in ("--star", f"{x!r},{y!r}")),
        *("--mu", str(arguments.mu)),
        *("--solver", arguments.solver),
        *("--n-iter", str(arguments.n_iter)),
        *(() if arguments.stop is None else ("--stop", str(arguments.stop))),
        *("--pad", str(arguments.pad)),
        *("--precision", _precision(arguments)),
        *("--engine", arguments.engine),
        *(() if device is None else ("--device", device)),
        *("-o", _as_path(arguments.output)),
    ]


def _precision(arguments: argparse.Namespace) -> str:
    return arguments.precision if arguments.engine == "opencl" else "double"


def _summary(arguments: argparse.Namespace, result: Result) -> list[str]:
    objective = result.history["objective"][-1]
    stars = (
        f"star at ({x:g}, {y:g}): {flux:.6g} electrons"
        for (x, y), flux in zip(arguments.stars, result.star_fluxes, strict=True)
    )
    reason = f"stopped by {result.stop_reason}"
    return [
        f"{result.n_iter} iterations on {result.device}, objective {objective:.6g}",
        *([] if result.stop_reason == "n_iter" else [reason]),
        *([f"mu chosen: {result.mu:.3g}"] if arguments.mu == "auto" else []),
        *stars,
        f"extended source: {result.extended.sum():.6g} electrons",
        f"written to {arguments.output}",
    ]


def _number_or_word(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _as_path(path: str) -> str:
    """Return a path that is not taken for an option."""
    return f"./{path}" if path.startswith("-") else path


COMMAND = Command(
    "reconstruct the sky from images of it, as stars plus an extended source",
    _add_arguments,
    _run,
)
