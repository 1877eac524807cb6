"""What is wrong in a frame whose PSF is not known: saturated pixels, cosmic rays and hot pixels."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from lnocl.core.scene.arrays import Array, Mask
from lnocl.core.scene.blemishes import flat_tops
from lnocl.errors import counted, note

# No stars are narrower than this, full width at half maximum, pixels, where no PSF is known.
SHARPEST = 1.5


def saturated_pixels(
    pixels: Array, significance: Array, bad: Mask, saturation: float | None
) -> Mask:
    """Return which pixels are saturated, by the level that is given and by flat tops."""
    given = np.zeros(bad.shape, bool) if saturation is None else pixels >= saturation
    flat = flat_tops(pixels, significance, bad | given)
    if flat.any():
        lowest, highest = pixels[flat].min(), pixels[flat].max()
        note(
            f"{counted(int(flat.sum()), 'pixel')} of flat tops at {lowest:.10g}"
            + (f" to {highest:.10g}" if highest > lowest else "")
            + f" are taken as saturated, as by `saturation` {lowest:.10g}"
        )
    return given | flat


def sharpest_psf() -> Array:
    """Return a PSF as sharp as optics leave it, a Gaussian of `SHARPEST`, summed in pixels."""
    edges = np.arange(-3.5, 4.0) * np.sqrt(4.0 * np.log(2.0)) / SHARPEST
    profile = np.diff(erf(edges))
    return np.outer(profile, profile) / profile.sum() ** 2


def are_counts(values: Array) -> bool:
    """Return whether these are whole counts, and not all of them alike."""
    return bool((values >= 0).all() and (values == np.round(values)).all() and np.ptp(values) > 0)
