"""What is known of the errors of PSFs, as it is given, checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lnocl.errors import InputError
from lnocl.scene.arrays import Array, numbers
from lnocl.scene.quantities import bare


def check_modes(modes: ArrayLike | None, psfs: Array) -> Array:
    """Return the modes of each PSF, shape (p, n, ky, kx); n is 0 where none are given."""
    if modes is None:
        return np.zeros((len(psfs), 0, *psfs.shape[1:]))
    given = numbers("psf_modes", bare("psf_modes", modes))
    wanted = psfs.shape
    if given.ndim == 3:
        given = given[None]
    if given.ndim != 4 or given.shape[0] not in (1, wanted[0]) or given.shape[2:] != wanted[1:]:
        raise InputError(
            f"`psf_modes` has shape {np.shape(modes)}; give (n, ky, kx), or one such cube for "
            f"each of the {wanted[0]} images, with PSFs of shape {wanted[1:]}"
        )
    if not np.isfinite(given).all():
        raise InputError("`psf_modes` hold values that are not finite; repair them first")
    return np.broadcast_to(given, (wanted[0], *given.shape[1:])).copy()


def check_pixels(name: str, values: ArrayLike | None, psfs: Array) -> Array:
    """Return a number for each pixel of each PSF, shape (p, ky, kx), or (0, ky, kx) for none.

    Parameters
    ----------
    name : str
        What they are, for messages.
    values : array_like, shape (p, ky, kx) or (ky, kx), or None
        Finite, none below 0, and not all 0.
    psfs : ndarray of float64, shape (p, ky, kx)
        The PSFs.
    """
    if values is None:
        return np.zeros((0, *psfs.shape[1:]))
    given = numbers(name, bare(name, values))
    given = given[None] if given.ndim == 2 else given
    if given.ndim != 3 or given.shape[0] not in (1, len(psfs)) or given.shape[1:] != psfs.shape[1:]:
        raise InputError(
            f"`{name}` has shape {np.shape(values)}; give {psfs.shape[1:]}, the shape of the PSFs, "
            f"or one such map for each of the {len(psfs)} images"
        )
    if not np.isfinite(given).all() or (given < 0).any():
        raise InputError(f"`{name}` hold values that are negative or not finite; repair them first")
    if not given.any(axis=(1, 2)).all():
        raise InputError(f"`{name}` hold a map that is all 0; leave `{name}` out, or give another")
    return np.broadcast_to(given, psfs.shape).copy()
