"""Maps of the noise of images, as telescopes write them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError
from lnocl.io.levels import clipped_sky
from lnocl.io.maps import Maps
from lnocl.io.names import ERR, NOISE, parse_kind
from lnocl.scene.arrays import Array
from lnocl.scene.uncertainties import variance_of, without_source

# No image has so many times the noise that its sky shows.
TOO_NOISY = 5.0
# The share of pixels that are the brightest.
BRIGHT = 0.01
# The flags DO_NOT_USE, SATURATED and JUMP_DET of JWST: the counts of such a pixel were not summed
# over the whole exposure, so that their variance in its units is larger.
CUT_SHORT = 1 | 2 | 4


class NoiseMap(NamedTuple):
    """A map of the noise of images.

    Attributes
    ----------
    kind : str
        Of `names.NOISE`.
    variance : ndarray of float64, shape (p, ny, nx)
        In units of the images squared; 0 where a pixel is bad.
    """

    kind: str
    variance: Array

    def read_noise(self, counts: Array, each: Array | float, mask: NDArray[np.bool_]) -> Array:
        """Return the read noise that stands for all noise but that of counts, electrons.

        Parameters
        ----------
        counts : ndarray of float64, shape (p, ny, nx)
            Electrons.
        each : ndarray or float
            Electrons in each unit of the images.
        mask : ndarray of bool, shape (p, ny, nx)
            Where it is not needed.

        Raises
        ------
        InputError
            A map whose noise is far more than the sky scatters; one with the source's noise that
            has less of it than counts have.
        """
        variance = np.where(mask, 0.0, each**2 * self.variance)
        self._refuse_other_kinds(counts, variance, mask)
        if self.kind != ERR:
            return np.asarray(np.sqrt(variance))
        return without_source(variance, counts, mask, (f"`noise` {ERR}", "rms"))

    def _refuse_other_kinds(self, counts: Array, variance: Array, mask: NDArray[np.bool_]) -> None:
        """Refuse a map of another kind than it is given as: its noise is not in the image."""
        for j, bad in enumerate(mask):
            if bad.all():
                continue
            noise = float(np.sqrt(np.median(variance[j][~bad])))
            _, scatter = clipped_sky(j, counts[j], bad)
            if noise > TOO_NOISY * scatter > 0:
                others = ", ".join(kind for kind in NOISE if kind != self.kind)
                raise InputError(
                    f"`noise` {self.kind} says that the noise of `images[{j}]` is {noise:.3g} "
                    f"electrons, and its sky scatters by {scatter:.3g}: see to its unit, or give "
                    f"it as what it is ({others})"
                )


def electrons_by_variance(
    image: Array, variance: Array, path: str, flags: Array | None = None
) -> float:
    """Return the electrons in a unit of an image, by the variance of their counts.

    Counts n = e g of an image g have the variance g / e in its units: e is the difference of image
    between the brightest hundredth of its pixels and the median one, over that of the variance. A
    sky that was subtracted, and the variance of read noise and dark current, cancel. Pixels are
    bright by their neighbours, whose noise is not theirs.

    Parameters
    ----------
    image, variance : ndarray of float64, shape (ny, nx)
        In units of the image, and those squared; not finite or 0 where they are not known.
    path : str
        Their file, for messages.
    flags : ndarray, shape (ny, nx), optional
        Sums of flags; pixels with one of `CUT_SHORT` are left out.

    Raises
    ------
    InputError
        The variance does not grow with the image.
    """
    known = np.isfinite(image) & np.isfinite(variance) & (variance > 0)
    if flags is not None:
        known &= (np.nan_to_num(flags).astype(np.int64) & CUT_SHORT) == 0
    values, variances = image[known], variance[known]
    electrons = 0.0
    if values.size:
        from scipy.ndimage import uniform_filter

        whole = np.where(known, image, np.median(values))
        beside = (9.0 * uniform_filter(whole, 3) - whole)[known]
        bright = beside >= np.quantile(beside, 1.0 - BRIGHT)
        middle = beside <= np.median(beside)
        rise = variances[bright].mean() - variances[middle].mean()
        electrons = (values[bright].mean() - values[middle].mean()) / rise if rise > 0 else 0.0
    if not 0.0 < electrons < np.inf:
        raise InputError(
            f"the variance of the counts of {path} does not grow with its image; give `gain` as a "
            "number, the electrons in its unit"
        )
    return float(electrons)


def read_noise_map(
    words: Sequence[str], maps: Maps, errors: Callable[[], Array]
) -> NoiseMap | None:
    """Return the map of noise that is given, None where none is.

    Parameters
    ----------
    words : sequence of str
        ``KIND=FILE`` with a kind of `names.NOISE`, or ``"err"``.
    maps : Maps
        Their reader.
    errors : callable
        ``errors()`` returns the extensions ERR of the images, which ``"err"`` means.

    Raises
    ------
    FileError, InputError
        As `Maps.read`; several kinds; negative values.
    """
    if not words:
        return None
    kinds, paths = zip(*map(parse_kind, words), strict=True)
    if len(set(kinds)) > 1:
        raise InputError(
            f"`noise` {kinds[0]} and {kinds[-1]} were given: each is all there is of noise; leave "
            "one out"
        )
    kind = kinds[0]
    values = errors() if list(words) == [ERR] else maps.read("noise", paths)
    if (values < 0).any():
        raise InputError(
            f"`noise` {words[0]} has negative pixels; they must be 0 or more, and 0 where a "
            "pixel is bad"
        )
    from astropy import nddata  # which takes its time to load

    return NoiseMap(kind, variance_of("noise", getattr(nddata, NOISE[kind])(values))[0])
