"""A point spread function from a frame of stars: repaired, centred, cropped, of unit sum.

Each step says in one line what it did; the record of `make_psf` holds these lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.errors import InputError
from lnocl.psf import checks, effective, resampling, steps
from lnocl.psf.centring import Mask, Pixel, Point

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StarPsf:
    """A PSF made from a frame of stars, and the record of its making.

    Attributes
    ----------
    psf : ndarray of float64, shape (k, k)
        Point spread function of unit sum, the star's centre at ``(k // 2, k // 2)``.
    scatter : ndarray of float64, shape (k, k), or None
        By how much the stars differ from it: the standard deviation of their own PSFs, weighted by
        flux, noise included. None where it is made of one star.
    shared_steps, own_steps : tuple of str
        One line for each step, in order, with its numbers: those that PSFs at all angles share,
        and the others. The flux left out of the crop is measured with the noise of all pixels of
        that square.
    flux : float
        Flux of the PSF before it was normalised, in the unit of the frame; that of all its stars.
    centres : tuple of tuple of float
        Position of ``(k // 2, k // 2)`` in the frame for each star: (x, y), 0-based pixels.
    background : float
        The level that was subtracted, in the unit of the frame.
    frame : ndarray of float64, shape (ny, nx)
        The frame as it was given; NaN where it was masked.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel was bad: not finite, masked or saturated.
    """

    psf: Array
    scatter: Array | None
    shared_steps: tuple[str, ...]
    own_steps: tuple[str, ...]
    flux: float
    centres: tuple[tuple[float, float], ...]
    background: float
    frame: Array
    bad: Mask

    @property
    def steps(self) -> tuple[str, ...]:
        """All steps."""
        return self.shared_steps + self.own_steps

    @property
    def centre(self) -> tuple[float, float]:
        """The first star's centre."""
        return self.centres[0]


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
    r"""Return the point spread function that a frame of one star or several shows.

    .. math:: K(r) = \frac{f(c + R^{-1} r) - b}{\sum_{r'} (f(c + R^{-1} r') - b)}

    with the frame f, its bad pixels interpolated, the background b, the star's centre c and the
    rotation R; r runs over the k x k pixels around ``(k // 2, k // 2)``.

    **Bad pixels** are interpolated from the `NEIGHBOURS` nearest good ones by quintic radial
    functions. In a Fizeau core with fringes 6 pixels apart, one bad pixel is found to 0.02 % of
    the peak rms, a block of 2 x 2 to 0.4 %, of 3 x 3 to 2 %, and a core clipped at 0.7 (0.5) of
    the peak has 1 % (4 %) less flux than it should; with fringes 3.4 pixels apart 16 % (34 %): a
    repaired core is a guess, and a warning says so. In the wings a repaired pixel is as noisy as
    its neighbours or twice that. Bad pixels with fewer than `MIN_GOOD` good ones in the square of
    side `WINDOW` around them, where all beyond the frame counts as bad, are set to the background.

    **The centre** is that of the circular Gaussian that fits the star best by least squares,
    together with a constant and without the bad pixels. It is not the brightest pixel: it is the
    centre of the light in the core, and of a disc crossed by fringes it is the centre of the disc,
    wherever the fringes lie, so PSFs at several angles turn about the same point of the sky. Rms
    error in a coordinate, on Fizeau, Airy and Gaussian stars of 2 pixels (FWHM) and wider: 0.004
    pixels and less without noise, 0.005 to 0.012 with noise of 1/100 of the peak in each pixel,
    0.025 to 0.06 with 1/20. Without noise it is 0.002 where the FWHM is 1.5, and 0.012 where it
    is 1. Stars that are brighter within 12 pixels pull it away.

    **The shift** to the middle of a pixel takes the star for a sum of Gaussians on its pixels
    (`lnocl.scene.shifting.place`). It is exact where the pixels sample the PSF, two to its FWHM
    and more. Below that it blurs, by 7 to 10 % of the peak at a FWHM of 1.5, and it rings where
    the star lies near the edge of a pixel: the darkest pixel of a Gaussian of FWHM 1, 1.5, 2, 2.5,
    3 pixels has -8, -1.8, -0.38, -0.04, -0.003 % of its peak after the worst of shifts, and all
    negative ones of 65 x 65 have -26, -7.6, -1.6, -0.18, -0.016 % of its flux. A quarter of a
    pixel from the middle these are -8, -1.2, -0.45, -0.05, -0.004 %. Where negative pixels grow by
    more than `RINGING` a warning says so. ``recentre=False`` leaves the pixels as they are.

    **The rotation** is by three shears in Fourier space (Unser et al.), which on a simulated
    Fizeau PSF at Nyquist's sampling is right to 3e-5 of the peak, where cubic splines are to 4e-2
    and quintic ones to 1.4e-2.

    **Several stars** give their effective PSF (Anderson & King 2000), by `effective.combine`: the
    one that, moved to each of them as `lnocl.deconvolve` moves it, explains all of them together.
    It has their noise together, no blur by a shift, also where they are undersampled, and no
    neighbours: those in the list are modelled, others are masked where one star shows them and
    another does not. Bad pixels are left to the other stars. Of four stars of 3e4 to 2e5 electrons,
    FWHM 2.5, one with two bad pixels in its core and one with a neighbour, the PSF is right to
    0.7 % of its peak, as noise allows; that of the brightest to 13 %, as it has the neighbour.

    Background and centring are the steps that any frame of a star needs, so they are done unless
    they are declined; cropping, clipping and rotating are choices, done if asked for.

    Parameters
    ----------
    frame : array_like, shape (ny, nx)
        Image of a star, in any linear unit. A pixel that is not finite, or that is masked in a
        `numpy.ma` array or a CCDData, is bad. Other arguments must not be masked.
    position : array_like, shape (2,) or (n, 2), optional
        Position of the star, or of several: (x, y), 0-based pixels, to `NEAR` pixels. By default
        the brightest pixel of the frame after a median filter of 3 x 3 good pixels.
    size : int, optional
        Side k of the PSF, pixels, 3 or more. By default the largest that the frame has around
        the star, at this rotation.
    background : float or "auto", optional
        Level to subtract, in the unit of the frame. "auto" is the median of the good pixels, after
        clipping at 3 sigma, in a square ring around the crop, half as wide as it, or around those
        of all stars; in the frame's border where fewer than `MIN_SKY` are there, or where no size
        is given.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad.
    saturation : float, optional
        Pixels of this value, positive, and above are bad.
    recentre : bool, optional
        Whether to find the star's centre and to shift it to the middle of a pixel. Otherwise the
        pixel at `position` is moved as it is. Several stars must be recentred.
    clip_negative : bool, optional
        Whether to set negative pixels to 0; the flux of the PSF grows by their flux.
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
        values; where the star is outside the frame or not found; where the crop does not fit in
        the frame; where all pixels are bad; where too few pixels of the star are good to repair
        the others; where nothing is above the background; where a star has no good core, or no
        star shows the middle.

    Warns
    -----
    LnoclWarning
        Saturated pixels in the PSF, whose repair is a guess; bad pixels with too few good ones
        around them, which were set to the background; ringing of an undersampled star.

    References
    ----------
    M. Unser, P. Thévenaz, L. Yaroslavsky, IEEE Trans. Image Process. 4, 1371 (1995), for rotation
    by shears. J. Anderson, I. R. King, PASP 112, 1360 (2000), for effective PSFs.

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
    bad pixels: 0 in the frame
    centre: x = 23.300, y = 18.800, FWHM 4.71 pixels; shifted by x -0.300, y 0.200
    crop: 21 x 21 pixels; 0.00 % of the flux in the largest square there is, 39 x 39, left out
    negative pixels: 0, 0.00 % of the flux; left as they are
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
        As `make_psf`; where `rotate` is empty.

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
    """Return the PSFs at all angles; the arguments are those of `make_psfs`."""
    given, bad = checks.read_frame(frame, mask)
    saturated = ~bad & (given >= checks.saturation_level(saturation))
    unusable = bad | saturated
    side, angles = checks.whole_size(size), checks.wrapped_angles(rotate)
    checks.refuse_unless_bool(recentre=recentre, clip_negative=clip_negative)
    if unusable.all():
        raise InputError("all pixels of the frame are bad; give a frame that shows a star")
    # A repaired pixel takes nothing from its value, however far beyond the level that is.
    pixels = np.where(bad, 0.0, np.minimum(given, checks.saturation_level(saturation)))
    half = None if side is None else max(resampling.reach(side, angle) for angle in angles)

    places, found = steps.find_stars(pixels, bad, position)
    level, measured = steps.measure_background(background, pixels, unusable, places, half)
    light = np.where(unusable, 0.0, pixels - level)
    region = steps.reachable(pixels.shape, places, half)
    unrepairable, repaired = steps.repair_bad(light, unusable, saturated, region)
    centres, shift, centred = steps.find_centres(light, unusable, places, level, recentre)
    middles = [steps.nearest_pixel(centre) for centre in centres]
    side = min(
        steps.fitting_side(given.shape, pixel, side, angle) for angle in angles for pixel in middles
    )
    scatter: Array | None = None
    combined: tuple[str, ...] = ()
    if len(middles) == 1:
        (pixel,) = middles
        steps.refuse_hole(unrepairable, pixel)
        steps.warn_of_guess(saturated, light, pixel, side)
    else:
        far = max(resampling.reach(side, angle) for angle in angles) + steps.MARGIN
        stars = effective.combine(light, unusable, centres, far)
        centres = [(star.y, star.x) for star in stars.stars]
        flux = sum(star.flux for star in stars.stars)
        light, scatter, pixel, shift = flux * stars.psf, flux * stars.scatter, (far, far), None
        combined = effective.lines(stars)
    squares = [
        _make_square(light, pixel, shift, side, angle, level, clip_negative) for angle in angles
    ]
    steps.warn_of_ringing([square.negative_shares for square in squares])
    return [
        StarPsf(
            square.psf / square.flux,
            None if scatter is None else _turn_scatter(scatter, side, angle) / square.flux,
            (*found, measured, repaired, *centred, *combined),
            square.lines,
            square.flux,
            tuple((x, y) for y, x in centres),
            level,
            given,
            unusable,
        )
        for square, angle in zip(squares, angles, strict=True)
    ]


def _turn_scatter(scatter: Array, side: int, angle: float) -> Array:
    turned = resampling.rotate(scatter, angle) if angle else scatter
    return steps.middle_square(turned, side).clip(min=0.0)


class _Square(NamedTuple):
    """A PSF at one angle, its flux, its negative shares before and after, and its lines."""

    psf: Array
    flux: float
    negative_shares: tuple[float, float]
    lines: tuple[str, ...]


def _make_square(
    light: Array,
    pixel: Pixel,
    shift: Point | None,
    side: int,
    angle: float,
    level: float,
    clip_negative: bool,
) -> _Square:
    lines = []
    work = before = steps.cut_square(light, pixel, resampling.reach(side, angle) + steps.MARGIN)
    if shift is not None:
        work = resampling.shift(work, shift)
    if angle:
        work, line = steps.rotate_square(work, angle, side // 2)
        lines.append(line)
    psf, line = steps.crop_square(work, side, light, pixel, level)
    lines.append(line)
    negative_shares = steps.negative_shares(steps.middle_square(before, side), psf)
    psf, line = steps.count_negative(psf, clip_negative)
    flux = float(psf.sum())
    normalised = f"normalised: flux {flux:.6g} set to 1"
    return _Square(psf, flux, negative_shares, (*lines, line, normalised))
