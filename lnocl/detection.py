"""Stars found in an image, by photutils."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from lnocl.errors import InputError, LnoclError, counted
from lnocl.process import ignored_warnings
from lnocl.scene.arrays import numbers
from lnocl.scene.cores import fwhm

if TYPE_CHECKING:
    from astropy.table import Table

# The sky's level is a median over boxes of so many PSF widths, and of this many pixels or more.
BOX_WIDTHS, MIN_BOX = 12, 24
# A PSF width to begin with where none is known, and the stars that it is then measured on.
FIRST_WIDTH, MEASURED = 3.0, 20
# Of maxima nearer to each other than so many PSF widths one is taken.
SEPARATION = 0.9
# What lies in the wings of brighter stars must be brighter than this share of them: PSFs err.
OF_WINGS = 0.5
# What has so many times the light of a star of its peak is extended.
EXTENDED = 1.7
# A Gaussian is one standard deviation below its median in this share of all.
DARKER = 0.1587
# A box with more bad pixels than this, percent, says nothing of the sky.
MOST_BAD = 50.0
# Side of the square in which a star's width is fitted, pixels, and the least width that is one.
FIT_SIDE, LEAST_WIDTH = 11, 0.8
# A saturated star is a region of bad pixels inside a ring whose median is so many times as
# significant as a star must be.
OF_RING = 4.0
# So few bad pixels are not the core of a saturated star, where a maximum was found beside them.
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
    """Return the stars in an image: local maxima of the shape of the PSF, by DAOFIND.

    The sky's level and noise are sigma-clipped medians in boxes, and are interpolated between them.
    Stars are sought in the image less its level, over its noise. Maxima in the wings of brighter
    stars are left out unless they are half as bright again as those wings, as the PSF has them.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        In any linear unit. Pixels that are not finite are bad. So are blocks of exactly 0 in an
        image that is not of whole counts.
    psf : array_like, shape (ky, kx), optional
        Its PSF. Without it the width is measured on the image's own stars, and no wings are known.
    threshold : float, optional
        Smallest significance of a star, that of its image through a filter of the PSF's width; more
        than 0.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad.
    saturation : float, optional
        Pixels of this value and above are saturated.

    Returns
    -------
    astropy.table.Table
        A row for each star, the brightest first, with these columns:

        - ``x`` and ``y``: pixels, 0-based;
        - ``peak``: the brightest pixel above the sky, in the unit of the image;
        - ``significance``: over the noise of a pixel;
        - ``saturated``: whether a pixel in the core is saturated or bad.

    Raises
    ------
    InputError
        An array has another shape or type, the threshold is not more than 0, or the image has no
        good pixel.
    LnoclError
        photutils is not installed.

    References
    ----------
    Stetson, P. B., PASP 99, 191 (1987), for DAOFIND.

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
    pixels, bad = _check(image, mask, threshold)
    shape = None if psf is None else _check_psf(psf)
    width = FIRST_WIDTH if shape is None else fwhm(shape)
    above, noise = _significance(pixels, bad, width)
    if shape is None:
        width = _measure_width(above, bad, threshold)
        above, noise = _significance(pixels, bad, width)
    found = _candidates(above, bad, width, threshold)
    saturated = bad | _holes(above * np.where(np.isfinite(noise), noise, 0.0))
    if saturation is not None:
        saturated |= pixels >= saturation
    cores, covered = _saturated_stars(above, saturated, found, width, threshold)
    found = found[~_at(covered, found)]
    touched = ndimage.binary_dilation(saturated, np.ones((3, 3)))
    stars = np.concatenate([cores, found])
    is_saturated = np.concatenate([np.ones(len(cores), bool), _at(touched, found)])
    if shape is not None:
        kept = ~_in_wings(stars, shape)
        stars, is_saturated = stars[kept], is_saturated[kept]
    return _table(stars, is_saturated, noise)


def _check(
    image: ArrayLike, mask: ArrayLike | None, threshold: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pixels, and which of them are bad."""
    pixels = numbers("image", image)
    if pixels.ndim != 2:
        raise InputError(f"image has {counted(pixels.ndim, 'dimension')}; give one image")
    if not threshold > 0:
        raise InputError(f"threshold must be more than 0; {threshold:g} was given")
    bad = ~np.isfinite(pixels) | _outside(pixels)
    if mask is not None:
        given = np.asarray(mask)
        if given.dtype != np.bool_ or given.shape != pixels.shape:
            raise InputError(
                f"mask of type {given.dtype} and shape {given.shape} must be booleans of the shape "
                f"of image, {pixels.shape}"
            )
        bad |= given
    if bad.all():
        raise InputError("image has no good pixel; give another, or another mask")
    return pixels, bad


def _at(flags: NDArray[np.bool_], stars: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the flags at the pixels of stars."""
    row, column = _pixels_of(stars, flags.shape)
    return flags[row, column]


def _pixels_of(
    stars: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return row and column of the pixel of each star, or of the nearest to it."""
    x, y = np.round(stars[:, :2].T).astype(np.int64)
    return y.clip(0, shape[0] - 1), x.clip(0, shape[1] - 1)


def _outside(pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return blocks of pixels of exactly 0 in an image that is not of whole counts.

    They are outside the field: a mosaic has 0 there.
    """
    empty = pixels == 0
    if not empty.any() or _are_counts(pixels[np.isfinite(pixels)]) or not pixels.any():
        return np.zeros(pixels.shape, bool)
    return ndimage.binary_opening(empty, np.ones((3, 3)))


def _are_counts(values: NDArray[np.float64]) -> bool:
    """Return whether these are whole counts, and not all of them alike."""
    return bool((values >= 0).all() and (values == np.round(values)).all() and np.ptp(values) > 0)


def _check_psf(psf: ArrayLike) -> NDArray[np.float64]:
    light = numbers("psf", psf)
    if light.ndim != 2 or not np.isfinite(light).all() or not light.sum() > 0:
        raise InputError(
            f"psf of shape {light.shape} must be one image of finite numbers with a positive sum"
        )
    return light


def _import_photutils() -> Any:
    try:
        import photutils.background
        import photutils.detection
        import photutils.psf
    except ImportError:
        raise LnoclError(
            "stars are found by photutils, which is not installed: pip install photutils"
        ) from None
    return photutils


def _sky(
    pixels: NDArray[np.float64], bad: NDArray[np.bool_], width: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sky's level and its noise at each pixel; the noise is 0 where all is flat.

    Of whole counts it is that of Poisson counts at least, since a median of few counts is 0.
    """
    from astropy.stats import sigma_clipped_stats

    photutils = _import_photutils()
    box = min(max(MIN_BOX, round(BOX_WIDTHS * width)), *pixels.shape)
    with ignored_warnings():  # of pixels that are not finite
        try:
            sky = photutils.background.Background2D(
                pixels, box, mask=bad, exclude_percentile=MOST_BAD
            )
        except ValueError:  # no box has enough good pixels
            _, level, noise = sigma_clipped_stats(pixels[~bad])
            return np.full(pixels.shape, level), np.full(pixels.shape, noise)
    noise = sky.background_rms
    if _are_counts(pixels[~bad]):
        means = ndimage.uniform_filter(np.where(bad, 0.0, pixels), box)[~bad]
        noise = np.maximum(noise, np.sqrt(max(float(np.quantile(means, 0.25)), 1.0 / box**2)))
    return sky.background, noise


def _significance(
    pixels: NDArray[np.float64], bad: NDArray[np.bool_], width: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what is above the sky over its noise, 0 where it is not known; and that noise."""
    level, noise = _sky(pixels, bad, width)
    # A flat part, such as one outside the field, has no noise.
    is_known = ~bad & (noise > 1e-6 * np.median(noise[~bad]))
    noise = np.where(is_known, noise, np.inf)
    return np.where(is_known, (pixels - level) / noise, 0.0), noise


def _candidates(
    above: NDArray[np.float64], bad: NDArray[np.bool_], width: float, threshold: float
) -> NDArray[np.float64]:
    """Return x, y and brightest pixel of the local maxima that look like stars."""
    photutils = _import_photutils()
    filled = _filled(above, bad, width)
    finder = photutils.detection.DAOStarFinder(1.0, width)
    filtered = ndimage.convolve(filled, finder.kernel.data, mode="nearest")[~bad & (above != 0)]
    # By its darker half, in which no star is; neighbouring pixels may share their noise.
    noise = float(np.median(filtered) - np.quantile(filtered, DARKER)) if filtered.size else 0.0
    if not noise > 0:
        return np.zeros((0, 3))
    finder = photutils.detection.DAOStarFinder(
        threshold * noise, width, min_separation=SEPARATION * width, scale_threshold=False
    )
    with ignored_warnings():  # photutils warns where it finds nothing
        found = finder(filled)
    if found is None:
        return np.zeros((0, 3))
    width_of = found["flux"] / found["peak"]  # the square of a width
    brightest = np.argsort(-found["peak"])[:MEASURED]
    found = found[width_of < EXTENDED * np.median(width_of[brightest])]
    return np.array([found["x_centroid"], found["y_centroid"], found["peak"]], float).T


def _filled(
    above: NDArray[np.float64], bad: NDArray[np.bool_], width: float
) -> NDArray[np.float64]:
    """Return an image whose bad pixels have the mean of those near them."""
    if not bad.any():
        return above
    known = ndimage.gaussian_filter((~bad).astype(float), width / 2.0)
    smooth = ndimage.gaussian_filter(np.where(bad, 0.0, above), width / 2.0)
    near = np.divide(smooth, known, out=np.zeros(above.shape), where=known > 1e-6)
    return np.where(bad, near, above)


def _measure_width(above: NDArray[np.float64], bad: NDArray[np.bool_], threshold: float) -> float:
    """Return the width of the brightest stars of an image, the median of Gaussians fitted."""
    photutils = _import_photutils()
    found = _candidates(above, bad, FIRST_WIDTH, threshold)
    brightest = found[np.argsort(-found[:, 2])][:MEASURED]
    if not len(brightest):
        return FIRST_WIDTH
    with ignored_warnings():  # of fits that fail
        widths = photutils.psf.fit_fwhm(
            above, xypos=brightest[:, :2], fwhm=FIRST_WIDTH, fit_shape=FIT_SIDE, mask=bad
        )
    good = widths[(widths > LEAST_WIDTH) & (widths < FIT_SIDE)]
    return float(np.median(good)) if good.size else FIRST_WIDTH


def _holes(light: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return dark pixels inside bright ones: cores in which counts were lost."""
    peak = ndimage.median_filter(light, 3).max()  # single bright pixels are no stars
    bright = light > HOLLOW * max(peak, 0.0)
    return ndimage.binary_fill_holes(bright) & ~bright


def _saturated_stars(
    above: NDArray[np.float64],
    saturated: NDArray[np.bool_],
    found: NDArray[np.float64],
    width: float,
    threshold: float,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return x, y and the brightest pixel round them of bad regions inside bright rings.

    Of a region with trails of bleeding it is the part that is wider than those. A few bad pixels
    beside a maximum that was found are a part of that star. The second array says which pixels are
    of these regions, or within a PSF width of them.
    """
    labels, _ = ndimage.label(saturated, np.ones((3, 3)))
    stars, covered = [], np.zeros(saturated.shape, bool)
    reach = max(2, round(width))
    # Most regions are single bad pixels in the sky, of which a frame may have a million.
    near = ndimage.maximum_filter(np.where(saturated, 0.0, above), 5)
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
        if not ring.any() or np.median(above[wider][ring]) < OF_RING * threshold:
            continue
        y, x = np.add(ndimage.center_of_mass(core), [part.start for part in wider])
        beside = np.hypot(found[:, 0] - x, found[:, 1] - y) < width
        if region.sum() <= FEW_PIXELS and beside.any():
            continue
        stars.append((x, y, above[wider][ring].max()))
        covered[wider] |= ndimage.binary_dilation(region, iterations=reach)
    return np.reshape(stars, (-1, 3)), covered


def _in_wings(stars: NDArray[np.float64], psf: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which stars are no more than the wings of brighter ones may be."""
    order = np.argsort(-stars[:, 2])
    is_wing = np.zeros(len(stars), bool)
    y0, x0 = (n // 2 for n in psf.shape)
    relative = psf / psf.max()
    wings = np.zeros(len(stars))
    neighbours = KDTree(stars[:, :2]) if len(stars) else None
    for i in order:
        is_wing[i] = stars[i, 2] < (1.0 + OF_WINGS) * wings[i]
        if neighbours is not None and not is_wing[i]:
            lit = np.array(neighbours.query_ball_point(stars[i, :2], float(np.hypot(*psf.shape))))
            lit = lit[stars[lit, 2] < stars[i, 2]]
            dx, dy = (stars[lit, :2] - stars[i, :2]).T
            share = ndimage.map_coordinates(relative, [y0 + dy, x0 + dx], order=1)
            wings[lit] += stars[i, 2] * share.clip(0.0)
    return is_wing


def _table(
    stars: NDArray[np.float64], saturated: NDArray[np.bool_], noise: NDArray[np.float64]
) -> Table:
    """Return the stars, the brightest first."""
    from astropy.table import Table

    x, y, significance = stars.T
    at = noise[_pixels_of(stars, noise.shape)]
    known = noise[np.isfinite(noise)]
    peak = significance * np.where(np.isfinite(at), at, np.median(known) if known.size else 0.0)
    order = np.lexsort((-peak, ~saturated))
    columns = {"x": x, "y": y, "peak": peak, "significance": significance, "saturated": saturated}
    return Table({name: values[order] for name, values in columns.items()})
