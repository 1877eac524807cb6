"""The grid of the transform: the lengths that its axes may have, and which of them a scene has."""

from __future__ import annotations

import math

import numpy as np

from lnocl.core.scene.arrays import whole
from lnocl.core.scene.line_weights import TAPS
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.padding import choose_pad
from lnocl.core.scene.rotation import PHASE_ROWS, cropped
from lnocl.errors import InputError, detail

MAX_AXIS = 8192
# Odd factors of an axis, and the least power of two beside them: a transform takes blocks of 8
# columns, and one of each pair (k, -k). With 11, 13 and 15 an iteration takes about as long as on
# the next of these lengths (docs/validation/speed.md).
ODD_FACTORS = 1, 3, 5, 7, 9
MIN_EVEN = 16

# The least side of a grid of turned images: kernels/turn.cl shifts as many columns at once.
LEAST_TURNED = 16

LENGTHS = sorted(
    odd << k
    for odd in ODD_FACTORS
    for k in range(1, MAX_AXIS.bit_length())
    if odd << k <= MAX_AXIS and (odd == 1 or 1 << k >= MIN_EVEN)
)


def pad_of(observation: Observation, pad: object) -> int:
    """Return how many unobserved pixels there are at least round the images, "auto" by a rule.

    Raises
    ------
    InputError
        `pad` is out of range.
    """
    if not (isinstance(pad, str) and pad == "auto"):
        return whole("pad", pad, 0, ", or auto")
    chosen = choose_pad(observation)
    reason = "light runs" if chosen else "no light runs"
    detail("`pad` chosen: %d pixels, as %s over the edge of the images", chosen, reason)
    return chosen


def grid_of(observation: Observation, pad: int) -> tuple[int, int]:
    """Return the shape (Ny, Nx) of the grid of a scene's images; its sky may be finer.

    It holds the images with their pad, and the PSFs, or as much of them as reaches from one end of
    the images to the other.

    Raises
    ------
    InputError
        The images are too large for the transform.
    """
    shape = extent(observation) if observation.is_turned else observation.shape
    # Light that is farther from its source than the images are wide reaches none of them.
    most = MAX_AXIS // observation.oversample
    sizes = (-(-k // observation.oversample) for k in psf_shape(observation))
    reach = (min(k, 2 * n, most) for n, k in zip(shape, sizes, strict=True))
    ny, nx = (max(n + 2 * pad, k) for n, k in zip(shape, reach, strict=True))
    if max(ny, nx) > most:
        also = f" and oversample={observation.oversample}" if observation.oversample > 1 else ""
        raise InputError(
            f"images of {shape} with `pad`={pad}{also} need a grid of {(ny, nx)}; "
            f"the largest axis is {most}: cut the images or pad less"
        )
    return length_for(ny), length_for(nx)


def psf_shape(observation: Observation) -> tuple[int, int]:
    """Return the smallest shape that contains every PSF, pixels of the sky.

    Where images have several scales that is what is not 0 of each, times its scale; but for those
    of single stars, which are not those of the sky.
    """
    shape, scales = observation.psfs.shape[1:], observation.scales
    own = observation.star_psfs.shape[2:]
    if (scales == 1.0).all():
        return max(shape[0], own[0]), max(shape[1], own[1])
    psfs = zip(observation.psfs, scales, strict=True)
    shapes = [own, *(scale * np.array(cropped(psf).shape) for psf, scale in psfs)]
    ky, kx = np.ceil(np.max(shapes, axis=0))
    return int(ky), int(kx)


def extent(observation: Observation) -> tuple[int, int]:
    """Return the grid that holds the sky, the corners of rotated images and their shears.

    It is in pixels of the images, finer ones by `oversample` of which are the sky's.
    That is the frame of the sky, the corners of all images in it, and what two of the three shears
    leave of each (`lnocl.core.scene.rotation.Rotation`): a grid is a period, and rows and columns
    that an image needs lie on one side of its ends. The ends of rows are those of a block of
    phases.
    """
    height, width = observation.sky_shape
    corners, needed = [np.array([(0.0, 0.0), (width - 1.0, height - 1.0)])], np.zeros(2)
    for j in range(observation.n_images):
        turn, shift, (rows, columns) = observation.on_fine_pixels(j)
        ends = [(x, y) for x in (columns[0], columns[-1]) for y in (rows[0], rows[-1])]
        corners.append(np.linalg.solve(turn, (np.array(ends) - shift).T).T)
        scale, slope = observation.scales[j], abs(math.tan(math.atan2(turn[1, 0], turn[0, 0]) / 2))
        sheared = scale * (len(columns) + slope * len(rows))
        taps = TAPS * (1.0 if scale == 1.0 else 1.0 + scale)
        needed = np.maximum(needed, (sheared + taps, np.ptp(corners[-1][:, 1]) + taps + PHASE_ROWS))
    size = np.maximum(np.ptp(np.concatenate(corners), axis=0) + TAPS, needed)
    x, y = (-(-(np.ceil(size).astype(int) + 1) // observation.oversample)).tolist()
    ny, nx = observation.shape
    return max(y, ny, LEAST_TURNED), max(x, nx, LEAST_TURNED)


def length_for(n: int) -> int:
    """Return the least length of an axis that holds n points.

    Examples
    --------
    >>> from lnocl.core.scene.grid import length_for
    >>> [length_for(n) for n in (5, 70, 100, 513, 1100)]
    [8, 80, 112, 576, 1152]
    """
    return next(length for length in LENGTHS if length >= n)
