"""How PSFs of several frames differ: their mean, the ways in which they vary, and their scatter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lnocl.core.scene.arrays import Array, numbers
from lnocl.core.scene.quantities import bare
from lnocl.errors import InputError, counted


class PsfModes(NamedTuple):
    """Mean, principal components and scatter of the PSFs of several frames.

    Attributes
    ----------
    mean : ndarray of float64, shape (ky, kx)
        Their mean, of unit sum.
    modes : ndarray of float64, shape (n, ky, kx)
        Their principal components, one standard deviation each, that of the largest first.
    scatter : ndarray of float64, shape (ky, kx)
        Standard deviation of each pixel.
    share : float
        The share of their variance that the modes have, 0 to 1.

    See Also
    --------
    find_modes : Returns it.

    Examples
    --------
    >>> import numpy as np
    >>> import lnocl
    >>> from lnocl.psf import find_modes
    >>> y, x = np.indices((9, 9)) - 4
    >>> psfs = [np.exp(-(x**2 + y**2) / width) for width in (4.0, 5.0, 6.0)]
    >>> found = find_modes(psfs, 1)
    >>> images = np.full((32, 32), 5.0)
    >>> observation = lnocl.Observation(
    ...     images, found.mean, psf_modes=found.modes, psf_scatter=found.scatter
    ... )
    >>> observation.psf_modes.shape
    (1, 1, 9, 9)
    """

    mean: Array
    modes: Array
    scatter: Array
    share: float


def find_modes(psfs: ArrayLike, n_modes: int) -> PsfModes:
    r"""Return mean, principal components and scatter of PSFs, for `lnocl.Observation`.

    With the differences from the mean, :math:`K_i - \bar K = U S V^T`, mode l is :math:`V_l S_l /
    \sqrt{n - 1}`.

    Parameters
    ----------
    psfs : array_like, shape (n, ky, kx)
        PSFs of the same star, or of several, in as many frames; of any positive sum.
    n_modes : int
        Modes wanted, at least 1 and fewer than PSFs.

    Returns
    -------
    PsfModes
        The mean, the modes, the scatter and the share of the variance that the modes have.

    Raises
    ------
    InputError
        The PSFs are not a cube of finite numbers, one has no positive sum, or there are not more of
        them than modes.

    References
    ----------
    Jee, M. J., et al., PASP 119, 1403 (2007), for principal components of PSFs.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.psf import find_modes
    >>> y, x = np.indices((9, 9)) - 4
    >>> psfs = [np.exp(-(x**2 + y**2) / width) for width in (4.0, 5.0, 6.0)]
    >>> found = find_modes(psfs, 1)
    >>> found.modes.shape, round(found.share, 2)
    ((1, 9, 9), 1.0)
    """
    given = numbers("psfs", bare("psfs", psfs))
    if given.ndim != 3 or not np.isfinite(given).all():
        raise InputError(f"psfs have shape {given.shape}; give a cube of finite numbers")
    sums = given.sum(axis=(1, 2), keepdims=True)
    if (sums <= 0).any():
        raise InputError(f"`psfs[{int(np.argmax(sums <= 0))}]` has no positive sum")
    if not (isinstance(n_modes, (int, np.integer)) and 1 <= n_modes < len(given)):
        raise InputError(
            f"{counted(n_modes, 'mode')} of {counted(len(given), 'PSF')}; give 1 mode or more, and "
            "more PSFs than modes"
        )
    given /= sums
    mean = given.mean(axis=0)
    differences = (given - mean).reshape(len(given), -1)
    _, values, components = np.linalg.svd(differences, full_matrices=False)
    deviations = values[:n_modes, None] / np.sqrt(len(given) - 1)
    power = float((values**2).sum())
    return PsfModes(
        mean,
        (deviations * components[:n_modes]).reshape(n_modes, *mean.shape),
        given.std(axis=0, ddof=1),
        float((values[:n_modes] ** 2).sum()) / power if power else 1.0,
    )
