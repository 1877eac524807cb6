"""Whether a model fits its images as well as noise allows: in all pixels, and at each star."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.detector import on_sky, psfs_on_detector
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.observation import Observation

# The core of a star is where its PSF is above this share of its peak; its wings go on to the other.
CORE, WINGS = 0.5, 1e-3
# Light round a star is looked for as far as so many widths of its PSF, in so many sectors, and is
# reported from these shares of the star's flux, and of all light there, on
# (docs/validation/psf.md).
REACH, SECTORS = 12.0, 8
MUCH_HALO, MUCH_SHARE = 0.1, 0.05
# So is light that a star may exchange with a host (docs/validation/psf_error.md).
MUCH_EXCHANGED = MUCH_HALO
# A misfit is this many times the noise, and as many standard errors above it.
MISFIT, SIGNIFICANCE = 1.5, 5.0
# Sides of the squares, pixels, in which the light of a sharp source is compared; the share that the
# smallest holds, and its standard deviations.
SHARP_SIDES, SHARP, CLEAR = (3, 5, 9), 0.9, 50.0
# Less than this share of the noise is not what an estimate that follows it leaves.
OVERFIT = 0.6


class Fit(NamedTuple):
    """How well a model m fits the counts g of some pixels.

    Each pixel has the weight ``w = m / (m + 1/2)``: of less than an electron it tells little. So
    chi squared, ``sum w (g - m)^2 / m``, is ``sum w`` for Poisson counts, and its variance, ``sum
    w^2 (2 + 1 / m)``, is twice that, whatever m.

    Attributes
    ----------
    n_pixels : int
        Good pixels.
    square_sum : float
        Chi squared.
    variance : float
        Its variance for Poisson counts, ``2 sum w``.

    See Also
    --------
    lnocl.Result.fit : Returns it for all pixels.

    Examples
    --------
    >>> from lnocl.residuals import Fit
    >>> fit = Fit(n_pixels=10000, square_sum=40000.0, variance=20000.0)
    >>> fit.rms, round(fit.error, 4), fit.is_misfit, fit.is_overfit
    (2.0, 0.0071, True, False)
    """

    n_pixels: int = 0
    square_sum: float = 0.0
    variance: float = 0.0

    @classmethod
    def of(cls, values: Array, models: Array) -> Fit:
        """Return the fit of pixels with these residuals and models."""
        good = ~np.isnan(values)
        weights = np.divide(models, models + 0.5, out=np.zeros_like(models), where=good)
        square_sum = float(np.sum(weights * values**2, where=good))
        return cls(int(np.count_nonzero(good)), square_sum, 2.0 * float(weights.sum()))

    def plus(self, other: Fit) -> Fit:
        """Return the fit of these pixels and others."""
        return Fit._make(one + more for one, more in zip(self, other, strict=True))

    @property
    def rms(self) -> float:
        """Rms of ``(g - m) / sqrt(m)``, weighted: 1 for noise, less where the model follows it."""
        return math.sqrt(2.0 * self.square_sum / self.variance) if self.variance else math.nan

    @property
    def error(self) -> float:
        """The standard error of the rms by noise, where the model fits."""
        return 1.0 / math.sqrt(self.variance) if self.variance else math.nan

    @property
    def is_misfit(self) -> bool:
        """Whether the rms is far above that of noise.

        It is above 1.5, and above 1 by more than five standard errors.
        """
        return self.rms > max(MISFIT, 1.0 + SIGNIFICANCE * self.error)

    @property
    def is_overfit(self) -> bool:
        """Whether the rms is far below that of noise.

        It is below 0.6, and below 1 by more than five standard errors.
        """
        return self.rms < min(OVERFIT, 1.0 - SIGNIFICANCE * self.error)


class StarResiduals(NamedTuple):
    """How well a model fits at a star.

    Attributes
    ----------
    core : Fit
        In the core of the star's images, where the PSF is above half its peak.
    wings : Fit
        In the wings, down to a thousandth of the peak.
    halo : float
        Light of the extended source that lies all round the star and falls outwards, as a share of
        what images show of the star; 0 for a star of flux 0. A PSF that is too narrow, or without
        wings, leaves such light there.
    halo_share : float
        The same light as a share of all that lies round the star.
    exchanged : float
        The share of the star's flux that it may exchange with an extended source that is brightest
        under it, two standard errors (`lnocl.core.solvers.exchange`). It is 0 where that is not
        most of the error, or where PSFs are exact.
    core_error : float
        The relative error of the PSF in the core that would leave what the core has over noise.

    See Also
    --------
    lnocl.Result.star_residuals : Returns it for each star.

    Examples
    --------
    >>> from lnocl.residuals import Fit, StarResiduals
    >>> star = StarResiduals(Fit(20, 20.0, 40.0), Fit(300, 300.0, 600.0), 0.2, 0.8)
    >>> star.is_misfit, star.has_halo
    (False, True)
    """

    core: Fit
    wings: Fit
    halo: float
    halo_share: float
    exchanged: float = 0.0
    core_error: float = 0.0

    @property
    def is_misfit(self) -> bool:
        """Whether residuals in core or wings are far above noise (`Fit.is_misfit`)."""
        return self.core.is_misfit or self.wings.is_misfit

    @property
    def has_halo(self) -> bool:
        """Whether much light lies all round the star.

        It is more than a tenth of the star's flux, and more than 5 % of all light round it.
        """
        return self.halo > MUCH_HALO and self.halo_share > MUCH_SHARE

    @property
    def is_like_host(self) -> bool:
        """Whether the star may exchange more than a tenth of its flux with a host."""
        return self.exchanged > MUCH_EXCHANGED


def sharp_sources(sky: Array, background: float, finer: int = 1) -> Array:
    """Return places and light of what is as sharp as a star in an extended source, brightest first.

    It is a maximum whose 3 x 3 pixels hold nine tenths of the light that 9 x 9 pixels have above
    the level between them, and 50 standard deviations of counts. A star that was not named is such
    a source: it has 230 standard deviations or more where all else has 13.

    Parameters
    ----------
    sky : ndarray of float64, shape (Ny, Nx)
        Extended source, electrons per pixel.
    background : float
        Electrons per pixel of it.
    finer : int, optional
        Pixels of the sky to one of the images, along each axis.

    Returns
    -------
    ndarray of float64, shape (n, 3)
        x and y in pixels of the images, and electrons.
    """
    from scipy.ndimage import maximum_filter, minimum_filter  # which --help need not load

    inner, between, outer = SHARP_SIDES
    is_maximum = sky == maximum_filter(sky, outer)
    # In flat parts of the sky, dark or not, all pixels are maxima.
    is_maximum &= (sky * inner**2 > CLEAR) & (sky > minimum_filter(sky, outer))
    y, x = np.nonzero(is_maximum)
    squares = np.lib.stride_tricks.sliding_window_view(np.pad(sky, outer // 2), (outer, outer))
    core, ring, whole = (
        squares[y, x][:, cut, cut].sum(axis=(1, 2))
        for cut in (slice((outer - side) // 2, (outer + side) // 2) for side in SHARP_SIDES)
    )
    level = (whole - ring) / (outer**2 - between**2)
    light = core - inner**2 * level
    noise = np.sqrt(np.maximum(core + inner**2 * background, 1.0))
    is_sharp = (light > SHARP * (whole - outer**2 * level)) & (light > CLEAR * noise)
    found = np.stack([x, y, light], axis=1)[is_sharp]
    found[:, :2] = (found[:, :2] - (finer - 1) / 2.0) / finer
    return found[np.argsort(-found[:, 2])]


def residuals(image: Array, mask: NDArray[np.bool_], model: Array) -> Array:
    """Return ``(g - m) / sqrt(m)``, shape (ny, nx); NaN where a pixel is bad, or the model is 0."""
    usable = ~mask & (model > 0)
    values = np.where(usable, image - model, np.nan)
    return np.divide(values, np.sqrt(model, where=usable, out=np.ones_like(model)), out=values)


def judge(observation: Observation, models: Iterable[Array]) -> list[Fit]:
    """Return how well the models m_j, each of shape (ny, nx), fit the good pixels of each image."""
    images = zip(observation.images, observation.mask, models, strict=True)
    return [Fit.of(residuals(image, mask, model), model) for image, mask, model in images]


def judge_stars(estimate: Estimate) -> list[StarResiduals]:
    """Return how well a model fits at each star, in all images together.

    Parameters
    ----------
    estimate : Estimate
        The models are made in windows round its stars alone.
    """
    found, scene = [], estimate.scene
    if not scene.n_stars:
        return []
    width = min(fwhm(psf) for psf in scene.observation.psfs)
    own = scene.observation.star_psfs
    psfs = [psfs_on_detector(scene.observation, each) for each in (*own, None)]  # None: of others
    on_pixels = on_sky(scene.stars, scene.oversample)
    n = scene.n_stars
    stars = zip(scene.stars, on_pixels, estimate.star_fluxes[:n], scene.shown[:n], strict=True)
    for s, (position, on_pixel, flux, shown) in enumerate(stars):
        core, wings, counts = Fit(), Fit(), 0.0
        for j in np.flatnonzero(shown).tolist():
            of_core, of_wings, more = _fits_at(estimate, j, psfs[scene.owned[s]][j], position)
            core, wings, counts = core.plus(of_core), wings.plus(of_wings), counts + more
        excess = max(core.square_sum - 0.5 * core.variance, 0.0)
        core_error = math.sqrt(excess / counts) if counts else 0.0
        halo, light = _halo(estimate.observed_sky, on_pixel, width)
        shown_flux = float(flux) * scene.share_shown(s)
        halo, share = (halo / each if each > 0 else 0.0 for each in (shown_flux, light))
        found.append(StarResiduals(core, wings, halo, share, core_error=core_error))
    return found


def _fits_at(estimate: Estimate, j: int, psf: Array, position: Array) -> tuple[Fit, Fit, float]:
    """Return the fit in core and wings of a star in one image, and the electrons in its core."""
    from astropy.nddata import NoOverlapError, overlap_slices

    from lnocl.core.scene.view import View, Window  # which load scipy

    scene, observation = estimate.scene, estimate.scene.observation
    y, x = np.nonzero(psf > WINGS * psf.max())
    bright = psf[y.min() : y.max() + 1, x.min() : x.max() + 1]
    # The middle of these pixels, where the PSF's is at the star.
    middle = [
        round(at) - n // 2 + low + size // 2
        for at, n, low, size in zip(
            observation.places(j, position)[::-1],
            psf.shape,
            (y.min(), x.min()),
            bright.shape,
            strict=True,
        )
    ]
    try:
        there, of_psf = overlap_slices(observation.shape, bright.shape, middle)
    except NoOverlapError:  # the star is in other images alone
        return Fit(), Fit(), 0.0
    rows, columns = there
    shape = rows.stop - rows.start, columns.stop - columns.start
    window = Window(rows.start, columns.start, shape)
    model = np.maximum(View(scene, j, window).model(estimate), 0.0)
    model = scene.in_electrons(model, j, there)
    values = residuals(observation.images[j][there], observation.mask[j][there], model)
    share = bright[of_psf] / psf.max()
    is_core, is_wing = share > CORE, (share > WINGS) & (share <= CORE)
    of_core, of_wings = (Fit.of(values[where], model[where]) for where in (is_core, is_wing))
    return of_core, of_wings, float(model[is_core & ~np.isnan(values)].sum())


def _halo(extended: Array, position: Array, width: float) -> tuple[float, float]:
    """Return the light that lies all round a position, and falls outwards; and all light there.

    In each ring round it that is the lower quartile of the means of eight sectors, and never more
    than in the ring inside it; less what is left in the outermost ring, at twelve PSF widths.
    """
    (x, y), (ny, nx) = position, extended.shape
    reach = min(REACH * width, x, y, nx - 1 - x, ny - 1 - y)
    edges = [0.0, 1.5]
    while edges[-1] < reach:
        edges.append(edges[-1] + max(1.0, 0.15 * edges[-1]))
    first = np.maximum(np.floor((y - edges[-1], x - edges[-1])).astype(int), 0)
    window = extended[first[0] : int(y + edges[-1]) + 2, first[1] : int(x + edges[-1]) + 2]
    rows, columns = np.indices(window.shape)
    dy, dx = rows + first[0] - y, columns + first[1] - x
    ring = np.digitize(np.hypot(dy, dx), edges) - 1
    sector = ((np.arctan2(dy, dx) / (2.0 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    sector[ring == 0] = 0
    n = len(edges) - 1
    inside = ring < n
    index = (ring * SECTORS + sector)[inside]
    counts = np.bincount(index, minlength=n * SECTORS).reshape(n, SECTORS)
    sums = np.bincount(index, window[inside], minlength=n * SECTORS).reshape(n, SECTORS)
    means = np.divide(sums, counts, out=np.full(sums.shape, np.inf), where=counts > 0)
    lower = np.sort(means, axis=1)[np.arange(n), (counts > 0).sum(axis=1) // 4]
    held = counts.sum(axis=1)
    falling = np.minimum.accumulate(lower[held > 0])  # none round a star beyond the sky
    halo = ((falling - falling[-1:]) * held[held > 0]).sum()
    return float(halo), float(sums.sum())
