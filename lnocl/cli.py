"""The command line: parse, load, run, write; nothing numerical."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, NoReturn, TextIO

from lnocl import __version__
from lnocl.deconvolution import ENGINES, PRECISIONS, SOLVERS, Result, deconvolve
from lnocl.errors import InputError, LnoclError, LnoclWarning
from lnocl.observation import Observation

FAILED = 1
INTERRUPTED = 130


class Command(NamedTuple):
    """A subcommand: its line in the help, what adds its arguments, and what runs it."""

    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments without the program's name; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("always", LnoclWarning)
        warnings.showwarning = _show_warning
        try:
            parsed = _make_parser().parse_args(arguments)
            parsed.command.run(parsed)
        except LnoclError as error:
            return _fail(str(error), error.exit_status)
        except MemoryError:
            return _fail("not enough memory; cut the images, or give fewer at a time", FAILED)
        except KeyboardInterrupt:
            return _fail("interrupted", INTERRUPTED)
        except OSError as error:
            return _fail(str(error), FAILED)
    return 0


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are ours, and that takes ``-1,3`` and ``-inf`` for values."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)[\d.,eainf+-]*$", re.I)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


def _make_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="lnocl",
        description="Multi-component Richardson-Lucy deconvolution of astronomical images.",
        epilog="Exit status: 0 done, 1 failed, 2 wrong use.",
    )
    parser.add_argument("--version", action="version", version=f"lnocl {__version__}")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=command.summary, description=command.summary)
        command.add_arguments(subparser)
        subparser.set_defaults(command=command)
    return parser


def _add_input_arguments(parser: argparse.ArgumentParser, required: bool) -> None:
    parser.add_argument(
        "images",
        nargs="+" if required else "*",
        metavar="IMAGE",
        help="FITS file with an image, in electrons per pixel, or one file with a cube of them",
    )
    parser.add_argument(
        "--psf",
        nargs="+",
        action="extend",
        required=required,
        dest="psfs",
        metavar="PSF",
        help="FITS file with a PSF, its peak at (ky // 2, kx // 2): one for all images or one "
        "for each, or one file with a cube of them",
    )
    parser.add_argument(
        "--background",
        nargs="+",
        action="extend",
        type=float,
        metavar="B",
        help="electrons per pixel, one for all images or one for each (default: 0)",
    )
    parser.add_argument(
        "--read-noise",
        nargs="+",
        action="extend",
        type=float,
        metavar="S",
        help="standard deviation in electrons, one for all images or one for each (default: 0)",
    )
    parser.add_argument(
        "--star",
        action="append",
        default=[],
        type=_position,
        dest="stars",
        metavar="X,Y",
        help="position of a point source in pixels, 0-based, x along columns; may be repeated",
    )


def _add_deconvolve_arguments(parser: argparse.ArgumentParser) -> None:
    _add_input_arguments(parser, required=True)
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
    _add_device(parser)
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT.fits",
        help="file for the extended source, the stars and the history of the objective",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.fits if it exists")
    parser.add_argument("--quiet", action="store_true", help="show warnings and errors only")


def _deconvolve(arguments: argparse.Namespace) -> None:
    from lnocl import fitsio

    fitsio.check_output(arguments.output, arguments.overwrite, [*arguments.images, *arguments.psfs])
    folder = os.getcwd()
    device = _device_spec(arguments)
    images = fitsio.read_stack(arguments.images)
    psfs = fitsio.read_stack(arguments.psfs)
    wcs = fitsio.wcs_cards(images.header)
    background = arguments.background or [0.0]
    read_noise = arguments.read_noise or [0.0]
    with contextlib.nullcontext() if arguments.quiet else _shown_log():
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
    fitsio.write_result(
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
        _say(_summary(arguments, result))


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


def _add_simulate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene",
        metavar="SCENE",
        help="hh34, a jet like the paper's, or a FITS file whose first image is the extended "
        "source; the header keywords STARX and STARY, 0-based, name its star",
    )
    _add_folder(parser, "images, PSFs, truth and record.json", required=True)
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


def _simulate(arguments: argparse.Namespace) -> None:
    from astropy import units as u

    from lnocl import demo, fitsio, simulate

    stars = arguments.stars and [simulate.Star(x, y, mag * u.mag) for x, y, mag in arguments.stars]
    target = simulate.load_target(arguments.scene, arguments.size, stars)
    units = {
        "angles": u.deg,
        "extended_magnitude": u.mag,
        "sky_brightness": simulate.MAG_PER_ARCSEC2,
        "read_noise": u.electron,
    }
    names = (*units, "exposure_time", "strehl", "throughput", "seed")
    given = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    experiment = simulate.Experiment(
        **{name: value * units[name] if name in units else value for name, value in given.items()}
    )
    fitsio.check_folder(arguments.output, arguments.overwrite, make=False)
    simulation = simulate.simulate(target, experiment)
    fitsio.check_folder(arguments.output, arguments.overwrite)
    command = demo.write_simulation(
        arguments.output, arguments.scene, simulation, arguments.overwrite
    )
    _say(
        [
            f"{len(simulation.images)} images, as many PSFs, truth.fits and record.json written "
            f"to {arguments.output}; to deconvolve them run",
            shlex.join(command),
        ]
    )


def _add_demo_arguments(parser: argparse.ArgumentParser) -> None:
    _add_folder(parser, "images, results and pictures", default="lnocl_demo")
    parser.add_argument(
        "--size",
        type=int,
        default=256,
        metavar="N",
        help="pixels along each side (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="of residual phases and noise (default: %(default)s)",
    )
    _add_device(parser)


def _demo(arguments: argparse.Namespace) -> None:
    from lnocl import demo, device

    spec = device.spec_of(device.choose(arguments.device).device)
    for line in demo.run(
        arguments.output, arguments.size, arguments.seed, spec, arguments.overwrite
    ):
        _say([line])


def _add_bench_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Without IMAGE the demo's scene is taken, whose truth is known."
    _add_input_arguments(parser, required=False)
    parser.add_argument(
        "--mu",
        type=float,
        help="weight of the Tikhonov term on the extended source, per electron (default: 0; "
        "that of lnocl demo for its scene)",
    )
    parser.add_argument(
        "--size",
        type=int,
        metavar="N",
        help="pixels along each side of the demo's scene (default: 256)",
    )
    parser.add_argument(
        "--n-iter",
        type=int,
        default=400,
        metavar="N",
        help="most iterations, 8 or more; N/8, N/4 and N/2 are measured too (default: %(default)s)",
    )
    parser.add_argument(
        "--accuracy",
        type=float,
        default=1e-3,
        metavar="A",
        help="deviation from double precision that the advice may have, and excess of the "
        "objective over that of double precision that the table times (default: %(default)s)",
    )
    _add_device(parser)
    parser.add_argument(
        "-o", "--output", metavar="STEM", help="write the table to STEM.ecsv, a plot to STEM.png"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace these files")
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def _bench(arguments: argparse.Namespace) -> None:
    from lnocl import bench, device

    source = bench.choose_source(
        arguments.images,
        arguments.psfs,
        arguments.background,
        arguments.read_noise,
        arguments.stars,
        arguments.mu,
        arguments.size,
    )
    for line in bench.run(
        source,
        arguments.n_iter,
        arguments.accuracy,
        device.spec_of(device.choose(arguments.device).device),
        arguments.output,
        arguments.overwrite,
        progress=not arguments.quiet,
    ):
        _say([line])


def _add_plot_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "results",
        nargs="+",
        metavar="RESULT",
        help="FITS file that lnocl deconvolve, lnocl demo or examples/hh34_table.py has written",
    )
    parser.add_argument(
        "--truth", metavar="TRUTH", help="FITS file with the true source, of lnocl simulate"
    )
    _add_folder(parser, "the figures, PNG files", required=True)


def _plot(arguments: argparse.Namespace) -> None:
    from lnocl import demo

    for line in demo.draw(
        arguments.output, arguments.results, arguments.truth, arguments.overwrite
    ):
        _say([line])


def _add_folder(parser: argparse.ArgumentParser, content: str, **keywords: Any) -> None:
    default = " (default: %(default)s)" if "default" in keywords else ""
    parser.add_argument(
        "-o", "--output", metavar="DIR", help=f"folder for {content}{default}", **keywords
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files in DIR")


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device",
        metavar="SPEC",
        help="OpenCL device as PLATFORM[:DEVICE], each an index or a part of the name; see "
        "lnocl devices (default: that of PYOPENCL_CTX, else the first GPU, else the first CPU)",
    )


def _add_no_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def _devices(arguments: argparse.Namespace) -> None:
    from lnocl import device

    found = device.find_devices()
    choice = device.choose(None)
    _say(
        [
            *(f"{device.spec_of(each)} {device.describe(each)}" for each in found),
            f"lnocl uses {device.spec_of(choice.device)} unless told otherwise: {choice.reason}",
        ]
    )


COMMANDS = {
    "demo": Command(
        "simulate a jet and its star, reconstruct them with and without the star as a component, "
        "and show the difference in a table and pictures",
        _add_demo_arguments,
        _demo,
    ),
    "deconvolve": Command(
        "reconstruct the sky from images of it, as stars plus an extended source",
        _add_deconvolve_arguments,
        _deconvolve,
    ),
    "simulate": Command(
        "simulate images of a scene as the paper's interferometer would take them",
        _add_simulate_arguments,
        _simulate,
    ),
    "plot": Command(
        "draw the paper's figures from results: objects, errors, magnitude and profiles",
        _add_plot_arguments,
        _plot,
    ),
    "bench": Command(
        "time single and double precision, padding and iterations, measure how far each strays "
        "from double precision, and say which to take",
        _add_bench_arguments,
        _bench,
    ),
    "devices": Command(
        "list the OpenCL devices, and say which one is used and why", _add_no_arguments, _devices
    ),
}


def _number_or_word(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _position(text: str) -> tuple[float, float]:
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y") from None
    return x, y


def _star(text: str) -> tuple[float, float, float]:
    try:
        x, y, magnitude = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y,MAG") from None
    return x, y, magnitude


def _as_path(path: str) -> str:
    """Return a path that is not taken for an option."""
    return f"./{path}" if path.startswith("-") else path


def _say(lines: Iterable[str]) -> None:
    """Write lines to stdout; a reader that has left early is no error."""
    try:
        for line in lines:
            sys.stdout.write(_one_line(line, sys.stdout) + "\n")
        sys.stdout.flush()
    except OSError as error:
        # What is still buffered would fail again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise


def _fail(message: str, exit_status: int) -> int:
    _complain("error", message)
    return exit_status


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    _complain("warning", str(message))


def _complain(kind: str, message: str) -> None:
    _note(f"{kind}: {message}")


def _note(message: str) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.write(_one_line(f"lnocl: {message}", sys.stderr) + "\n")
        sys.stderr.flush()


class _Notes(logging.Handler):
    """Shows what the library logs, once where it says the same of several runs."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if message not in self._shown:
            self._shown.add(message)
            _note(message)


@contextlib.contextmanager
def _shown_log() -> Iterator[None]:
    """Show on stderr what the library logs."""
    log, handler = logging.getLogger("lnocl"), _Notes()
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.setLevel(level)
        log.removeHandler(handler)


def _one_line(text: str, stream: TextIO) -> str:
    """Return text in one line, with escapes for what a terminal should not or cannot show."""
    joined = " ".join(part.strip() for part in text.splitlines())
    shown = "".join(c if c.isprintable() else _escape(c) for c in joined)
    encoding = stream.encoding or "ascii"
    return shown.encode(encoding, "backslashreplace").decode(encoding)


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
