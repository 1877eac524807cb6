"""Images of a star and its jet through a Fizeau interferometer, as the paper simulated them.

The experiment is that of La Camera et al. (2012), section 3: a target of stars and an extended
source, one PSF for each hour angle, photon noise of target and sky, and read noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from astropy import constants
from astropy import units as u
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.optimize import brentq
from scipy.special import expit

from lnocl.errors import InputError
from lnocl.io import fitsread
from lnocl.scene.observation import unmasked

Array = NDArray[np.float64]

# The Large Binocular Telescope: two primary mirrors of 8.4 m, 14.4 m apart (J. M. Hill,
# R. F. Green, J. H. Slagle, Proc. SPIE 6267, 62670Y, 2006), each behind an adaptive secondary of
# 911 mm with 672 actuators (A. Riccardi et al., Proc. SPIE 4839, 721, 2003).
BASELINE = 14.4 * u.m
APERTURE_DIAMETER = 8.4 * u.m
OBSCURATION_DIAMETER = 0.911 * u.m
N_ACTUATORS = 672

# Independent residual phases that are averaged for one long exposure, for each aperture.
N_SCREENS = 100
# Residual phase beyond which the coherent core is gone, radians rms.
MAX_PHASE_RMS = 4.0
# Field that the pupil is sampled for, in wavelength over aperture diameter, at least: the light
# beyond it is folded back, about 0.5 % of a perfect image.
MIN_FIELD = 80
# Largest grid for it, pixels along an axis.
MAX_GRID = 8192

MIN_SIZE = 32
# Below this the 24 rows around the star of `hh34` do not fit.
MIN_JET_SIZE = 64
DEFAULT_SIZE = 1024

# Electrons that one image may hold of all sources and of the sky in a pixel; Poisson deviates are
# 64-bit integers, and float64 counts one by one up to 9e15.
MAX_ELECTRONS = 1e15

MAG_PER_ARCSEC2 = u.mag / u.arcsec**2
PHOTON_RATE = u.photon / u.s / u.m**2


def fizeau_psf(
    shape: tuple[int, int],
    angle: u.Quantity,
    wavelength: u.Quantity,
    pixel_scale: u.Quantity,
    strehl: float = 1.0,
    seed: int | np.random.SeedSequence = 0,
) -> Array:
    r"""Return the long-exposure PSF of the Large Binocular Telescope in Fizeau mode.

    The fields :math:`E_1, E_2` are the Fourier transforms of the two apertures, each a disc with
    a central obscuration and its own residual phase. With the baseline B their light adds up to

    .. math:: K(x) \propto \langle |E_1|^2 + |E_2|^2 \rangle
              + 2 \Re [\langle E_1 E_2^* \rangle \exp(2 \pi i B \cdot x / \lambda)],

    an Airy pattern crossed by fringes. The average is over `N_SCREENS` residual phases with the
    power spectrum :math:`(1 + (k / k_c)^2)^{-11/6}`: that of Kolmogorov beyond the cut-off
    :math:`k_c` of the adaptive optics, half a cycle per actuator, and flat below it. Their rms
    is found such that the Strehl ratio is the one asked for.

    The PSF is sampled at pixel centres, not integrated over pixels. The pixels must sample the
    longest spatial frequency, (B + D) / wavelength; so nothing is lost by it. Light that falls
    outside the frame comes back in at the opposite side, as on the periodic grid of the
    convolution, so the sum holds for a frame of any size.

    Parameters
    ----------
    shape : tuple of int
        Shape (ny, nx); each even and `MIN_SIZE` or more.
    angle : Quantity
        Angle of the baseline, from the x axis towards the y axis. The fringes are orthogonal to
        it.
    wavelength : Quantity
        A length, positive.
    pixel_scale : Quantity
        Angle per pixel, positive, at most ``wavelength / (2 (B + D))``: 9.6 mas at 2.12 um; at
        least the `MAX_GRID`-th part of `MIN_FIELD`, 0.5 mas.
    strehl : float
        Strehl ratio, the peak over that of the same PSF without residual phase, in (0, 1]. Met
        to 0.001 in a frame of 1 arcsec or more, and to 0.004 in one of 0.6 arcsec; in a smaller
        one the halo folded back lifts the peak, by 0.015 in 0.3 arcsec. Below 0.01 the halo
        alone is as high.
    seed : int or SeedSequence
        Of the residual phases; not used where `strehl` is 1.

    Returns
    -------
    ndarray of float64, shape (ny, nx)
        PSF of unit sum, not negative, centred on ``(ny // 2, nx // 2)``.

    Raises
    ------
    InputError
        Where an argument has the wrong unit or is out of its range.

    References
    ----------
    J. W. Goodman, "Introduction to Fourier Optics", section 6, for the pupil and the Strehl
    ratio; R. J.-L. Fétick et al., A&A 628, A99 (2019), for the residual phase, flat below the
    cut-off and of Kolmogorov's kind beyond it.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulate import fizeau_psf
    >>> psf = fizeau_psf((128, 128), 0 * u.deg, 2.12 * u.um, 5 * u.mas)
    >>> bool(psf[64, 64] == psf.max()), round(float(psf.sum()), 12)
    (True, 1.0)

    The fringes lie 2.12 um / 14.4 m = 6.07 pixels apart along x:

    >>> row = psf[64, 64:75]
    >>> int(row[4:9].argmax()) + 4
    6
    """
    ny, nx = _check_shape(shape)
    theta = _quantity("angle", angle, u.rad)
    length = _positive("wavelength", wavelength, u.m)
    scale = _positive("pixel_scale", pixel_scale, u.rad)
    _check_share("strehl", strehl)
    diameter, baseline = APERTURE_DIAMETER.to_value(u.m), BASELINE.to_value(u.m)
    coarsest = length / (2 * (baseline + diameter))
    if scale > coarsest * (1 + 1e-9):
        raise InputError(
            f"pixel_scale must be at most {(coarsest * u.rad).to(u.mas):.3g} to sample the "
            f"fringes at this wavelength; {pixel_scale} was given"
        )
    least = MIN_FIELD * length / (diameter * scale)
    grid = ny * math.ceil(least / ny), nx * math.ceil(least / nx)
    if max(grid) > MAX_GRID:
        raise InputError(
            f"{nx} x {ny} pixels of {pixel_scale} need a grid of {grid[1]} x {grid[0]}; "
            f"the largest side is {MAX_GRID}: give coarser pixels or a smaller frame"
        )
    steps = length / (grid[0] * scale), length / (grid[1] * scale)
    pupil = _pupil(steps)
    if strehl == 1:
        halo, cross = _average_fields(pupil, np.zeros((1, *pupil.shape), complex))
    else:
        phases = _residual_phases(pupil.shape, steps, np.random.default_rng(seed))
        halo, cross = _average_fields(pupil, phases * _phase_rms(pupil, phases, strehl))
    halo, cross = _interpolate(halo, pupil.shape, grid).real, _interpolate(cross, pupil.shape, grid)
    y, x = (scale * n * fft.fftfreq(n) for n in grid)
    wave_number = 2 * np.pi * baseline / length
    fringes = np.multiply.outer(
        np.exp(1j * wave_number * math.sin(theta) * y),
        np.exp(1j * wave_number * math.cos(theta) * x),
    )
    psf = (halo + 2 * (cross * fringes).real).reshape(grid[0] // ny, ny, grid[1] // nx, nx)
    psf = fft.fftshift(psf.sum(axis=(0, 2))).clip(min=0)
    return psf / psf.sum()


def _pupil(steps: tuple[float, float]) -> Array:
    """Return the transmission of one aperture, with pixels cut by an edge in part open."""
    outer, inner = (d.to_value(u.m) / 2 for d in (APERTURE_DIAMETER, OBSCURATION_DIAMETER))
    half = [math.ceil(outer / step) for step in steps]
    y, x = (step * np.arange(-h, h + 1) for step, h in zip(steps, half, strict=True))
    r = np.hypot(y[:, None], x)
    edge = max(steps)
    return np.clip((outer - r) / edge + 0.5, 0, 1) - np.clip((inner - r) / edge + 0.5, 0, 1)


def _residual_phases(
    shape: tuple[int, ...], steps: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.complex128]:
    """Return phases of unit variance, the real part for one aperture, the imaginary for the other.

    Shape (N_SCREENS, *shape).
    """
    pitch = APERTURE_DIAMETER.to_value(u.m) * math.sqrt(math.pi / 4 / N_ACTUATORS)
    size = [fft.next_fast_len(n) for n in shape]
    ky, kx = (fft.fftfreq(n, step) for n, step in zip(size, steps, strict=True))
    power = (1 + (2 * pitch) ** 2 * (ky[:, None] ** 2 + kx**2)) ** (-11 / 6)
    white = rng.standard_normal((N_SCREENS, *size, 2)).view(np.complex128)[..., 0]
    phases = fft.ifft2(np.sqrt(power / power.sum()) * white, norm="forward")
    return phases[:, : shape[0], : shape[1]]


def _phase_rms(pupil: Array, phases: NDArray[np.complex128], strehl: float) -> float:
    """Return the rms phase, radians, at which the averaged images have this Strehl ratio."""
    lit = pupil > 0
    weights = (pupil[lit] / (2 * pupil.sum())).astype(np.float32)
    first, second = (part[:, lit].astype(np.float32) for part in (phases.real, phases.imag))

    def excess(rms: float) -> float:
        a, b = np.float32(rms) * first, np.float32(rms) * second
        in_phase = ((np.cos(a) + np.cos(b)) * weights).sum(axis=1, dtype=np.float64)
        quadrature = ((np.sin(a) + np.sin(b)) * weights).sum(axis=1, dtype=np.float64)
        return float(np.mean(in_phase**2 + quadrature**2)) - strehl

    if excess(MAX_PHASE_RMS) >= 0:
        return MAX_PHASE_RMS
    return float(brentq(excess, 0, MAX_PHASE_RMS, xtol=1e-4))


def _average_fields(
    pupil: Array, phases: NDArray[np.complex128]
) -> tuple[Array, NDArray[np.complex128]]:
    """Return ``<|E_1|^2 + |E_2|^2>`` and ``<E_1 E_2*>``, sampled just finely enough for both."""
    size = tuple(fft.next_fast_len(2 * n) for n in pupil.shape)
    halo, cross = np.zeros(size), np.zeros(size, complex)
    for phase in phases:
        first = fft.fft2(pupil * np.exp(1j * phase.real), s=size)
        second = fft.fft2(pupil * np.exp(1j * phase.imag), s=size)
        halo += np.abs(first) ** 2 + np.abs(second) ** 2
        cross += first * second.conj()
    return halo, cross


def _interpolate(
    image: NDArray, pupil_shape: tuple[int, ...], grid: tuple[int, int]
) -> NDArray[np.complex128]:
    """Return the image of a pupil on a finer grid: its spectrum ends where the pupil does."""
    spectrum = fft.ifft2(image)
    ky, kx = (np.arange(1 - n, n) for n in pupil_shape)
    padded = np.zeros(grid, complex)
    padded[np.ix_(ky, kx)] = spectrum[np.ix_(ky, kx)]
    return fft.fft2(padded, overwrite_x=True)


def collecting_area() -> u.Quantity:
    """Return the area of the two apertures without their obscurations, 109.5 m2.

    ``2 pi / 4 (D^2 - d^2)`` with D = 8.4 m and d = 0.911 m.

    Examples
    --------
    >>> from lnocl.simulate import collecting_area
    >>> print(f"{collecting_area():.2f}")
    109.53 m2
    """
    return (np.pi / 2 * (APERTURE_DIAMETER**2 - OBSCURATION_DIAMETER**2)).to(u.m**2)


def photon_rate(
    magnitude: u.Quantity, zero_point: u.Quantity, wavelength: u.Quantity, bandwidth: u.Quantity
) -> u.Quantity:
    r"""Return the photons that arrive per second and square metre from a source.

    .. math:: \frac{F_0}{h} \frac{\Delta\lambda}{\lambda} 10^{-0.4 m}, for a narrow band.

    Parameters
    ----------
    magnitude : Quantity
        In mag, finite.
    zero_point : Quantity
        Flux density of magnitude 0 per unit frequency, such as Jy; positive.
    wavelength, bandwidth : Quantity
        Lengths, positive.

    Returns
    -------
    Quantity
        In photon / (s m2).

    Raises
    ------
    InputError
        Where an argument has the wrong unit or is out of its range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulate import photon_rate
    >>> print(f"{photon_rate(13 * u.mag, 666.7 * u.Jy, 2.12 * u.um, 0.02 * u.um):.1f}")
    598.9 ph / (s m2)
    """
    flux_density = _positive("zero_point", zero_point, u.Jy) * u.Jy
    width = _positive("bandwidth", bandwidth, u.m) / _positive("wavelength", wavelength, u.m)
    try:
        dimming = 10 ** (-0.4 * _quantity("magnitude", magnitude, u.mag))
    except OverflowError:
        raise InputError(f"magnitude {magnitude} is too bright for any number") from None
    return (flux_density / constants.h * width * dimming * u.photon).to(PHOTON_RATE)


def pixel_magnitude(surface_brightness: u.Quantity, pixel_scale: u.Quantity) -> u.Quantity:
    """Return the magnitude of one square pixel of a surface brightness.

    ``S - 2.5 log10(pixel_scale^2 / arcsec^2)``

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
        Where an argument has the wrong unit or is out of its range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulate import pixel_magnitude
    >>> print(f"{pixel_magnitude(13.5 * u.mag / u.arcsec**2, 5 * u.mas):.3f}")
    25.005 mag
    """
    side = _positive("pixel_scale", pixel_scale, u.arcsec)
    brightness = _quantity("surface_brightness", surface_brightness, MAG_PER_ARCSEC2)
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
        Positive.

    Returns
    -------
    Quantity
        In electrons.

    Raises
    ------
    InputError
        Where an argument has the wrong unit or is out of its range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulate import electrons
    >>> print(electrons(2 * u.photon / u.s / u.m**2, 100 * u.m**2, 0.5, 1 * u.min))
    6000.0 electron
    """
    _check_share("throughput", throughput)
    arriving = _not_negative("rate", rate, PHOTON_RATE)
    collected = _positive("area", area, u.m**2) * _positive("exposure_time", exposure_time, u.s)
    return arriving * collected * throughput * u.electron


@dataclass(frozen=True, eq=False)
class Experiment:
    """How the images are taken; the defaults are those of La Camera et al. (2012).

    The paper names neither the zero point nor the throughput: see docs/photometry.md.

    Attributes
    ----------
    wavelength, bandwidth : Quantity
        Of the narrow-band filter, H2 at 2.12 um; lengths, positive.
    pixel_scale : Quantity
        Angle per pixel, positive, at most ``wavelength / (2 (B + D))``.
    angles : Quantity
        One or several angles of the baseline, one for each image, from the x axis towards the y
        axis.
    exposure_time : Quantity
        Of each image, positive.
    throughput : float
        Electrons per photon that reaches the telescope, in (0, 1].
    strehl : float
        Strehl ratio of each PSF, in (0, 1].
    zero_point : Quantity
        Flux density of magnitude 0, positive: Ks of M. Cohen, W. A. Wheaton, S. T. Megeath, AJ
        126, 1090 (2003).
    extended_magnitude : Quantity
        Integrated magnitude of the extended source.
    sky_brightness : Quantity
        In mag / arcsec2.
    read_noise : Quantity
        Standard deviation, electrons per pixel, zero or more.
    seed : int
        Of residual phases and noise, zero or more.

    Raises
    ------
    InputError
        Where a value has the wrong unit or is out of its range; where an image would hold more
        than `MAX_ELECTRONS` of the extended source, of the sky in a pixel, or of read noise.

    Examples
    --------
    >>> from lnocl.simulate import Experiment
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
        for name, unit in (
            ("wavelength", u.um),
            ("bandwidth", u.um),
            ("pixel_scale", u.mas),
            ("exposure_time", u.min),
            ("zero_point", u.Jy),
        ):
            object.__setattr__(self, name, _positive(name, getattr(self, name), unit) * unit)
        for name, unit in (("extended_magnitude", u.mag), ("sky_brightness", MAG_PER_ARCSEC2)):
            object.__setattr__(self, name, _quantity(name, getattr(self, name), unit) * unit)
        noise = _not_negative("read_noise", self.read_noise, u.electron)
        object.__setattr__(self, "read_noise", noise * u.electron)
        object.__setattr__(self, "angles", _check_angles(self.angles))
        _check_share("throughput", self.throughput)
        _check_share("strehl", self.strehl)
        if not (isinstance(self.seed, (int, np.integer)) and self.seed >= 0):
            raise InputError(f"seed must be a whole number, 0 or more; {self.seed} was given")
        _check_electrons("the extended source", self.source_electrons(self.extended_magnitude))
        _check_electrons("the sky in a pixel", self.sky_electrons)
        _check_electrons("read_noise", noise)
        if not math.isfinite(self.source_electrons(0 * u.mag)):
            raise InputError("a star of magnitude 0 would leave infinitely many electrons")

    def source_electrons(self, magnitude: u.Quantity) -> float:
        """Return the electrons that one image holds of a source of this magnitude."""
        rate = photon_rate(magnitude, self.zero_point, self.wavelength, self.bandwidth)
        area = collecting_area()
        return float(electrons(rate, area, self.throughput, self.exposure_time).value)

    @property
    def sky_electrons(self) -> float:
        """Electrons of the sky in each pixel of one image."""
        return self.source_electrons(pixel_magnitude(self.sky_brightness, self.pixel_scale))


@dataclass(frozen=True)
class Star:
    """A point source.

    Attributes
    ----------
    x, y : int
        Position in pixels, 0-based, x along columns.
    magnitude : Quantity
        In mag.
    """

    x: int
    y: int
    magnitude: u.Quantity = 13.0 * u.mag


class Target:
    """What is observed: an extended source and the stars in it.

    Parameters
    ----------
    extended : array_like, shape (ny, nx)
        Extended source in any unit of flux per pixel, not negative, of a positive sum. Both axes
        even and `MIN_SIZE` or more.
    stars : sequence of Star, optional
        Point sources, at whole pixels of the image.

    Attributes
    ----------
    extended : ndarray of float64, shape (ny, nx)
        Of unit sum.
    stars : tuple of Star
        The point sources.

    Raises
    ------
    InputError
        Where the extended source is not a plane of finite numbers, has masked or negative pixels,
        no flux or one that is not finite, or an odd or too small side; where a star lies outside
        it or between pixels.
    """

    def __init__(self, extended: ArrayLike, stars: Sequence[Star] = ()) -> None:
        array = unmasked("the extended source", extended)
        if array.ndim != 2 or array.dtype.kind not in "biuf":
            raise InputError(
                f"the extended source has {array.ndim} dimensions of {array.dtype}; "
                "give two, of real numbers"
            )
        _check_shape(array.shape)
        array = array.astype(np.float64)
        if not (np.isfinite(array).all() and (array >= 0).all()):
            raise InputError("the extended source must be finite and not negative everywhere")
        with np.errstate(over="ignore"):
            total = array.sum()
        if not np.isfinite(total):
            raise InputError(
                "the extended source is too large to be summed: divide it by a constant"
            )
        if total == 0:
            raise InputError("the extended source has no flux: all its pixels are zero")
        self.extended = array / total
        self.stars = tuple(_check_star(star, array.shape) for star in stars)


def hh34(size: int = DEFAULT_SIZE) -> Target:
    """Return a jet of the kind of HH 34 and the star that drives it, on a square of this size.

    The axis of the jet lies along y. It leaves the star as a thin spine that widens and wiggles
    a little, carries curved knots, the first 8 pixels from the star and each 1.45 times as far as
    the one before, and ends in a bow shock. Width and knots are the same in a frame of any size;
    the length follows the frame, so a jet in a smaller one is cut shorter and has fewer knots.
    Nothing in it is random.

    Parameters
    ----------
    size : int
        Pixels along each side; even, `MIN_JET_SIZE` or more.

    Returns
    -------
    Target
        With the star, of magnitude 13, at ``(size // 2, size // 4)``.

    Raises
    ------
    InputError
        Where the size is odd or too small.

    Examples
    --------
    >>> from lnocl.simulate import hh34
    >>> target = hh34(256)
    >>> target.extended.shape, target.stars[0].x, target.stars[0].y
    ((256, 256), 128, 64)
    """
    ny, nx = _check_shape((size, size), MIN_JET_SIZE)
    star = Star(nx // 2, ny // 4)
    s = np.arange(ny)[:, None] - float(star.y)  # distance from the star along the axis
    length = 0.62 * ny
    width = 4.0 + 0.02 * np.clip(s, 0, None)
    t = np.arange(nx) - star.x - 0.25 * width * np.sin(s / (4.0 + 0.09 * length))
    across = np.exp(-0.5 * (t / width) ** 2)
    along = expit(s / 1.5) * expit((length - s) / (0.02 * length)) * np.exp(-1.5 * s / length)
    jet = along * across
    distance, k = 8.0, 0
    while distance < 0.85 * length:
        front = (s - distance + t**2 / (6.0 * width)) / (1.2 + 0.05 * distance)
        brightness = (2.5 + 1.5 * math.cos(2.4 * k)) * math.exp(-1.5 * distance / length)
        jet += brightness * np.exp(-0.5 * front**2) * across
        distance, k = 1.45 * distance, k + 1
    shell = (s - length + t**2 / (0.2 * length)) / (1.5 + 0.008 * length)
    jet += 0.7 * np.exp(-0.5 * shell**2 - 0.5 * (t / (0.09 * length)) ** 2)
    return Target(np.where(jet > 1e-6 * jet.max(), jet, 0.0), [star])


SCENES = {"hh34": hh34}


def load_target(
    scene: str | Path, size: int | None = None, stars: Sequence[Star] | None = None
) -> Target:
    """Return a built-in scene, or the first image of a FITS file as the extended source.

    Parameters
    ----------
    scene : str or Path
        Name of a built-in scene (``"hh34"``), or a FITS file. Its pixels are taken as they are;
        its WCS is not read.
    size : int, optional
        Pixels along each side of a built-in scene, 1024 by default; a file has its own.
    stars : sequence of Star, optional
        Stars instead of those of the scene. Those of a file are one star of magnitude 13 at the
        header keywords STARX, STARY (0-based), where it has them, else none.

    Returns
    -------
    Target
        Extended source and stars.

    Raises
    ------
    InputError
        An unknown scene, a size given with a file, or anything that `Target` refuses.
    FileError
        A file that is not readable as FITS, or holds no image.

    Examples
    --------
    >>> from lnocl.simulate import load_target
    >>> load_target("hh34", size=64).extended.shape
    (64, 64)
    """
    if str(scene) in SCENES:
        target = SCENES[str(scene)](DEFAULT_SIZE if size is None else size)
        return target if stars is None else Target(target.extended, stars)
    if not Path(scene).is_file():
        raise InputError(
            f"scene {str(scene)!r} is neither a built-in one ({', '.join(SCENES)}) nor a file"
        )
    if size is not None:
        raise InputError(f"size {size} was given with {scene}, which has its own; leave it out")
    image = fitsread.read_single(str(scene))
    if stars is None:
        keyed = "STARX" in image.header and "STARY" in image.header
        stars = [Star(image.header["STARX"], image.header["STARY"])] if keyed else []
    return Target(image.data[0], stars)


@dataclass(frozen=True, eq=False)
class Simulation:
    """What `simulate` returns.

    Attributes
    ----------
    images : ndarray of float64, shape (p, ny, nx)
        Electrons per pixel, with noise; read noise makes some negative where the sky is dark.
    psfs : ndarray of float64, shape (p, ny, nx)
        Of unit sum, peak at ``(ny // 2, nx // 2)``.
    background : ndarray of float64, shape (p,)
        Electrons of the sky per pixel.
    read_noise : float
        Standard deviation, electrons.
    extended : ndarray of float64, shape (ny, nx)
        The true extended source, electrons per pixel.
    stars : list of (x, y)
        Positions in pixels, 0-based, x along columns.
    star_fluxes : ndarray of float64, shape (n,)
        The true fluxes, electrons.
    zero_magnitude_flux : float
        Electrons of a star of magnitude 0.
    experiment : Experiment
        How the images were taken.
    """

    images: Array
    psfs: Array
    background: Array
    read_noise: float
    extended: Array
    stars: list[tuple[int, int]]
    star_fluxes: Array
    zero_magnitude_flux: float
    experiment: Experiment

    def record(self) -> dict[str, Any]:
        """Return every number the simulation was made from, ready for `json.dump`."""
        return {
            "target": {
                "shape": list(self.extended.shape),
                "extended_electrons": float(self.extended.sum()),
                "stars": [
                    {"x": x, "y": y, "electrons": float(flux)}
                    for (x, y), flux in zip(self.stars, self.star_fluxes, strict=True)
                ],
            },
            "experiment": {
                item.name: _plain(getattr(self.experiment, item.name))
                for item in fields(self.experiment)
            },
            "telescope": {
                "baseline": _plain(BASELINE),
                "aperture_diameter": _plain(APERTURE_DIAMETER),
                "obscuration_diameter": _plain(OBSCURATION_DIAMETER),
                "collecting_area": _plain(collecting_area()),
                "n_actuators": N_ACTUATORS,
                "n_screens": N_SCREENS,
            },
            "zero_magnitude_electrons": self.zero_magnitude_flux,
            "sky_electrons_per_pixel": self.experiment.sky_electrons,
        }


def simulate(target: Target, experiment: Experiment | None = None) -> Simulation:
    """Return images of the target, one for each angle of the experiment.

    ``images[j] ~ Poisson(K_j * extended + sum_s c_s P_js + b) + Normal(0, read_noise)``

    The convolution is periodic and the PSFs are those handed back (the paper's inverse crime).

    Parameters
    ----------
    target : Target
        Extended source and stars.
    experiment : Experiment, optional
        By default the paper's.

    Returns
    -------
    Simulation
        Images, PSFs and the truth.

    Raises
    ------
    InputError
        Where the pixels are too coarse for the wavelength; where the light of all sources, and of
        the sky in a pixel, adds up to more than `MAX_ELECTRONS`.

    References
    ----------
    A. La Camera, S. Antoniucci, M. Bertero et al., "Image reconstruction for observations with
    a high dynamic range: LINC-NIRVANA simulations of a stellar jet", Proc. SPIE 8445 (2012),
    section 3.

    Examples
    --------
    >>> from lnocl.simulate import hh34, simulate
    >>> simulation = simulate(hh34(64))
    >>> simulation.images.shape, simulation.stars
    ((4, 64, 64), [(32, 16)])
    """
    experiment = Experiment() if experiment is None else experiment
    stars = [(star.x, star.y) for star in target.stars]
    star_fluxes = np.array([experiment.source_electrons(star.magnitude) for star in target.stars])
    for star, flux in zip(target.stars, star_fluxes, strict=True):
        _check_electrons(f"the star at ({star.x}, {star.y})", float(flux))
    extended_flux = experiment.source_electrons(experiment.extended_magnitude)
    total = float(star_fluxes.sum()) + extended_flux + experiment.sky_electrons
    _check_electrons("all light together", total)
    *psf_seeds, noise_seed = np.random.SeedSequence(experiment.seed).spawn(
        len(experiment.angles) + 1
    )
    psfs = np.stack(
        [
            fizeau_psf(
                target.extended.shape,
                angle,
                experiment.wavelength,
                experiment.pixel_scale,
                experiment.strehl,
                seed,
            )
            for angle, seed in zip(experiment.angles, psf_seeds, strict=True)
        ]
    )
    extended = target.extended * extended_flux
    background = np.full(len(psfs), experiment.sky_electrons)
    read_noise = float(experiment.read_noise.value)
    expected = _expected_images(psfs, extended, stars, star_fluxes) + background[:, None, None]
    rng = np.random.default_rng(noise_seed)
    images = rng.poisson(expected) + rng.normal(0.0, read_noise, expected.shape)
    return Simulation(
        images=images,
        psfs=psfs,
        background=background,
        read_noise=read_noise,
        extended=extended,
        stars=stars,
        star_fluxes=star_fluxes,
        zero_magnitude_flux=experiment.source_electrons(0 * u.mag),
        experiment=experiment,
    )


def _expected_images(
    psfs: Array, extended: Array, stars: list[tuple[int, int]], star_fluxes: Array
) -> Array:
    """Return the images of extended source and stars without sky or noise, (p, ny, nx)."""
    ny, nx = extended.shape
    otfs = fft.rfft2(fft.ifftshift(psfs, axes=(1, 2)))
    # The transform leaves rounding errors of either sign where there is no light.
    images = fft.irfft2(otfs * fft.rfft2(extended), s=(ny, nx)).clip(min=0)
    for (x, y), flux in zip(stars, star_fluxes, strict=True):
        images += flux * np.roll(psfs, (y - ny // 2, x - nx // 2), axis=(1, 2))
    return images


def _plain(value: Any) -> Any:
    """Return a number, or a quantity as its value and unit, in types that JSON knows."""
    if isinstance(value, u.Quantity):
        return {"value": value.value.tolist(), "unit": value.unit.to_string()}
    return int(value) if isinstance(value, (int, np.integer)) else float(value)


def _quantity(name: str, value: Any, unit: u.UnitBase) -> float:
    """Return a finite number in this unit."""
    try:
        with np.errstate(over="ignore"):
            converted = u.Quantity(value).to_value(unit)
    except (TypeError, ValueError, u.UnitsError):
        raise InputError(
            f"{name} must be a quantity in {unit} or the like; {value} was given"
        ) from None
    if np.ndim(converted) != 0 or not np.isfinite(converted):
        raise InputError(f"{name} must be one finite number; {value} was given")
    return float(converted)


def _positive(name: str, value: Any, unit: u.UnitBase) -> float:
    number = _quantity(name, value, unit)
    if number <= 0:
        raise InputError(f"{name} must be positive; {value} was given")
    return number


def _not_negative(name: str, value: Any, unit: u.UnitBase) -> float:
    number = _quantity(name, value, unit)
    if number < 0:
        raise InputError(f"{name} must not be negative; {value} was given")
    return number


def _check_electrons(name: str, number: float) -> None:
    if not number <= MAX_ELECTRONS:
        raise InputError(
            f"{name} would leave {number:.3g} electrons in one image; at most "
            f"{MAX_ELECTRONS:.0e} can be simulated"
        )


def _check_angles(angles: Any) -> u.Quantity:
    try:
        values = np.atleast_1d(u.Quantity(angles).to_value(u.deg)).astype(np.float64)
    except (TypeError, ValueError, u.UnitsError):
        raise InputError(f"angles must be quantities in deg; {angles} was given") from None
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise InputError(f"angles must be one or several finite numbers; {angles} was given")
    return values * u.deg


def _check_share(name: str, value: float) -> None:
    if not (isinstance(value, (int, float, np.floating)) and 0 < value <= 1):
        raise InputError(f"{name} must be in (0, 1]; {value} was given")


def _check_shape(shape: Any, least: int = MIN_SIZE) -> tuple[int, int]:
    if np.shape(shape) != (2,):
        raise InputError(f"shape must be (ny, nx); {shape} was given")
    ny, nx = shape
    for n in (ny, nx):
        if not isinstance(n, (int, np.integer)) or n % 2 or n < least:
            raise InputError(
                f"the image is {nx} x {ny} pixels; each side must be even and {least} or more"
            )
    return int(ny), int(nx)


def _check_star(star: Star, shape: tuple[int, ...]) -> Star:
    ny, nx = shape
    _quantity("the magnitude of a star", star.magnitude, u.mag)
    for value in (star.x, star.y):
        if not isinstance(value, (int, float, np.integer, np.floating)):
            raise InputError(f"the position of a star must be two numbers; {value!r} was given")
    if not (0 <= star.x <= nx - 1 and 0 <= star.y <= ny - 1):
        raise InputError(
            f"the star at ({star.x:g}, {star.y:g}) lies outside the image: x must be in "
            f"[0, {nx - 1}] and y in [0, {ny - 1}]"
        )
    if star.x != round(star.x) or star.y != round(star.y):
        raise InputError(
            f"the star at ({star.x:g}, {star.y:g}) lies between pixels; give the nearest whole "
            f"pixel ({round(star.x)}, {round(star.y)})"
        )
    return Star(round(star.x), round(star.y), u.Quantity(star.magnitude).to(u.mag))
