"""The PSF of a Fizeau interferometer, from its pupil and residual phases."""

from __future__ import annotations

import math

import numpy as np
from astropy import units as u
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import brentq

from lnocl.core.scene.arrays import Array
from lnocl.errors import InputError
from lnocl.simulation.checks import check_shape, check_share, number, positive
from lnocl.simulation.telescope import (
    APERTURE_DIAMETER,
    BASELINE,
    N_ACTUATORS,
    OBSCURATION_DIAMETER,
)

# Independent residual phases that are averaged for one long exposure, for each aperture.
N_SCREENS = 100
# Residual phase beyond which the coherent core is gone, radians rms.
MAX_PHASE_RMS = 4.0
# Field that the pupil is sampled for, in wavelength over aperture diameter, at least: the light
# beyond it is folded back, about 0.5 % of a perfect image.
MIN_FIELD = 80
# Largest grid for it, pixels along an axis.
MAX_GRID = 8192


def fizeau_psf(
    shape: tuple[int, int],
    angle: u.Quantity,
    wavelength: u.Quantity,
    pixel_scale: u.Quantity,
    strehl: float = 1.0,
    seed: int | np.random.SeedSequence = 0,
) -> Array:
    r"""Return the long-exposure PSF of the Large Binocular Telescope in Fizeau mode.

    The fields :math:`E_1, E_2` are the Fourier transforms of the two apertures, each a disc with a
    central obscuration and its own residual phase. With the baseline B their light adds up to

    .. math:: K(x) \propto \langle |E_1|^2 + |E_2|^2 \rangle
              + 2 \Re [\langle E_1 E_2^* \rangle \exp(2 \pi i B \cdot x / \lambda)],

    an Airy pattern crossed by fringes. The average is over 100 residual phases with the power
    spectrum :math:`(1 + (k / k_c)^2)^{-11/6}`. It is that of Kolmogorov beyond the cut-off
    :math:`k_c` of the adaptive optics, half a cycle per actuator, and flat below it. Their rms is
    found such that the Strehl ratio is the one asked for.

    The PSF is sampled at pixel centres, not integrated over pixels. The pixels must sample the
    longest spatial frequency, (B + D) / wavelength; so nothing is lost by it. Light that falls
    outside the frame comes back in at the opposite side, as on the periodic grid of the
    convolution. So the sum holds for a frame of any size.

    Parameters
    ----------
    shape : tuple of int
        Shape (ny, nx); each even and 32 or more.
    angle : Quantity
        Angle of the baseline, from the x axis towards the y axis. The fringes are orthogonal to it.
    wavelength : Quantity
        A length, positive.
    pixel_scale : Quantity
        Angle per pixel, positive, at most ``wavelength / (2 (B + D))``, 9.6 mas at 2.12 um. As the
        grid has at most 8192 pixels along an axis, it is at least 0.5 mas there.
    strehl : float
        Strehl ratio, the peak over that of the same PSF without residual phase, in (0, 1]. It is
        met to 0.001 in a frame of 1 arcsec or more, and to 0.004 in one of 0.6 arcsec. In a smaller
        frame the halo folded back lifts the peak, by 0.015 in 0.3 arcsec. Below 0.01 the halo alone
        is as high.
    seed : int or SeedSequence
        Of the residual phases; not used where `strehl` is 1.

    Returns
    -------
    ndarray of float64, shape (ny, nx)
        PSF of unit sum, not negative, centred on ``(ny // 2, nx // 2)``.

    Raises
    ------
    InputError
        An argument has the wrong unit or is out of its range.

    References
    ----------
    J. W. Goodman, "Introduction to Fourier Optics", section 6, for the pupil and the Strehl ratio;
    R. J.-L. Fétick et al., A&A 628, A99 (2019), for the residual phase, flat below the cut-off and
    of Kolmogorov's kind beyond it.

    Examples
    --------
    >>> import astropy.units as u
    >>> from lnocl.simulation import fizeau_psf
    >>> psf = fizeau_psf((128, 128), 0 * u.deg, 2.12 * u.um, 5 * u.mas)
    >>> bool(psf[64, 64] == psf.max()), round(float(psf.sum()), 12)
    (True, 1.0)

    The fringes lie 2.12 um / 14.4 m = 6.07 pixels apart along x:

    >>> row = psf[64, 64:75]
    >>> int(row[4:9].argmax()) + 4
    6
    """
    ny, nx = check_shape(shape)
    theta = number("angle", angle, u.rad)
    length = positive("wavelength", wavelength, u.m)
    scale = positive("pixel_scale", pixel_scale, u.rad)
    check_share("strehl", strehl)
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
