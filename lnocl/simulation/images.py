"""Simulated images of a target, with photon noise and read noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from lnocl.core.scene.arrays import Array
from lnocl.errors import InputError
from lnocl.simulation.fizeau import fizeau_psf
from lnocl.simulation.targets import Target
from lnocl.simulation.telescope import Experiment

# Most electrons of all sources in an image and of sky and read noise in a pixel: Poisson deviates
# are 64-bit integers, and float64 counts one by one up to 9e15.
MAX_ELECTRONS = 1e15


@dataclass(frozen=True, eq=False)
class Simulation:
    """Simulated images, and the truth that they show.

    Attributes
    ----------
    images : ndarray of float64, shape (p, ny, nx)
        Electrons per pixel, with noise. Read noise makes some negative where the sky is dark.
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
    experiment : Experiment
        How the images were taken.

    See Also
    --------
    simulate : Returns it.

    Examples
    --------
    >>> import lnocl
    >>> from lnocl.simulation import Experiment, hh34, simulate
    >>> seen = simulate(hh34(64), Experiment(angles="0 deg", strehl=1.0))
    >>> observation = lnocl.Observation(
    ...     seen.images, seen.psfs, background=seen.background, read_noise=seen.read_noise
    ... )
    >>> observation.images.shape, seen.star_fluxes.shape
    ((1, 64, 64), (1,))
    """

    images: Array
    psfs: Array
    background: Array
    read_noise: float
    extended: Array
    stars: list[tuple[int, int]]
    star_fluxes: Array
    experiment: Experiment


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
        The pixels are too coarse for the wavelength. Or the light of all sources, and sky and read
        noise of a pixel, add up to more than 1e15 electrons.

    References
    ----------
    A. La Camera, S. Antoniucci, M. Bertero et al., "Image reconstruction for observations with a
    high dynamic range: LINC-NIRVANA simulations of a stellar jet", Proc. SPIE 8445 (2012), section
    3.

    Examples
    --------
    >>> from lnocl.simulation import hh34, simulate
    >>> simulation = simulate(hh34(64))
    >>> simulation.images.shape, simulation.stars
    ((4, 64, 64), [(32, 16)])
    """
    experiment = Experiment() if experiment is None else experiment
    stars = [(star.x, star.y) for star in target.stars]
    star_fluxes = np.array([experiment.source_electrons(star.magnitude) for star in target.stars])
    extended_flux = experiment.source_electrons(experiment.extended_magnitude)
    read_noise = float(experiment.read_noise.value)
    total = float(star_fluxes.sum()) + extended_flux + experiment.sky_electrons + read_noise
    if not total <= MAX_ELECTRONS:
        raise InputError(
            f"all light together and the read noise would leave {total:.3g} electrons in one "
            f"image; at most {MAX_ELECTRONS:.0e} can be simulated"
        )
    p = len(experiment.angles)
    *seeds, noise_seed = np.random.SeedSequence(experiment.seed).spawn(p + 1)
    how = experiment.wavelength, experiment.pixel_scale, experiment.strehl
    shape = target.extended.shape
    psfs = np.stack(
        [
            fizeau_psf(shape, angle, *how, seed)
            for angle, seed in zip(experiment.angles, seeds, strict=True)
        ]
    )
    extended = target.extended * extended_flux
    background = np.full(len(psfs), experiment.sky_electrons)
    expected = _expected_images(psfs, extended, stars, star_fluxes) + background[:, None, None]
    rng = np.random.default_rng(noise_seed)
    images = rng.poisson(expected) + rng.normal(0.0, read_noise, expected.shape)
    return Simulation(
        images, psfs, background, read_noise, extended, stars, star_fluxes, experiment
    )


def _expected_images(
    psfs: Array, extended: Array, stars: list[tuple[int, int]], star_fluxes: Array
) -> Array:
    """Return the images of extended source and stars without sky or noise, (p, ny, nx)."""
    ny, nx = extended.shape
    otfs = fft.rfft2(fft.ifftshift(psfs, axes=(1, 2)))
    # The transform leaves rounding errors of either sign in dark pixels.
    images = fft.irfft2(otfs * fft.rfft2(extended), s=(ny, nx)).clip(min=0)
    for (x, y), flux in zip(stars, star_fluxes, strict=True):
        images += flux * np.roll(psfs, (y - ny // 2, x - nx // 2), axis=(1, 2))
    return images
