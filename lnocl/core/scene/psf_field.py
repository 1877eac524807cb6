"""PSFs that vary over the field of an image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lnocl.core.scene.arrays import Array, numbers, whole
from lnocl.core.scene.quantities import bare, in_unit
from lnocl.errors import InputError, counted


class PsfField:
    """PSFs that vary over an image, given at the nodes of a grid of positions.

    Between four nodes the PSF is bilinear, ``K = sum_i w_i K_i``, with weights w_i that sum to 1,
    as `photutils.psf.GriddedPSFModel` defines it. Beyond the nodes it is that of the nearest place
    of the grid.

    Parameters
    ----------
    psfs : array_like, shape (n, ky, kx)
        PSF of each node, with its centre at ``(ky // 2, kx // 2)``, held as it is given.
        `lnocl.Observation` normalises the sum of each to 1, and refuses what cannot be a PSF.
    positions : array_like, shape (n, 2)
        (x, y) of the nodes, pixels of the image, 0-based, in any order. They fill a rectangular
        grid of one node or more. They may be a Quantity in pixels.

    Raises
    ------
    InputError
        - The shapes do not agree, or a value is masked or not a real number.
        - Positions are not finite, not in pixels, or do not fill a grid.

    See Also
    --------
    lnocl.deconvolve_tiles : Reconstructs each part of an image with its own PSF.

    References
    ----------
    L. Denis, E. Thiebaut, F. Soulez, J.-M. Becker, R. Mourya, Int. J. Comput. Vis. 115, 253 (2015),
    section 2.3, for interpolation of PSFs.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl import PsfField
    >>> narrow, wide = np.zeros((3, 3)), np.full((3, 3), 1 / 9)
    >>> narrow[1, 1] = 1.0
    >>> field = PsfField([narrow, wide], [(0, 0), (100, 0)])
    >>> field.at(25, 7)[1, 1].round(4)
    np.float64(0.7778)
    """

    def __init__(self, psfs: ArrayLike, positions: ArrayLike) -> None:
        stack = numbers("psfs", bare("psfs", psfs))
        places = numbers("positions", positions, unit="pix")
        if stack.ndim != 3 or places.shape != (len(stack), 2) or not len(stack):
            raise InputError(
                f"psfs has shape {stack.shape} and positions {places.shape}; give n PSFs, "
                "(n, ky, kx), and (x, y) of each, (n, 2)"
            )
        if not np.isfinite(places).all():
            raise InputError("positions of PSFs must be finite")
        self._x, self._y = np.unique(places[:, 0]), np.unique(places[:, 1])
        order = np.lexsort((places[:, 0], places[:, 1]))
        if not np.array_equal(places[order], self._positions):
            raise InputError(
                f"the positions of {counted(len(stack), 'PSF')} do not fill a grid of "
                f"{len(self._x)} columns and {len(self._y)} rows; give one PSF for each node"
            )
        self._psfs = stack[order].reshape(len(self._y), len(self._x), *stack.shape[1:])

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (ky, kx) of each PSF.

        Examples
        --------
        >>> import numpy as np
        >>> from lnocl import PsfField
        >>> PsfField(np.ones((2, 3, 5)), [(0, 0), (100, 0)]).shape
        (3, 5)
        """
        return self._psfs.shape[2], self._psfs.shape[3]

    def at(self, x: float, y: float) -> Array:
        """Return the PSF at a position.

        Parameters
        ----------
        x, y : float
            Position, pixels of the image, 0-based. Beyond the nodes the PSF is that of the nearest
            edge of the grid.

        Returns
        -------
        ndarray of float64, shape (ky, kx)
            The PSF, in the unit in which the nodes were given.

        Examples
        --------
        >>> import numpy as np
        >>> from lnocl import PsfField
        >>> field = PsfField([np.zeros((3, 3)), np.ones((3, 3))], [(0, 0), (100, 0)])
        >>> field.at(25, 7)[1, 1], field.at(500, 7)[1, 1]
        (np.float64(0.25), np.float64(1.0))
        """
        x, y = in_unit("x", x, "pix"), in_unit("y", y, "pix")
        (i, u), (j, v) = _between(self._x, x), _between(self._y, y)
        cell = self._psfs[j : j + len(v), i : i + len(u)]
        return np.asarray(np.tensordot(np.outer(v, u), cell, axes=2))

    @property
    def nodes(self) -> tuple[Array, Array]:
        """The x of its columns and the y of its rows, ascending."""
        return self._x, self._y

    def numbers(self) -> Array:
        """Return the PSFs, row by row of the grid, and the x and y of its lines, in one dimension.

        They differ where two fields do, so that a checksum of them tells fields apart.
        """
        return np.concatenate([self._psfs.ravel(), self._x, self._y])

    @property
    def _positions(self) -> Array:
        return np.stack(np.meshgrid(self._x, self._y), axis=-1).reshape(-1, 2)

    def turned(self, function: Callable[[Array], Array], transform: Array) -> PsfField:
        """Return a field of what a function makes of all PSFs, at places by a map, shape (2, 3).

        That is one by quarter turns and flips.
        """
        places = self._positions @ transform[:, :2].T + transform[:, 2]
        return PsfField(function(self._psfs.reshape(-1, *self.shape)), places)

    def moved(self, dx: float, dy: float) -> PsfField:
        """Return the same PSFs with all positions moved."""
        other = copy(self)
        other._x, other._y = self._x + dx, self._y + dy
        return other

    def mapped(self, function: Callable[[Array], Array]) -> PsfField:
        """Return a field of what a function makes of all PSFs, shape (n, ky, kx)."""
        other = copy(self)
        stack = function(self._psfs.reshape(-1, *self.shape))
        other._psfs = stack.reshape(*self._psfs.shape[:2], *stack.shape[1:])
        return other

    def variation(self, psf: Array, shape: tuple[int, int]) -> float:
        """Return how far the corners of an image differ at most from a PSF, over its norm."""
        ny, nx = shape
        corners = [self.at(x, y) for x in (0, nx - 1) for y in (0, ny - 1)]
        return float(max(np.linalg.norm(each - psf) for each in corners) / np.linalg.norm(psf))

    @classmethod
    def of_model(cls, model: Any, oversample: int) -> PsfField:
        """Return the field of a gridded model of photutils.

        `lnocl.Observation` takes such a model as it is; this samples its PSFs for other purposes.

        Parameters
        ----------
        model : photutils.psf.GriddedPSFModel
            Model of effective PSFs.
        oversample : int
            Samples to a pixel of the image along each axis, 1 or more.

        Returns
        -------
        PsfField
            The PSFs at the nodes of the model, sampled at that interval from their centre on, as
            far as the model's samples reach. Values are the model's, of a flux of 1.

        Raises
        ------
        InputError
            `oversample` is not a whole number, 1 or more.

        Examples
        --------
        >>> import numpy as np
        >>> from astropy.nddata import NDData
        >>> from photutils.psf import GriddedPSFModel
        >>> from lnocl import PsfField
        >>> meta = {"grid_xypos": [(0, 0), (50, 0), (0, 50), (50, 50)], "oversampling": 4}
        >>> model = GriddedPSFModel(NDData(np.ones((4, 21, 21)), meta=meta))
        >>> PsfField.of_model(model, oversample=2).shape
        (9, 9)
        """
        whole("oversample", oversample, 1)
        sizes = np.array(model.data.shape[1:]) / model.oversampling * oversample
        half_y, half_x = ((sizes - 1) // 2).astype(int).tolist()
        y, x = np.mgrid[-half_y : half_y + 1, -half_x : half_x + 1] / oversample
        psfs = [model.evaluate(px + x, py + y, 1.0, px, py) for px, py in model.grid_xypos]
        return cls(psfs, model.grid_xypos)


def _between(nodes: Array, at: float) -> tuple[int, Array]:
    """Return the first of the nodes on both sides of a place, and their weights."""
    if len(nodes) == 1:
        return 0, np.ones(1)
    i = int(np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2))
    share = float(np.clip((at - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0, 1.0))
    return i, np.array([1.0 - share, share])


# PSFs of images: shape (p, ky, kx), or where they vary over images a field of each.
Psfs = Array | tuple[PsfField, ...]
Kind = TypeVar("Kind", Array, tuple[PsfField, ...], Psfs)


def mapped(psfs: Kind, function: Callable[[int, Array], Array]) -> Kind:
    """Return what a function makes of the PSFs of each image.

    It takes the number of the image and a stack of its PSFs, shape (n, ky, kx): one, or those of
    all nodes.
    """
    if isinstance(psfs, tuple):
        return tuple(field.mapped(partial(function, j)) for j, field in enumerate(psfs))
    return np.array([function(j, psf[None])[0] for j, psf in enumerate(psfs)])


def either(is_first: NDArray[np.bool_], first: Psfs, second: Psfs) -> Psfs:
    """Return the first PSFs of the images where these are wanted, else the second."""
    pairs = zip(is_first, first, second, strict=True)
    chosen = [one if is_wanted else other for is_wanted, one, other in pairs]
    return tuple(chosen) if isinstance(first, tuple) else np.array(chosen)


def read_fields(psfs: Any, n_images: int, oversample: int, are_effective: bool) -> list[PsfField]:
    """Return the fields that are given for PSFs, one for each image; [] where arrays are.

    Parameters
    ----------
    psfs : PsfField, photutils.psf.GriddedPSFModel or a sequence of them, or anything else
        One for all images or one for each.
    n_images, oversample, are_effective : int, int, bool
        Of the observation.

    Raises
    ------
    InputError
        There are neither one nor one for each image; those of photutils, which are effective PSFs,
        are to be taken for others; they differ in shape.
    """
    given: Sequence[Any] = list(psfs) if isinstance(psfs, (list, tuple)) else [psfs]
    if not given or not all(isinstance(each, PsfField) or _is_model(each) for each in given):
        return []
    if len(given) not in (1, n_images):
        raise InputError(
            f"{counted(len(given), 'field')} of PSFs for {counted(n_images, 'image')}; give one, "
            "or one for each image"
        )
    if oversample > 1 and not are_effective and any(map(_is_model, given)):
        raise InputError("PSFs of photutils are effective PSFs; give `effective_psfs`=True")
    fields = [PsfField.of_model(each, oversample) if _is_model(each) else each for each in given]
    if len({field.shape for field in fields}) > 1:
        raise InputError("the PSFs of several fields differ in shape; give them in one")
    return fields * (n_images // len(fields))


def _is_model(psfs: Any) -> bool:
    return hasattr(psfs, "grid_xypos") and hasattr(psfs, "evaluate")
