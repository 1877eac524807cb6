"""The steps from a frame of a star to a PSF; each says in one line what it did."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from astropy.stats import sigma_clipped_stats
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import InputError, warn
from lnocl.psf import resampling
from lnocl.psf.centring import FWHM, SEARCH, Array, Mask, Pixel, Point, brightest, fit_gaussian
from lnocl.psf.checks import MIN_SIZE, _one_number
from lnocl.psf.repair import repair
from lnocl.scene.observation import numbers

# Pixels kept around the crop while it is shifted and rotated, since Fourier shifts wrap.
MARGIN = 16
# Pixels that a background is measured from, at least.
MIN_SKY = 100
# Width of the frame's border, as a share of the shorter side.
BORDER = 1 / 16
# By how much a shift or a rotation may make negative pixels grow without a warning: a share of the
# flux, and of what they were, since noise is not what it was after either.
RINGING, OF_NOISE = 0.01, 0.2


def _find(pixels: Array, bad: Mask, position: ArrayLike | None) -> tuple[Pixel, str]:
    """Return the pixel at the star."""
    ny, nx = pixels.shape
    if position is None:
        start = brightest(pixels, bad)
        return start, f"star: brightest pixel of the median-filtered frame, {_at(start)}"
    given = numbers("position", position)
    if given.shape != (2,) or not np.isfinite(given).all():
        raise InputError(f"position is {position!r}; give two finite numbers, x and y")
    start = _nearest((float(given[1]), float(given[0])))
    if not (0 <= start[0] < ny and 0 <= start[1] < nx):
        raise InputError(
            f"position ({given[0]:g}, {given[1]:g}) is outside the frame of {nx} x {ny} pixels; "
            "give x and y, 0-based"
        )
    return start, f"star: given at x = {given[0]:g}, y = {given[1]:g}"


def _region(shape: tuple[int, ...], start: Pixel, half: int | None) -> tuple[slice, slice]:
    """Return all that can reach the PSF, wherever the centre will be found."""
    far = max(shape) if half is None else half + MARGIN + SEARCH
    y, x = (slice(max(i - far, 0), i + far + 1) for i in start)
    return y, x


def _background(
    background: float | str,
    pixels: Array,
    bad: Mask,
    start: Pixel,
    half: int | None,
) -> tuple[float, str]:
    if not isinstance(background, str):
        level = _one_number("background", background)
        return level, f"background: {level:g}, as given, subtracted"
    if background != "auto":
        raise InputError(f'background is {background!r}; give a number or "auto"')
    y, x = (np.abs(np.arange(n) - i) for n, i in zip(pixels.shape, start, strict=True))
    distance = np.maximum(y[:, None], x)
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


def _repair(
    light: Array, bad: Mask, saturated: Mask, region: tuple[slice, slice]
) -> tuple[Mask, str]:
    """Interpolate the bad pixels of a region in place; return those that are too far inside."""
    if not bad.any():
        return bad, "bad pixels: none"
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


def _stay(start: Pixel) -> tuple[Point, str]:
    y, x = start
    return (float(y), float(x)), f"centre: pixel {_at(start)}; not shifted"


def _centre(
    light: Array, region: tuple[slice, slice], start: Pixel, level: float
) -> tuple[Point, str]:
    """Return the centre of the star, to a part of a pixel."""
    origin = region[0].start, region[1].start
    (y, x), sigma = fit_gaussian(light[region], (start[0] - origin[0], start[1] - origin[1]), level)
    centre = float(y + origin[0]), float(x + origin[1])
    pixel = _nearest(centre)
    shift = pixel[0] - centre[0], pixel[1] - centre[1]
    return centre, (
        f"centre: x = {centre[1]:.3f}, y = {centre[0]:.3f}, FWHM {FWHM * sigma:.2f} pixels; "
        f"shifted by x {_plain(shift[1], 3)}, y {_plain(shift[0], 3)}"
    )


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


def _fit(shape: tuple[int, ...], pixel: Pixel, side: int | None, angle: float) -> int:
    """Return the side of the PSF: as asked for if the frame has it, or the largest there is."""
    largest = _largest(shape, pixel, angle)
    if largest < MIN_SIZE:
        raise InputError(f"the star at {_at(pixel)} is at the edge of the frame; give another")
    if side is None:
        return largest
    if side > largest:
        turned = f", rotated by {angle:g} degrees," if angle else ""
        raise InputError(
            f"a PSF of {side} x {side} pixels{turned} around the star at {_at(pixel)} reaches "
            f"beyond the frame; give a size of {largest} or less"
        )
    return side


def _cut(array: NDArray, pixel: Pixel, half: int) -> NDArray:
    """Return the square of this half width around a pixel, mirrored where the frame ends."""
    inside = tuple(slice(max(i - half, 0), i + half + 1) for i in pixel)
    missing = [
        (max(half - i, 0), max(i + half + 1 - n, 0))
        for i, n in zip(pixel, array.shape, strict=True)
    ]
    return np.pad(array[inside], missing, mode="symmetric")


def _middle(work: NDArray, side: int) -> NDArray:
    """Return the square of this side around the middle of one of odd side."""
    first = len(work) // 2 - side // 2
    return work[first : first + side, first : first + side]


def _rotate(work: Array, angle: float, radius: int) -> tuple[Array, str]:
    """Rotate about the middle; what it costs is measured within a radius."""
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


def _crop(work: Array, side: int, light: Array, pixel: Pixel, level: float) -> tuple[Array, str]:
    """Return the PSF, and which share of the flux it leaves out."""
    psf = _middle(work, side).copy()
    largest = _largest(light.shape, pixel, 0.0)
    y, x = (slice(i - largest // 2, i - largest // 2 + largest) for i in pixel)
    kept, whole = float(psf.sum()), float(light[y, x].sum())
    if not kept > 0:
        raise InputError(
            f"the flux of the PSF above the background {level:g} is {kept:g}; give another "
            "position or a lower background"
        )
    if side == largest:
        return psf, f"crop: {side} x {side} pixels, the largest square there is"
    left_out = _percent(1 - kept / whole) + " of the flux" if whole > 0 else "an unknown share"
    return psf, (
        f"crop: {side} x {side} pixels; {left_out} in the largest square there is, "
        f"{largest} x {largest}, left out"
    )


def _warn_of_guess(saturated: Mask, light: Array) -> None:
    if n_saturated := int(saturated.sum()):
        share = light[saturated].sum() / light.sum()
        warn(
            f"{n_saturated} saturated pixels of the PSF were repaired, and hold "
            f"{_percent(share)} of its flux: its core is a guess"
        )


def _warn_of_ringing(shares: Sequence[tuple[float, float]]) -> None:
    """Warn of the worst, of shares of the flux in negative pixels before and after."""
    before, after = max(shares, key=lambda share: share[1] - (1 + OF_NOISE) * share[0])
    if after > RINGING + (1 + OF_NOISE) * before:
        warn(
            f"shift and rotation ring: negative pixels hold {_percent(after)} of the flux, "
            f"{_percent(before)} before; the star is undersampled, and without recentring its "
            "pixels are left as they are"
        )


def _negative(psf: Array, clip: bool) -> tuple[Array, str]:
    negative = psf < 0
    share = _percent(psf[negative].sum() / psf.sum())
    what = "set to 0" if clip else "kept"
    line = f"negative pixels: {negative.sum()}, {share} of the flux; {what}"
    return (np.where(negative, 0.0, psf) if clip else psf), line


def _nearest(point: Point) -> Pixel:
    return math.floor(point[0] + 0.5), math.floor(point[1] + 0.5)


def _at(pixel: Pixel) -> str:
    return f"x = {pixel[1]}, y = {pixel[0]}"


def _plain(value: float, digits: int) -> str:
    """Return a number without a minus sign before zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _percent(share: float, digits: int = 2) -> str:
    return _plain(100 * float(share), digits) + " %"
