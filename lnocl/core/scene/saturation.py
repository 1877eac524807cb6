"""Cores of stars that a detector has lost, clipped, set to 0 or wrapped round; and rays on them.

A core is looked at beside the star's own wings. Its PSF and a level are fitted to the pixels
outside, with slopes of the PSF, so that the place may be a little off, and a broad host. A core is
lost where its brightest pixels have one value that is below that model; or where pixels far below
it lie inside brighter ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, label

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.blemishes import cosmic_rays
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.scene import Scene

# The square in which a star is looked at reaches so many widths of its PSF from it, at least and at
# most so many pixels.
REACH, LEAST_REACH, MOST_REACH = 3.0, 5, 40
# The star dominates where its PSF is above this share of its peak; neighbours are modelled that
# have as much there.
SEEN = 0.02
# A host beside star and level is a Gaussian of this share of the square.
HOST = 0.25
# The fit takes PSFs for wrong by this share of the star.
PSF_ERROR = 0.05
# A flat top is below the model by so many standard deviations and this share. Few pixels are alike
# by chance, which must be less than this, unless they are below by many more and the rest fits.
BELOW, LESS, CHANCE, CLEARLY = 5.0, 0.03, 1e-7, 10.0
# Of symmetric scenes without noise so many pixels may be alike; then most of the next are too.
ORBIT, ALIKE = 8, 0.25
# Values are the same but for rounding.
ROUNDING = 1e-9
# A wrapped value is half of the true one at most, and the model is not better than this.
MISSING = 0.6
# The lowest pixel of a hole has less than this share of the median beside it.
HOLE = 0.5
# Parts of the core that are left out of the fit, by their share of the peak, and how well the PSF
# is to fit round it: the rms of what is left over the light.
PARTS, FITTED = (0.9, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05), 0.15

# Rays on a star are looked for where the PSF is wider than this, pixels, and taken to be wrong by
# this share of the model, from which so many fits leave out what is so many times that above it.
SHARPEST, RAY_ERROR, CLIPS, CLIPPED = 2.2, 0.07, 4, 4.0


class LostCore(NamedTuple):
    """The pixels of a star's core that an image has lost.

    Attributes
    ----------
    image, star : int
        Which.
    rows, columns : slice
        A window of the image round the star.
    lost : ndarray of bool
        Which pixels of the window are lost.
    level : float
        The electrons at which they are flat; NaN where they are far below the pixels beside them.
    """

    image: int
    star: int
    rows: slice
    columns: slice
    lost: Mask
    level: float


class _Core(NamedTuple):
    """A star in a window: its light, its variance, good pixels, PSF, and columns of the fit."""

    light: Array
    variance: Array
    good: Mask
    psf: Array
    columns: Array

    def model(self, outside: Mask) -> tuple[Array, float] | None:
        """Return the light that pixels outside tell, and the flux over its error."""
        use = outside & self.good
        if np.count_nonzero(use & (self.psf > SEEN)) < 2 * len(self.columns):
            return None
        variance, columns = self.variance, self.columns[:, use].T
        found = np.zeros(len(self.columns))
        for _ in range(3):
            weights = np.sqrt(variance[use] + (PSF_ERROR * found[0] * self.psf[use]) ** 2) ** -1.0
            found = np.linalg.lstsq(weights[:, None] * columns, weights * self.light[use])[0]
        errors = np.linalg.pinv((weights[:, None] * columns).T @ (weights[:, None] * columns))
        return np.tensordot(found, self.columns, 1), found[0] / math.sqrt(max(errors[0, 0], 1e-99))


def lost_cores(scene: Scene) -> Iterator[LostCore]:
    """Yield what images have lost of the core of each star that they show.

    Not of stars with PSFs of their own, whose core a coronagraph may hide.
    """
    observation = scene.observation
    for j, s, (rows, columns), core in _cores(scene):
        counts = core.light + _pixels(observation.background, j, rows, columns)
        counts = counts - _pixels(observation.read_noise, j, rows, columns) ** 2
        if (flat := _flat(core, counts)) is not None:
            yield LostCore(j, s, rows, columns, flat, float(counts[flat].max()))
        elif (hole := _hole(core)) is not None:
            yield LostCore(j, s, rows, columns, hole, math.nan)


def rays_on_stars(scene: Scene, known: Mask) -> Mask:
    """Return where images are sharper than their PSFs beside the models of their stars.

    The models are those of `lost_cores`, without pixels that are far above them. Nothing is said of
    PSFs so narrow that a star's place between pixels makes it sharp. Rays that are known
    are masked.
    """
    observation = scene.observation
    rays, psfs = np.zeros(observation.mask.shape, bool), psfs_on_detector(observation)
    is_wide = [fwhm(psf) > SHARPEST for psf in psfs]
    for j, _, (rows, columns), core in _cores(scene):
        used, found = core.good.copy(), None
        for _ in range(CLIPS if is_wide[j] else 0):
            if (found := core.model(used)) is None:
                break
            left = core.light - found[0]
            noise = np.sqrt(core.variance + (RAY_ERROR * found[0]) ** 2)
            used &= left < CLIPPED * noise
        if found is not None:
            # A PSF that is wrong leaves as much below the model as above it.
            below = float((-left / noise)[core.good].max(initial=0.0))
            noise *= max(below / CLIPPED, 1.0)
            masked = known[j, rows, columns]
            left[masked] = 0.0  # as beside the star, where nothing else is known
            found_there = cosmic_rays(left, noise, ~(core.good | masked), [psfs[j]])
            # What is larger than the rays in it is what a wrong PSF leaves.
            labels, _ = label(left > CLIPPED * noise, np.ones((3, 3)))
            beyond = labels[~binary_dilation(found_there, np.ones((3, 3)))]
            found_there &= ~np.isin(labels, beyond[beyond > 0])
            rays[j, rows, columns] |= found_there & ~masked
    return rays


def _cores(scene: Scene) -> Iterator[tuple[int, int, tuple[slice, slice], _Core]]:
    """Yield each star in each image that shows it, and the window that it is in."""
    observation = scene.observation
    if not scene.n_stars:
        return
    from scipy.spatial import KDTree  # which the start of a command need not load

    widths = [fwhm(psf) for psf in psfs_on_detector(observation)]
    for j, width in enumerate(widths):
        reach = int(np.clip(np.ceil(REACH * width), LEAST_REACH, MOST_REACH))
        shown = np.flatnonzero(scene.shown[: scene.n_stars, j] & (scene.owned < 0))
        places = scene.star_field.places[j][shown]
        near = KDTree(places).query_ball_point(places, 2 * reach, p=np.inf) if len(places) else []
        for k, s in enumerate(shown.tolist()):
            rows, columns = (
                slice(max(round(at) - reach, 0), min(round(at) + reach + 1, n))
                for at, n in zip(places[k][::-1].tolist(), observation.shape, strict=True)
            )
            core = _cut(scene, j, s, shown[[i for i in near[k] if i != k]].tolist(), rows, columns)
            if core is not None:
                yield j, s, (rows, columns), core


def _pixels(values: Array, j: int, rows: slice, columns: slice) -> Array | float:
    """Return those of a window of image j, of numbers or maps of all."""
    return values[j][rows, columns] if values.ndim == 3 else float(values[j])


def _cut(
    scene: Scene, j: int, s: int, others: Iterable[int], rows: slice, columns: slice
) -> _Core | None:
    """Return a star and what is beside it; None where no good pixel is near its middle."""
    observation = scene.observation
    shape = rows.stop - rows.start, columns.stop - columns.start
    if min(shape) < 2:
        return None
    first, exposure = (rows.start, columns.start), _pixels(observation.exposure, j, rows, columns)
    psfs = [
        exposure * scene.star_cutout(j, star).add_to(np.zeros(shape), first, scene.image_grid)
        for star in (s, *others)
    ]
    peak = psfs[0].max()
    good = ~observation.mask[j][rows, columns]
    if not peak > 0 or not good[psfs[0] > 0.5 * peak].any():
        return None
    psf = psfs[0] / peak
    beside = [each / peak for each in psfs[1:] if each.max() > SEEN * peak]
    counts = observation.images[j][rows, columns]
    light = counts - _pixels(observation.background, j, rows, columns)
    y, x = np.indices(shape) - np.reshape([n // 2 for n in shape], (2, 1, 1))
    v, u = (each - int(each.flat[psf.argmax()]) for each in (y, x))
    host = np.exp(-(u**2 + v**2) / (2.0 * (HOST * max(shape)) ** 2))
    fitted = np.array([psf, *np.gradient(psf), np.ones(shape), x, y, host, *beside])
    return _Core(light, np.maximum(counts, 1.0), good, psf, fitted)


def _flat(core: _Core, counts: Array) -> Mask | None:
    """Return the pixels of a flat top, if there is one."""
    inside = core.good & (core.psf > SEEN)
    top = float(counts[inside].max())
    flat = inside & (np.abs(counts - top) <= ROUNDING * abs(top))
    n, n_inside = int(flat.sum()), int(inside.sum())
    is_bright = core.light[flat].mean() > CLEARLY * math.sqrt(core.variance[flat].mean())
    if n < 2 or not is_bright:
        return None
    # The chance that as many counts of the brightest pixels are alike, each with its neighbour.
    values = np.sort(counts[inside & ~flat])[::-1][: max(12, 2 * n)]
    if n <= ORBIT and 1.0 - len(np.unique(values)) / max(len(values), 1) > ALIKE:
        return None
    of_two = 1.0 / math.sqrt(4.0 * math.pi * max(top, 1.0))
    n_top = min(n_inside, 4 * n)
    chance = math.comb(n_top - 1, n - 1) * of_two ** (n - 1)
    found = core.model(~flat)
    if found is None:
        return flat if chance < CHANCE else None
    model, _ = found
    below, variance = (model - core.light)[flat], core.variance[flat]
    needed = BELOW if chance < CHANCE else CLEARLY
    is_below = below.mean() > max(
        needed * math.sqrt(variance.mean() / n), LESS * model[flat].mean()
    )
    if not is_below or (chance >= CHANCE and not _is_fitted(core, model, inside & ~flat)):
        return None
    return flat


def _hole(core: _Core) -> Mask | None:
    """Return the pixels that are far below the star's model, inside brighter ones, if any are."""
    from scipy.ndimage import binary_dilation, rank_filter

    # Beside a hole three pixels or more are brighter, and more so than the PSF is; else no fit.
    light = np.where(core.good, core.light, 0.0)
    of_light, of_psf = (rank_filter(each, -3, 3) for each in (light, core.psf))
    is_low = light * of_psf < HOLE * core.psf * of_light
    if not (is_low & core.good & (core.psf > PARTS[-1])).any():
        return None
    for part in PARTS:
        inside = core.psf > part
        found = core.model(~inside)
        if found is None:
            continue
        model, significance = found
        ring = core.good & ~inside & (core.psf > 0.2 * part)
        if significance < CLEARLY or not _is_fitted(core, model, ring):
            continue
        below = model - core.light
        noise = np.sqrt(core.variance + np.maximum(model, 0.0))
        lost = core.good & inside & (below > CLEARLY * noise) & (core.light < MISSING * model)
        if not lost.any():
            continue
        beside = binary_dilation(lost, np.ones((3, 3))) & ~lost & core.good
        if beside.any() and core.light[lost].min() < HOLE * np.median(core.light[beside]):
            return lost
    return None


def _is_fitted(core: _Core, model: Array, where: Mask) -> bool:
    """Return whether the star's PSF fits there, but for noise and a share of its light."""
    if not where.any():
        return False
    left = float(np.mean((core.light - model)[where] ** 2 - core.variance[where]))
    return math.sqrt(max(left, 0.0)) < FITTED * float(np.mean(model[where]))
