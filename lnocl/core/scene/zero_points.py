"""Zero points of images: by what factor all stars are brighter in one image than in others.

Light is summed in circles round each star, the mean of a ring taken off, and divided by the same of
its PSF. The ratio of two images then hardly hangs on the shapes of PSFs, and not on what lies under
the star. Circles of three sizes tell a zero point, which all have, from a PSF that is wrong, and
from light beside the star, such as a cosmic ray, that one image has.

A star has another flux in each filter, so that images are compared with those of their own.

In several epochs a star may vary. So there a zero point is that of three stars or more, by how much
these vary against each other in all images together, with Student's distribution: three that agree
in one of few images do so by chance (docs/validation/epochs.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import fwhm
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.scene import Scene

# Radii of the circles and of the ring, in the widths of the widest PSF, and pixels at least.
CIRCLES, RING, LEAST_WIDTH = (0.7, 1.5, 2.5), (3.0, 4.5), 1.5
# Stars with this relative error at most are used, the brightest; more than this is not known of
# each, which may vary a little.
FAINTEST, MOST_STARS, SYSTEMATIC = 0.1, 100, 0.005
# Bad pixels may hold this share of a star's light, and leave so much of the ring.
HIDDEN, LEFT = 0.05, 0.5
# A zero point is used that is more than this, so many times its error, and the same in all circles
# but for these shares, in the least and the largest beside the other, or so many errors. Beside it
# others are that are fewer times theirs: what made one is likely to have made them.
LEAST, SIGNIFICANT, LIKELY, ALIKE, APART = 0.03, 4.0, 2.0, (0.5, 0.25), 3.0
# Of several epochs, an image has so many good stars or no zero point.
FEWEST = 3


class ZeroPoints(NamedTuple):
    """Natural logarithms of the factors of images, relative to the one in the middle.

    Attributes
    ----------
    values, errors : ndarray of float64, shape (p,)
        NaN where an image shows no star well.
    n_stars : int
        Stars that they are measured on.
    varying : ndarray of float64, shape (p,)
        The errors where stars vary as they do against each other.
    """

    values: Array
    errors: Array
    n_stars: int
    varying: Array


def zero_points(scene: Scene) -> ZeroPoints | None:
    """Return the zero points that are used, 0 where none is; None where no image has one."""
    if scene.mixing is None:
        return _of_one_filter(scene)
    filters = [images for images in scene.mixing.images if len(images) > 1]
    each = [_of_one_filter(scene.of_images(images)) for images in filters]
    found = [(images, of) for images, of in zip(filters, each, strict=True) if of is not None]
    return _joined(scene.n_images, found) if found else None


def _joined(n: int, found: Sequence[tuple[Sequence[int], ZeroPoints]]) -> ZeroPoints:
    """Return the zero points of n images from those of filters.

    As filters are compared, of two images in the middle the brighter one is taken: clouds dim.
    """
    values, errors, varying = np.zeros((3, n))
    for images, of in found:
        values[images] = of.values - np.quantile(of.values, 0.5, method="higher")
        errors[images], varying[images] = of.errors, of.varying
    return ZeroPoints(values, errors, max(of.n_stars for _, of in found), varying)


def _of_one_filter(scene: Scene) -> ZeroPoints | None:
    fewest = FEWEST if scene.n_epochs > 1 else 1
    # Few stars lie so far from others that the largest circle tells of them.
    measured = [_measured(scene, *each) for each in zip(CIRCLES, (fewest, fewest, 1), strict=True)]
    found = [each for each in measured if each is not None]
    if len(found) < len(CIRCLES):
        return None
    core, middle, large = found
    errors = middle.varying if scene.n_epochs > 1 else middle.errors
    with np.errstate(invalid="ignore"):
        is_used = abs(middle.values) > np.maximum(LEAST, LIKELY * errors)
        for each, share in zip((core, large), ALIKE, strict=True):
            apart = APART * np.hypot(each.errors, middle.errors)
            change = abs(each.values - middle.values)
            is_used &= change < np.maximum(share * abs(middle.values), apart)
        is_sure = is_used & (abs(middle.values) > SIGNIFICANT * errors)
        is_sure &= abs(large.values) > np.maximum(LEAST, SIGNIFICANT * large.errors)
    if not is_sure.any():
        return None
    return middle._replace(values=np.where(is_used, middle.values, 0.0), errors=errors)


def _measured(scene: Scene, radius: float, fewest: int) -> ZeroPoints | None:
    """Return the zero points in circles of so many widths, of images of so many good stars or more.

    None where no star shows two.
    """
    fluxes, variances = _photometry(scene, radius)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.sqrt(variances) / fluxes
        is_good = (fluxes > 0) & (relative < FAINTEST)
    for _ in is_good:  # a star in one image tells nothing, and an image may then have too few
        is_good[:, is_good.sum(axis=0) < 2] = False
        is_good[is_good.sum(axis=1) < fewest] = False
    brightest = np.argsort(np.where(is_good, relative, np.inf).min(axis=0))[:MOST_STARS]
    stars = brightest[is_good[:, brightest].any(axis=0)]
    if not len(stars):
        return None
    is_good = is_good[:, stars]
    logs = np.log(np.where(is_good, fluxes[:, stars], np.nan))
    errors = np.where(is_good, np.hypot(relative[:, stars], SYSTEMATIC), np.nan)
    values = np.zeros(len(logs))
    for _ in range(10):  # stars and images in turn
        of_stars = np.nanmedian(logs - values[:, None], axis=0)
        found = [_middle(each - of_stars, error) for each, error in zip(logs, errors, strict=True)]
        values = np.array([each[0] for each in found])
    formal, scatters = np.array(found)[:, 1:].T
    varying = np.fmax(scatters, formal * _varying(logs - of_stars, errors))
    values -= np.nanmedian(values)
    return ZeroPoints(values, np.fmax(formal, scatters), len(stars), varying)


def _varying(values: Array, errors: Array) -> float:
    """Return by how much larger errors of zero points are as stars vary from image to image.

    Pairs of stars tell that, whatever the zero points are. Values are relative to the middle one of
    each star, errors without that.
    """
    from scipy.stats import norm, t  # a third of a second, for several epochs

    seen = np.isfinite(values)
    of_star, n_images = seen.sum(axis=0), np.count_nonzero(seen.any(axis=1))
    apart_by = values * np.sqrt(of_star / (of_star - 1.0))  # each is 2 or more
    ones, others = np.triu_indices(values.shape[1], 1)
    apart = abs(apart_by[:, ones] - apart_by[:, others])
    apart /= np.hypot(errors[:, ones], errors[:, others])
    freedom = int(seen.sum()) - n_images - values.shape[1] + 1
    if freedom < 1 or not np.isfinite(apart).any():
        return np.inf
    scatter = max(np.nanmedian(apart) / norm.ppf(0.75), 1.0)
    return float(scatter * t.isf(norm.sf(SIGNIFICANT), freedom) / SIGNIFICANT)


def _middle(values: Array, errors: Array) -> tuple[float, float, float]:
    """Return the weighted median of values that are not NaN, its error, and that by scatter."""
    known = np.isfinite(values)
    values, weights = values[known], errors[known] ** -2.0
    n = len(values)
    if not n:
        return np.nan, np.nan, np.nan
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - weights[order] / 2.0
    middle = float(np.interp(weights.sum() / 2.0, share, values[order]))
    if n < 3:
        return middle, float(weights.sum() ** -0.5), 0.0
    scatter = 1.4826 * float(np.median(abs(values - middle))) * np.sqrt(np.pi / 2.0 / n)
    return middle, float(np.sqrt(np.pi / 2.0 / weights.sum())), scatter


def _photometry(scene: Scene, radius: float) -> tuple[Array, Array]:
    """Return fluxes and their variances, shape (p, n_stars); NaN where an image has none."""
    psfs, scales = psfs_on_detector(scene.observation), scene.observation.scales
    width = max(fwhm(psf) * scale for psf, scale in zip(psfs, scales, strict=True))
    found = np.full((scene.n_images, scene.n_stars // scene.n_epochs, 2), np.nan)
    for j, scale in enumerate(scales):
        unit = max(width, LEAST_WIDTH) / scale
        for s in np.flatnonzero(scene.shown[: scene.n_stars, j] & (scene.owned < 0)).tolist():
            found[j, s // scene.n_epochs] = _of_star(scene, j, s, radius, unit)
    return found[..., 0], found[..., 1]


def _of_star(scene: Scene, j: int, s: int, radius: float, unit: float) -> tuple[float, float]:
    """Return the flux of a star in an image and its variance; NaN where too little is seen of it.

    The radius is in units of so many pixels.
    """
    observation, (x, y) = scene.observation, scene.star_field.places[j][s]
    reach, (ny, nx) = int(np.ceil(RING[1] * unit)), observation.shape
    edge = min(x, y, nx - 1 - x, ny - 1 - y)
    if edge < radius * unit - 0.5:
        return np.nan, np.nan
    rows, columns = (
        slice(max(round(at) - reach, 0), min(round(at) + reach + 1, n))
        for at, n in ((y, ny), (x, nx))
    )
    there, first = (j, rows, columns), (rows.start, columns.start)
    counts, good = observation.images[there], ~observation.mask[there]
    light = counts - np.broadcast_to(observation.background[j], (ny, nx))[rows, columns]
    star = scene.star_cutout(j, s).add_to(np.zeros(good.shape), first, scene.image_grid)
    if observation.exposure.ndim == 3:
        star = star * observation.exposure[there]
    v, u = np.indices(good.shape)
    distance = np.hypot(v + first[0] - y, u + first[1] - x) / unit
    circle, ring = distance <= radius, good & (distance > RING[0]) & (distance <= RING[1])
    n_ring, n_whole = np.count_nonzero(ring), np.pi * np.diff(np.square(RING)).item() * unit**2
    is_hidden = star[circle & ~good].sum() > HIDDEN * star[circle].sum()
    if is_hidden or n_ring < LEFT * n_whole:
        return np.nan, np.nan
    circle &= good
    weights = circle - ring * (np.count_nonzero(circle) / n_ring)
    of_psf = float((weights * star).sum())
    if not of_psf > 0:
        return np.nan, np.nan
    return float((weights * light).sum()) / of_psf, float((weights**2 * counts).sum()) / of_psf**2
