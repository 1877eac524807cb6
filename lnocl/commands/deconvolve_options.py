"""The arguments of the command ``deconvolve``."""

from __future__ import annotations

import inspect

from lnocl.commands import options
from lnocl.commands.declared import BACKGROUND, DEVICE, READ_NOISE, SATURATION, parameter
from lnocl.commands.options import option
from lnocl.core.scene.fields import OVERSAMPLES
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_families import FAMILIES
from lnocl.deconvolution import deconvolve
from lnocl.io.calibration import Calibration
from lnocl.io.names import NOISE, PSF_ERRORS, STAR_PSFS

PARAMETERS = {
    name: declared.default for name, declared in inspect.signature(deconvolve).parameters.items()
}
OPTIONS = {
    "input": [
        options.IMAGES,
        options.PSFS.but(required=True),
        # None for no card where they are not given.
        parameter(Observation, "oversample", choices=OVERSAMPLES, metavar=None, default=None),
        parameter(
            Observation,
            "effective_psfs",
            default=None,
            card=("EPSF", "the PSFs hold the response of a pixel"),
        ),
        parameter(
            Observation, "psf_centre", card=("PSFCENTR", "what became of PSFs off their centre")
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
            help="add cubes: RESIDUALS of each image, (image - model) / sqrt(model), and MODELS, "
            "in electrons, whose headers have the coordinates of the image where all images share "
            "them, else their offsets; and ELECTRONS, how many one unit of the result is",
        ),
        options.PICTURE.but(
            help="picture of image, model, residuals and extended source, whole and at each star, "
            "and of how the iteration was chosen"
        ),
        *options.HOW_MUCH_IS_SAID,
    ],
    "calibration": [
        BACKGROUND.but(
            help=f"{BACKGROUND.keywords['help']}; a number or a map is taken as known, while the "
            "amount of `halos` is fitted"
        ),
        parameter(
            Calibration,
            "halos",
            "--halo",
            action="append",
            nargs=None,
            dest="halos",
            metavar="FILE",
            checksum="HSUM",
        ),
        READ_NOISE,
        parameter(
            Calibration,
            "exposure",
            metavar="T",
            card=("EXP", "exposure, seconds"),
            checksum="ESUM",
        ),
        parameter(
            Calibration, "gain", metavar="G", card=("GAIN", "electrons for each unit of the images")
        ),
        parameter(Calibration, "mask", metavar="FILE", checksum="MSUM"),
        SATURATION,
        parameter(
            deconvolve,
            "mend_images",
            action=options.EITHER,
            card=("MENDED", "whether images were mended"),
        ),
        parameter(Calibration, "noise", kinds=NOISE, checksum="NSUM"),
        parameter(Calibration, "align"),
        parameter(Calibration, "angle", metavar="ANGLE", checksum="ASUM"),
        parameter(Calibration, "epoch", metavar="EPOCH", needs=("stars", "star_table")),
        parameter(
            Calibration,
            "components",
            "--component",
            action="append",
            nargs=None,
            dest="components",
            type=options.mixture,
            metavar="NAME=WEIGHTS",
            card=("COMP", "component, and its weight in each image"),
        ),
        parameter(Calibration, "centre", type=options.pixel, metavar="X,Y", needs=("angle",)),
    ],
    "stars": [
        options.STARS,
        options.STAR_TABLE,
        parameter(
            deconvolve,
            "refine_positions",
            "--refine",
            dest="refine_positions",
            needs=("stars", "star_table"),
            card=("REFINED", "star positions"),
        ),
        parameter(
            deconvolve,
            "refine_psfs",
            also="none: no fit",
            default=None,
            nargs="+",
            choices=(*FAMILIES, "none"),
            metavar="WHAT",
            card=("REFPSF", "asked of the PSFs"),
        ),
        parameter(
            Observation,
            "psf_error",
            default=None,
            type=float,
            metavar="SHARE",
            needs=("stars", "star_table"),
            card=("PSFPRIOR", "relative error that PSFs may have"),
        ),
        parameter(
            Calibration,
            "psf_errors",
            kinds=PSF_ERRORS,
            needs=("stars", "star_table"),
            checksum="DSUM",
        ),
        parameter(
            Calibration,
            "star_psfs",
            "--star-psf",
            action="append",
            nargs=None,
            dest="star_psfs",
            kinds=STAR_PSFS,
            type=options.placed_file,
            metavar="X,Y=FILE",
            needs=("stars", "star_table"),
            checksum="QSUM",
        ),
    ],
    "reconstruction": [
        parameter(deconvolve, "n_iter"),
        parameter(deconvolve, "stop", metavar="RULE"),
        parameter(deconvolve, "solver", card=("SOLVER", "iteration")),
        parameter(deconvolve, "mu", metavar="MU"),
        parameter(deconvolve, "smoothing", metavar="WEIGHT"),
        parameter(deconvolve, "spectral_smoothing", metavar="SHARE"),
        parameter(deconvolve, "pad", card=("PAD", "least unobserved pixels round the images")),
        parameter(deconvolve, "precision", card=("PRECISIO", "precision of the arithmetic")),
        DEVICE,
        parameter(deconvolve, "engine", card=("ENGINE", "engine")),
    ],
    "tiles": [
        option(
            "--tile",
            type=int,
            metavar="N",
            help="reconstruct tile by tile on grids of N x N pixels, each with the PSF of its "
            "middle: for large images, and PSFs that vary (default: about five times the side of "
            "the PSFs where --psf is a grid of them, else no tiles)",
        ),
        options.parallel("tiles"),
    ],
    "long runs": [
        parameter(
            deconvolve, "checkpoint", also="on Ctrl-C too", metavar="FILE", is_repeated=False
        ),
        parameter(deconvolve, "resume", metavar="FILE", is_input=True, is_repeated=False),
    ],
}
ALL_OPTIONS = [each for group in OPTIONS.values() for each in group]
