"""A look at a PSF by itself: its centre, width, negative pixels, and the light in its wings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import median_filter

from lnocl.core.scene.cores import centre, fwhm, off_centre
from lnocl.core.scene.psfs import FAR_OFF_CENTRE, LITTLE_OFF_CENTRE, MUCH_NEGATIVE
from lnocl.detection.checks import read_psf

# Wings and border are squares round the centre, as shares of half the side.
WINGS, BORDER = (0.55, 0.7), (0.85, 1.0)
# A PSF with fewer pixels in its FWHM is undersampled.
SAMPLED = 2.0
# Shares of the light from which on it is reported; wings that fall more slowly than this power
# of the radius look like a background. PSFs of eight public sets that are in order have at most
# 1.6 % and 2.2 %, those of benchmarks/own_frame.py up to 15 % of noise.
MUCH_NOISE, MUCH_AT_BORDER, BACKGROUND_FALL = 0.15, 0.05, 1.0
# The mean deviation of white noise over the median of what a median filter of 3 x 3 leaves of it.
OF_NOISE = 1.372
BETTER = "make it from brighter or more stars"


class PsfReport(NamedTuple):
    """Measures of a PSF that need no image: its centre, width, negative pixels and wings.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns.
    off_centre : tuple of float
        From ``(kx // 2, ky // 2)`` to the centre of light of the core, pixels along x and y.
    fwhm : float
        Full width of the core at half its maximum, pixels.
    negative : float
        The light of negative pixels, as a share of all.
    noise : float
        The light that differs from pixel to pixel in wings and border, extrapolated to all pixels,
        as a share of all.
    border : float
        The light of a background at the border's level, as a share of all.
    fall : float
        The power of the radius by which light falls from the wings to the border; NaN where there
        is none. It is 0 for a background, and 3 for wings of seeing or diffraction.

    See Also
    --------
    examine : Returns it.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.psf import examine
    >>> y, x = np.indices((33, 33)) - 16.0
    >>> report = examine(np.exp(-(x**2 + y**2) / 8))
    >>> report.shape, round(report.fwhm, 1), abs(report.negative)
    ((33, 33), 4.7, 0.0)
    """

    shape: tuple[int, ...]
    off_centre: tuple[float, float]
    fwhm: float
    negative: float
    noise: float
    border: float
    fall: float

    def lines(self) -> list[str]:
        r"""Return all numbers, a sentence each.

        Returns
        -------
        list of str
            Six lines: size, centre, FWHM, negative pixels, noise and border.

        Examples
        --------
        >>> import numpy as np
        >>> from lnocl.psf import examine
        >>> y, x = np.indices((33, 33)) - 16.0
        >>> print(*examine(np.exp(-(x**2 + y**2) / 8)).lines()[:3], sep="\n")
        size: 33 x 33 pixels
        centre: its core lies (0.00, 0.00) pixels from (16, 16)
        FWHM: 4.73 pixels
        """
        (dx, dy), (y, x) = self.off_centre, centre(self.shape)
        fall = f", and falls there as r^-{self.fall:.1f}" if self.fall > 0 else ""
        return [
            f"size: {self.shape[1]} x {self.shape[0]} pixels",
            f"centre: its core lies ({dx:z.2f}, {dy:z.2f}) pixels from ({x}, {y})",
            f"FWHM: {self.fwhm:.2f} pixels",
            f"negative pixels: {_percent(self.negative)} of its light",
            f"noise: {_percent(self.noise)} of its light, if all pixels have that of the wings",
            f"border: {_percent(self.border)} of its light, were all of it a background{fall}",
        ]

    def faults(self) -> list[str]:
        """Return the faults of the PSF, each with what to do.

        Returns
        -------
        list of str
            One sentence for each; empty for a PSF without them.

        Examples
        --------
        >>> import numpy as np
        >>> from lnocl.psf import examine
        >>> y, x = np.indices((33, 33)) - 16.0
        >>> examine(np.exp(-(x**2 + y**2))).faults()
        ['it is undersampled: fewer than two pixels to its FWHM']
        """
        distance = float(np.hypot(*self.off_centre))
        refused = ", and is refused" if distance >= FAR_OFF_CENTRE else ""
        lit = self.border > MUCH_AT_BORDER
        is_level = lit and self.fall < BACKGROUND_FALL
        # Noise grows with the pixels.
        quiet = int(max(self.shape) * (MUCH_NOISE / max(self.noise, MUCH_NOISE)) ** 0.5)
        found = [
            (
                distance >= LITTLE_OFF_CENTRE,
                f"it is {distance:.2f} pixels off its centre{refused}: take --psf-centre fit",
            ),
            (self.fwhm < SAMPLED, "it is undersampled: fewer than two pixels to its FWHM"),
            (self.negative > MUCH_NEGATIVE, f"many of its pixels are negative: {BETTER}"),
            (
                self.noise > MUCH_NOISE,
                f"its wings are noise: {BETTER}, or of {quiet} pixels a side",
            ),
            (is_level, "its border is level: subtract a background, or make it larger"),
            (lit and not is_level, "its wings are cut off: make it larger"),
        ]
        return [sentence for is_so, sentence in found if is_so]


def examine(psf: ArrayLike) -> PsfReport:
    r"""Return measures of a PSF that need no image.

    Parameters
    ----------
    psf : array_like, shape (ky, kx)
        In any linear unit.

    Returns
    -------
    PsfReport
        Centre, width, negative pixels and wings, and the faults that follow from them.

    Raises
    ------
    InputError
        Values that are not finite numbers; another number of axes; a sum that is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.psf import examine
    >>> y, x = np.indices((33, 33)) - 16.0
    >>> print(*examine(np.exp(-((x - 1) ** 2 + y**2) / 8) + 2e-3).faults(), sep="\n")
    it is 1.00 pixels off its centre, and is refused: take --psf-centre fit
    its border is level: subtract a background, or make it larger
    """
    light = read_psf(psf)
    y, x = (
        abs(np.arange(n) - i) / max(n // 2, 1)
        for n, i in zip(light.shape, centre(light.shape), strict=True)
    )
    reach = np.maximum(y[:, None], x)
    wings, border = ((reach >= low) & (reach <= high) for low, high in (WINGS, BORDER))
    outer = wings | border
    apart = abs(light - median_filter(light, 3))[outer]
    noise = OF_NOISE * float(np.median(apart)) if apart.size else 0.0
    level, inner = (float(np.median(light[at])) if at.any() else 0.0 for at in (border, wings))
    fall = np.nan
    if level > 0 and inner > 0:
        fall = float(np.log(inner / level) / np.log(sum(BORDER) / sum(WINGS)))
    return PsfReport(
        light.shape,
        off_centre(light),
        fwhm(light),
        float(-light.clip(max=0.0).sum()),
        noise * light.size,
        level * light.size,
        fall,
    )


def _percent(share: float) -> str:
    return f"{100 * share:z.2g} %"
