"""Stars found in an image, with its PSF or without."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lnocl.core.scene.arrays import Array, Mask, darker_noise, number_in
from lnocl.core.scene.blemishes import sharp_pixels
from lnocl.core.scene.cores import core, fwhm
from lnocl.core.scene.quantities import in_unit, split
from lnocl.detection.checks import read_image, read_psf
from lnocl.detection.defects import are_counts, saturated_pixels, sharpest_psf
from lnocl.detection.maxima import SIGNIFICANT
from lnocl.detection.search import PointSources, around, find_points, in_boxes, pixels_at
from lnocl.errors import InputError, installed, warn
from lnocl.process import ignored_warnings

if TYPE_CHECKING:
    from astropy.table import Table

# The sky's level is a median over boxes of so many PSF widths, and of this many pixels or more.
BOX_WIDTHS, MIN_BOX = 12, 24
# Noise is measured in the image less the same, smoothed by a Gaussian of so many PSF widths.
SMOOTHER = 0.5
# A PSF width to begin with where none is known, pixels, and the stars that it is then measured on.
FIRST_WIDTH, MEASURED = 3.0, 20
# The stars among them are the narrowest that are this share of all, and as wide as each other to
# the other share: galaxies and clumps are wider, and cosmic rays, if they are narrower, differ.
NARROW, ALIKE = 0.25, 0.15
# Half the side of the square in which a star's width is fitted, pixels, and the least width.
FIT_HALF, LEAST_WIDTH = 10, 0.8
# Limits of Moffat functions, and half the side of a PSF that is one, in its widths.
BOUNDS, PSF_WIDTHS = {"gamma": (0.3, 30.0), "alpha": (1.2, 20.0)}, 8
# Stars of a round PSF are no longer than this, over their width.
LONGEST = 1.5
# A PSF is not this image's where stars are narrower than this share of its width.
NARROWER = 0.7
# Stars are as wide as this share of the PSF, or wider.
TOO_NARROW = 0.6
# A saturated star is a region of bad pixels inside a ring whose median is so many times as
# significant as a star must be.
OF_RING = 4.0
# So few bad pixels are fitted round as others.
FEW_PIXELS = 4
# Trails of bleeding are so many rows or columns wide, at most.
TRAIL = 3
# Pixels above this share of the brightest star are a ring, where darker ones lie inside them.
HOLLOW = 0.3


def find_stars(
    image: ArrayLike,
    psf: ArrayLike | None = None,
    *,
    threshold: float = 5.0,
    mask: ArrayLike | None = None,
    saturation: float | None = None,
) -> Table:
    r"""Return the stars in an image, by a matched filter with its PSF.

    The sky's level is a sigma-clipped median in boxes, interpolated between them, and the noise is
    that of neighbouring pixels. The filter works on the image g without its level. At each pixel n
    it fits a flux c of the PSF P and a constant b, in a disc round it,

    .. math:: \min_{c, b} \sum_m w_m (g_m - c P_{n m} - b)^2

    with one over the variance as weights w. Significant maxima are taken out of the image, the
    brightest first, so that their side lobes are no stars. Maxima in the wings of brighter stars
    are left out unless they are half as bright as those wings. So are extended sources: maxima that
    the PSF, smoothed by a Gaussian of 0.4 of its width, fits better than the PSF. Pixels sharper
    than the PSF, as cosmic rays leave them, are bad, and sources less than 0.6 times as wide are
    left out. Pixels of flat tops count as saturated, and a line of the log says how many
    (`lnocl.core.scene.blemishes`).

    Stars are sought from 5 standard deviations on, also where the threshold is higher: the noise of
    the filtered image is that without them.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        In any linear unit. Pixels that are masked or not finite are bad. So are blocks of exactly 0
        in an image that is not of whole counts.
    psf : array_like, shape (ky, kx), optional
        Its PSF, with its peak at (ky // 2, kx // 2). Without it, it is a round Moffat function as
        wide as the image's own stars.
    threshold : float, optional
        Smallest significance of a star, standard deviations; more than 0.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad.
    saturation : float, optional
        Pixels of this value and above are saturated, besides flat tops; more than 0. A Quantity is
        converted to the unit of the image.

    Returns
    -------
    astropy.table.Table
        A row for each star, the saturated ones first, and then the brightest, with these columns:

        - ``x`` and ``y``: pixels, 0-based;
        - ``peak``: of its image above the sky, in the unit of the image;
        - ``significance``: its flux over the standard deviation of such fluxes in the image;
        - ``width``: of its image, full at half maximum, pixels;
        - ``saturated``: whether a pixel in the core is saturated or bad.

        ``meta["n_extended"]`` is the number of extended sources left out, ``meta["n_sharp"]``
        that of cosmic rays and other sources sharper than the PSF.

    Warns
    -----
    LnoclWarning
        No PSF is given, and the brightest sources are not round; or stars are much narrower than
        the PSF.

    Raises
    ------
    InputError
        - An array has another shape or type, or the image has no good pixel.
        - The threshold or the saturation is not a number of more than 0.
    LnoclError
        photutils is not installed.

    References
    ----------
    Stetson, P. B., PASP 99, 191 (1987), for maxima of a least-squares flux and a constant.
    Hogbom, J. A., A&AS 15, 417 (1974), for taking out the brightest first.
    Desai, S. et al., ApJ 757, 83 (2012), for a PSF and a broader one that tell points from others.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.detection import find_stars
    >>> y, x = np.indices((64, 64))
    >>> noise = np.random.default_rng(1).normal(0, 1, (64, 64))
    >>> image = noise + 200 * np.exp(-((x - 30.2) ** 2 + (y - 20) ** 2) / 8)
    >>> stars = find_stars(image)
    >>> print(len(stars), stars["x"][0].round(1), stars["y"][0].round(1))
    1 30.2 20.0
    """
    installed(
        "photutils.background", "the sky under stars is found by photutils, which is not installed"
    )
    image, unit = split("image", image)
    threshold = in_unit("threshold", threshold, "")
    if saturation is not None:
        saturation = in_unit("saturation", saturation, unit or "")
        number_in("saturation", saturation, "more than 0", lambda given: given > 0)
    number_in("threshold", threshold, "more than 0", lambda given: given > 0)
    pixels, bad = read_image("image", image, mask)
    bad |= _outside(pixels)
    if bad.all():
        raise InputError("image has no good pixel; give another, or another mask")
    # The noise in which stars are seen is that without them, whatever the threshold.
    sought = min(threshold, SIGNIFICANT)
    shape = None if psf is None else read_psf(psf)
    width = FIRST_WIDTH if shape is None else fwhm(shape)
    above, noise = _above_sky(pixels, bad, width)
    saturated = bad | saturated_pixels(pixels, above / noise, bad, saturation) | _holes(above)
    counts = are_counts(pixels[~bad])
    sharp = sharp_pixels(above, noise, saturated, [sharpest_psf()], counts)
    above, noise = _above_sky(pixels, bad | sharp, width)
    own = _measured_psf(above / noise, sought, is_all=shape is None)
    shape = own if shape is None else shape
    above, noise = _above_sky(pixels, bad | sharp, fwhm(shape))
    sharp |= sharp_pixels(above, noise, saturated | sharp, [own, shape], counts)
    above, noise = _above_sky(pixels, bad | sharp, fwhm(shape))
    cores, covered = _saturated_stars(above / noise, saturated, fwhm(shape), sought)
    unit = float(noise.min()) if np.isfinite(noise).any() else 1.0
    weights = np.where(saturated, 0.0, (noise / unit) ** -2.0)
    found = find_points(above / unit, weights, shape, sought, cores, covered, is_rough=psf is None)
    if psf is not None:
        _compare_widths(found, fwhm(shape))
    stars = _table(found, saturated, unit * float(shape.max()))
    stars = stars[stars["significance"] >= threshold]
    narrow = _narrow_rows(stars, fwhm(shape))
    stars.meta["n_extended"] = int((found.extended >= threshold).sum())
    stars.meta["n_sharp"] = ndimage.label(sharp, np.ones((3, 3)))[1] + int(narrow.sum())
    return stars[~narrow]


def _outside(pixels: Array) -> Mask:
    """Return blocks of pixels of exactly 0 in an image that is not of whole counts.

    They are outside the field: a mosaic has 0 there.
    """
    empty = pixels == 0
    if not empty.any() or are_counts(pixels[np.isfinite(pixels)]) or not pixels.any():
        return np.zeros(pixels.shape, bool)
    return ndimage.binary_opening(empty, np.ones((3, 3)))


def _above_sky(pixels: Array, bad: Mask, width: float) -> tuple[Array, Array]:
    """Return the light above the sky and its noise; 0 and infinite where the sky is not known.

    The noise is that of what a Gaussian leaves of white noise. Of whole counts it is that of
    Poisson counts at least, since a median of few counts is 0.
    """
    box = min(max(MIN_BOX, round(BOX_WIDTHS * width)), *pixels.shape)
    filled = _filled(pixels, bad, width)
    level, _ = in_boxes(filled, bad, box)
    rough = filled - ndimage.gaussian_filter(filled, SMOOTHER * width)
    impulse = np.eye(1, 4 * box + 1, 2 * box)[0]
    kernel = ndimage.gaussian_filter1d(impulse, SMOOTHER * width)
    squares = 1.0 - 2.0 * kernel.max() ** 2 + (kernel**2).sum() ** 2  # of an impulse less the same
    noise = in_boxes(rough, bad, box)[1] / np.sqrt(squares)
    if are_counts(pixels[~bad]):
        means = ndimage.uniform_filter(np.where(bad, 0.0, pixels), box)[~bad]
        noise = np.maximum(noise, np.sqrt(max(float(np.quantile(means, 0.25)), 1.0 / box**2)))
    # A flat part, such as one outside the field, has no noise.
    is_known = ~bad & (noise > 1e-6 * np.median(noise[~bad]))
    return np.where(is_known, filled - level, 0.0), np.where(is_known, noise, np.inf)


def _filled(pixels: Array, bad: Mask, width: float) -> Array:
    """Return an image whose bad pixels have the mean of those near them, or of all."""
    if not bad.any():
        return pixels
    known = ndimage.gaussian_filter((~bad).astype(float), width / 2.0)
    smooth = ndimage.gaussian_filter(np.where(bad, 0.0, pixels), width / 2.0)
    mean = np.full(pixels.shape, pixels[~bad].mean())
    near = np.divide(smooth, known, out=mean, where=known > 1e-6)
    return np.where(bad, near, pixels)


def _measured_psf(image: Array, threshold: float, is_all: bool) -> Array:
    """Return a round Moffat function as narrow as the narrow ones among the brightest sources.

    Where it is all there is to know of the PSF it is warned of sources that are not round.
    """
    from astropy.modeling.fitting import TRFLSQFitter
    from astropy.modeling.models import Const2D, Moffat2D

    smooth = ndimage.gaussian_filter(image, FIRST_WIDTH / 2.355)
    lowest = threshold * darker_noise(smooth)
    apart = 2 * round(FIRST_WIDTH) + 1
    y, x = np.nonzero((smooth == ndimage.maximum_filter(smooth, apart)) & (smooth > lowest))
    fits = []
    for i in np.argsort(-smooth[y, x])[:MEASURED]:
        there = around(x[i], y[i], (FIT_HALF, FIT_HALF), image.shape)
        rows, columns = np.mgrid[there]
        star = Moffat2D(image[y[i], x[i]], x[i], y[i], FIRST_WIDTH / 2, 3.0, bounds=BOUNDS)
        with ignored_warnings():  # of fits that do not converge
            fit = TRFLSQFitter()(star + Const2D(), columns, rows, image[there])[0]
        if LEAST_WIDTH < fit.fwhm < FIT_HALF and np.hypot(fit.x_0 - x[i], fit.y_0 - y[i]) < 2:
            fits.append((fit.fwhm, fit.alpha.value, _elongation(image[there])))
    width, power, length = np.median(_narrow(fits), axis=0)
    if is_all and length > LONGEST:
        warn(
            f"the brightest sources are {length:.1f} times as long as wide: give the PSF, unless "
            "it is round, as stars are sought with a round one"
        )
    half = round(PSF_WIDTHS * width)
    light = Moffat2D(1.0, 0.0, 0.0, width / (2.0 * np.sqrt(2.0 ** (1.0 / power) - 1.0)), power)
    profile = light(*np.mgrid[-half : half + 1, -half : half + 1])
    return profile / profile.sum()


def _narrow(fits: list[tuple[float, float, float]]) -> Array:
    """Return the fits, each with its width first, that are those of stars."""
    found = np.array(sorted(fits) or [(FIRST_WIDTH, BOUNDS["alpha"][1], 1.0)])
    widths = found[:, 0]
    ends = np.searchsorted(widths, (1.0 + ALIKE) * widths, side="right")
    enough = np.flatnonzero(ends - np.arange(len(widths)) >= NARROW * len(widths))
    first = enough[0] if len(enough) else int(NARROW * len(widths))
    return found[first : ends[first]]


def _elongation(window: Array) -> float:
    """Return the length of what is above half the peak of a star, over its width."""
    at = np.nonzero(core(window, 0.5))
    # Pixels have a variance of 1/12 of their own.
    variances = np.linalg.eigvalsh(np.cov(at, aweights=window[at], ddof=0)) + 1.0 / 12.0
    return float(np.sqrt(variances[1] / variances[0]))


def _holes(light: Array) -> Mask:
    """Return dark pixels inside bright ones: cores in which counts were lost."""
    peak = ndimage.median_filter(light, 3).max()  # single bright pixels are no stars
    bright = light > HOLLOW * max(peak, 0.0)
    return ndimage.binary_fill_holes(bright) & ~bright


def _saturated_stars(
    significance: Array, saturated: Mask, width: float, threshold: float
) -> tuple[Array, Mask]:
    """Return x and y of bad regions of some size inside bright rings.

    Of a region with trails of bleeding it is the part that is wider than those. The second array
    says which pixels are of these regions, or within a PSF width of them.
    """
    labels, _ = ndimage.label(saturated, np.ones((3, 3)))
    stars, covered = [], np.zeros(saturated.shape, bool)
    reach = max(2, round(width))
    # Most regions are single bad pixels in the sky, of which a frame may have a million.
    near = ndimage.maximum_filter(np.where(saturated, 0.0, significance), 5)
    places = ndimage.find_objects(labels)
    brightest = ndimage.maximum(near, labels, np.arange(1, len(places) + 1))
    for label in np.flatnonzero(np.asarray(brightest) >= OF_RING * threshold) + 1:
        there = places[label - 1]
        wider = tuple(slice(max(part.start - reach, 0), part.stop + reach) for part in there)
        region = labels[wider] == label
        lines = np.ones((1, TRAIL + 1)), np.ones((TRAIL + 1, 1))
        thick = np.all([ndimage.binary_opening(region, line) for line in lines], axis=0)
        core = thick if thick.any() else region
        ring = ndimage.binary_dilation(core, iterations=2) & ~saturated[wider]
        if region.sum() <= FEW_PIXELS or not ring.any():
            continue
        if np.median(significance[wider][ring]) < OF_RING * threshold:
            continue
        y, x = np.add(ndimage.center_of_mass(core), [part.start for part in wider])
        stars.append((x, y))
        covered[wider] |= ndimage.binary_dilation(region, iterations=reach)
    return np.reshape(stars, (-1, 2)), covered


def _narrow_rows(stars: Table, width: float) -> Mask:
    """Return which stars are narrower than the PSF, or than most of them if this is too wide.

    The width of stars of 5 to 30 standard deviations is that of the PSF to 0.6 in all but 1 of 800,
    and is known of all.
    """
    own = np.asarray(stars["width"], float)
    whole = ~np.asarray(stars["saturated"], bool)
    known = own[whole & np.isfinite(own)]
    usual = min(width, float(np.median(known))) if known.size else width
    return whole & ~(own >= TOO_NARROW * usual)


def _compare_widths(stars: PointSources, width: float) -> None:
    """Warn where the brightest stars are not as wide as the PSF."""
    brightest = stars.width[~stars.is_known][np.argsort(-stars.flux[~stars.is_known])[:MEASURED]]
    if np.isfinite(brightest).any() and np.nanmedian(brightest) < NARROWER * width:
        warn(
            f"stars are {np.nanmedian(brightest):.2f} pixels wide and the PSF {width:.2f}: give "
            "the PSF of this image, in its pixels, or none"
        )


def _table(stars: PointSources, saturated: Mask, psf_peak: float) -> Table:
    """Return the stars, the saturated ones and then the brightest first."""
    from astropy.table import Table

    touched = (
        stars.is_known
        | ndimage.binary_dilation(saturated, np.ones((3, 3)))[
            pixels_at(stars.x, stars.y, saturated.shape)
        ]
    )
    columns = {
        "x": stars.x,
        "y": stars.y,
        "peak": stars.flux * psf_peak,
        "significance": stars.significance,
        "width": stars.width,
        "saturated": touched,
    }
    order = np.lexsort((-stars.flux, ~touched))
    return Table({name: values[order] for name, values in columns.items()})
