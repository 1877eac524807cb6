"""The command ``deconvolve``: load images and PSFs, run, write the result."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lnocl.commands import checkpoints, messages, options, record
from lnocl.commands.options import SEVERAL, finite, number_or_word, option, whole_or_word
from lnocl.commands.parser import Command
from lnocl.commands.summary import summarise
from lnocl.deconvolution import deconvolve
from lnocl.residuals import StarResiduals
from lnocl.result import Result
from lnocl.runs.options import ENGINES, PRECISIONS
from lnocl.scene.psf_families import FAMILIES
from lnocl.solvers import SOLVERS

if TYPE_CHECKING:
    from astropy.io import fits

    from lnocl.io.fitswrite import Card, StarColumn
    from lnocl.io.frames import Calibration, Frames

PARAMETERS = {
    name: parameter.default for name, parameter in inspect.signature(deconvolve).parameters.items()
}


def _parameter(flag: str, **keywords: Any) -> options.Option:
    """Return the option for a parameter of `lnocl.deconvolve`, with the same default."""
    given = option(flag, **keywords)
    return given.but(default=PARAMETERS[given.name])


OPTIONS = {
    "input": [
        options.IMAGES,
        options.PSFS.but(required=True),
        option(
            "--psf-centre",
            choices=("check", "fit", "given"),
            default="check",
            card=("PSFCENTR", "what became of PSFs off their centre"),
            help="what becomes of a PSF whose core lies off its centre, (ky // 2, kx // 2): check, "
            "it is refused; fit, it is moved there; given, nothing (default: %(default)s)",
        ),
    ],
    "output": [
        option(
            "-o",
            "--output",
            required=True,
            metavar="OUT.fits",
            help="FITS file for the extended source, the stars and the history of the objective",
        ),
        options.OVERWRITE.but(help="replace OUT.fits if it exists"),
        option(
            "--models",
            action="store_true",
            help="add a cube with the model of each image, in electrons; its header has the "
            "coordinates of the image where all images share them, else their offsets",
        ),
        option(
            "--residuals",
            action="store_true",
            help="add a cube with the residuals of each image, (image - model) / sqrt(model), with "
            "the same header; say how well the model fits in all pixels",
        ),
        options.QUIET,
    ],
    "calibration": [
        options.BACKGROUND,
        options.READ_NOISE,
        option(
            "--exposure",
            **SEVERAL,
            type=number_or_word,
            metavar="T",
            card=("EXP", "exposure, seconds"),
            checksum="ESUM",
            help="seconds, a FITS file with a map of them, or a keyword of the images' headers "
            "such as EXPTIME; one for all images or one for each; the result is then per second",
        ),
        option(
            "--gain",
            type=number_or_word,
            metavar="G",
            card=("GAIN", "electrons for each unit of the images"),
            help="electrons for each adu, or for each of whatever unit the images have; or a "
            "keyword of the images' headers such as GAIN; or their extension with the variance of "
            "counts, as VAR_POISSON of JWST",
        ),
        option(
            "--mask",
            **SEVERAL,
            metavar="FILE",
            checksum="MSUM",
            help="FITS file that is not 0 where a pixel is bad, or dq, the extension DQ of each "
            "image; one for all images or one for each",
        ),
        option(
            "--good-bits",
            metavar="BITS",
            card=("GOODBITS", "flags of DQ that are no fault"),
            help="with --mask dq: flags that are no fault, as in 16,64, or ~1 for all but 1; 0 for "
            "none (default: of JWST ~1, of HST those of pixels that were corrected, else 0)",
        ),
        options.SATURATION,
        option(
            "--inverse-variance",
            **SEVERAL,
            metavar="FILE",
            checksum="VSUM",
            help="FITS file with 1 / variance of sky and read noise, in units of the images, 0 "
            "where a pixel is bad; one for all images or one for each",
        ),
        option(
            "--variance",
            **SEVERAL,
            metavar="FILE",
            checksum="WSUM",
            help="the same with their variance",
        ),
        option(
            "--rms",
            **SEVERAL,
            metavar="FILE",
            checksum="QSUM",
            help="the same with their standard deviation",
        ),
        option(
            "--error",
            **SEVERAL,
            metavar="FILE",
            checksum="NSUM",
            help="the same with the standard deviation of all noise, that of the source's counts "
            "too; or err, the extension ERR of each image",
        ),
        option(
            "--align",
            choices=("wcs",),
            help="take the offsets between the images from their sky coordinates",
        ),
    ],
    "stars": [
        options.STARS,
        option(
            "--star-sky",
            action="append",
            default=[],
            metavar="RA,DEC",
            help="position of a star on the sky (ICRS), in degrees or as hh:mm:ss,dd:mm:ss; may "
            "be repeated",
        ),
        option(
            "--stars",
            metavar="FILE",
            dest="star_table",
            is_input=True,
            help="table of stars in any format of astropy, with columns x and y, or ra and dec, "
            "or as photutils, SExtractor, Gaia and VizieR name them",
        ),
        option(
            "--refine",
            action="store_true",
            default=None,  # for no card where it is not given
            dest="refine_positions",
            card=("REFINED", "star positions"),
            help="fit the positions of the stars too, each within 3 pixels of the one given",
        ),
        option(
            "--refine-psfs",
            nargs="+",
            choices=tuple(FAMILIES),
            default=[],
            metavar="WHAT",
            card=("REFPSF", "asked of the PSFs"),
            help="fit the PSFs to the stars before the reconstruction, and use them where they fit "
            "better: shift, jitter (a blur, or a sharpening), strehl (needs --ideal-psf or "
            "--pupil), pupil (phases; needs --pupil), modes (needs --psf-modes), pixels "
            "(needs two stars); at least one star",
        ),
        option(
            "--ideal-psf",
            dest="ideal_psfs",
            **SEVERAL,
            metavar="FILE",
            checksum="DSUM",
            help="FITS file with a PSF without aberrations, of the shape of the PSFs; one for all "
            "images or one for each",
        ),
        option(
            "--pupil",
            dest="pupils",
            **SEVERAL,
            metavar="FILE",
            checksum="TSUM",
            help="FITS file with the transmission of a pupil, of the shape of the PSFs and in "
            "their frequencies, its middle at (ky // 2, kx // 2); one for all images or one "
            "for each",
        ),
        option(
            "--psf-modes",
            metavar="FILE",
            checksum="LSUM",
            help="FITS file with a cube of the ways in which the PSFs may differ, one standard "
            "deviation each, of the shape of the PSFs and for all of them; in an extension MODES, "
            "as lnocl psf --modes writes it, or as its image",
        ),
        option(
            "--psf-scatter",
            **SEVERAL,
            metavar="FILE",
            checksum="SSUM",
            help="FITS file with the standard deviation of the pixels of a PSF of unit sum, in an "
            "extension SCATTER, as lnocl psf writes it, or as its image: it is added to the noise "
            "at the stars; one for all images or one for each",
        ),
        option(
            "--round-source",
            action="store_true",
            default=None,  # for no card where it is not given
            card=("ROUND", "the source lies all round a star"),
            help="with --refine-psfs: a disc, ring or host lies all round a star, so that what "
            "does is not the PSF's",
        ),
        option(
            "--zero-point",
            type=finite,
            metavar="MAG",
            card=("ZEROPT", "magnitude of a flux of 1"),
            help="magnitude of a flux of 1 in the unit of the result, that of the images, per "
            "second where exposures are given; adds a column mag to the table of stars",
        ),
    ],
    "reconstruction": [
        _parameter(
            "--n-iter",
            type=int,
            metavar="N",
            card=("NITER", "iterations done"),
            help="largest number of iterations (default: %(default)s)",
        ),
        _parameter(
            "--stop",
            type=number_or_word,
            metavar="RULE",
            card=("STOPPED", "why it stopped"),
            help="when to stop before N iterations: held-out, at the iteration that held-out "
            "counts choose; discrepancy, when the data are fitted as well as noise allows; a "
            "number below 1, when the objective changes relatively by less in an iteration; or "
            "none (default: %(default)s)",
        ),
        _parameter(
            "--solver",
            choices=tuple(SOLVERS),
            card=("SOLVER", "iteration"),
            help="scaled gradient projection, or the split-gradient method, the paper's, which "
            "needs ten times the iterations and more (default: %(default)s)",
        ),
        _parameter(
            "--mu",
            type=float,
            metavar="MU",
            card=("MU", "weight of the Tikhonov term, per electron"),
            help="weight of the Tikhonov term on the extended source, per electron (default: "
            "%(default)s)",
        ),
        _parameter(
            "--smoothing",
            type=number_or_word,
            metavar="WEIGHT",
            card=("SMOOTHIN", "weight of the edge-preserving term"),
            help="weight of an edge-preserving term against noise, or auto: that which suits the "
            "noise of the counts (default: %(default)s)",
        ),
        _parameter(
            "--pad",
            type=whole_or_word,
            metavar="N",
            card=("PAD", "least unobserved pixels round the images"),
            help="smallest number of unobserved pixels round the images; auto: where light runs "
            "over the edge as many as the PSFs need, else 0 (default: %(default)s)",
        ),
        _parameter(
            "--precision",
            choices=PRECISIONS,
            card=("PRECISIO", "precision of the arithmetic"),
            help="arithmetic on the OpenCL device (default: %(default)s)",
        ),
        options.DEVICE,
        _parameter(
            "--engine",
            choices=ENGINES,
            card=("ENGINE", "engine"),
            help="OpenCL, or the NumPy reference, which computes in double (default: %(default)s)",
        ),
    ],
    "long runs": checkpoints.OPTIONS,
}
ALL_OPTIONS = [each for group in OPTIONS.values() for each in group]


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.io import atomic, fitsread, fitswrite, missions
    from lnocl.io.frames import Calibration, read_frames
    from lnocl.io.headers import observed_cards

    inputs = options.input_paths(ALL_OPTIONS, vars(arguments))
    atomic.check_fits_output(arguments.output, arguments.overwrite, inputs)
    checkpoints.check(arguments, inputs)
    folder = os.getcwd()
    given = {**vars(arguments), "device": _device_spec(arguments)}
    with messages.shown_log(arguments.quiet), checkpoints.Interrupts() as interrupts:
        given |= missions.calibrate(arguments.images[0], given)
        calibration = Calibration(**_given(given, Calibration._fields))
        frames = read_frames(arguments.images, arguments.psfs, calibration)
        given["stars"] = _stars(arguments, frames.header)
        wcs = fitsread.wcs_cards(frames.header)
        result = deconvolve(
            frames.observation,
            **_parameters(given),
            progress=not arguments.quiet,
            callback=interrupts.callback,
        )
        interrupts.listen()  # a run that was resumed at its end has no iteration to start from
        at_stars = result.star_residuals()
        overall = result.fit() if arguments.residuals else None
        if result.stop_reason == "callback":
            result = dataclasses.replace(result, stop_reason="interrupt")
        offsets = frames.observation.offsets
        repeated = given | _repeated(given, calibration, frames)
        fitswrite.write_result(
            arguments.output,
            result.extended / frames.electrons,
            result.star_positions,
            result.star_fluxes / frames.electrons,
            result.history,
            wcs=wcs,
            cards=[
                *observed_cards(frames.header),
                *record.make_cards(
                    ALL_OPTIONS,
                    repeated | _used(repeated, frames, result),
                    frames.sha256,
                    [
                        *_refinement_cards(result),
                        *(fitswrite.offset_cards(offsets) if arguments.align else []),
                    ],
                ),
            ],
            commands=record.make_commands("deconvolve", ALL_OPTIONS, repeated, folder),
            overwrite=arguments.overwrite,
            held_out=result.held_out if result.held_out.size else None,
            unit=frames.unit,
            star_columns=_star_columns(arguments, result, frames, at_stars),
            cubes=_cubes(arguments, result),
            psf_fit=_refinement_table(result),
            psfs=result.psfs if repeated["refine_psfs"] else None,
            psf_errors=_psf_errors(result),
            doubtful=None if result.psf_refinement is None else result.doubtful,
            offsets=offsets,
        )
        if not arguments.quiet:
            messages.say(summarise(arguments, result, frames, at_stars, overall))
    interrupts.explain(arguments, result)


def _given(values: Mapping[str, Any], names: Any) -> dict[str, Any]:
    """Return the values that are given, of these names; the others have defaults elsewhere."""
    return {name: values[name] for name in names if values.get(name) is not None}


def _parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of `lnocl.deconvolve`; in the shell, no rule has a name."""
    rule = None if given["stop"] == "none" else given["stop"]
    return _given(given, PARAMETERS) | {"stop": rule}


def _repeated(given: Mapping[str, Any], calibration: Calibration, frames: Frames) -> dict[str, Any]:
    """Return the values of the command that repeats the run, where others were given."""
    return {
        "background": frames.background,
        "read_noise": frames.read_noise,
        "star_sky": [],
        "star_table": None,
        "precision": given["precision"] if given["engine"] == "opencl" else "double",
    }


def _used(repeated: Mapping[str, Any], frames: Frames, result: Result) -> dict[str, Any]:
    """Return the values that were computed with, where rules and keywords were given."""
    from lnocl.scene.padding import choose_pad

    exposure = frames.observation.exposure
    return {
        "n_iter": result.n_iter,
        "stop": result.stop_reason,
        "mu": result.mu,
        "smoothing": result.smoothing,
        "device": result.device,
        "gain": frames.gain,
        "pad": choose_pad(frames.observation) if repeated["pad"] == "auto" else repeated["pad"],
        **({"exposure": exposure.tolist()} if repeated["exposure"] and exposure.ndim == 1 else {}),
    }


def _stars(arguments: argparse.Namespace, header: fits.Header) -> list[tuple[float, float]]:
    """Return the positions of all stars, in pixels: of --star, --star-sky and --stars."""
    positions = list(arguments.stars)
    if arguments.star_sky or arguments.star_table:
        from lnocl.io import sky

        if arguments.star_sky:
            wcs = sky.celestial_wcs(header, arguments.images[0])
            coordinates = sky.parse_sky(arguments.star_sky)
            positions += sky.to_pixels(coordinates, wcs, arguments.images[0]).tolist()
        if arguments.star_table:
            positions += sky.read_stars(arguments.star_table, header, arguments.images[0]).tolist()
    return [(x, y) for x, y in positions]


def _star_columns(
    arguments: argparse.Namespace,
    result: Result,
    frames: Frames,
    at_stars: Sequence[StarResiduals],
) -> list[StarColumn]:
    """Return the columns of the table of stars after positions and fluxes."""
    from lnocl.io import sky
    from lnocl.io.fitswrite import StarColumn, column_unit
    from lnocl.metrics import magnitude

    columns = []
    header = frames.header
    if arguments.refine_positions:
        x_error, y_error = result.star_position_errors.T
        flux_errors = result.star_flux_errors / frames.electrons
        columns += [
            StarColumn("x_error", x_error, "pix", "standard error"),
            StarColumn("y_error", y_error, "pix", "standard error"),
            StarColumn("flux_error", flux_errors, column_unit(frames.unit), "standard error"),
        ]
    if arguments.zero_point is not None:
        fluxes = result.star_fluxes / frames.electrons
        magnitudes = [magnitude(flux, 1.0) + arguments.zero_point for flux in fluxes]
        columns.append(StarColumn("mag", magnitudes, "mag", "by the zero point"))
    if sky.has_celestial(header):
        ra, dec = sky.to_sky(result.star_positions, header).T
        columns += [
            StarColumn("ra", ra, "deg", "right ascension, ICRS"),
            StarColumn("dec", dec, "deg", "declination, ICRS"),
        ]
    core, wings, halo, _ = map(list, zip(*at_stars, strict=True) if at_stars else [()] * 4)
    for name, found in (("core", core), ("wings", wings)):
        values = [fit.rms for fit in found]
        comment = f"rms residual in the {name}, 1 by noise"
        columns.append(StarColumn(f"{name}_rms", values, "", comment))
    columns.append(StarColumn("halo", halo, "", "light all round it over its flux"))
    return columns


def _cubes(arguments: argparse.Namespace, result: Result) -> dict[str, tuple[Any, str]]:
    return {
        **({"MODELS": (result.models(), "electron")} if arguments.models else {}),
        **({"RESIDUALS": (result.residuals(), "")} if arguments.residuals else {}),
    }


def _refinement_cards(result: Result) -> list[Card]:
    found = result.psf_refinement
    if found is None:
        return []
    before, after = found.misfit
    return [
        ("PSFUSED", found.is_accepted, "whether refined PSFs are used"),
        ("PSFMIS1", before, "reduced chi squared, PSFs as given"),
        ("PSFMIS2", after, "reduced chi squared, PSFs refined"),
        ("PSFERR", found.psf_error, "relative error that the PSFs used have"),
        ("PSFNOISE", found.is_noise, "whether it was added to the noise"),
    ]


def _psf_errors(result: Result) -> Any:
    """Return the relative error of the PSFs, a row a ring."""
    found = result.psf_refinement
    if found is None:
        return None
    columns = {"from": found.edges[:-1], "to": found.edges[1:], "error": found.errors_in_rings}
    rows = np.zeros(len(found.errors_in_rings), [(name, float) for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return rows


def _refinement_table(result: Result) -> Any:
    """Return the parameters of the PSFs, a row an image."""
    found = result.psf_refinement
    if found is None:
        return None
    names = [name.replace(" ", "_") for name in found.parameters]
    rows = np.zeros(len(found.values), [("image", np.int64), *((name, float) for name in names)])
    rows["image"] = np.arange(1, len(rows) + 1)
    for name, values in zip(names, found.values.T, strict=True):
        rows[name] = values
    return rows


def _device_spec(arguments: argparse.Namespace) -> str | None:
    """Return the OpenCL device as indices, so that the run can be repeated on the same."""
    if arguments.engine != "opencl":
        return arguments.device
    from lnocl.opencl import device

    return device.spec_of(device.choose(arguments.device).device)


COMMAND = Command(
    "reconstruct the sky from images of it, as stars plus an extended source", OPTIONS, _run
)
