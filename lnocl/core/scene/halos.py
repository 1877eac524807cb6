"""Halos: light of known shape and unknown amount in each image, as that of a star's speckles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, numbers, refuse_masked, values_and_mask
from lnocl.core.scene.quantities import bare
from lnocl.core.scene.shifting import Cutout
from lnocl.errors import InputError

if TYPE_CHECKING:
    from lnocl.core.scene.fields import Field
    from lnocl.core.scene.observation import Observation


def read_halos(_: Field, halos: ArrayLike | None, held: Observation) -> Array:
    """Return the shapes of halos, shape (n, p, ny, nx), of unit sum; n is 0 where none are given.

    Parameters
    ----------
    _ : Field
        That of `halos`.
    halos : array_like, shape (n, p, ny, nx), (n, 1, ny, nx), (p, ny, nx) or (ny, nx), or None
        Finite and not negative where a pixel is good, and not 0 on all good pixels of an image.
    held : Observation
        Its mask, True where a pixel of an image is bad; halos are 0 there.
    """
    mask = held.mask
    if halos is None:
        return np.zeros((0, *mask.shape))
    array, masked = values_and_mask("halos", bare("halos", halos))
    given = _of_each(array, mask.shape)
    refuse_masked("halos", _of_each(masked, mask.shape) & ~mask)
    shapes = np.where(mask, 0.0, numbers("halos", given, copy=False))
    refuse_values(shapes)
    refuse_dark(shapes, mask)
    # First by their largest values, lest the sum overflows.
    shapes /= shapes.max(axis=(2, 3), keepdims=True)
    return np.asarray(shapes / shapes.sum(axis=(2, 3), keepdims=True))


def _of_each(array: NDArray, images: tuple[int, ...]) -> NDArray:
    """Return an array with an axis of halos and one of images."""
    axes = {2: np.s_[None, None], 3: np.s_[None], 4: np.s_[:]}
    whole = array[axes[array.ndim]] if array.ndim in axes else array
    if whole.ndim != 4 or whole.shape[1] not in (1, images[0]) or whole.shape[2:] != images[1:]:
        raise InputError(
            f"`halos` has shape {array.shape}; give {images[1:]}, the shape of an image, for all "
            f"images, {images} for each of them, or several such halos, {('n', *images)}"
        )
    return np.broadcast_to(whole, (len(whole), *images))


def refuse_values(halos: Array) -> None:
    """Refuse values that are negative or not finite."""
    good = (halos >= 0) & np.isfinite(halos)
    if not good.all():
        k, j, y, x = np.argwhere(~good)[0]
        raise InputError(
            f"`halos` must be finite and not negative where a pixel is good; halo {k + 1} has "
            f"{halos[k, j, y, x]:g} at ({x}, {y}) in `images[{j}]`: set it to 0, or mask the pixel"
        )


def refuse_dark(halos: Array, mask: NDArray[np.bool_]) -> None:
    """Refuse a halo without light on the good pixels of an image, whose amount nothing tells."""
    for k, halo in enumerate(halos):
        is_dark = ~(halo * ~mask).any(axis=(1, 2))
        if is_dark.any():
            raise InputError(
                f"halo {k + 1} of `halos` is 0 on all good pixels of `images[{is_dark.argmax()}]`, "
                "which tell nothing of its amount; leave out the halo, or the image"
            )


def rough_halos(observation: Observation, j: int) -> Array | float:
    """Return the light of the halos of image j, by least squares without stars and sky."""
    if not len(observation.halos):
        return 0.0
    good = ~observation.mask[j]
    excess = observation.images[j] - observation.background[j]
    shapes = observation.halos[:, j]
    amounts = np.linalg.lstsq(shapes[:, good].T, excess[good], rcond=None)[0]
    return np.asarray(np.tensordot(np.maximum(amounts, 0.0), shapes, axes=1))


def halo_cutouts(
    halos: Array, weights: NDArray | None, is_map: bool, grid: tuple[int, int]
) -> list[list[Cutout]]:
    """Return for each image the light of each halo of each image, shape by shape.

    It is 0 in images other than its own. Where exposures are a map, the weights, which the whole
    model is multiplied by, are divided out.
    """
    n, p, ny, nx = halos.shape
    nothing = Cutout(np.zeros((1, 1)), 0, 0)
    there: list[list[Cutout]] = []
    for j in range(p):
        of_image: Sequence[Array] = list(halos[:, j])
        if weights is not None and is_map:
            of_image = [_over(halo, weights[j][:ny, :nx]) for halo in of_image]
        there.append([nothing] * (n * p))
        there[j][j::p] = [Cutout(halo, 0, 0).aligned(grid) for halo in of_image]
    return there


def _over(halo: Array, weights: Array) -> Array:
    return np.divide(halo, weights, out=np.zeros(halo.shape), where=weights > 0)
