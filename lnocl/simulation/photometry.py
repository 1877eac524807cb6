"""Photons and electrons of a magnitude."""

from __future__ import annotations

import math

from astropy import constants
from astropy import units as u

from lnocl.errors import InputError
from lnocl.simulation.checks import check_share, number, positive

MAG_PER_ARCSEC2 = u.mag / u.arcsec**2
PHOTON_RATE = u.photon / u.s / u.m**2


def photon_rate(
    magnitude: u.Quantity, zero_point: u.Quantity, wavelength: u.Quantity, bandwidth: u.Quantity
) -> u.Quantity:
    r"""Return the photons that arrive per second and square metre from a source.

    .. math:: \frac{F_0}{h} \frac{\Delta\lambda}{\lambda} 10^{-0.4 m}

    for a narrow band of width Δλ at λ, with the zero point F_0 and the magnitude m.

    Parameters
    ----------
    magnitude : Quantity
        In mag, finite.
    zero_point : Quantity
        Flux density of magnitude 0 per unit frequency, such as Jy; positive.
    wavelength : Quantity
        Of the band, a length, positive.
    bandwidth : Quantity
        Of the band, a length, positive.

    Returns
    -------
    Quantity
        In photon / (s m2).

    Raises
    ------
    InputError
        An argument has the wrong unit or is out of its range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulation import photon_rate
    >>> print(f"{photon_rate(13 * u.mag, 666.7 * u.Jy, 2.12 * u.um, 0.02 * u.um):.1f}")
    598.9 ph / (s m2)
    """
    flux_density = positive("zero_point", zero_point, u.Jy) * u.Jy
    width = positive("bandwidth", bandwidth, u.m) / positive("wavelength", wavelength, u.m)
    try:
        dimming = 10 ** (-0.4 * number("magnitude", magnitude, u.mag))
    except OverflowError:
        raise InputError(f"magnitude {magnitude} is too bright for any number") from None
    return (flux_density / constants.h * width * dimming * u.photon).to(PHOTON_RATE)


def pixel_magnitude(surface_brightness: u.Quantity, pixel_scale: u.Quantity) -> u.Quantity:
    """Return the magnitude of one square pixel of a surface brightness.

    ``m = S - 2.5 log10(pixel_scale^2 / arcsec^2)`` for the surface brightness S.

    Parameters
    ----------
    surface_brightness : Quantity
        In mag / arcsec2, finite.
    pixel_scale : Quantity
        Angle per pixel, positive.

    Returns
    -------
    Quantity
        In mag.

    Raises
    ------
    InputError
        An argument has the wrong unit or is out of its range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulation import pixel_magnitude
    >>> print(f"{pixel_magnitude(13.5 * u.mag / u.arcsec**2, 5 * u.mas):.3f}")
    25.005 mag
    """
    side = positive("pixel_scale", pixel_scale, u.arcsec)
    brightness = number("surface_brightness", surface_brightness, MAG_PER_ARCSEC2)
    return (brightness - 5 * math.log10(side)) * u.mag


def electrons(
    rate: u.Quantity, area: u.Quantity, throughput: float, exposure_time: u.Quantity
) -> u.Quantity:
    """Return the electrons that a photon rate leaves on the detector.

    ``rate * area * throughput * exposure_time``

    Parameters
    ----------
    rate : Quantity
        In photon / (s m2), zero or more.
    area : Quantity
        Collecting area, positive.
    throughput : float
        Electrons per photon that reaches the telescope, in (0, 1].
    exposure_time : Quantity
        A time, positive.

    Returns
    -------
    Quantity
        In electrons.

    Raises
    ------
    InputError
        An argument has the wrong unit or is out of its range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulation import electrons
    >>> print(electrons(2 * u.photon / u.s / u.m**2, 100 * u.m**2, 0.5, 1 * u.min))
    6000.0 electron
    """
    check_share("throughput", throughput)
    arriving = number("rate", rate, PHOTON_RATE, minimum=0.0)
    collected = positive("area", area, u.m**2) * positive("exposure_time", exposure_time, u.s)
    return arriving * collected * throughput * u.electron
