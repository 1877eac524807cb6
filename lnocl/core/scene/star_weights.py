"""What images observe of the light of stars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.errors import counted, warn

if TYPE_CHECKING:
    from lnocl.core.scene.scene import Scene
    from lnocl.core.scene.stars import StarField

# Below this share of its maximum the total weight of a pixel of the extended source is taken as
# "not observed" (the threshold of Bertero & Boccacci 2005, A&A 437, 369, for boundary effects).
OBSERVED_SHARE = 0.01


def weigh_stars(
    scene: Scene, field: StarField, owners: NDArray[np.intp], shares: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return ``sum_j <P_js, w_j>`` for each star, and whether any image observed it.

    An image did where `OBSERVED_SHARE` of the star's light falls on its good pixels, however
    short the exposure: it may be the only one that is not saturated. A sum that negative pixels
    of a PSF make negative counts as 0. PSFs of their own show a share of the light.

    Parameters
    ----------
    scene : Scene
        The images.
    field : StarField
        The stars, and then halos.
    owners : ndarray of int, shape (n,)
        The PSF of its own that each star has, -1 where it has none.
    shares : ndarray of float64, shape (n_own, p)
        Of the light that each of these shows in each image.
    """
    has_own = np.append(owners >= 0, np.zeros(len(field) - len(owners), bool))
    if scene.weights is None:
        light = field.shown.T.astype(np.float64)
        if scene.n_epochs > 1:  # else a star is in all images, of mean exposure 1
            light[:, : len(field.positions)] *= scene.gains[:, None]
        # Samples of an effective PSF a pixel apart may sum to another number.
        is_summed = has_own | (scene.oversample > 1 and scene.observation.effective_psfs)
        for s in np.flatnonzero(is_summed):
            light[:, s] = [cutouts[s].values.sum() for cutouts in field.cutouts]
        return light.sum(axis=0), np.ones(len(field), bool)
    total, is_observed = np.zeros(len(field)), np.zeros(len(field), bool)
    for j, weights in enumerate(scene.weights):
        windows = [
            (cutout, weights[cutout.window(scene.image_grid)]) for cutout in field.cutouts[j]
        ]
        light = np.array([float((cutout.values * w).sum()) for cutout, w in windows])
        on_good = np.array([float((cutout.values * (w > 0)).sum()) for cutout, w in windows])
        total += np.maximum(light, 0.0)
        whole = np.full(len(field), scene.gains[j])
        whole[has_own] *= shares[owners[owners >= 0], j]
        is_observed |= (on_good >= OBSERVED_SHARE * whole) & (light > 0)
    return total, is_observed


def warn_of_lost_stars(scene: Scene, is_lost: NDArray[np.bool_]) -> None:
    """Warn of stars, shape (n,), of which no good pixel has any light."""
    of_epochs = is_lost.reshape(-1, scene.n_epochs)
    is_dark = np.asarray(of_epochs.all(axis=1))
    stars = scene.places
    if n_dark := int(is_dark.sum()):
        x, y = stars[is_dark][0]
        others = f", and so do {counted(n_dark - 1, 'other')}" if n_dark > 1 else ""
        or_dark = "" if scene.transmission is None else f" or not {OBSERVED_SHARE:g} is transmitted"
        warn(
            f"the star at ({x:g}, {y:g}) lies where all images are masked{or_dark}{others}: it "
            "is left out, and its flux is NaN"
        )
    of_epochs = of_epochs & ~is_dark[:, None]
    if n_lost := int(of_epochs.sum()):
        s, epoch = np.argwhere(of_epochs)[0].tolist()
        x, y = stars[s]
        others = f", as {counted(n_lost - 1, 'other')} in their epochs" if n_lost > 1 else ""
        warn(
            f"the star at ({x:g}, {y:g}) is on no good pixel of epoch {epoch}: its flux there "
            f"is NaN{others}"
        )
