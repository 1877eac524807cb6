r"""PSFs from the images themselves: parameters of each, the extended source marginalised.

The model of image j is ``m_j = A_j f + sum_s c_s P_js + b_j``, all of which depends on the
parameters theta_j of PSF j. Near an estimate

.. math:: g_j \approx m_j + J \eta + A_j (a C^{1/2} x) + D_j(y) * (f + \sum_s c_s \delta_s)

with the changes eta of parameters, fluxes and positions, J the derivatives of the models; an error
of the extended source that is as large as it is, smoothed, a, and correlated over C; and, where
they are free, the corrections D_j of the PSFs' pixels. The fields x and y are of N(0, 1). All are
fitted at once, weighted by 1 / m_j: eta is eliminated, x and y found by conjugate gradients. Where
f is held instead, it takes up a part of what is wrong with the PSFs, and eta lags and is biased.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.fft
from scipy.ndimage import gaussian_filter

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.camera import sampled, spread
from lnocl.core.scene.detector import pixel_spectrum
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.psf_families import PsfFamilies, PsfParameters, Spectrum, spectrum
from lnocl.core.scene.psf_pixels import PsfPixels
from lnocl.core.scene.threads import threads
from lnocl.core.scene.view import View
from lnocl.core.solvers.fluxes import MAX_FADING
from lnocl.core.solvers.least_squares import Field, LeastSquares, LinearImage, SourceError
from lnocl.core.solvers.sources import Sources

# The error of the extended source is correlated over this, pixels of the images, and as large as it
# is smoothed over that.
CORRELATED, SMOOTHED = 1.5, 4.0
# Steps of conjugate gradients, and the share of the gradient at which they end.
N_STEPS, FINISHED = 40, 1e-2
# A step moves no parameter by more of its prior's standard deviations, and no star by more pixels.
MAX_STEP, MAX_MOVE = 3.0, 0.5


class PsfStep(NamedTuple):
    """Changes of PSF parameters, new fluxes of stars and halos, electrons, and stars' positions."""

    parameters: PsfParameters
    star_fluxes: Array
    positions: Array


def step(
    estimate: Estimate, families: PsfFamilies, parameters: PsfParameters, moves: bool
) -> PsfStep:
    """Return a step of Gauss and Newton for PSFs and stars, the extended source marginalised.

    Parameters
    ----------
    estimate : Estimate
        The PSFs of its scene are those of the parameters.
    families : PsfFamilies
        What the PSFs may be.
    parameters : PsfParameters
        The present ones.
    moves : bool
        Whether the stars' positions are fitted too.
    """
    scene, extended, fluxes = estimate.scene, estimate.extended, estimate.fluxes
    model, values = Model(scene), parameters.values
    images = _linearise(estimate, families, values, model, moves)
    n, places = len(fluxes), scene.places
    of_stars = np.zeros(n + (places.size if moves else 0))
    at = np.append(of_stars, values)
    prior = np.append(of_stars, np.tile(families.prior**-2.0, len(values)))
    fields: list[Field] = [_source_error(model, extended)]
    if families.pixels is not None:
        fields.append(_PixelErrors(model, families.pixels, extended, fluxes, parameters.pixels))
    change, changes = _fit(images, fields, prior).solve(at)
    longest = (abs(change[len(of_stars) :].reshape(values.shape)) / families.prior).max(initial=0.0)
    change *= MAX_STEP / max(longest, MAX_STEP)
    of_stars, of_psfs = np.split(change, [len(of_stars)])
    to = np.maximum(fluxes + of_stars[:n], MAX_FADING * fluxes)
    moved = of_stars[n:].reshape(-1, len(places)).T.clip(-MAX_MOVE, MAX_MOVE)
    pixels = parameters.pixels if families.pixels is None else changes[1]
    to = Estimate.of_scaled(scene, extended, to).star_fluxes
    changed = PsfParameters(of_psfs.reshape(values.shape), pixels)
    return PsfStep(changed, to, places + moved if moves else places)


def settle(estimate: Estimate, model: Model, share: float) -> Estimate:
    """Return the estimate nearest to one whose extended source may be off by a share of itself.

    It is that of the least squares with the PSFs held: ``f + share a C^(1/2) x``, which may be
    negative, and the star fluxes that go with it.

    Parameters
    ----------
    estimate : Estimate
        What is modelled, and how bright it is.
    model : Model
        Of the scene.
    share : float
        The standard deviation of f, over its smoothed self.
    """
    scene, extended, fluxes = estimate.scene, estimate.extended, estimate.fluxes
    held = PsfFamilies((), scene.observation)
    images = _linearise(estimate, held, held.first().values, model, False)
    error = _source_error(model, share * extended)
    change, (x, *_) = _fit(images, [error], np.zeros(len(fluxes))).solve()
    return Estimate.of_scaled(scene, extended + error.of(x), fluxes + change)


def _fit(images: list[LinearImage], fields: Sequence[Field], prior: Array) -> LeastSquares:
    return LeastSquares(images, fields, prior, N_STEPS, FINISHED)


def _source_error(model: Model, extended: Array) -> SourceError:
    # In single precision: conjugate gradients end long before its rounding.
    single, width = model.single(), CORRELATED * model.oversample
    amplitude = gaussian_filter(extended, SMOOTHED * model.oversample, mode="wrap")
    amplitude = amplitude.astype(np.float32)
    return SourceError(single.forward, single.adjoint, amplitude, width, model.scene.scale)


def _linearise(
    estimate: Estimate, families: PsfFamilies, values: Array, model: Model, moves: bool
) -> list[LinearImage]:
    """Return the images near the estimate: all its sources, and then parameters of PSFs."""
    scene, extended = estimate.scene, estimate.extended
    sources = Sources(estimate, np.arange(scene.n_fluxes), moves)
    k, q, images = len(families.prior), scene.oversample, list[LinearImage]()
    for j, diffuse in enumerate(model.convolved(extended)):
        view, light = View(scene, j), scene.star_field.light(j, estimate.fluxes)
        image = sources.linear(view, sampled(diffuse, q) + light + view.background)
        slopes = _psf_slopes(estimate, families, values[j], model, j, diffuse) if k else []
        images.append(image.beside(slopes, sources.n + np.arange(j * k, (j + 1) * k)))
    return images


def _psf_slopes(
    estimate: Estimate, families: PsfFamilies, values: Array, model: Model, j: int, diffuse: Array
) -> list[Array]:
    """Return the derivatives of the model of an image with respect to the parameters of its PSF.

    The PSF changes light as the image has it, before its pixels sample that. Halos and stars with
    PSFs of their own are as they are given. `diffuse` is the convolved extended source before
    pixels sample it.
    """
    scene, fluxes = estimate.scene, estimate.fluxes
    factors, modes = families.slopes(j, scene.grid, values)
    if scene.rotations:  # else slopes would ring by edges beyond the pixels that are used
        sky = _sky(model, j, estimate.extended, fluxes)
        whole = spectrum(scene.observation.psfs[j], scene.grid) * sky
    else:
        light = diffuse.copy()
        for s in np.flatnonzero(scene.shown[:, j] & scene.through_psfs).tolist():
            star = scene.star_field.psfs[j][s].on_sky(*scene.star_field.places[j][s])
            light[star.window(scene.grid)] += fluxes[s] * star.values
        whole = scipy.fft.rfft2(light)
        sky = _sky(model, j, estimate.extended, fluxes) if modes else whole
    changes = [*(factor * whole for factor in factors), *(mode * sky for mode in modes)]
    return [sampled(scipy.fft.irfft2(each, scene.grid), scene.oversample) for each in changes]


def _sky(model: Model, j: int, extended: Array, fluxes: Array) -> Spectrum:
    """Return the spectrum of all that PSF j is convolved with: stars, extended source, pixels.

    It is in the frame of the image, whose pixels are each `oversample`-th of the sky's.
    """
    scene = model.scene
    u, v = np.fft.rfftfreq(scene.grid[1])[None, :], np.fft.fftfreq(scene.grid[0])[:, None]
    places, shares = scene.star_field.places[j], scene.transmitted(scene.stars)[j]
    sky = scene.areas[j] / scene.oversample**2 * model.cameras[j].in_frame(extended)
    for s in np.flatnonzero(scene.shown[:, j] & scene.through_psfs):
        x, y = scene.oversample * places[s]
        sky = sky + shares[s] * fluxes[s] * np.exp(-2j * np.pi * (u * x + v * y))
    return np.asarray(sky * (scene.gains[j] * pixel_spectrum(v, u, scene.observation)))


class _PixelErrors:
    """The errors of the pixels of the PSFs, ``D_j * (f + sum_s c_s delta_s)``."""

    def __init__(
        self, model: Model, pixels: PsfPixels, extended: Array, fluxes: Array, at: Array
    ) -> None:
        self._pixels, self._grid, self.at = pixels, model.grid, at
        self._oversample = model.oversample
        self._skies = [_sky(model, j, extended, fluxes) for j in range(len(at))]
        places = [np.arange(k) - k // 2 for k in at.shape[1:]]
        self._places = np.ix_(*(at % n for at, n in zip(places, self._grid, strict=True)))

    def forward(self, x: Array) -> Iterator[Array]:
        for j, (field, sky) in enumerate(zip(x, self._skies, strict=True)):
            change = spectrum(self._pixels.correction(j, field), self._grid)
            seen = scipy.fft.irfft2(change * sky, self._grid, workers=threads(self._grid))
            yield sampled(seen, self._oversample)

    def adjoint(self, images: Array) -> Array:
        fields, workers = np.empty_like(self.at), threads(self._grid)
        for j, (image, sky) in enumerate(zip(images, self._skies, strict=True)):
            of_image = scipy.fft.rfft2(spread(image, self._oversample), workers=workers)
            back = sky.conj() * of_image
            of_psf = scipy.fft.irfft2(back, self._grid, workers=workers)[self._places]
            fields[j] = self._pixels.adjoint(j, of_psf)
        return fields
