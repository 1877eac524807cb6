"""Noise maps of images, in the forms that telescope pipelines write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.uncertainties import OtherNoiseError, variance_of, without_source
from lnocl.errors import InputError
from lnocl.io.levels import clipped_sky
from lnocl.io.maps import Maps
from lnocl.io.names import ERR, NOISE, parse_kind

# No image has so many times the noise that its sky shows.
TOO_NOISY = 5.0
# The share of pixels that are the brightest.
BRIGHT = 0.01
# The flags DO_NOT_USE, SATURATED and JUMP_DET of JWST: the counts of such a pixel were not summed
# over the whole exposure, so that their variance in its units is larger.
CUT_SHORT = 1 | 2 | 4


class NoiseMap(NamedTuple):
    """The noise map of p images.

    Attributes
    ----------
    kind : str
        The form in which it was given, a key of `names.NOISE`. The noise of kind `names.ERR`
        includes that of the source's photons.
    variance : ndarray of float64, shape (p, ny, nx)
        Variance of each pixel, in units of the images squared; 0 where a pixel is bad.
    """

    kind: str
    variance: Array

    def read_noise(self, counts: Array, each: Array | float, mask: NDArray[np.bool_]) -> Array:
        """Return the read noise of each pixel, electrons (rms), shape (p, ny, nx); 0 where masked.

        It holds all noise but the photon noise of `counts`, which is subtracted from a map of kind
        `names.ERR`.

        Parameters
        ----------
        counts : ndarray of float64, shape (p, ny, nx)
            The images, electrons.
        each : ndarray or float
            Electrons in one unit of the images; it broadcasts to (p, ny, nx).
        mask : ndarray of bool, shape (p, ny, nx)
            True where a pixel is bad.

        Raises
        ------
        InputError
            The noise is more than `TOO_NOISY` times the scatter of an image's sky. A map of kind
            `names.ERR` has less noise than the counts.
        """
        variance = np.where(mask, 0.0, each**2 * self.variance)
        self._refuse_other_kinds(counts, variance, mask)
        if self.kind != ERR:
            return np.asarray(np.sqrt(variance))
        return without_source(variance, counts, mask, (f"`noise` {ERR}", "rms"))

    def _refuse_other_kinds(self, counts: Array, variance: Array, mask: NDArray[np.bool_]) -> None:
        """Refuse a map far noisier than the sky of an image: its kind or unit is another."""
        for j, bad in enumerate(mask):
            if bad.all():
                continue
            noise = float(np.sqrt(np.median(variance[j][~bad])))
            _, scatter = clipped_sky(j, counts[j], bad)
            if noise > TOO_NOISY * scatter > 0:
                others = ", ".join(kind for kind in NOISE if kind != self.kind)
                raise OtherNoiseError(
                    f"`noise` {self.kind} says that the noise of `images[{j}]` is {noise:.3g} "
                    f"electrons, and its sky scatters by {scatter:.3g}: see to its unit, or give "
                    f"it as what it is ({others})"
                )


def electrons_by_variance(
    image: Array, variance: Array, path: str, flags: Array | None = None
) -> float:
    """Return the electrons in a unit of an image, by the variance of their counts.

    Poisson counts n = e g of an image g have the variance g / e in its units. So e is the rise of
    the image over the rise of the variance. Each rise is the mean of the brightest hundredth of the
    pixels minus the mean of the fainter half. A subtracted sky cancels, as do the variances of read
    noise and dark current. Pixels are ranked by the sum of their eight neighbours, so that their
    own noise does not rank them.

    Parameters
    ----------
    image, variance : ndarray of float64, shape (ny, nx)
        In units of the image, and those squared. Pixels that are not finite, or have no variance,
        are left out.
    path : str
        Their file, for messages.
    flags : ndarray, shape (ny, nx), optional
        Bits of data quality; pixels with one of `CUT_SHORT` are left out.

    Raises
    ------
    InputError
        No pixel is known, or the variance does not grow with the image.
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
    """Return the noise map that the user gave, as a variance; None for no words.

    Parameters
    ----------
    words : sequence of str
        ``KIND=FILE`` for each map, all with the same key of `names.NOISE`. The single word
        ``"err"`` stands for the extensions ERR of the images.
    maps : Maps
        Reads these files.
    errors : callable
        ``errors()`` returns the extensions ERR; it is called for the word ``"err"`` alone.

    Raises
    ------
    FileError, InputError
        As `Maps.read`; several kinds were given, or a map has negative values.
    """
    if not words:
        return None
    kinds, paths = zip(*map(parse_kind, words), strict=True)
    if len(set(kinds)) > 1:
        raise InputError(
            f"`noise` {kinds[0]} and {kinds[-1]} were given: each describes the whole noise; "
            "give one of them"
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
