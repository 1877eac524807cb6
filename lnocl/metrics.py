"""The paper's measures of a reconstruction: errors, star magnitude, profiles along the jet.

The definitions are those of La Camera et al. (2012), sections 3.2 and 4. The axis of the jet lies
along y, so a pixel line across it is a row. Positions are whole pixels (x, y), 0-based, x along
columns.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from lnocl.core.scene.arrays import Array, numbers
from lnocl.core.scene.quantities import bare, in_unit, split
from lnocl.errors import InputError, counted

N_STAR_ROWS = 24


def star_rows(star: tuple[int, int], shape: tuple[int, int]) -> slice:
    """Return the 24 rows around the star, from ``y - 12`` to ``y + 11``.

    Parameters
    ----------
    star : (x, y)
        Position of the star.
    shape : tuple of int
        Shape (ny, nx) of the image.

    Returns
    -------
    slice
        Of the first axis.

    Raises
    ------
    InputError
        One of the rows lies outside the image.

    References
    ----------
    La Camera et al. (2012), section 3.2.

    Examples
    --------
    >>> from lnocl.metrics import star_rows
    >>> star_rows((128, 64), (256, 256))
    slice(52, 76, None)
    """
    _, y = _check_star(star, shape)
    start = y - N_STAR_ROWS // 2
    if start < 0 or start + N_STAR_ROWS > shape[0]:
        raise InputError(
            f"the {N_STAR_ROWS} rows around the star at y = {y} do not fit in {shape[0]} rows"
        )
    return slice(start, start + N_STAR_ROWS)


def mask_star(image: ArrayLike, star: tuple[int, int]) -> Array:
    """Return a copy of the image with 0 in the 3 x 3 pixels around the star.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Any image.
    star : (x, y)
        Position of the star, one pixel or more from the edge.

    Returns
    -------
    ndarray of float64, shape (ny, nx)
        The masked image.

    Raises
    ------
    InputError
        The image is not a plane of finite, unmasked numbers, or the box leaves it.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.metrics import mask_star
    >>> mask_star(np.ones((4, 4)), (1, 2)).sum()
    np.float64(7.0)
    """
    masked = _plane("image", bare("image", image)).copy()
    masked[_box(star, masked.shape)] = 0.0
    return masked


def restoration_error(
    reconstruction: ArrayLike,
    truth: ArrayLike,
    rows: slice | None = None,
    star: tuple[int, int] | None = None,
) -> float:
    r"""Return the restoration error, the relative rms error of a reconstruction.

    .. math:: \rho = \| f - \bar f \| \, / \, \| \bar f \|

    The norms are over the pixels compared. The paper's :math:`\rho'` is over all rows, its
    :math:`\rho''` over `star_rows`. For stars apart from the extended source (MC-RL) compare the
    extended sources, without `star`. For both in one image (RLM) give `star`. Its pixels are then
    masked in reconstruction and truth, so that the truth may be given with the star or without it.

    Parameters
    ----------
    reconstruction : array_like, shape (ny, nx)
        The reconstructed source, f.
    truth : array_like, shape (ny, nx)
        The true source, in the same unit; a Quantity is converted.
    rows : slice, optional
        Rows to compare; by default all.
    star : (x, y), optional
        Position of the star, a whole pixel, around which 3 x 3 pixels of both are set to 0.

    Returns
    -------
    float
        Zero or more; 0.1 is an error of 10 %. Infinite where it exceeds the range of numbers.

    Raises
    ------
    InputError
        - The shapes differ, or a value is masked or not finite.
        - `rows` is not a slice.
        - The star is not at a whole pixel, or the box around it leaves the image.
        - The truth is zero in all pixels compared.

    References
    ----------
    La Camera et al. (2012), Eq. 11.

    Examples
    --------
    >>> from lnocl.metrics import restoration_error
    >>> restoration_error([[3.0, 0.0], [0.0, 5.0]], [[3.0, 0.0], [0.0, 4.0]])
    0.2
    """
    reconstruction, unit = split("reconstruction", reconstruction)
    found = _plane("reconstruction", reconstruction)
    true = _plane("truth", in_unit("truth", truth, unit or ""))
    if found.shape != true.shape:
        raise InputError(f"the reconstruction has shape {found.shape} and the truth {true.shape}")
    if star is not None:
        found, true = mask_star(found, star), mask_star(true, star)
    if rows is not None:
        if not isinstance(rows, slice):
            raise InputError(f"rows must be a slice, as star_rows returns; {rows} was given")
        found, true = found[rows], true[rows]
    brightest = np.abs(true).max(initial=0.0)
    if brightest == 0:
        raise InputError("the truth is zero in all pixels compared: no error is relative to it")
    with np.errstate(over="ignore"):
        found, true = found / brightest, true / brightest
        return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def magnitude(flux: float, zero_magnitude_flux: float) -> float:
    """Return the magnitude of a flux, ``-2.5 log10(flux / zero_magnitude_flux)``.

    Parameters
    ----------
    flux : float
        Zero or more.
    zero_magnitude_flux : float
        Flux of magnitude 0 in the same unit, positive.

    Returns
    -------
    float
        In mag; infinite where the flux is 0.

    Raises
    ------
    InputError
        A flux is out of its range.

    Examples
    --------
    >>> from lnocl.metrics import magnitude
    >>> magnitude(1e4, 1e10)
    15.0
    """
    flux, unit = split("flux", flux)
    zero_magnitude_flux = in_unit("zero_magnitude_flux", zero_magnitude_flux, unit or "")
    if not (math.isfinite(zero_magnitude_flux) and zero_magnitude_flux > 0):
        raise InputError(
            f"zero_magnitude_flux must be positive and finite; {zero_magnitude_flux} was given"
        )
    if not (math.isfinite(flux) and flux >= 0):
        raise InputError(f"flux must be finite and not negative; {flux} was given")
    return -2.5 * math.log10(flux / zero_magnitude_flux) if flux > 0 else math.inf


def flux_profile(image: ArrayLike, star: tuple[int, int] | None = None) -> Array:
    """Return the flux profile along the jet, the sum of each row.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Source whose axis lies along y.
    star : (x, y), optional
        Position of the star, a whole pixel, in the image of both (RLM). The 3 rows around it are
        masked.

    Returns
    -------
    ndarray of float64, shape (ny,)
        In the unit of the image; NaN where masked.

    Raises
    ------
    InputError
        The image is not a plane of finite, unmasked numbers, or the star is not at a whole pixel,
        one or more from its edge.

    References
    ----------
    La Camera et al. (2012), section 4, Fig. 6.

    Examples
    --------
    >>> from lnocl.metrics import flux_profile
    >>> flux_profile([[1, 2, 3], [0, 4, 0]])
    array([6., 4.])
    """
    plane = _plane("image", bare("image", image))
    profile = plane.sum(axis=1)
    if star is not None:
        profile[_box(star, plane.shape)[0]] = np.nan
    return profile


def _plane(name: str, values: ArrayLike) -> Array:
    array = numbers(name, values, copy=False)
    if array.ndim != 2:
        raise InputError(f"{name} has {counted(array.ndim, 'dimension')}; give two")
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds values that are not finite")
    return array


def _check_star(star: tuple[int, int], shape: tuple[int, ...]) -> tuple[int, int]:
    place = numbers("star", star, unit="pix")
    if place.shape != (2,) or not np.array_equal(place, np.rint(place)):
        raise InputError(f"star must be (x, y), in whole pixels; {star} was given")
    x, y = place
    if not (0 <= x < shape[1] and 0 <= y < shape[0]):
        raise InputError(f"the star at ({x:g}, {y:g}) lies outside the image of shape {shape}")
    return round(x), round(y)


def _box(star: tuple[int, int], shape: tuple[int, ...]) -> tuple[slice, slice]:
    x, y = _check_star(star, shape)
    if not (1 <= x < shape[1] - 1 and 1 <= y < shape[0] - 1):
        raise InputError(f"the 3 x 3 pixels around the star at ({x}, {y}) leave the image")
    return slice(y - 1, y + 2), slice(x - 1, x + 2)
