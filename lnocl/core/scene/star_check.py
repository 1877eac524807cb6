"""Stars in the images beside the PSFs that they are modelled with: their widths and places."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import centroid, fwhm
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.star_weights import warn_of_lost_stars
from lnocl.errors import counted, in_words, warn

# The square in which a star is looked at reaches so many widths of its PSF from it, at least and at
# most so many pixels; the level round it is measured from so many widths on.
REACH, LEAST_REACH, MOST_REACH, LEVEL_FROM = 3.0, 5, 40, 2.0
# Stars are looked at whose peak is so many times its noise, and so many times the level round them.
MIN_SIGNIFICANCE, MIN_CONTRAST = 50.0, 3.0
# On 100 scenes of a jet at its star, 0.3 to 300 times as bright, stars were up to 4 % wider than
# their PSFs, and up to 0.95 FWHM over their contrast off.
MAX_WIDTH_ERROR = 0.1
MAX_OFFSET, LIGHT_ROUND = 0.15, 1.5


class StarCheck(NamedTuple):
    """A star in an image beside its PSF.

    Attributes
    ----------
    image, star : int
        Which.
    widths : tuple of float
        FWHM of the star in the image, and of its PSF there, pixels.
    offset : tuple of float
        From where its PSF is, pixels along x and y.
    contrast : float
        The peak of the star over the brighter parts round it.
    """

    image: int
    star: int
    widths: tuple[float, float]
    offset: tuple[float, float]
    contrast: float

    def excess_distance(self) -> float:
        """Return by how much the offset exceeds what the light round the star may explain."""
        allowed = MAX_OFFSET + LIGHT_ROUND * self.widths[1] / self.contrast
        return float(np.hypot(*self.offset)) - allowed


def check_stars(scene: Scene) -> Iterator[StarCheck]:
    """Yield each star in each image that shows it bright, alone and whole."""
    observation = scene.observation
    if not scene.n_stars:
        return
    from scipy.spatial import KDTree  # which the start of a command need not load

    for j, psf in enumerate(psfs_on_detector(observation)):
        reach = int(np.clip(np.ceil(REACH * fwhm(psf)), LEAST_REACH, MOST_REACH))
        light = observation.images[j] - observation.background[j]
        shown = np.flatnonzero(scene.shown[: scene.n_stars, j])
        positions = scene.star_field.places[j][shown]
        nearest = KDTree(positions).query(positions, k=[2], p=np.inf)[0][:, 0]  # infinite if alone
        is_of_psf = scene.owned[shown] < 0
        for k in np.flatnonzero((nearest >= 2 * reach) & is_of_psf).tolist():
            s, position = int(shown[k]), positions[k]
            x, y = np.round(position).astype(int)
            rows, columns = (slice(at - reach, at + reach + 1) for at in (y, x))
            star = light[max(rows.start, 0) : rows.stop, max(columns.start, 0) : columns.stop]
            side = 2 * reach + 1
            if star.shape != (side, side) or observation.mask[j][rows, columns].any():
                continue
            first = rows.start, columns.start
            cutout = scene.star_cutout(j, s)
            model = cutout.add_to(np.zeros((side, side)), first, scene.image_grid)
            found = _compare(star, model, observation.images[j][rows, columns])
            if found is not None:
                yield StarCheck(j, s, *found)


def _compare(
    star: Array, model: Array, counts: Array
) -> tuple[tuple[float, float], tuple[float, float], float] | None:
    reach = star.shape[0] // 2
    y, x = np.indices(star.shape) - reach
    around = np.hypot(x, y) > reach * LEVEL_FROM / REACH
    star, model = star - np.median(star[around]), model - np.median(model[around])
    core = np.hypot(x, y) <= max(2.0, reach / REACH)
    at = np.unravel_index(int(np.where(core, star, -np.inf).argmax()), star.shape)
    noise = np.sqrt(max(counts[at], 1.0))
    if star[at] < MIN_SIGNIFICANCE * noise or star[at] < star.max():
        return None
    contrast = float(star[at] / max(np.percentile(star[around], 90), noise))
    if contrast < MIN_CONTRAST:
        return None
    (row, column), (model_row, model_column) = centroid(star), centroid(model)
    return (fwhm(star), fwhm(model)), (column - model_column, row - model_row), contrast


def _masked_stars(scene: Scene) -> Iterator[int]:
    """Yield the stars whose middle is on a bad pixel, or outside, in every image.

    Not those with PSFs of their own, which behind a mask have no middle.
    """
    observation = scene.observation
    size = observation.shape[::-1]
    for s, star in enumerate(scene.stars):
        if not scene.shown[s].any() or scene.owned[s] >= 0:  # of the former is told otherwise
            continue
        places = [observation.places(j, star) for j in range(observation.n_images)]
        nearest = np.round(places).astype(int)
        inside = ((nearest >= 0) & (nearest < size)).all(axis=1) & scene.shown[s]
        bad = [observation.mask[j][tuple(nearest[j][::-1])] for j in np.flatnonzero(inside)]
        if all(bad):
            yield s


def warn_of_stars(scene: Scene, moves: bool, own: NDArray[np.intp] | None = None) -> None:
    """Warn of masked stars, of the PSF whose width fits a star least, and of the star farthest off.

    Parameters
    ----------
    scene : Scene
        The stars and the images.
    moves : bool
        Whether positions are refined, so that none is off.
    own : ndarray of int, optional
        The stars that are looked at, in all epochs: of others a tile sees a part. By default all.

    Warns
    -----
    LnoclWarning
        No good pixel shows a star, in an epoch or at all; a star lies on a bad pixel of every image
        of an epoch; a PSF is a tenth wider or narrower than a star; a
        star lies more than 0.15 pixels, and more than what is beside it explains, from where its
        PSF is.
    """
    of_places = np.arange(scene.n_stars) // scene.n_epochs
    is_own = np.ones(scene.n_stars, bool) if own is None else np.isin(of_places, own)
    warn_of_lost_stars(scene, is_own & ~scene.is_shown[: scene.n_stars])
    if masked := {of_places[s].item() for s in _masked_stars(scene) if is_own[s]}:
        place = in_words(scene.places[min(masked)])
        others = f", as {counted(len(masked) - 1, 'other')}" if len(masked) > 1 else ""
        warn(
            f"the star at {place} lies on bad pixels{others}: its flux rests on its "
            "wings, and so on the PSF's; see to the mask"
        )
    found = [each for each in check_stars(scene) if is_own[each.star]]
    if not found:
        return
    worst = max(found, key=lambda each: abs(np.log(each.widths[0] / each.widths[1])))
    star, psf = worst.widths
    if abs(np.log(psf / star)) > np.log1p(MAX_WIDTH_ERROR):
        finer = round(psf / star)
        hint = (
            f", as one sampled {finer} times too fine is: rebin it, or give oversample"
            if finer >= 2
            else ""
        )
        place = in_words(scene.stars[worst.star])
        warn(
            f"`psfs[{worst.image}]` does not fit: it is {psf / star:.2f} times as wide as the star "
            f"at {place} in `images[{worst.image}]`, FWHM {psf:.2f} and {star:.2f} "
            f"pixels{hint}"
        )
        return  # the place means little then
    farthest = max(found, key=StarCheck.excess_distance)
    if farthest.excess_distance() > 0 and not moves:
        (dx, dy), place = farthest.offset, in_words(scene.stars[farthest.star])
        warn(
            f"the star at {place} lies ({dx:z.2f}, {dy:z.2f}) pixels from there in "
            f"`images[{farthest.image}]`: give its place, take `refine_positions`, or mend the "
            f"centre of `psfs[{farthest.image}]`"
        )
