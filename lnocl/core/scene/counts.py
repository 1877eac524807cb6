"""The range of counts and exposures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array, pixels
from lnocl.errors import InputError, warn

if TYPE_CHECKING:
    from lnocl.core.scene.observation import Observation

# Most electrons in a pixel: sums of squares of a sky of so many remain far from the largest number,
# and float32, in which results are written, holds their sum.
MAX_COUNTS = 1e30


def refuse_overflow(counts: Mapping[str, Array]) -> None:
    """Refuse counts above `MAX_COUNTS`, by their names."""
    for name, values in counts.items():
        if not (values <= MAX_COUNTS).all():
            raise InputError(
                f"the {name}, with `exposure` and the square of `read_noise`, must be at most "
                f"{MAX_COUNTS:g} electrons per pixel: divide the counts and `read_noise` by a "
                "constant"
            )


def without_negative(images: Array, has_read_noise: bool) -> Array:
    """Return images with 0 where counts are negative, and warn of these."""
    n_negative = int((images < 0).sum())
    if not n_negative:
        return images
    words = pixels(n_negative, "image", "negative", "set to 0")
    warn(
        f"{words}, with the square of `read_noise` added"
        if has_read_noise
        else f"{words}; if the sky was subtracted, give the noise that it left as `read_noise`, "
        "or add the sky to the images and give it as `background`"
    )
    return np.maximum(images, 0.0)


def means(values: Array, mask: NDArray[np.bool_]) -> Array:
    """Return the number of each image, of maps the mean of good pixels; 0 where it has none.

    Bad pixels of a map hold what belongs to no image, such as an exposure of 1.
    """
    if values.ndim == 1:
        return values
    pairs = zip(values, ~mask, strict=True)
    return np.array([each[good].mean() if good.any() else 0.0 for each, good in pairs])


def mean_exposure(observation: Observation) -> float:
    """Return the mean of the exposures, of good pixels where they are maps.

    Raises
    ------
    InputError
        They are too large to be summed.
    """
    exposures = observation.exposure
    with np.errstate(over="ignore"):
        seen = exposures[~observation.mask] if exposures.ndim == 3 else exposures
        mean = float(seen.mean())
    if not np.isfinite(mean):
        raise InputError("the exposures are too large to be summed: divide them by a constant")
    return mean
