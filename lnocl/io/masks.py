"""Which pixels of images in files are bad, and why."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lnocl.core.scene.arrays import Array, Mask
from lnocl.errors import counted, note, warn
from lnocl.io.calibration import Calibration
from lnocl.io.fitsread import read_contents
from lnocl.io.flags import NO_BITS, bad_pixels, good_bits_of, most_common_flag
from lnocl.io.image_files import ImageFiles

# Of more masked pixels than this share of an image it is warned.
MUCH_MASKED = 0.1


def read_mask(files: ImageFiles, exposure: Array | None) -> Mask:
    """Return which pixels are bad, and log their number, each pixel for its first reason."""
    beyond = _beyond(files)
    masked = beyond.copy()
    for why, bad in _bad_pixels(files, exposure):
        for j, count in enumerate((bad & ~masked).sum(axis=(1, 2))):
            note("`images[%d]`: %s masked %s", j, counted(count, "pixel"), why)
        masked |= bad
    n_masked, n_pixels = ((~beyond & each).sum(axis=(1, 2)) for each in (masked, ~beyond))
    for j, share in enumerate(n_masked / n_pixels):
        if share > MUCH_MASKED:
            warn(
                f"{100 * share:.0f} % of `images[{j}]` are masked: the notes say why; leave "
                "`mask` out, or name flags that are no fault, as in `mask` dq:16, if they are "
                "good"
            )
    return masked


def mask_of(path: str, word: str) -> tuple[Mask, list[str]]:
    """Return which pixels of one image are bad, by a file or ``dq`` or ``wht``; and its checksum.

    Raises
    ------
    FileError, InputError
        The file is refused by `ImageFiles` or `Maps.read`, or has no such extension.
    """
    files = ImageFiles([path], Calibration(mask=[word]))
    return read_mask(files, None)[0], files.maps.sha256.get("mask", [])


def _beyond(files: ImageFiles) -> Mask:
    """Return which pixels are beyond images that are smaller than others."""
    beyond = np.ones(files.stack.data.shape, bool)
    for each, (ny, nx) in zip(beyond, files.stack.shapes, strict=True):
        each[:ny, :nx] = False
    return beyond


def _bad_pixels(files: ImageFiles, exposure: Array | None) -> Iterator[tuple[str, Mask]]:
    words = files.calibration.mask
    flags = [word for word in words if word.partition(":")[0] == "dq"]
    if paths := [word for word in words if word not in (*flags, "wht")]:
        yield "by the mask", files.maps.read("mask", paths) != 0  # NaN is not 0 either
    if flags:
        yield "by the extension DQ", _data_quality(files, flags[-1])
    if "wht" in words:
        yield "without weight", files.extensions("WHT", "mask") == 0
    level = files.calibration.saturation
    if level is not None:
        yield f"as saturated, at {level:g} or above", files.stack.data >= level
    if exposure is not None and exposure.ndim == 3:
        yield "without exposure", exposure == 0
    if files.noise is not None:
        yield "by the map of noise", files.noise.variance == 0


def _data_quality(files: ImageFiles, word: str) -> Mask:
    sums = files.extensions("DQ", "mask")
    flagged = np.empty(sums.shape, bool)
    for j, path in enumerate(files.paths):
        good_bits = word[len("dq:") :]
        if word == "dq":
            words = map(read_contents(path).value, ("TELESCOP", "INSTRUME", "DETECTOR"))
            good_bits = good_bits_of(*words)
        if good_bits != NO_BITS:
            note("%s: of the flags in DQ %s are no fault", path, good_bits)
        of_file = slice(None) if len(files.paths) == 1 else slice(j, j + 1)
        flagged[of_file] = bad_pixels(sums[of_file], good_bits, path)
        flag, n = most_common_flag(sums[of_file][flagged[of_file]])
        if n:
            note("%s: %s with the flag %d of DQ", path, counted(n, "pixel"), flag)
    return flagged
