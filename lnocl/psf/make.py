"""A point spread function from a frame of a star: repaired, centred, cropped, of unit sum.

Each step says in one line what it did; the record of `make_psf` holds these lines.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.stats import sigma_clipped_stats
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import InputError, warn
from lnocl.psf import resampling
from lnocl.psf.centring import FWHM, SEARCH, Mask, Pixel, Point, brightest, fit_gaussian
from lnocl.psf.repair import WINDOW, repair
from lnocl.scene.observation import numbers, unmasked, values_and_mask

Array = NDArray[np.float64]

MIN_SIZE = 3
# The first steps, which do not depend on the angle: star, background, bad pixels, centre.
N_SHARED_STEPS = 4
# Pixels kept around the crop while it is shifted and rotated, since Fourier shifts wrap.
MARGIN = 16
# Pixels that a background is measured from, at least.
MIN_SKY = 100
# Width of the frame's border, as a share of the shorter side.
BORDER = 1 / 16
# By how much a shift or a rotation may make negative pixels grow without a warning: a share of the
# flux, and of what they were, since noise is not what it was after either.
RINGING, OF_NOISE = 0.01, 0.2
# Values beyond this have no finite variance in float64.
LARGEST = 1e150


@dataclass(frozen=True)
class StarPsf:
    """A PSF made from a frame of a star, and how it was made.

    Attributes
    ----------
    psf : ndarray of float64, shape (k, k)
        Point spread function of unit sum, the star's centre at ``(k // 2, k // 2)``.
    steps : tuple of str
        What was done, one line for each step, in order, with its numbers. The flux left out of
        the crop is measured with the noise of all pixels of that square.
    flux : float
        Flux of the PSF before it was normalised, in the unit of the frame.
    centre : tuple of float
        Where ``(k // 2, k // 2)`` lies in the frame: (x, y), 0-based pixels.
    background : float
        What was subtracted, in the unit of the frame.
    frame : ndarray of float64, shape (ny, nx)
        The frame as it was given; NaN where it was masked.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel was bad: not finite, masked or saturated.
    """

    psf: Array
    steps: tuple[str, ...]
    flux: float
    centre: tuple[float, float]
    background: float
    frame: Array
    bad: Mask


def make_psf(
    frame: ArrayLike,
    position: ArrayLike | None = None,
    size: int | None = None,
    background: float | str = "auto",
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    recentre: bool = True,
    clip_negative: bool = False,
    rotate: float = 0.0,
) -> StarPsf:
    r"""Return the point spread function that a frame of a star shows.

    .. math:: K(r) = \frac{f(c + R^{-1} r) - b}{\sum_{r'} (f(c + R^{-1} r') - b)}

    with the frame f, its bad pixels interpolated, the background b, the star's centre c and the
    rotation R; r runs over the k x k pixels around ``(k // 2, k // 2)``.

    **Bad pixels** are interpolated from the `NEIGHBOURS` nearest good ones by quintic radial
    functions. In a Fizeau core with fringes 6 pixels apart, one bad pixel is found to 0.02 % of
    the peak rms, a block of 2 x 2 to 0.4 %, of 3 x 3 to 2 %, and what was clipped at 0.7 (0.5) of
    the peak has 1 % (4 %) less flux than it should; with fringes 3.4 pixels apart 16 % (34 %): a
    repaired core is a guess, and a warning says so. In the wings a repaired pixel is as noisy as
    its neighbours or twice that. Bad pixels with fewer than `MIN_GOOD` good ones in the square of
    side `WINDOW` around them, where all beyond the frame counts as bad, are set to the background.

    **The centre** is that of the circular Gaussian that fits the star best by least squares
    (adaptive moments). It is not the brightest pixel: it is the centre of the light in the core,
    and of a disc crossed by fringes it is the centre of the disc, wherever the fringes lie, so
    PSFs at several angles turn about the same point of the sky. Rms error in a coordinate, on
    Fizeau, Airy and Gaussian stars of 2 pixels (FWHM) and wider: 0.004 pixels and less without
    noise, 0.007 to 0.015 with noise of 1/100 of the peak in each pixel, 0.03 to 0.08 with 1/20.
    Without noise it is 0.02 where the FWHM is 1.5, and 0.05 where it is 1.

    **The shift** to the middle of a pixel is by the phase of the Fourier transform: exact where
    the pixels sample the PSF, two to its FWHM and more. Where they do not it rings: the darkest
    pixel of a Gaussian of FWHM 1, 1.5, 2, 2.5, 3 pixels has -8, -1.6, -0.4, -0.05, -0.004 % of
    its peak after the worst of shifts, and all negative ones of 65 x 65 have -50, -14, -2.4, -0.3,
    -0.02 % of its flux. Where negative pixels grow by more than `RINGING` a warning says so.
    ``recentre=False`` leaves the pixels as they are.

    **The rotation** is by three shears in Fourier space (Unser et al.), which on a simulated
    Fizeau PSF at Nyquist's sampling is right to 3e-5 of the peak, where cubic splines are to 4e-2
    and quintic ones to 1.4e-2.

    Background and centring are the steps that any frame of a star needs, so they are done unless
    they are declined; cropping, clipping and rotating are choices, done if asked for.

    Parameters
    ----------
    frame : array_like, shape (ny, nx)
        Image of a star, in any linear unit. A pixel that is not finite, or that is masked in a
        `numpy.ma` array or a CCDData, is bad. Nothing else may be masked.
    position : tuple of float, optional
        Where the star is: (x, y), 0-based pixels, to `SEARCH` pixels. By default at the brightest
        pixel of the frame after a median filter of 3 x 3 good pixels.
    size : int, optional
        Side k of the PSF, pixels, 3 or more. By default the largest that the frame has around
        the star, at this rotation.
    background : float or "auto", optional
        What to subtract, in the unit of the frame. "auto" is the median of the good pixels, after
        clipping at 3 sigma, in a square ring around the crop, half as wide as it; in the frame's
        border where fewer than `MIN_SKY` are there, or where no size is given.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad.
    saturation : float, optional
        Pixels of this value, positive, and above are bad.
    recentre : bool, optional
        Whether to find the star's centre and to shift it to the middle of a pixel. Otherwise the
        pixel at `position` is moved as it is.
    clip_negative : bool, optional
        Whether to set negative pixels to 0; the flux of the PSF grows by what they held.
    rotate : float, optional
        Angle, degrees, from the x axis towards the y axis: counter-clockwise with y up. The PSF
        of a baseline at angle a becomes that of one at a + rotate. Multiples of 90 degrees are
        exact.

    Returns
    -------
    StarPsf
        The PSF and the steps.

    Raises
    ------
    InputError
        Where an argument has the wrong type, shape or range, or, but for the frame, holds masked
        values; where the star is outside the frame
        or not found; where the crop does not fit in the frame; where no good pixel is left;
        where the star is a hole too wide to be repaired; where nothing is above the
        background.

    Warns
    -----
    LnoclWarning
        Saturated pixels in the PSF, whose repair is a guess; bad pixels too far from good ones
        that were set to the background; ringing where the star is undersampled.

    References
    ----------
    G. M. Bernstein, M. Jarvis, AJ 123, 583 (2002), for adaptive moments; M. Unser, P. Thévenaz,
    L. Yaroslavsky, IEEE Trans. Image Process. 4, 1371 (1995), for rotation by shears.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.psf import make_psf
    >>> y, x = np.mgrid[:40, :50]
    >>> frame = 100 + 5000 * np.exp(-((x - 23.3) ** 2 + (y - 18.8) ** 2) / 8)
    >>> star = make_psf(frame, size=21, background=100.0)
    >>> print(*star.steps, sep="\n")
    star: brightest pixel of the median-filtered frame, x = 23, y = 19
    background: 100, as given, subtracted
    bad pixels: none
    centre: x = 23.300, y = 18.800, FWHM 4.71 pixels; shifted by x -0.300, y 0.200
    crop: 21 x 21 pixels; 0.00 % of the flux in the largest square there is, 39 x 39, left out
    negative pixels: 0, 0.00 % of the flux; kept
    normalised: flux 125664 set to 1
    """
    (star,) = _make(
        frame, position, size, background, mask, saturation, recentre, clip_negative, [rotate]
    )
    return star


def make_psfs(
    frame: ArrayLike,
    rotate: Sequence[float],
    position: ArrayLike | None = None,
    size: int | None = None,
    background: float | str = "auto",
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    recentre: bool = True,
    clip_negative: bool = False,
) -> list[StarPsf]:
    """Return the PSFs that a frame of a star gives at several angles.

    Star, background, repair and centre are found once, so the PSFs differ in their angle only.
    With one angle this is `make_psf`.

    Parameters
    ----------
    rotate : sequence of float
        Angles, degrees, as in `make_psf`. The four of the paper's baselines are 0, 45, 90, 135.
    frame, position, size, background, mask, saturation, recentre, clip_negative
        As in `make_psf`. The size, or the largest there is, is that which fits at all angles.

    Returns
    -------
    list of StarPsf
        One for each angle, all of one shape; their steps begin with the same lines.

    Raises
    ------
    InputError
        As `make_psf`; where there is no angle.

    Warns
    -----
    LnoclWarning
        As `make_psf`, once for all angles.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.psf import make_psfs
    >>> y, x = np.mgrid[:40, :50]
    >>> frame = np.exp(-((x - 23.3) ** 2 / 8 + (y - 18.8) ** 2 / 32))
    >>> stars = make_psfs(frame, [0, 90], size=21, background=0)
    >>> np.abs(stars[1].psf - stars[0].psf.T).max() < 1e-7
    np.True_
    """
    return _make(
        frame, position, size, background, mask, saturation, recentre, clip_negative, rotate
    )


def _make(
    frame: ArrayLike,
    position: ArrayLike | None,
    size: int | None,
    background: float | str,
    mask: ArrayLike | None,
    saturation: float | None,
    recentre: bool,
    clip_negative: bool,
    rotate: Sequence[float],
) -> list[StarPsf]:
    given, bad = _read(frame, mask)
    saturated = ~bad & (given >= _saturation(saturation))
    # A repaired pixel takes nothing from its value, however far beyond the level that is.
    pixels = np.where(bad, 0.0, np.minimum(given, _saturation(saturation)))
    side, angles = _size(size), [_angle(angle) for angle in rotate]
    for name, flag in (("recentre", recentre), ("clip_negative", clip_negative)):
        if not isinstance(flag, bool | np.bool_):
            raise InputError(f"{name} is {flag!r}; give True or False")
    if not angles:
        raise InputError("rotate holds no angle; give one or more")
    unusable = bad | saturated
    if unusable.all():
        raise InputError("all pixels of the frame are bad; there is no star to be seen")
    steps = []

    start, line = _find(pixels, bad, position)
    steps.append(line)
    half = None if side is None else max(resampling.reach(side, angle) for angle in angles)
    level, line = _background(background, pixels, unusable, start, half)
    steps.append(line)
    light = np.where(unusable, 0.0, pixels - level)
    region = _region(pixels.shape, start, half)
    unrepairable, line = _repair(light, unusable, saturated, region)
    steps.append(line)
    centre, line = _centre(light, region, start, level) if recentre else _stay(start)
    steps.append(line)
    pixel = _nearest(centre)
    side = min(_fit(given.shape, pixel, side, angle) for angle in angles)
    if unrepairable[pixel]:
        raise InputError(
            f"the star at {_at(pixel)} is a hole: only few of the {WINDOW} x {WINDOW} pixels "
            "there are good; take a frame with a shorter exposure"
        )
    by = (pixel[0] - centre[0], pixel[1] - centre[1]) if recentre else None
    stars, rung = [], []
    for angle in angles:
        psf, share, lines = _turn(light, pixel, by, side, angle, level, clip_negative)
        rung.append(share)
        flux = float(psf.sum())
        lines = [*steps, *lines, f"normalised: flux {flux:.6g} set to 1"]
        at = centre[1], centre[0]
        stars.append(StarPsf(psf / flux, tuple(lines), flux, at, level, given, unusable))
    _warn_of_guess(_cut(saturated, pixel, side // 2), _cut(light, pixel, side // 2))
    _warn_of_ringing(rung)
    return stars


def _turn(
    light: Array,
    pixel: Pixel,
    by: Point | None,
    side: int,
    angle: float,
    level: float,
    clip_negative: bool,
) -> tuple[Array, tuple[float, float], list[str]]:
    """Return the PSF at an angle, the negative share of its flux before and after, and lines."""
    lines = []
    work = before = _cut(light, pixel, resampling.reach(side, angle) + MARGIN)
    if by is not None:
        work = resampling.shift(work, by)
    if angle:
        work, line = _rotate(work, angle, side // 2)
        lines.append(line)
    psf, line = _crop(work, side, light, pixel, level)
    lines.append(line)
    share = [float(-image.clip(max=0).sum() / psf.sum()) for image in (_middle(before, side), psf)]
    psf, line = _negative(psf, clip_negative)
    return psf, (share[0], share[1]), [*lines, line]


def _read(frame: ArrayLike, mask: ArrayLike | None) -> tuple[Array, Mask]:
    """Return a float64 copy with NaN where it is bad, and where that is."""
    given, masked = values_and_mask("frame", frame)
    pixels = numbers("frame", given)
    if pixels.ndim != 2 or pixels.size == 0:
        raise InputError(f"frame has shape {pixels.shape}; give one image, (ny, nx)")
    bad = ~np.isfinite(pixels) | masked
    if mask is not None:
        more = unmasked("mask", mask)
        if more.dtype != np.bool_:
            raise InputError(
                f"mask is of type {more.dtype}; give booleans, True where a pixel is bad"
            )
        if more.shape != pixels.shape:
            raise InputError(f"mask has shape {more.shape}; the frame has {pixels.shape}")
        bad |= more
    pixels[bad] = np.nan
    if (np.abs(pixels) > LARGEST).any():
        raise InputError(f"frame holds values beyond {LARGEST:g}; give it in another unit")
    return pixels, bad


def _one_number(name: str, value: object) -> float:
    array = numbers(name, value)  # type: ignore[arg-type]
    if array.ndim or not np.isfinite(array):
        raise InputError(f"{name} is {value!r}; give one finite number")
    return float(array)


def _saturation(saturation: float | None) -> float:
    if saturation is None:
        return math.inf
    level = _one_number("saturation", saturation)
    if level <= 0:
        raise InputError(f"saturation must be positive; {level:g} was given")
    return level


def _size(size: int | None) -> int | None:
    if size is None:
        return None
    try:
        side = operator.index(size)
    except TypeError:
        side = 0
    if side < MIN_SIZE or isinstance(size, bool | np.bool_):
        raise InputError(f"size must be a whole number of {MIN_SIZE} or more; {size!r} was given")
    return side


def _angle(rotate: float) -> float:
    """Return the angle in [-180, 180], degrees."""
    return math.remainder(_one_number("rotate", rotate), 360)


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
