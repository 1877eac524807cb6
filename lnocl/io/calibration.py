"""The calibration of images in files, which options of the shell declare too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from lnocl.core.scene.observation import PsfCentre

Word = str | float
# Components of which each image shows one.
EACH = "each"


class Calibration(NamedTuple):
    """The calibration of images in files; a `Word` is a number, a file, or as listed.

    Attributes
    ----------
    background : sequence of Word
        Electrons per pixel, a FITS file with a map of them, or "auto", measured and then fitted
        with the rest; below 0 where too much sky was subtracted; one for all images or one for each
        (default: 0).

        What is measured is the mode of the image (`lnocl.io.levels`).
    read_noise : sequence of Word
        Standard deviation in electrons, a FITS file with a map of it, a keyword of the images'
        headers such as RDNOISE, or "auto", what the scatter of the sky has beyond the noise of its
        counts; one for all images or one for each (default: 0; auto where the sky was subtracted).

        A keyword may be in the header of the image or of its file. The scatter is sigma-clipped.
    noise : sequence of str
        FITS file with the noise of each pixel in units of the images, 0 where a pixel is bad: of
        sky and read noise 1 / variance (ivar=FILE), variance (var=FILE) or standard deviation
        (rms=FILE); or the standard deviation of all noise, that of the source's counts too
        (err=FILE; err alone is the extension ERR of each image); one for all images or one for
        each.
    exposure : sequence of Word
        Seconds, a FITS file with a map of them, or a keyword of the images' headers such as
        EXPTIME; one for all images or one for each. Rates are multiplied by it; the result of
        counts is then per second.
    mask : sequence of str
        FITS file that is not 0 where a pixel is bad; or dq, the extension DQ of each image, or wht,
        where its extension WHT is 0; one for all images or one for each. dq:BITS names the flags
        that are no fault, as in dq:16,64, or dq:~1 for all but 1; with dq:0 each flag is a fault
        (default: of JWST ~1,512, of HST those of pixels that were corrected, else 0).

        Flags are as for `flags.bad_pixels`.
    saturation : float, optional
        Pixels of this value and above are bad, in the unit of the images.
    gain : float or str, optional
        Electrons for each adu, or for each of whatever unit the images have; or a keyword of the
        images' headers such as GAIN; or their extension with the variance of counts, as VAR_POISSON
        of JWST (default: 1 for counts; for other units what their VAR_POISSON, `noise` err or ERR
        shows).

        Counts per time stay counts per time.
    align : {"wcs"}, optional
        Take offsets, rotations, flips and scales of the images from their sky coordinates (default:
        they have none); the sky has the pixels of the first image, or of one whose pixels are
        smaller, and images may have several shapes.

        So may their PSFs.
    angle : sequence of float or str
        Parallactic angles of images of an altazimuth telescope without derotator, degrees: a
        keyword of their headers such as PARANG, a file (FITS, or text with a number a line), or one
        number for each image. The extended source has north up.
    centre : tuple of float, optional
        Pixel about which the field turns, with `angle` (default: the middle, nx // 2, ny // 2).
    epoch : sequence of float or str
        Epochs of the images; stars, such as a quasar that varies, have a flux of their own in each.
        Give the word each, where every image is an epoch; the word night, where the images of a
        night are one, by the dates in their headers; a keyword of these such as DATE-OBS; or a
        label for each image (default: one epoch).
    components : sequence of str
        Skies of which each image shows a known mixture: the name of one, and its weight in each
        image, or one weight for all, as in line=1,0 and continuum=1,1 for an image in a line and
        one beside it. A weight is a number; one with its standard error, as in 0.93+-0.02; or a
        keyword of the images' headers, or 1 over it, as in continuum=1/PHOTFLAM. Weights by
        keywords are divided by the largest of their component. May be repeated. The word each is
        for images that show a sky of their own each, such as bands or the slices of a cube
        (default: one sky).

        A standard error is that of the weight after this division.
    oversample, effective_psfs, psf_centre, psf_error
        As for `Observation`.
    psf_errors : sequence of str
        FITS files of the shape of the PSFs that tell how these may be wrong: ideal=FILE, a PSF
        without aberrations; pupil=FILE, the transmission of a pupil in the frequencies of the PSFs,
        its middle at (ky // 2, kx // 2); scatter=FILE, the standard deviation of the pixels of a
        PSF of unit sum, by default the extension SCATTER of the files of PSFs where they have one,
        as those of ``lnocl psf``, and `psf_error` is not 0; of these one for all images or one
        for each; modes=FILE, a cube of the ways in which all PSFs may differ, one standard
        deviation each. Each may be an extension of its name beside a PSF, as ``lnocl psf`` writes
        SCATTER and MODES.
    halos : sequence of str
        Light of known shape and unknown amount, such as the speckles round a star, of which the
        amount is fitted in each image: a FITS file with its image, or a cube of one for each; or
        flat, a level of the background; may be repeated.
    star_psfs : sequence of str
        PSF of its own of a star, such as one behind the mask of a coronagraph: the pixel of the
        star that it is for, and a FITS file with its PSF, or a cube of one for each image, whose
        sums are the shares of its light that the images show; may be repeated.
    """

    background: Sequence[Word] = (0.0,)
    read_noise: Sequence[Word] = (0.0,)
    noise: Sequence[str] = ()
    exposure: Sequence[Word] = ()
    mask: Sequence[str] = ()
    saturation: float | None = None
    gain: Word | None = None
    align: Literal["wcs"] | None = None
    angle: Sequence[Word] = ()
    centre: tuple[float, float] | None = None
    epoch: Sequence[Word] = ()
    components: Sequence[str] = ()
    oversample: int = 1
    effective_psfs: bool = False
    psf_centre: PsfCentre = "check"
    psf_error: float | None = None
    psf_errors: Sequence[str] = ()
    halos: Sequence[str] = ()
    star_psfs: Sequence[str] = ()
