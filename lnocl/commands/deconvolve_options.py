"""The arguments of the command ``deconvolve``."""

from __future__ import annotations

import inspect
from typing import Any

from lnocl.commands import checkpoints, options
from lnocl.commands.options import SEVERAL, number_or_word, option, whole_or_word
from lnocl.deconvolution import deconvolve
from lnocl.io.names import NOISE, PSF_ERRORS
from lnocl.runs.options import ENGINES, PRECISIONS
from lnocl.scene.fields import OVERSAMPLES
from lnocl.scene.psf_families import FAMILIES
from lnocl.solvers import SOLVERS

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
            "--oversample",
            type=int,
            choices=OVERSAMPLES,
            help="pixels of the extended source, and of the PSFs, to one of the images along each "
            "axis, for detectors with fewer than two pixels to the PSF's width; offsets of "
            "fractions of a pixel then add resolution (default: 1)",
        ),
        option(
            "--effective-psfs",
            action="store_true",
            default=None,  # for no card where it is not given
            card=("EPSF", "the PSFs hold the response of a pixel"),
            help="with --oversample: each sample of the PSFs holds what a pixel of the images "
            "sees, as in effective PSFs of photutils or STDPSF files; else what a pixel of the "
            "PSF sees, as in STPSF's",
        ),
        option(
            "--psf-centre",
            choices=("check", "fit", "given"),
            default="check",
            card=("PSFCENTR", "what became of PSFs off their centre"),
            help="a PSF whose core lies off its centre, (ky // 2, kx // 2): check, a warning from "
            "0.25 pixels on, an error from 0.8; fit, it is moved there; given, nothing (default: "
            "%(default)s)",
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
            "--residuals",
            action="store_true",
            help="add two cubes: RESIDUALS of each image, (image - model) / sqrt(model), and "
            "MODELS, in electrons; their headers have the coordinates of the image where all "
            "images share them, else their offsets",
        ),
        options.PICTURE.but(
            help="picture of image, model, residuals and extended source, whole and at each star, "
            "and of how the iteration was chosen"
        ),
        options.QUIET,
    ],
    "calibration": [
        options.BACKGROUND.but(
            help=f"{options.BACKGROUND.keywords['help']}; it is taken as known, where the amount "
            "of --halo is fitted"
        ),
        option(
            "--halo",
            action="append",
            dest="halos",
            metavar="FILE",
            checksum="HSUM",
            help="light of known shape and unknown amount, such as the speckles round a star, of "
            "which the amount is fitted in each image: a FITS file with its image, or a cube of "
            "one for each; or flat, a level of the background; may be repeated",
        ),
        options.READ_NOISE,
        option(
            "--exposure",
            **SEVERAL,
            type=number_or_word,
            metavar="T",
            card=("EXP", "exposure, seconds"),
            checksum="ESUM",
            help="seconds, a FITS file with a map of them, or a keyword of the images' headers "
            "such as EXPTIME; one for all images or one for each. Rates are multiplied by it; the "
            "result of counts is then per second",
        ),
        option(
            "--gain",
            type=number_or_word,
            metavar="G",
            card=("GAIN", "electrons for each unit of the images"),
            help="electrons for each adu, or for each of whatever unit the images have; or a "
            "keyword of the images' headers such as GAIN; or their extension with the variance of "
            "counts, as VAR_POISSON of JWST (default: 1 for counts; for other units what their "
            "VAR_POISSON, --noise err or ERR shows)",
        ),
        option(
            "--mask",
            **SEVERAL,
            metavar="FILE",
            checksum="MSUM",
            help="FITS file that is not 0 where a pixel is bad; or dq, the extension DQ of each "
            "image, or wht, where its extension WHT is 0; one for all images or one for each. "
            "dq:BITS names the flags that are no fault, as in dq:16,64, or dq:~1 for all but 1; "
            "dq:0 for none (default: of JWST ~1,512, of HST those of pixels that were corrected, "
            "else 0)",
        ),
        options.SATURATION,
        option(
            "--noise",
            **SEVERAL,
            kinds=NOISE,
            checksum="NSUM",
            help="FITS file with the noise of each pixel in units of the images, 0 where a pixel "
            "is bad: of sky and read noise 1 / variance (ivar=FILE), variance (var=FILE) or "
            "standard deviation (rms=FILE); or the standard deviation of all noise, that of the "
            "source's counts too (err=FILE; err alone is the extension ERR of each image); one for "
            "all images or one for each",
        ),
        option(
            "--align",
            choices=("wcs",),
            help="take offsets, rotations, flips and scales of the images from their sky "
            "coordinates (default: they have none); the sky has the pixels of the first image, or "
            "of one whose pixels are smaller, and images may have several shapes",
        ),
        option(
            "--angle",
            **SEVERAL,
            type=number_or_word,
            metavar="ANGLE",
            checksum="ASUM",
            help="parallactic angles of images of an altazimuth telescope without derotator, "
            "degrees: a keyword of their headers such as PARANG, a file (FITS, or text with a "
            "number a line), or one number for each image. The extended source has north up",
        ),
        option(
            "--epoch",
            **SEVERAL,
            type=number_or_word,
            metavar="EPOCH",
            needs=("stars", "star_table"),
            help="epochs of the images, in each of which a star has a flux of its own, as a quasar "
            "that varies: each, for one an image; a keyword of their headers such as DATE-OBS; or "
            "a label for each image (default: one epoch)",
        ),
        option(
            "--centre",
            type=options.pixel,
            metavar="X,Y",
            needs=("angle",),
            help="with --angle: where the field turns about, pixels (default: the middle, "
            "nx // 2, ny // 2)",
        ),
    ],
    "stars": [
        options.STARS,
        options.STAR_TABLE,
        option(
            "--refine",
            action=options.EITHER,
            dest="refine_positions",
            needs=("stars", "star_table"),
            card=("REFINED", "star positions"),
            help="fit the positions of the stars too, each within 3 pixels of the one given, or "
            "take them as given; by default they are fitted where that mends a misfit at the "
            "stars and smoothing is chosen",
        ),
        option(
            "--refine-psfs",
            nargs="+",
            choices=(*FAMILIES, "none"),
            metavar="WHAT",
            card=("REFPSF", "asked of the PSFs"),
            help="fit the PSFs to the stars before the reconstruction where they do not fit, and "
            "use them where they fit better: shift, jitter (a blur, or a sharpening), strehl "
            "(needs --psf-errors ideal or pupil), pupil (phases; needs --psf-errors pupil), modes "
            "(needs --psf-errors modes), pixels, none; by default, where smoothing is chosen, "
            "jitter, of several images shift, those whose files are given, and pixels",
        ),
        option(
            "--psf-errors",
            **SEVERAL,
            kinds=PSF_ERRORS,
            needs=("stars", "star_table"),
            checksum="DSUM",
            help="FITS files of the shape of the PSFs that tell how these may be wrong: ideal="
            "FILE, a PSF without aberrations; pupil=FILE, the transmission of a pupil in the "
            "frequencies of the PSFs, its middle at (ky // 2, kx // 2); scatter=FILE, the standard "
            "deviation of the pixels of a PSF of unit sum, which the smoothing near stars follows; "
            "of these one for all images or one for each; modes=FILE, a cube of the ways in which "
            "all PSFs may differ, one standard deviation each. Each may be an extension of its "
            "name beside a PSF, as lnocl psf writes SCATTER and MODES",
        ),
    ],
    "reconstruction": [
        _parameter(
            "--n-iter",
            type=int,
            metavar="N",
            help="largest number of iterations (default: %(default)s)",
        ),
        _parameter(
            "--stop",
            type=number_or_word,
            metavar="RULE",
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
            help="weight of the Tikhonov term on the extended source, per electron (default: "
            "%(default)s)",
        ),
        _parameter(
            "--smoothing",
            type=number_or_word,
            metavar="WEIGHT",
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
    "tiles": [
        option(
            "--tile",
            type=int,
            metavar="N",
            help="reconstruct tile by tile on grids of N x N pixels, each with the PSF of its "
            "middle: for large images, and PSFs that vary (default: where --psf is a grid of PSFs "
            "five times its side, else the whole)",
        ),
        options.PARALLEL.but(
            help="tiles at once: a number of processes, or current-scheduler, the workers of the "
            "scheduler of Dask that DASK_SCHEDULER_ADDRESS names (default: one after the other)"
        ),
    ],
    "long runs": checkpoints.OPTIONS,
}
ALL_OPTIONS = [each for group in OPTIONS.values() for each in group]
