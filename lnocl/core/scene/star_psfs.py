"""PSFs of their own of some stars, as that of a star behind the mask of a coronagraph."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, numbers, refuse_unless
from lnocl.core.scene.psfs import check_psfs
from lnocl.core.scene.quantities import bare
from lnocl.core.scene.rotation import Rotation, turned_psf
from lnocl.core.scene.shifting import MovablePsf
from lnocl.errors import InputError, counted

if TYPE_CHECKING:
    from lnocl.core.scene.detector import Movable
    from lnocl.core.scene.fields import Field
    from lnocl.core.scene.observation import Observation

# A star has the PSF of a place that it is so near to, pixels.
NEAR = 0.5
# No PSF shows more than all light of its star, but for rounding.
WHOLE = 1.001


def read_star_places(field: Field, places: ArrayLike | None, _: Observation) -> Array:
    """Return the places of stars that have PSFs of their own, shape (n, 2)."""
    given = numbers(field.name, () if places is None else places, unit="pix")
    if given.shape == (2,):
        given = given[None]
    if given.size and (given.ndim != 2 or given.shape[1] != 2):
        raise InputError(f"`{field.name}` has shape {given.shape}; give pairs (x, y)")
    refuse_unless(f"`{field.name}`", given, "finite", np.isfinite(given))
    given = given.reshape(-1, 2)
    for k, place in enumerate(given):
        if (np.hypot(*(given[:k] - place).T) <= 2 * NEAR).any():
            x, y = place
            raise InputError(f"`{field.name}` has ({x:g}, {y:g}) twice; give each star one PSF")
    return given


def read_star_psfs(field: Field, psfs: ArrayLike | None, held: Observation) -> Array:
    """Return the PSFs of these stars, shape (n, p, ky, kx), as bright as given."""
    name, n, p = field.name, len(held.star_places), held.n_images
    given = numbers(name, np.zeros((0, p, 1, 1)) if psfs is None else bare(name, psfs))
    shape = given.shape
    given = given[(None,) * (4 - given.ndim)] if given.ndim in (2, 3) else given
    if given.ndim != 4 or len(given) != n or given.shape[1] not in (1, p):
        raise InputError(
            f"`{name}` has shape {shape}, and `star_places` {counted(n, 'place')}; give "
            f"(n, p, ky, kx), PSFs of each star there in each of {counted(p, 'image')}, (ky, kx) "
            "of one star in all"
        )
    if not n:
        return np.zeros((0, p, 1, 1))
    found = np.array([check_psfs(name, each, p) for each in given])
    sums = found.sum(axis=(2, 3))
    if (sums > WHOLE).any():
        raise InputError(
            f"`{name}` has the sum {sums.max():.4g}: it is the share of the star's light that an "
            "image shows, 1 without a mask; divide it by the light of the star beside the mask"
        )
    return found


def refuse_unowned(observation: Observation, stars: Array) -> None:
    """Refuse a place of a PSF at which there is no star."""
    owners = owned(observation, stars)
    for k, (x, y) in enumerate(observation.star_places):
        if k not in owners:
            raise InputError(
                f"no star is within {NEAR:g} pixels of ({x:g}, {y:g}) of `star_places`, whose PSF "
                "is for one there: give that star, or its place"
            )


def owned(observation: Observation, stars: Array) -> NDArray[np.intp]:
    """Return the number of the PSF of its own that each star has, -1 where it has none."""
    found = np.full(len(stars), -1)
    for k, place in enumerate(observation.star_places if len(stars) else ()):
        distances = np.hypot(*(stars - place).T)
        nearest = int(distances.argmin())
        if distances[nearest] <= NEAR:
            found[nearest] = k
    return found


class StarPsfs:
    """The PSFs of their own of stars in a scene, to be placed.

    Parameters
    ----------
    observation : Observation
        The images and these PSFs.
    gains : ndarray of float64, shape (p,)
        What the PSFs of each image are multiplied by.
    movable : callable
        Returns PSFs to be placed on the images' grid, as its pixels see them.
    grid : tuple of int
        Shape (Ny, Nx) of the sky's grid.

    Attributes
    ----------
    shares : ndarray of float64, shape (n, p)
        The share of its star's light that each shows.
    """

    def __init__(
        self,
        observation: Observation,
        gains: Array,
        movable: Callable[[Array], list[Movable]],
        grid: tuple[int, int],
    ) -> None:
        self._grid = grid
        self._scaled = gains[:, None, None] * observation.star_psfs
        self._movable = [movable(each) for each in self._scaled]
        self.shares = observation.star_psfs.sum(axis=(2, 3))

    def into(self, psfs: list[list[Movable]], owners: NDArray[np.intp]) -> list[list[Movable]]:
        """Put them into those of each image and star, for the stars that have them."""
        for s in np.flatnonzero(owners >= 0):
            for of_image, psf in zip(psfs, self._movable[owners[s]], strict=True):
                of_image[s] = psf
        return psfs

    def of_sky(self, k: int, j: int, rotation: Rotation | None) -> MovablePsf:
        """Return PSF k of image j, which may be turned, as the sky sees it, on the sky's grid."""
        if rotation is None:
            return self._movable[k][j].fine
        turned = turned_psf(self._scaled[k, j], rotation.angle, rotation.scale)
        return MovablePsf(turned, self._grid)
