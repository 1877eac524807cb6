"""Whether the pixels of PSFs are those of their images, as their headers say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lnocl.core.scene.fields import OVERSAMPLES
from lnocl.errors import warn
from lnocl.io import sky
from lnocl.io.fitsread import Stack

# The logarithm of the pixels' size in image and PSF may differ by this much.
MAX_SCALE_ERROR = 0.02


def warn_of_pixel_scales(images: Stack, psfs: Stack, grids: Sequence[Any], oversample: int) -> None:
    """Warn of the first PSF whose pixels are of another size than those of its image.

    Parameters
    ----------
    images, psfs : Stack
        Their headers are read.
    grids : sequence of photutils.psf.GriddedPSFModel
        Of each file of PSFs, or none; they are sampled on the images' pixels as they need.
    oversample : int
        Pixels of a PSF to one of its image.
    """
    scales = [sky.pixel_scale(header) for header in psfs.headers]
    for j, header in enumerate(psfs.headers):
        finer = None if grids or scales[j] else sky.oversampling(header)
        if finer is not None and finer != oversample:
            warn(
                f"`psfs[{j}]` is sampled {finer:g} times finer than the detector, by OVERSAMP in "
                f"its header: give `oversample` {finer:g}, or bin it to "
                + ("the image's pixels" if oversample == 1 else f"{oversample} times finer")
            )
            return
    for j, of_psf in enumerate(scales):
        # The images' coordinates need not be read where nothing is known of a PSF.
        of_image = of_psf and sky.pixel_scale(images.headers[min(j, len(images.headers) - 1)])
        if not (of_psf and of_image):
            continue
        may_be = (1.0, float(np.max(grids[j].oversampling))) if grids else (float(oversample),)
        if min(abs(np.log(of_image / of_psf / q)) for q in may_be) > MAX_SCALE_ERROR:
            advice = (
                "give the grid of this camera" if grids else _advice(of_image, of_psf, oversample)
            )
            warn(
                f"the pixels of `psfs[{j}]` are of {of_psf:.4g} arcsec, those of its image of "
                f"{of_image:.4g}: {advice}"
            )
            return


def _advice(of_image: float, of_psf: float, oversample: int) -> str:
    """Return how to make the pixels of a PSF those of its image."""
    wanted, finer = of_image / oversample, round(of_image / of_psf)
    exact = finer in OVERSAMPLES and abs(of_image / of_psf / finer - 1) < 0.01
    words = f"give oversample {finer}, or " if exact else ""
    pixels = "the image's pixels" if oversample == 1 else f"{wanted:.4g} arcsec"
    return f"{words}rebin it to {pixels}, by {wanted / of_psf:.3g}"
