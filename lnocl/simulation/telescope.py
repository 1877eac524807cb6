"""The Large Binocular Telescope, and the paper's experiment with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy import constants
from astropy import units as u

from lnocl.core.scene.arrays import whole
from lnocl.errors import InputError
from lnocl.simulation.checks import check_share, number, numbers, positive

MAG_PER_ARCSEC2 = u.mag / u.arcsec**2
PER_SECOND_AND_M2 = u.s**-1 * u.m**-2

# The Large Binocular Telescope: two primary mirrors of 8.4 m, 14.4 m apart (J. M. Hill,
# R. F. Green, J. H. Slagle, Proc. SPIE 6267, 62670Y, 2006), each behind an adaptive secondary of
# 911 mm with 672 actuators (A. Riccardi et al., Proc. SPIE 4839, 721, 2003).
BASELINE = 14.4 * u.m
APERTURE_DIAMETER = 8.4 * u.m
OBSCURATION_DIAMETER = 0.911 * u.m
N_ACTUATORS = 672


@dataclass(frozen=True, eq=False)
class Experiment:
    """Instrument, filter and exposures; the defaults are those of La Camera et al. (2012).

    The paper names neither the zero point nor the throughput (:doc:`/validation/photometry`).

    Parameters
    ----------
    wavelength : Quantity, optional
        Of the narrow-band filter, by default H2 at 2.12 um; a length, positive.
    bandwidth : Quantity, optional
        Of that filter, by default 0.02 um; a length, positive.
    pixel_scale : Quantity, optional
        Angle per pixel, by default 5 mas; positive, at most ``wavelength / (2 (B + D))``.
    angles : Quantity, optional
        One or several angles of the baseline, one for each image, from the x axis towards the y
        axis. By default 0, 45, 90 and 135 degrees.
    exposure_time : Quantity, optional
        Of each image, by default 30 minutes; positive.
    throughput : float, optional
        Electrons per photon that reaches the telescope, in (0, 1]; by default 0.3.
    strehl : float, optional
        Strehl ratio of each PSF, in (0, 1]; by default 0.7.
    zero_point : Quantity, optional
        Flux density of magnitude 0, positive; by default 666.7 Jy, Ks of M. Cohen, W. A. Wheaton,
        S. T. Megeath, AJ 126, 1090 (2003).
    extended_magnitude : Quantity, optional
        Integrated magnitude of the extended source, by default 13 mag.
    sky_brightness : Quantity, optional
        In mag / arcsec2, by default 13.5.
    read_noise : Quantity, optional
        Standard deviation, electrons per pixel, zero or more; by default 10.
    seed : int, optional
        Of residual phases and noise, zero or more; by default 0.

    Raises
    ------
    InputError
        A value has the wrong unit or is out of its range.

    References
    ----------
    La Camera, A., Antoniucci, S., Bertero, M., et al., Proc. SPIE 8445 (2012), section 3.

    Examples
    --------
    >>> from lnocl.simulation import Experiment
    >>> experiment = Experiment(exposure_time="10 min", read_noise="5 electron")
    >>> print(experiment.exposure_time)
    10.0 min
    """

    wavelength: u.Quantity = 2.12 * u.um
    bandwidth: u.Quantity = 0.02 * u.um
    pixel_scale: u.Quantity = 5.0 * u.mas
    angles: u.Quantity = (0.0, 45.0, 90.0, 135.0) * u.deg
    exposure_time: u.Quantity = 30.0 * u.min
    throughput: float = 0.3
    strehl: float = 0.7
    zero_point: u.Quantity = 666.7 * u.Jy
    extended_magnitude: u.Quantity = 13.0 * u.mag
    sky_brightness: u.Quantity = 13.5 * MAG_PER_ARCSEC2
    read_noise: u.Quantity = 10.0 * u.electron
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("wavelength", "bandwidth", "pixel_scale", "exposure_time", "zero_point"):
            unit = getattr(Experiment, name).unit  # that of the default
            object.__setattr__(self, name, positive(name, getattr(self, name), unit) * unit)
        for name, unit in (("extended_magnitude", u.mag), ("sky_brightness", MAG_PER_ARCSEC2)):
            object.__setattr__(self, name, number(name, getattr(self, name), unit) * unit)
        noise = number("read_noise", self.read_noise, u.electron, minimum=0.0)
        object.__setattr__(self, "read_noise", noise * u.electron)
        angles = np.atleast_1d(numbers("angles", self.angles, u.deg))
        if angles.ndim != 1 or angles.size == 0:
            raise InputError(f"angles must be one or several numbers; {self.angles} was given")
        object.__setattr__(self, "angles", angles * u.deg)
        check_share("throughput", self.throughput)
        check_share("strehl", self.strehl)
        whole("seed", self.seed, 0)

    def source_electrons(self, magnitude: u.Quantity) -> float:
        r"""Return the electrons that one image holds of a source.

        .. math:: \frac{F_0}{h} \frac{\Delta\lambda}{\lambda} 10^{-0.4 m} A q t

        for the zero point F_0, the magnitude m, the area A of the two apertures without their
        obscurations (109.5 m2), the throughput q and the exposure time t.

        Parameters
        ----------
        magnitude : Quantity
            Magnitude of the source, in mag, finite.

        Returns
        -------
        float
            Electrons.

        Raises
        ------
        InputError
            The magnitude has the wrong unit or is not finite.

        Examples
        --------
        >>> import astropy.units as u
        >>> from lnocl.simulation import Experiment
        >>> print(f"{Experiment().source_electrons(13 * u.mag):.3g}")
        3.54e+07
        """
        width = self.bandwidth.to_value(u.m) / self.wavelength.to_value(u.m)
        with np.errstate(over="ignore"):
            dimming = np.power(10.0, -0.4 * number("magnitude", magnitude, u.mag))
            rate = (self.zero_point / constants.h * width * dimming).to_value(PER_SECOND_AND_M2)
            area = np.pi / 2 * (APERTURE_DIAMETER**2 - OBSCURATION_DIAMETER**2).to_value(u.m**2)
            return float(rate * (area * self.exposure_time.to_value(u.s)) * self.throughput)

    @property
    def sky_electrons(self) -> float:
        """Electrons of the sky in each pixel of one image.

        Examples
        --------
        >>> from lnocl.simulation import Experiment
        >>> round(Experiment().sky_electrons)
        559
        """
        side = self.pixel_scale.to_value(u.arcsec)
        return self.source_electrons(self.sky_brightness.value * u.mag - 5 * np.log10(side) * u.mag)
