"""The steps from a frame of a star to a PSF; each says in one line what it did."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from astropy.stats import mad_std, sigma_clipped_stats
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label, maximum_filter, value_indices

from lnocl.core.scene.apertures import FWHM
from lnocl.core.scene.arrays import Array, Mask, numbers
from lnocl.core.scene.blemishes import sharp_pixels
from lnocl.core.scene.psf_edge import LEAST_RADIUS, psf_edge
from lnocl.core.scene.shifting import ENDLESS, MARGIN, MovablePsf
from lnocl.core.scene.transforms import enlarged
from lnocl.detection.defects import are_counts, saturated_pixels, sharpest_psf
from lnocl.detection.fitting import fit
from lnocl.detection.maxima import SIGNIFICANT
from lnocl.errors import InputError, counted, warn
from lnocl.psf import resampling
from lnocl.psf.centring import SEARCH, Pixel, Point, brightest, fit_gaussian
from lnocl.psf.checks import MIN_SIZE, one_number
from lnocl.psf.repair import WINDOW, repair
from lnocl.psf.wings import FROM, distance, fit_sky

# The background is lowered by so many of its errors or more, and by this share of the flux; where
# the farthest pixels are above it by less than this share of that. Of a larger share it is warned.
CERTAIN, LITTLE, TRUSTED, MUCH = 5.0, 0.001, 0.5, 0.01
# Fewest pixels that a background is measured from.
MIN_SKY = 100
# Width of the frame's border, as a share of the shorter side.
BORDER = 1 / 16
# Another star is a maximum in the wings of the given ones, above this share of the peak of one that
# it is near: what is nearer or fainter may be rings and speckles.
BRIGHT = 0.05
# It is a star where the brightest given one, moved there, leaves no more than this share of its
# peak and so many times the noise (rms), to so many widths; else it is masked.
WITHIN, ALIKE, NOISY, MASKED = 1.5, 0.05, 2.0, 2.0
# Fringes as fine as the pixels may have this share of a star's peak; less noise than the other is
# rounding.
FINE, NOISELESS = 1e-3, 1e-6
# Growth of negative pixels by shift and rotation that calls for a warning: a share of the flux on
# top of a share of the negative flux before, since both change noise too.
RINGING, OF_NOISE = 0.01, 0.2


def find_stars(
    pixels: Array, bad: Mask, position: ArrayLike | None
) -> tuple[list[Pixel], list[str]]:
    """Return the stars' pixels, those at `position`, or the brightest; and a line for each."""
    ny, nx = pixels.shape
    if position is None:
        start = brightest(pixels, bad)
        return [start], [f"star: brightest pixel of the median-filtered frame, {_at(start)}"]
    given = numbers("position", position, unit="pix")
    if given.shape[-1:] != (2,) or given.ndim > 2 or not given.size or not np.isfinite(given).all():
        raise InputError(f"position is {position!r}; give two finite numbers, x and y")
    places, lines = [], []
    for x, y in given.reshape(-1, 2):
        start = nearest_pixel((float(y), float(x)))
        if not (0 <= start[0] < ny and 0 <= start[1] < nx):
            raise InputError(
                f"position ({x:g}, {y:g}) is outside the frame of {nx} x {ny} pixels; give x and "
                "y, 0-based"
            )
        if start in places:
            raise InputError(f"position ({x:g}, {y:g}) is given twice; give each star once")
        places.append(start)
        lines.append(f"star: given at x = {x:g}, y = {y:g}")
    return places, lines


def find_defects(
    pixels: Array, bad: Mask, starts: list[Pixel], saturation: float | None
) -> tuple[Mask, Mask]:
    """Return saturated pixels, by their level and by flat tops, and rays and hot pixels.

    Where a star may be these are not told from one that the pixels undersample.
    """
    good = pixels[~bad]
    light = np.where(bad, 0.0, pixels - np.median(good))
    peak = float(light[_distance(bad.shape, starts) <= SEARCH].max())
    scatter = float(mad_std(good))
    noise = math.hypot(scatter, FINE * peak)
    # Without noise pixels are alike by symmetry.
    significance = light / scatter if scatter > NOISELESS * peak else np.zeros(bad.shape)
    saturated = saturated_pixels(pixels, significance, bad, saturation)
    unknown, psfs = bad | saturated, [sharpest_psf()]
    rays = sharp_pixels(light, np.full(bad.shape, noise), unknown, psfs, are_counts(good))
    return saturated, rays & (_distance(bad.shape, starts) > SEARCH)


def reachable(shape: tuple[int, ...], starts: list[Pixel], half: int | None) -> Mask:
    """Return the pixels that the PSF may be made of, wherever its centre is found."""
    far = max(shape) if half is None else half + MARGIN + SEARCH
    return _distance(shape, starts) <= far


def _distance(shape: tuple[int, ...], starts: list[Pixel]) -> NDArray[np.int_]:
    """Return how far each pixel is from the nearest star, along x or y."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    each = [np.maximum(abs(y - row), abs(x - column)) for row, column in starts]
    return np.min(each, axis=0)


def measure_background(
    background: float | str, pixels: Array, bad: Mask, starts: list[Pixel], half: int | None
) -> tuple[float, str]:
    """Return the background: as given, or the median around the crops or in the border."""
    if not isinstance(background, str):
        level = one_number("background", background)
        return level, f"background: {level:g}, as given, subtracted"
    if background != "auto":
        raise InputError(f'`background` is {background!r}; give a number or "auto"')
    distance = _distance(pixels.shape, starts)
    sky, where = np.zeros_like(bad), "around the crop"
    if half is not None:
        sky = ~bad & (distance > half) & (distance <= 2 * half)
    if sky.sum() < MIN_SKY:
        width = max(1, int(min(pixels.shape) * BORDER))
        sky, where = ~bad, "in the frame's border"
        sky[width:-width, width:-width] = False
    if not sky.any():
        raise InputError("no good pixel is left for the background; give it as a number")
    _, level, scatter = map(float, sigma_clipped_stats(pixels[sky], sigma=3.0))
    return level, (
        f"background: {level:g} subtracted, scatter {scatter:.3g}, "
        f"median of {sky.sum()} pixels {where}"
    )


def lower_background(
    level: float, light: Array, bad: Mask, centres: list[Point], width: float, side: int
) -> tuple[float, list[str]]:
    """Return the background beneath the wings of stars, where it is lower, and a line for that.

    Parameters
    ----------
    level : float
        The background as measured.
    light : ndarray of float64, shape (ny, nx)
        The frame above it.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel is bad.
    centres : list of tuple of float
        Row and column of the stars.
    width : float
        Their FWHM, pixels.
    side : int
        The side of the PSF.

    Warns
    -----
    LnoclWarning
        Wings reach beyond the frame, so that their light is taken for sky.
    """
    peaks = np.array([light[nearest_pixel(centre)] for centre in centres]).clip(0.0)
    sky = fit_sky(light, bad, centres, peaks, width, 2 * side)
    core = distance(light.shape, centres) < FROM * width
    flux = float(light[core & ~bad].sum())
    if sky is None or not flux > 0:
        return level, []
    share = -sky.level * len(centres) * side**2 / flux
    if sky.level > -CERTAIN * sky.error or share < LITTLE:
        return level, []
    if sky.nearest > TRUSTED * -sky.level:
        if share > MUCH:
            warn(
                f"the wings of the star reach beyond the frame: up to about {_percent(share, 0)} "
                "of its light is taken for background; give `background` as a number, or a smaller "
                "size"
            )
        return level, []
    return level + sky.level, [
        f"background: {level + sky.level:g} instead, to which the wings fall; it held "
        f"{_percent(share)} of the flux"
    ]


def repair_bad(light: Array, bad: Mask, saturated: Mask, region: Mask) -> tuple[Mask, str]:
    """Interpolate the bad pixels of a region in place; return those that are too far inside."""
    if not bad.any():
        return bad, "bad pixels: 0 in the frame"
    repaired, unrepairable = repair(light, bad, region)
    if n_unrepairable := int(unrepairable.sum()):
        warn(
            f"{n_unrepairable} bad pixels around the star have too few good ones beside them and "
            "were set to the background"
        )
    return unrepairable, (
        f"bad pixels: {bad.sum()} in the frame, {saturated.sum()} of them saturated; "
        f"{repaired.sum()} around the star repaired, {n_unrepairable} set to the background"
    )


def find_centres(
    light: Array, unusable: Mask, starts: list[Pixel], level: float, recentre: bool
) -> tuple[list[Point], Point | None, list[str], float]:
    """Return the stars' centres, the shift of one to the middle of a pixel, lines, and the FWHM.

    The shift is None for none, the width that of the widest, and 0 where none is measured.
    """
    if not recentre:
        if len(starts) > 1:
            raise InputError("several stars must be recentred; give one, or leave recentre")
        centre = float(starts[0][0]), float(starts[0][1])
        return [centre], None, [f"centre: pixel {_at(starts[0])}; not shifted"], 0.0
    centres, lines, width = [], [], 0.0
    for start in starts:
        centre, sigma = fit_gaussian(light, unusable, start, level)
        centres.append(centre)
        width = max(width, FWHM * sigma)
        lines.append(
            f"centre: x = {centre[1]:.3f}, y = {centre[0]:.3f}, FWHM {FWHM * sigma:.2f} pixels"
        )
    if len(starts) > 1:
        return centres, None, lines, width
    pixel = nearest_pixel(centres[0])
    shift = pixel[0] - centres[0][0], pixel[1] - centres[0][1]
    moved = f"; shifted by x {shift[1]:z.3f}, y {shift[0]:z.3f}"
    return centres, shift, [lines[0] + moved], width


def find_neighbours(
    light: Array, bad: Mask, centres: list[Point], width: float, half: int
) -> tuple[list[Point], Mask, list[str]]:
    """Return other stars that the windows of these show, pixels of other sources, and a line.

    The arguments are those of `lower_background`; windows reach `half` pixels from their star.
    """
    noise = float(mad_std(light[~bad]))
    far = _distance(bad.shape, [nearest_pixel(centre) for centre in centres]) > half
    highest = (light == maximum_filter(light, 2 * math.ceil(width) + 1)) & ~bad
    brightest_given = max(centres, key=lambda centre: light[nearest_pixel(centre)])
    stars, others, n_others = list[Point](), list[Point](), 0
    # A maximum has several pixels where it is flat, as that of a saturated star.
    labels, _ = label(highest & (light > SIGNIFICANT * noise), np.ones((3, 3)))
    for pixels in value_indices(labels, ignore_value=0).values():
        plateau = np.transpose(pixels).tolist()
        row, column = plateau[len(plateau) // 2]
        offsets = np.abs(np.array(centres) - (row, column))
        peaks = [light[nearest_pixel(centres[s])] for s in range(len(centres))]
        is_near = offsets.max(axis=1) < half + FROM * width
        is_bright = light[row, column] > BRIGHT * np.array(peaks)
        if np.hypot(*offsets.T).min() < FROM * width or not (is_near & is_bright).any():
            continue
        place, misfit = _fit_star(light, brightest_given, (row, column), width)
        is_there = math.dist(place, (row, column)) < width
        is_alike = misfit < math.hypot(ALIKE * light[row, column], NOISY * noise)
        is_new = all(math.dist(place, star) > width for star in stars)
        core = cut_square(bad | far, nearest_pixel(place), math.ceil(width / 2))
        if is_there and is_alike and is_new and not core.any():
            stars.append(place)
        else:
            others += plateau
            n_others += 1
    if not (stars or others):
        return [], far & False, []
    use = "taken too" if len(centres) == 1 else "modelled beside them"
    line = (
        f"neighbours: {counted(len(stars), 'star')} not given, {use}; "
        f"{counted(n_others, 'other source')} masked"
    )
    return stars, far | (distance(bad.shape, others) < MASKED * width), [line]


def _fit_star(light: Array, star: Point, start: Pixel, width: float) -> tuple[Point, float]:
    """Return where another star, scaled, explains the light at a pixel, and the rms of the rest."""
    pixel, half = nearest_pixel(star), math.ceil(WITHIN * width)
    square, found = cut_square(light, pixel, half + MARGIN), cut_square(light, start, half)
    other, side = MovablePsf(square, ENDLESS), (2 * half + 1, 2 * half + 1)

    def moved(x: float, y: float) -> Array:
        place = other.with_slopes(pixel[1] - star[1] + x, pixel[0] - star[0] + y)
        return place.add_to(np.zeros((3, *side)), (-half, -half), ENDLESS)

    scale = np.array([light[start] / square.max()])
    (move,), (flux,) = fit(moved, np.zeros((1, 2)), scale, found, np.ones(side))
    misfit = found - flux * moved(*move)[0]
    return (start[0] + move[1], start[1] + move[0]), float(np.sqrt(np.mean(misfit**2)))


def _largest(shape: tuple[int, ...], pixel: Pixel, angle: float) -> int:
    """Return the side of the largest PSF that the frame has around a pixel."""
    before = min(pixel)
    after = min(n - 1 - i for n, i in zip(shape, pixel, strict=True))
    if angle == 0:
        return min(2 * before + 1, 2 * after + 2)
    side = 2 * min(before, after) + 1
    while side > 1 and resampling.reach(side, angle) > min(before, after):
        side -= 2
    return side


def fitting_side(
    shape: tuple[int, ...], pixels: list[Pixel], side: int | None, angle: float
) -> int:
    """Return the side of the PSF: as asked for if one star has it, or the largest that all have.

    What the frame does not show of the other stars is left to that one.
    """
    sides = [_largest(shape, pixel, angle) for pixel in pixels]
    if min(sides) < MIN_SIZE:
        edge = pixels[int(np.argmin(sides))]
        raise InputError(f"the star at {_at(edge)} is at the edge of the frame; give another")
    largest = max(sides)
    if side is None:
        return min(sides)
    if side > largest:
        turned = f", rotated by {angle:g} degrees," if angle else ""
        raise InputError(
            f"a PSF of {side} x {side} pixels{turned} around the star at "
            f"{_at(pixels[int(np.argmax(sides))])} reaches beyond the frame; give a size of "
            f"{largest} or less"
        )
    return side


def refuse_hole(unrepairable: Mask, pixel: Pixel) -> None:
    """Refuse a star whose middle has too few good pixels around it to be repaired."""
    if unrepairable[pixel]:
        raise InputError(
            f"the star at {_at(pixel)} has too few good pixels among the {WINDOW} x {WINDOW} "
            "around it; take a frame with a shorter exposure"
        )


def cut_square(array: NDArray, pixel: Pixel, half: int) -> NDArray:
    """Return the square of this half width around a pixel, mirrored where the frame ends."""
    inside = tuple(slice(max(i - half, 0), i + half + 1) for i in pixel)
    missing = [
        (max(half - i, 0), max(i + half + 1 - n, 0))
        for i, n in zip(pixel, array.shape, strict=True)
    ]
    return np.pad(array[inside], missing, mode="symmetric")


def rotate_square(work: Array, angle: float, radius: int) -> tuple[Array, str]:
    """Rotate about the middle; the change of sharpness is measured within a radius."""
    turned = resampling.rotate(work, angle)
    y, x = (np.arange(len(work)) - len(work) // 2 for _ in range(2))
    disc = np.hypot(y[:, None], x) <= radius
    sharpness = [
        float((image[disc] ** 2).sum() / image[disc].sum() ** 2) for image in (work, turned)
    ]
    return turned, (
        f"rotation: {angle:g} degrees; its sharpness, the sum of the squares over the square of "
        f"the sum, changed by {_percent(sharpness[1] / sharpness[0] - 1, 4)}"
    )


def crop_square(
    work: Array, side: int, light: Array, pixel: Pixel, level: float
) -> tuple[Array, str]:
    """Return the PSF; the line says which share of its light is outside it, as its edge tells."""
    psf = enlarged(work, (side, side), is_centred=True).copy()
    flux = float(psf.sum())
    if not flux > 0:
        raise InputError(
            f"the flux of the PSF above the background {level:g} is {flux:g}; give another "
            "position or a lower background"
        )
    line = f"crop: {side} x {side} pixels"
    if side == _largest(light.shape, pixel, 0.0):
        line += ", the largest square there is"
    edge = psf_edge(psf)
    if edge.radius < LEAST_RADIUS:
        return psf, f"{line}; too few to tell the light beyond"
    beyond = f"{100 * edge.share:.2f} +- {_percent(edge.light_error)}"
    return psf, f"{line}; by its edge {beyond} of its light is beyond"


def warn_of_guess(saturated: Mask, light: Array, pixel: Pixel, side: int) -> None:
    """Warn where saturated pixels of the PSF were repaired."""
    saturated, light = (cut_square(image, pixel, side // 2) for image in (saturated, light))
    if n_saturated := int(saturated.sum()):
        share = _percent(light[saturated].sum() / light.sum())
        warn(
            f"{n_saturated} saturated pixels of the PSF were repaired, and hold {share} of its "
            "flux: its core is a guess"
        )


def negative_shares(before: Array, psf: Array) -> tuple[float, float]:
    """Return the flux in negative pixels before shift and rotation and after, as shares."""
    negative, after = (float(-image.clip(max=0).sum() / psf.sum()) for image in (before, psf))
    return negative, after


def warn_of_ringing(shares: Sequence[tuple[float, float]]) -> None:
    """Warn where shift and rotation made negative pixels grow; the worst of all PSFs counts."""
    before, after = max(shares, key=lambda share: share[1] - (1 + OF_NOISE) * share[0])
    if after > RINGING + (1 + OF_NOISE) * before:
        warn(
            f"the PSF rings: negative pixels hold {_percent(after)} of its flux after shift and "
            f"rotation, {_percent(before)} before; the star is undersampled, and its pixels stay "
            "as they are without recentring and rotation"
        )


def count_negative(psf: Array, clip: bool) -> tuple[Array, str]:
    """Return the PSF with its negative pixels, or with 0 in their place."""
    negative = psf < 0
    share = _percent(psf[negative].sum() / psf.sum())
    done = "set to 0, which adds as much to it" if clip else "left as they are"
    line = f"negative pixels: {negative.sum()}, {share} of the flux; {done}"
    return (np.where(negative, 0.0, psf) if clip else psf), line


def nearest_pixel(point: Point) -> Pixel:
    """Return the pixel that a point lies in."""
    return math.floor(point[0] + 0.5), math.floor(point[1] + 0.5)


def _at(pixel: Pixel) -> str:
    return f"x = {pixel[1]}, y = {pixel[0]}"


def _percent(share: float, digits: int = 2) -> str:
    return f"{100 * float(share):z.{digits}f} %"
