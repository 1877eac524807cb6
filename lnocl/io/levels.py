"""The sky of an image, measured: its level and its noise."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError
from lnocl.scene.observation import Array

log = logging.getLogger("lnocl")

Mask = NDArray[np.bool_]


def sky_level(j: int, counts: Array, mask: Mask) -> float:
    """Return the background of image j: the sigma-clipped median of its good pixels, or 0.

    Raises
    ------
    InputError
        No pixel is good.
    """
    median, scatter = clipped_sky(j, counts, mask)
    log.info(
        "image %d: background %.6g electrons per pixel, scatter %.3g (sigma-clipped median)",
        j + 1,
        median,
        scatter,
    )
    if median < 0:
        log.info(
            "image %d: its sky was subtracted; taken are a background of 0, and its noise as "
            "read noise, which may be auto",
            j + 1,
        )
    return max(median, 0.0)


def sky_noise(j: int, counts: Array, mask: Mask) -> float:
    """Return the noise that the sky of image j has beside that of its counts, electrons.

    Raises
    ------
    InputError
        No pixel is good.
    """
    median, scatter = clipped_sky(j, counts, mask)
    noise = float(np.sqrt(max(scatter**2 - max(median, 0.0), 0.0)))
    log.info("image %d: read noise %.4g electrons (sigma-clipped scatter)", j + 1, noise)
    return noise


def clipped_sky(j: int, counts: Array, mask: Mask) -> tuple[float, float]:
    """Return the sigma-clipped median and scatter of the good pixels of image j.

    Raises
    ------
    InputError
        No pixel is good.
    """
    from astropy.stats import sigma_clipped_stats

    good = counts[~mask & np.isfinite(counts)]
    if good.size == 0:
        raise InputError(
            f"image {j} has no good pixel to measure its sky; leave the image out, or give "
            "background and read_noise as numbers"
        )
    _, median, scatter = sigma_clipped_stats(good)
    return float(median), float(scatter)
