"""Whether the noise of images is that of Poisson counts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array, Mask, together
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.remembered import remembered
from lnocl.errors import warn

# Noise is measured in square blocks, of these the darker half, where there are so many.
BLOCK = 8
MIN_BLOCKS = 12
# Rows of blocks that are measured; of images with twice as many every second one, and so on.
MAX_ROWS = 128
# Second differences of neighbours, and of pixels so far apart.
FAR = 3
# Of the variance over the mean it is warned beyond this factor of 1, unless neighbours differ by
# less than this share of what pixels apart do (docs/validation/psf.md).
MAX_FACTOR = 1.5
# The mean of the darker half of blocks of noise is a tenth of a pixel's noise below that of all.
DARKNESS = 0.3
MIN_SHARE = 0.7


class Noise(NamedTuple):
    """The noise of an image where it is darkest.

    Attributes
    ----------
    mean, level : float
        Electrons per pixel of image and background, with the square of the read noise.
    variance : float
        By second differences of neighbours: ``<(g(n - 1) - 2 g(n) + g(n + 1))^2> / 6``.
    variance_apart : float
        The same of pixels three apart; larger where the noise of neighbours is correlated.
    """

    mean: float
    level: float
    variance: float
    variance_apart: float

    def log_factor(self) -> float:
        """Return the logarithm of the variance over the mean, 0 for Poisson counts."""
        least = float(np.finfo(float).tiny)
        return float(np.log(max(self.variance, least) / max(self.mean, least)))

    def is_darker_than(self, level: float, variance: float) -> bool:
        """Return whether it is darker than a level of this variance by more than noise makes it."""
        noise = np.sqrt(max(variance, self.variance))
        return bool(level - self.mean > DARKNESS * noise)

    def is_white(self) -> bool:
        """Return whether neighbours differ as much as pixels apart."""
        return self.variance >= MIN_SHARE * self.variance_apart


def measure_noise(observation: Observation) -> Iterator[Noise | None]:
    """Yield the noise of each image; None where too few blocks are free of bad pixels."""
    each = zip(observation.images, observation.mask, observation.background, strict=True)
    yield from map(noise_of, *zip(*each, strict=True))


def noise_of(image: Array, mask: Mask, background: Array | float) -> Noise | None:
    """Return the noise of an image; None where too few blocks are free of bad pixels.

    Parameters
    ----------
    image, mask : ndarray, shape (ny, nx)
        Electrons per pixel; True where a pixel is bad.
    background : float or ndarray, shape (ny, nx)
        Electrons per pixel.
    """
    ny, nx = (n - n % BLOCK for n in image.shape)
    image, mask = _some_rows(image[:ny, :nx]), _some_rows(mask[:ny, :nx])
    level = _some_rows(background[:ny, :nx]) if isinstance(background, np.ndarray) else background
    return _noise_of_blocks(np.where(mask, 0.0, image), mask, level)


@remembered(2**16)  # each step of the preparation asks for that of its images
def _noise_of_blocks(image: Array, mask: Mask, background: Array | float) -> Noise | None:
    """Return the noise of an image of whole blocks, 0 where a pixel is bad."""
    means = _block_means(image)
    good = _block_means(mask.astype(np.float64)) == 0
    if good.sum() < 2 * MIN_BLOCKS:
        return None
    dark = good & (means <= np.median(means[good]))
    excess = image - background  # the background may have structure that is known
    near, apart = (_block_means(_squares(excess, lag))[dark] for lag in (1, FAR))
    level = means - _block_means(excess)
    values = means[dark], level[dark], near, apart
    return Noise(*map(float, map(np.median, values)))  # many blocks may hold next to nothing


def with_noise_shown(observation: Observation) -> Observation:
    """Return an observation with as much less read noise as its images scatter less.

    That is done where the variance is less than two thirds of the mean, as for `warn_of_noise`,
    but of neighbours and of pixels apart: noise that is too large hides all else that is wrong.
    """
    shares = np.zeros(observation.n_images)
    for j, noise in enumerate(measure_noise(observation)):
        if noise is not None and noise.level > 0:
            more = noise.mean - max(noise.variance, noise.variance_apart)
            if more > (1.0 - 1.0 / MAX_FACTOR) * noise.mean and more < noise.level:
                shares[j] = more / noise.level
    if not shares.any():
        return observation
    background = observation.background
    excess = np.multiply(*together(background, shares))
    images = np.subtract(*together(observation.images, excess)).clip(0.0)
    return observation.replace(images=images, background=background - excess)


def _some_rows(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return all rows of blocks, or every so many-th of more than `MAX_ROWS`."""
    ny, nx = pixels.shape
    some = pixels.reshape(ny // BLOCK, BLOCK, nx)[:: ny // (BLOCK * MAX_ROWS) or 1]
    return some.reshape(len(some) * BLOCK, nx)


def _squares(image: Array, lag: int) -> Array:
    """Return the squares of second differences along rows over 6, their mean at the ends."""
    differences = image[:, : -2 * lag] - 2.0 * image[:, lag:-lag] + image[:, 2 * lag :]
    return np.pad(differences**2 / 6.0, ((0, 0), (lag, lag)), mode="reflect")


def _block_means(pixels: Array) -> Array:
    ny, nx = pixels.shape
    return pixels.reshape(ny // BLOCK, BLOCK, nx // BLOCK, BLOCK).mean(axis=(1, 3))


def warn_of_noise(observation: Observation) -> None:
    """Warn of the image whose noise is least that of Poisson counts.

    More variance at a distance than between neighbours is structure, such as the rings of a star,
    or noise that neighbours share, as in drizzled images. That costs held-out counts nothing
    (benchmarks/defaults.py --drizzled).

    Warns
    -----
    LnoclWarning
        The variance is 1.5 times the mean or more, or less than two thirds of it; or the
        background is above the darker half of an image.
    """
    measured = [
        (j, noise) for j, noise in enumerate(measure_noise(observation)) if noise is not None
    ]
    for j, noise in measured:
        if noise.is_darker_than(noise.level, noise.level):
            warn(
                f"the background of `images[{j}]` is too high: it is {noise.level:.6g} electrons "
                f"per pixel where the darker half of the image has {noise.mean:.6g}"
            )
            return
    found = [(abs(noise.log_factor()), j, noise) for j, noise in measured if noise.is_white()]
    size, j, noise = max(found, default=(0.0, 0, Noise(1.0, 1.0, 1.0, 1.0)))
    if size >= np.log(MAX_FACTOR):
        warn(
            f"the noise of `images[{j}]` is not that of its counts: where it is darkest the "
            f"variance is {noise.variance:.3g} and the mean {noise.mean:.3g} electrons; see to "
            "gain, background (a sky that was subtracted is added again) and read noise"
        )
