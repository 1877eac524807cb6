"""Short runs with PSFs that are to be judged, in a window round the stars."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from lnocl.process import ignored_warnings
from lnocl.runs.run import Run
from lnocl.runs.start import Setup, make_model, make_start
from lnocl.scene.detector import on_sky
from lnocl.scene.observation import Array, Observation
from lnocl.scene.padding import choose_pad
from lnocl.scene.penalty import Penalty
from lnocl.scene.rings import Rings, medians
from lnocl.scene.scene import MIN_MODEL, Scene
from lnocl.solvers.fluxes import fit_fluxes
from lnocl.solvers.psf_fit import Misfit, PsfStep, misfit

# Of the extended source, what lies all round a star is the star's: this quantile in each ring.
ROUND = 0.4
# So many times what the PSFs' error may fake is not the extended source's.
FAKED = 2.0
# Short runs look at a window of this side, pixels of the images.
WINDOW = 256
# The median of the square of a normal deviate of unit variance.
MEDIAN = 0.455
# Where stars give so little of their peak, residuals show nothing of their PSFs; nor do they show
# more than this of those.
DARK, MOST_WRONG = 1e-9, 1.0
# PSFs are judged after so many iterations.
JUDGED = 15
# The error of a PSF's pixel is a share of the PSF, smoothed over so many pixels of the images.
SPREAD = 2.0


def find_window(setup: Setup, observation: Observation) -> tuple[Observation, Array, Array]:
    """Return the observation cut to a window round most of the stars, these, and its corner."""
    size = np.minimum(observation.shape[::-1], WINDOW)
    last = np.array(observation.shape[::-1]) - size
    middle = (setup.stars.min(axis=0) + setup.stars.max(axis=0)) / 2.0
    firsts = [np.clip(np.round(at) - size // 2, 0, last) for at in (middle, *setup.stars)]
    low = np.array(firsts)[:, None] - 0.5
    held = np.all((setup.stars >= low) & (setup.stars < low + size), axis=2)
    best = int(np.argmax(held.sum(axis=1)))
    x, y = (slice(int(at), int(at + n)) for at, n in zip(firsts[best], size, strict=True))
    cut = copy(observation)
    for name in ("images", "mask", "background", "exposure"):
        values = getattr(observation, name)
        setattr(cut, name, values[:, y, x] if values.ndim == 3 else values)
    return cut, setup.stars[held[best]] - firsts[best], firsts[best]


class ShortRuns:
    """Short runs with PSFs to be judged, whose stars are refined where they are in the run."""

    def __init__(
        self, setup: Setup, observation: Observation, stars: Array, is_round: bool
    ) -> None:
        # One grid for all PSFs that are tried.
        pad = choose_pad(observation) if setup.pad == "auto" else setup.pad
        self._setup = replace(setup, solver="sgp", stars=stars, pad=pad)
        self._observation, self._share = observation, 0.0 if is_round else ROUND

    @property
    def n_images(self) -> int:
        """Number of images."""
        return self._observation.n_images

    def at(self, psfs: Array, n_iter: int) -> Estimate:
        """Return the estimate after so many iterations with these PSFs."""
        with ignored_warnings():  # those of the reconstruction are the same
            run = Run(make_start(self._setup, self._seen_through(psfs), Penalty()), n_iter)
            for _ in run:
                pass
        extended, fluxes = run.engine.extended().astype(np.float64), run.engine.star_fluxes()
        return _clean(run.scene, extended, fluxes, self._share)

    def judge(self, psfs: Array) -> tuple[Misfit, Estimate]:
        """Return how well these PSFs fit, and the estimate by which that is judged."""
        found = self.at(psfs, JUDGED)
        return misfit(found.scene, found.extended, found.fluxes), found

    def moved(self, estimate: Estimate, psfs: Array, change: PsfStep) -> Estimate:
        """Return an estimate with other PSFs and stars."""
        ny, nx = self._observation.shape
        positions = change.positions.clip(0, (nx - 1, ny - 1))
        with ignored_warnings():
            scene = Scene(self._seen_through(psfs), positions, pad=self._setup.pad)
        return replace(estimate, scene=scene, fluxes=change.fluxes)

    def _seen_through(self, psfs: Array) -> Observation:
        """Return the observation with these PSFs, as far as the window may show them."""
        most = WINDOW * self._observation.oversample
        cut = [
            slice(n // 2 - min(n, most) // 2, n // 2 - min(n, most) // 2 + min(n, most))
            for n in psfs.shape[1:]
        ]
        return with_psfs(self._observation, psfs[:, *cut])


@dataclass(frozen=True)
class Estimate:
    """An estimate without what PSFs in error may have left in its extended source.

    `kappa` is the relative error of the PSFs in each of the `Rings` round the stars, as far as
    residuals show it beyond the noise of the counts: the root of the median of
    ``((g - m)^2 / 0.455 - m) / (sum_s c_s P_js)^2``.
    """

    scene: Scene
    extended: Array
    fluxes: Array
    kappa: Array


def _clean(scene: Scene, extended: Array, fluxes: Array, share: float) -> Estimate:
    """Return an estimate whose extended source has nothing that the stars' PSFs may have left.

    Where `share` is not 0, that is this quantile of each ring round a star.
    """
    model = make_model(scene)
    shape, q = scene.observation.shape, scene.oversample
    inside = tuple(map(slice, shape))
    sky_shape = scene.observation.sky_shape
    on_images = tuple(map(slice, sky_shape))  # the part of the sky's grid that they show
    rings = Rings(sky_shape, on_sky(scene.stars, q), q)
    kept = extended.copy()
    if share:
        round_stars = rings.round_stars(kept[on_images], share)
        kept[on_images] = np.maximum(kept[on_images] - round_stars, 0.0)
    diffuse = model.forward(kept)
    diffuse += model.background
    fluxes = fit_fluxes(scene, model, diffuse, fluxes)
    excess, number = [], []
    mean_light = np.zeros(sky_shape)
    for j, (counts, light) in enumerate(zip(scene.images(), model.starlight(fluxes), strict=True)):
        total = np.maximum(diffuse[j] + light, MIN_MODEL)[inside]
        counts, light, weights = (
            each[inside]
            for each in (counts, light, np.broadcast_to(model.weights[j], scene.image_grid))
        )
        good = weights > 0
        variance = np.divide(total, weights * scene.scale, out=np.ones(shape), where=good)
        squares = (counts - total) ** 2 / MEDIAN
        lit = good & (light > DARK * light.max())
        excess.append((squares - variance)[lit] / light[lit] ** 2)
        number.append(Rings(shape, scene.stars + scene.observation.offsets[j]).number[lit])
        mean_light += starlight_on_sky(scene, j, fluxes) / scene.n_images
    kappa = np.zeros(rings.number.max() + 1)
    found = medians(np.concatenate(number), np.concatenate(excess)).clip(0.0, MOST_WRONG**2) ** 0.5
    kappa[: len(found)] = found[: len(kappa)]
    faked = FAKED / np.sqrt(scene.n_images) * kappa[rings.number] * mean_light
    kept[on_images] = np.maximum(kept[on_images] - faked, 0.0)
    return Estimate(scene, kept, fluxes, kappa)


def starlight_on_sky(scene: Scene, j: int, fluxes: Array) -> Array:
    """Return the PSF of image j times its flux at each star, within the images' part of the sky."""
    ny, nx = scene.observation.sky_shape
    total = np.zeros(scene.grid)
    for s, flux in enumerate(fluxes):
        stamp = scene.psf_on_sky(j, s)
        total[stamp.window(scene.grid)] += flux * stamp.values
    return total[:ny, :nx]


def estimate_scatter(psfs: Array, kappa: Array, oversample: int) -> Array:
    """Return the scatter of the pixels of PSFs, a share of the PSF round each pixel.

    Parameters
    ----------
    psfs : ndarray of float64, shape (p, ky, kx)
        The PSFs.
    kappa : ndarray of float64
        The error that residuals show in each ring, as `Estimate.kappa`.
    oversample : int
        Pixels of the PSFs to one of the images, along each axis.
    """
    share = at_rings(kappa, rings_of(psfs, oversample))
    width = SPREAD * oversample
    return np.array([share * gaussian_filter(psf, width).clip(0.0) for psf in psfs])


def rings_of(psfs: Array, oversample: int) -> Rings:
    """Return the rings round the middle of PSFs."""
    ky, kx = psfs.shape[1:]
    return Rings((ky, kx), np.array([(kx // 2, ky // 2)]), oversample)


def at_rings(values: Array, rings: Rings) -> Array:
    """Return the value of its ring at each pixel; beyond the last, that of the last."""
    return values[np.minimum(rings.number, len(values) - 1)]


def with_psfs(observation: Observation, psfs: Array) -> Observation:
    """Return an observation with other PSFs, as they are."""
    other = copy(observation)
    other.psfs = psfs
    return other
