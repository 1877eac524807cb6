"""Pupils of telescopes, sampled for the PSFs that they make."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from astropy import units as u

from lnocl.core.scene.arrays import Array
from lnocl.errors import InputError
from lnocl.simulation.checks import check_shape, number, numbers, positive
from lnocl.simulation.telescope import APERTURE_DIAMETER, BASELINE, OBSCURATION_DIAMETER

# A pixel that an edge cuts is open by the share of its points inside, so many along an axis.
POINTS = 8


def circular_pupil(
    shape: tuple[int, int],
    wavelength: u.Quantity,
    pixel_scale: u.Quantity,
    diameter: u.Quantity,
    obscuration: u.Quantity = 0.0 * u.m,
    centres: Sequence[u.Quantity] = ((0.0, 0.0) * u.m,),
) -> Array:
    """Return the transmission of a pupil of circular apertures.

    It is for the parameter ``pupils`` of `lnocl.Observation`.

    A pixel is ``wavelength / (n pixel_scale)`` long, with n the PSF's pixels along the axis. The
    PSF without aberrations is then :math:`|F(P)|^2`, with light beyond its frame wrapped round.

    Parameters
    ----------
    shape : tuple of int
        Shape (ny, nx) of the PSF; each even and 32 or more.
    wavelength : Quantity
        A length, positive.
    pixel_scale : Quantity
        Angle per pixel of the PSF, positive.
    diameter : Quantity
        Diameter of each aperture, a length, positive.
    obscuration : Quantity, optional
        Diameter of the central obscuration of each aperture, zero or more and less than `diameter`.
    centres : Quantity, shape (n, 2), or sequence of Quantity, optional
        (x, y) of the apertures, lengths; by default one in the middle. Where apertures overlap the
        pupil is open.

    Returns
    -------
    ndarray of float64, shape (ny, nx)
        Transmission, 0 to 1: the share of each pixel that is open. The middle of the pupil is at
        ``(ny // 2, nx // 2)``.

    Raises
    ------
    InputError
        - An argument has the wrong shape or unit, or is out of range.
        - An aperture reaches beyond the frame, or all are too small for its pixels.

    References
    ----------
    Goodman, J. W., "Introduction to Fourier Optics", section 6.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulation import circular_pupil
    >>> pupil = circular_pupil((64, 64), 1 * u.um, 10 * u.mas, 8 * u.m)
    >>> bool(pupil[32, 32] == 1), bool(pupil[0, 0] == 0)
    (True, True)
    """
    ny, nx = check_shape(shape)
    length = positive("wavelength", wavelength, u.m)
    scale = positive("pixel_scale", pixel_scale, u.rad)
    outer = positive("diameter", diameter, u.m) / 2.0
    inner = number("obscuration", obscuration, u.m, 0.0) / 2.0
    if inner >= outer:
        raise InputError(f"obscuration must be less than diameter; {obscuration} was given")
    y, x = (length / scale * _points(n) for n in (ny, nx))
    pupil = np.zeros((ny * POINTS, nx * POINTS), bool)
    places = numbers("centres", centres, u.m)
    if places.shape[1:] != (2,):
        raise InputError(f"centres must be (x, y) of each aperture, (n, 2); {centres} was given")
    for at_x, at_y in places:
        if abs(at_x) + outer > x[-1] or abs(at_y) + outer > y[-1]:
            raise InputError(
                f"an aperture reaches beyond the frame of {2 * x[-1]:.3g} m: give finer pixels"
            )
        r = np.hypot(y[:, None] - at_y, x - at_x)
        pupil |= (r <= outer) & (r >= inner)
    if not pupil.any():
        raise InputError("no pixel of the pupil is open: give more of the centres or a diameter")
    return pupil.reshape(ny, POINTS, nx, POINTS).mean(axis=(1, 3))


def fizeau_pupil(
    shape: tuple[int, int], angle: u.Quantity, wavelength: u.Quantity, pixel_scale: u.Quantity
) -> Array:
    """Return the two apertures of the Large Binocular Telescope: those of `fizeau_psf`.

    They are sampled as `circular_pupil` samples them.

    Parameters
    ----------
    shape : tuple of int
        Shape (ny, nx) of the PSF; each even and 32 or more.
    angle : Quantity
        Angle of the baseline, from the x axis towards the y axis.
    wavelength : Quantity
        A length, positive.
    pixel_scale : Quantity
        Angle per pixel of the PSF, positive.

    Returns
    -------
    ndarray of float64, shape (ny, nx)
        Transmission, 0 to 1; the middle of the pupil is at ``(ny // 2, nx // 2)``.

    Raises
    ------
    InputError
        An argument has the wrong unit or is out of range, or an aperture lies beyond the frame.

    References
    ----------
    Hill, J. M., Green, R. F., Slagle, J. H., Proc. SPIE 6267, 62670Y (2006), for the telescope.

    Examples
    --------
    The middle between the apertures is dark, and their area is 110 m2:

    >>> import astropy.units as u
    >>> from lnocl.simulation import fizeau_pupil
    >>> pupil = fizeau_pupil((128, 128), 0 * u.deg, 2.12 * u.um, 5 * u.mas)
    >>> side = (2.12 * u.um / (128 * 5 * u.mas).to_value(u.rad)).to(u.m)
    >>> bool(pupil[64, 64] == 0), f"{pupil.sum() * side**2:.0f}"
    (True, '110 m2')
    """
    theta = number("angle", angle, u.rad)
    half = BASELINE / 2.0 * (math.cos(theta), math.sin(theta))
    apertures = APERTURE_DIAMETER, OBSCURATION_DIAMETER, (half, -half)
    return circular_pupil(shape, wavelength, pixel_scale, *apertures)


def _points(n: int) -> Array:
    """Return where the points in the pixels of an axis lie, 0 in the middle of pixel n // 2."""
    return ((np.arange(n * POINTS) + 0.5) / POINTS - 0.5 - n // 2) / n
