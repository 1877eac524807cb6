"""A point spread function from a frame of stars: repaired, centred, cropped, of unit sum.

Each step says in one line what it did; the record of `make_psf` holds these lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lnocl.core.scene.arrays import Array, Mask, flag, whole
from lnocl.core.scene.psfs import PSF_ERROR
from lnocl.core.scene.quantities import in_unit, split
from lnocl.core.scene.shifting import MARGIN
from lnocl.core.scene.transforms import enlarged
from lnocl.detection.checks import read_image
from lnocl.errors import InputError
from lnocl.psf import checks, effective, resampling, steps
from lnocl.psf.centring import Pixel, Point
from lnocl.psf.scatter import of_one


@dataclass(frozen=True)
class StarPsf:
    """A PSF made from a frame of stars, and the record of its making.

    Attributes
    ----------
    psf : ndarray of float64, shape (k, k)
        Point spread function of unit sum, the star's centre at ``(k // 2, k // 2)``.
    scatter : ndarray of float64, shape (k, k)
        Standard deviation of its pixels: noise, and how stars differ where there are several
        (`lnocl.psf.scatter`). `lnocl.Observation` takes it with the PSF.
    error : float
        Standard error of its width, relative to that: 0.03 by one star, less where several are
        alike (`lnocl.psf.scatter.width_error`). It is the `psf_error` of an observation.
    shared_steps : tuple of str
        One line for each step that PSFs at all angles share, in order, with its numbers.
    own_steps : tuple of str
        The same for the other steps. The light beyond the crop is what the edge of the PSF tells
        (`lnocl.core.scene.psf_edge`), as `lnocl.deconvolve` takes it.
    flux : float
        Flux of the PSF before it was normalised, in the unit of the frame; that of all its stars.
    centres : tuple of tuple of float
        Position of ``(k // 2, k // 2)`` in the frame for each star that was given or found by its
        brightness, not for neighbours: (x, y), 0-based pixels.
    background : float
        The level that was subtracted, in the unit of the frame.
    frame : ndarray of float64, shape (ny, nx)
        The frame as it was given; NaN where it was masked.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel was bad: not finite, masked or saturated.

    See Also
    --------
    make_psf : Returns it.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.psf import make_psf
    >>> y, x = np.mgrid[:40, :50]
    >>> frame = 100 + 5000 * np.exp(-((x - 23.3) ** 2 + (y - 18.8) ** 2) / 8)
    >>> star = make_psf(frame, size=21, background=100.0)
    >>> star.psf.shape, round(star.flux), star.background, star.scatter.shape
    ((21, 21), 125664, 100.0, (21, 21))
    """

    psf: Array
    scatter: Array
    error: float
    shared_steps: tuple[str, ...]
    own_steps: tuple[str, ...]
    flux: float
    centres: tuple[tuple[float, float], ...]
    background: float
    frame: Array
    bad: Mask

    @property
    def steps(self) -> tuple[str, ...]:
        """All steps, one line each: those that PSFs at all angles share, then the others.

        Examples
        --------
        >>> import numpy as np
        >>> from lnocl.psf import make_psf
        >>> y, x = np.mgrid[:40, :50]
        >>> frame = 5000 * np.exp(-((x - 23.3) ** 2 + (y - 18.8) ** 2) / 8)
        >>> make_psf(frame, size=21, background=0).steps[0]
        'star: brightest pixel of the median-filtered frame, x = 23, y = 19'
        """
        return self.shared_steps + self.own_steps

    @property
    def centre(self) -> tuple[float, float]:
        """The first star's centre, (x, y) in 0-based pixels of the frame.

        Examples
        --------
        >>> import numpy as np
        >>> from lnocl.psf import make_psf
        >>> y, x = np.mgrid[:40, :50]
        >>> frame = 5000 * np.exp(-((x - 23.3) ** 2 + (y - 18.8) ** 2) / 8)
        >>> [round(each, 3) for each in make_psf(frame, size=21, background=0).centre]
        [23.3, 18.8]
        """
        return self.centres[0]


def make_psf(
    frame: ArrayLike,
    position: ArrayLike | None = None,
    size: int | None = None,
    background: float | Literal["auto"] = "auto",
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    recentre: bool = True,
    clip_negative: bool = False,
    rotate: float = 0.0,
) -> StarPsf:
    r"""Return the point spread function that a frame of one star or several shows.

    .. math:: K(r) = \frac{f(c + R^{-1} r) - b}{\sum_{r'} (f(c + R^{-1} r') - b)}

    Here f is the frame, with its bad pixels interpolated, and b the background. The star's centre
    is c, the rotation R, and r runs over the k x k pixels around ``(k // 2, k // 2)``.

    Any frame of a star needs background and centring, so they are done unless they are declined.
    Cropping, clipping and rotating are done if asked for.

    Parameters
    ----------
    frame : array_like, shape (ny, nx)
        Image of a star, in any linear unit. A pixel that is not finite, or that is masked in a
        `numpy.ma` array or a CCDData, is bad. Other arguments must not be masked. Quantities are
        taken in the unit of the frame, in pixels and in degrees.
    position : array_like, shape (2,) or (n, 2), optional
        Position of the star, or of several: (x, y), 0-based pixels, to 5 pixels. By default the
        brightest pixel of the frame after a median filter of 3 x 3 good pixels.
    size : int, optional
        Side k of the PSF, pixels, 3 or more. By default the largest that the frame has around the
        star, at this rotation.
    background : float or "auto", optional
        Level to subtract, in the unit of the frame. "auto" is the median of the good pixels in a
        square ring, after clipping at 3 sigma. The ring is around the crop, or around those of all
        stars, and half as wide as the crop. Where it has fewer than 100 pixels, or no size is
        given, the frame's border is taken.
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
        Angle, degrees, from the x axis towards the y axis: counter-clockwise with y up. The PSF of
        a baseline at angle a becomes that of one at a + rotate. Multiples of 90 degrees are exact.

    Returns
    -------
    StarPsf
        The PSF and the steps.

    Raises
    ------
    InputError
        - An argument has the wrong type, shape or range, or, but for the frame, masked values.
        - The star is outside the frame or not found, or the crop does not fit in the frame.
        - All pixels are bad, or too few pixels of the star are good to repair the others.
        - Nothing is above the background.
        - A star has no good core, or no star shows the middle.

    Warns
    -----
    LnoclWarning
        - Saturated pixels of the PSF were repaired, which is a guess.
        - Bad pixels have too few good ones around them, and were set to the background.
        - An undersampled star rings.
        - Wings reach beyond the frame, and were taken for background.

    See Also
    --------
    make_psfs : Makes PSFs at several angles.
    examine : Checks a PSF.

    Notes
    -----
    **Bad pixels** are interpolated from the 48 nearest good ones by quintic radial functions. Some
    have fewer than 40 good ones in the square of side 11 around them, where all beyond the frame
    counts as bad. They are set to the background. In the wings a repaired pixel is as noisy as its
    neighbours or twice that. A repaired core is a guess, and a warning says so. This was measured
    in a Fizeau core with fringes 6 pixels apart:

    - One bad pixel is found to 0.02 % of the peak rms.
    - A block of 2 x 2 is found to 0.4 %, one of 3 x 3 to 2 %.
    - A core clipped at 0.7 (0.5) of the peak has 1 % (4 %) less flux than it should.
    - With fringes 3.4 pixels apart such a core has 16 % (34 %) less.

    **Wings** reach into the ring that the background is measured in. So all pixels from three
    widths on are fitted with a level and the wings of a Moffat function. Where the level is lower
    by five of its errors and 0.1 % of the flux it is taken, unless wings reach beyond the frame.

    **The centre** is that of the circular Gaussian that fits the star best by least squares,
    together with a constant and without the bad pixels. It is the centre of the light in the core,
    not the brightest pixel. Of a disc crossed by fringes it is the centre of the disc, wherever the
    fringes lie. So PSFs at several angles turn about the same point of the sky. Stars that are
    brighter within 12 pixels pull it away. The rms error in a coordinate was measured on Fizeau,
    Airy and Gaussian stars of 2 pixels (FWHM) and wider:

    - 0.004 pixels and less without noise;
    - 0.005 to 0.012 pixels with noise of 1/100 of the peak in each pixel;
    - 0.025 to 0.06 pixels with noise of 1/20.

    Without noise it is 0.002 pixels where the FWHM is 1.5, and 0.012 where it is 1.

    **The shift** to the middle of a pixel takes the star for a sum of Gaussians on its pixels
    (`lnocl.core.scene.shifting.place`). It is exact where the pixels sample the PSF, two to its
    FWHM and more. Below that it blurs, by 7 to 10 % of the peak at a FWHM of 1.5. It also rings
    where the star lies near the edge of a pixel. The table has the negative pixels of a Gaussian in
    65 x 65 pixels, after the worst of shifts and a quarter of a pixel from the middle.

    ==== ======================= ================= =======================
    FWHM darkest pixel, of peak, all of them, of   all of them, of flux,
         worst shift             flux, worst shift quarter of a pixel off
    ==== ======================= ================= =======================
    1    -8 %                    -26 %             -8 %
    1.5  -1.8 %                  -7.6 %            -1.2 %
    2    -0.38 %                 -1.6 %            -0.45 %
    2.5  -0.04 %                 -0.18 %           -0.05 %
    3    -0.003 %                -0.016 %          -0.004 %
    ==== ======================= ================= =======================

    A warning says so where negative pixels grow by more than 1 % of the flux. ``recentre=False``
    leaves the pixels as they are.

    **The rotation** is by three shears in Fourier space (Unser et al.). On a simulated Fizeau PSF
    at Nyquist's sampling it is right to 3e-5 of the peak. Cubic splines are right to 4e-2, quintic
    ones to 1.4e-2.

    **Several stars** give their effective PSF (Anderson & King 2000), by
    `lnocl.psf.effective.combine`. Moved to each star as `lnocl.deconvolve` moves it, this PSF
    explains all of them together. It has the noise of all stars together, and no blur by a shift,
    also where they are undersampled. Bad pixels are left to the other stars.

    **Neighbours** are modelled with the PSF: stars not given that lie three widths or more from the
    given ones, with a twentieth of the peak of one of them or more. Where several stars are given
    these alone make the PSF, so that a star with something round it can be left out; where one is
    given, its neighbours are taken with it.
    What the brightest given star, moved and scaled, does not explain is masked: galaxies, and stars
    too near to each other. So the PSF is the effective one wherever there are
    neighbours. This was measured with four stars of 3e4 to 2e5 electrons and FWHM 2.5. One had two
    bad pixels in its core and one a neighbour. Their PSF is right to 0.7 % of its peak, as noise
    allows.

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
    crop: 21 x 21 pixels; by its edge 0.01 +- 0.05 % of its light is beyond
    negative pixels: 0, 0.00 % of the flux; left as they are
    normalised: flux 125664 set to 1
    """
    (star,) = make_psfs(
        frame, [rotate], position, size, background, mask, saturation, recentre, clip_negative
    )
    return star


def make_psfs(
    frame: ArrayLike,
    rotate: Sequence[float],
    position: ArrayLike | None = None,
    size: int | None = None,
    background: float | Literal["auto"] = "auto",
    mask: ArrayLike | None = None,
    saturation: float | None = None,
    recentre: bool = True,
    clip_negative: bool = False,
) -> list[StarPsf]:
    """Return the PSFs that a frame of a star gives at several angles.

    Star, background, repair and centre are found once, so the PSFs differ in their angle only. With
    one angle this is `make_psf`.

    Parameters
    ----------
    frame : array_like, shape (ny, nx)
        Image of a star, as for `make_psf`.
    rotate : sequence of float
        Angles, degrees, as in `make_psf`. The four of the paper's baselines are 0, 45, 90, 135.
    position : array_like, shape (2,) or (n, 2), optional
        Position of the star, or of several, as for `make_psf`.
    size : int, optional
        Side of the PSFs, pixels. By default the largest that fits at all angles.
    background : float or "auto", optional
        Level to subtract, as for `make_psf`.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad.
    saturation : float, optional
        Pixels of this value, positive, and above are bad.
    recentre : bool, optional
        Whether to find the star's centre, as for `make_psf`.
    clip_negative : bool, optional
        Whether to set negative pixels to 0, as for `make_psf`.

    Returns
    -------
    list of StarPsf
        One for each angle, all of one shape; their steps begin with the same lines.

    Raises
    ------
    InputError
        As `make_psf`; or `rotate` is empty.

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
    frame, unit = split("frame", frame)
    if saturation is not None:
        saturation = in_unit("saturation", saturation, unit or "")
    if not isinstance(background, str):
        background = in_unit("background", background, unit or "")
    given, bad = read_image("frame", frame, mask)
    side = None if size is None else whole("size", size, checks.MIN_SIZE)
    angles = checks.wrapped_angles(rotate)
    recentre, clip_negative = flag("recentre", recentre), flag("clip_negative", clip_negative)
    # A repaired pixel takes nothing from its value, however far beyond the level that is.
    pixels = np.where(bad, 0.0, np.minimum(given, checks.saturation_level(saturation)))
    if bad.all() or (pixels[~bad] >= checks.saturation_level(saturation)).all():
        raise InputError("all pixels of the frame are bad; give a frame that shows a star")
    half = None if side is None else max(resampling.reach(side, angle) for angle in angles)

    places, found = steps.find_stars(pixels, bad, position)
    saturated, rays = steps.find_defects(pixels, bad, places, saturation)
    unusable = bad | saturated | rays
    level, measured = steps.measure_background(background, pixels, unusable, places, half)
    light = np.where(unusable, 0.0, pixels - level)
    region = steps.reachable(pixels.shape, places, half)
    unrepairable, repaired = steps.repair_bad(light, unusable, saturated, region)
    centres, shift, centred, width = steps.find_centres(light, unusable, places, level, recentre)
    middles = [steps.nearest_pixel(centre) for centre in centres]
    side = min(steps.fitting_side(given.shape, middles, side, angle) for angle in angles)
    if len(middles) == 1:
        (pixel,) = middles
        steps.refuse_hole(unrepairable, pixel)
    combined: tuple[str, ...] = ()
    error = PSF_ERROR
    far = max(resampling.reach(side, angle) for angle in angles) + MARGIN
    lowered, others = list[str](), list[str]()
    if width:
        more, masked, others = steps.find_neighbours(light, unusable, centres, width, far)
        centres = [*centres, *more]
        if isinstance(background, str):
            before = level
            level, lowered = steps.lower_background(level, light, unusable, centres, width, side)
            light = np.where(unrepairable, 0.0, light + before - level)
    if len(middles) == 1:
        steps.warn_of_guess(saturated, light, pixel, side)
    if len(centres) > 1 or others:
        hidden = masked | (unusable if len(centres) > 1 else unrepairable)
        stars = effective.combine(light, hidden, centres, far, len(middles))
        centres = [(star.y, star.x) for star in stars.stars[: len(middles)]]
        flux = sum(star.flux for star in stars.stars)
        light, pixel, shift = flux * stars.psf, (far, far), None
        scatter, error = flux * stars.scatter, stars.error
        combined = (*others, *effective.lines(stars))
    else:
        scatter = of_one(light, unusable, pixel, far)
    squares = [
        _make_square(light, pixel, shift, side, angle, level, clip_negative) for angle in angles
    ]
    steps.warn_of_ringing([square.negative_shares for square in squares])
    return [
        StarPsf(
            square.psf / square.flux,
            _turn_scatter(scatter, side, angle) / square.flux,
            error,
            (*found, measured, *lowered, repaired, *centred, *combined),
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
    return enlarged(turned, (side, side), is_centred=True).clip(min=0.0)


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
    work = before = steps.cut_square(light, pixel, resampling.reach(side, angle) + MARGIN)
    if shift is not None:
        work = resampling.shift(work, shift)
    if angle:
        work, line = steps.rotate_square(work, angle, side // 2)
        lines.append(line)
    psf, line = steps.crop_square(work, side, light, pixel, level)
    lines.append(line)
    before = enlarged(before, (side, side), is_centred=True)
    negative_shares = steps.negative_shares(before, psf)
    psf, line = steps.count_negative(psf, clip_negative)
    flux = float(psf.sum())
    normalised = f"normalised: flux {flux:.6g} set to 1"
    return _Square(psf, flux, negative_shares, (*lines, line, normalised))
