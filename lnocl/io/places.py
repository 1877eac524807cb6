"""Where images lie in the sky, from their headers; and the epochs that they are of."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from astropy.io import fits

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.quantities import in_unit
from lnocl.core.scene.transforms import rotations, scale_of
from lnocl.core.scene.units import parse
from lnocl.errors import FileError, InputError, counted, detail, note, warn
from lnocl.io import sky
from lnocl.io.calibration import Calibration, Word
from lnocl.io.fitsfile import open_fits, open_regular
from lnocl.io.fitsread import Stack, date_of, read_keyword

if TYPE_CHECKING:
    from astropy.time import Time

# Most that is read of a file of angles.
MAX_BYTES = 2**27
# The longest night, days.
NIGHT = 0.5


class Places(NamedTuple):
    """Where images lie.

    Attributes
    ----------
    maps : dict of str to ndarray
        `offsets` or `transforms`, where there are any.
    header : astropy.io.fits.Header
        That of the sky: of the image whose pixels it has; with field rotation without coordinates.
    sha256 : list of str
        Checksum of the file of angles, where there is one.
    """

    maps: dict[str, Any]
    header: fits.Header
    sha256: list[str]


def read_places(stack: Stack, calibration: Calibration) -> Places:
    """Return where images lie by `align` or `angle`; warn of what neither heeds.

    Raises
    ------
    FileError, InputError
        Both are given; a cube is to be aligned; coordinates or angles are missing, or unusable.
    """
    if calibration.angle:
        if calibration.align is not None:
            raise InputError("give `angle` or `align`, not both: each has the rotation")
        transforms, sha256 = _field_rotation(stack, calibration)
        return Places({"transforms": transforms}, _without_coordinates(stack.header), sha256)
    if calibration.align is None:
        if len(stack.headers) > 1 and all(map(sky.has_celestial, stack.headers)):
            _warn_of_places(stack)
        return Places({}, stack.header, [])
    if len(stack.headers) != len(stack.data):
        raise InputError(
            f"{stack.paths[0]} is a cube, with one WCS for all its images; to align them give a "
            "file for each"
        )
    return _by_coordinates(stack)


def _by_coordinates(stack: Stack) -> Places:
    images = stack.headers, stack.paths, stack.shapes
    finest = sky.finest(*images)
    found, path = sky.transforms(*images, finest), stack.paths[finest]
    if finest:
        note("the sky has the pixels of %s, the smallest: positions are in these", path)
    is_turned = (found[:, :, :2] != np.eye(2)).any()
    for j, each in enumerate(found):
        if j == finest:
            continue
        larger = f", pixels {scale:.6g} times as large" if (scale := scale_of(each)) > 1 else ""
        if is_turned:
            angle = sky.rotation_angle(each)
            detail("`images[%d]`: turned by %.3f degrees%s, from the WCS", j, angle, larger)
        else:
            dx, dy = each[:, 2]
            detail("`images[%d]`: offset %.3f, %.3f pixels in x, y, from the WCS", j, dx, dy)
    maps = {"transforms": found} if is_turned else {"offsets": found[:, :, 2]}
    return Places(maps, stack.headers[finest], [])


def _field_rotation(stack: Stack, calibration: Calibration) -> tuple[Array, list[str]]:
    """Return the maps of images of the parallactic angles given, or of a file of these."""
    words, (p, ny, nx) = calibration.angle, stack.data.shape
    sha256 = list[str]()
    if len(words) == 1 and isinstance(words[0], str) and os.path.isfile(words[0]):
        angles, checksum = read_angles(words[0])
        sha256.append(checksum)
    else:
        if len(words) not in (1, p):
            raise InputError(
                f"{counted(len(words), 'angle')} for {counted(p, 'image')}; give a keyword, a "
                "file of the angles, or one number for each image"
            )
        each = (words[min(j, len(words) - 1)] for j in range(p))
        angles = np.array([_angle(stack, j, word) for j, word in enumerate(each)])
    if len(angles) != p:
        raise InputError(f"{words[0]} has {len(angles)} angles for {counted(p, 'image')}")
    centre = calibration.centre or (nx // 2, ny // 2)
    # Field rotation turns north, and the sky with it, away from the y axis.
    return rotations(-angles, centre), sha256


def read_angles(path: str) -> tuple[Array, str]:
    """Return the angles in a file, one for each image, and its SHA-256 checksum.

    Parameters
    ----------
    path : str
        FITS, with an image of one dimension, in the angle of its BUNIT or else in degrees; or text
        with a number a line.

    Raises
    ------
    FileError
        The file cannot be read, or holds something else.
    """
    try:
        with open_regular(path) as stream:
            content = stream.read(MAX_BYTES)
    except (OSError, ValueError) as error:
        raise FileError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from error
    if content.startswith(b"SIMPLE"):
        with open_fits(path) as file:
            images = [hdu for hdu in file.hdus() if len(getattr(hdu, "shape", ()) or ()) == 1]
            values = np.array(images[0].data, np.float64) if images else np.zeros(0)
            if unit := parse(str(images[0].header.get("BUNIT", ""))) if images else None:
                values = in_unit("angle", values * unit, "deg")
    else:
        try:
            values = np.array(content.decode("ascii").split(), np.float64)
        except ValueError as error:
            raise FileError(f"{path} must hold numbers alone, an angle a line") from error
    if not (values.size and np.isfinite(values).all()):
        raise FileError(f"{path} must hold a finite angle for each image")
    return values, hashlib.sha256(content).hexdigest()


def _angle(stack: Stack, j: int, word: Word) -> float:
    if isinstance(word, (int, float)):
        return float(word)
    found = stack.number("angle", j, word, " degrees")
    if found is None:
        raise InputError(
            f"{stack.file_of(j)[0]} has no {word} in its header, and there is no such file; give "
            "`angle` as a number, another keyword, or a file of the angles"
        )
    return found + 0.0  # no negative zero


def _without_coordinates(header: fits.Header) -> fits.Header:
    """Return the header of an image with field rotation: north is up in the sky alone."""
    header = header.copy()
    for keyword in ("CTYPE1", "CTYPE2"):
        header.remove(keyword, ignore_missing=True)
    return header


def _warn_of_places(stack: Stack) -> None:
    """Warn of the first image that is not where the first is, by their coordinates."""
    try:
        found = sky.transforms(stack.headers, stack.paths, stack.shapes)
    except InputError as error:
        warn(error.message)
        return
    for path, each in zip(stack.paths, found, strict=True):
        dx, dy = each[:, 2]
        if scale_of(each) != 1.0:
            where = f"has pixels {scale_of(each):.4g} times as large as"
        elif (each[:, :2] != np.eye(2)).any():
            where = f"is turned by {sky.rotation_angle(each):.2f} degrees against"
        elif max(abs(dx), abs(dy)) > sky.MAX_OFFSET_VARIATION:
            where = f"lies ({dx:.2f}, {dy:.2f}) pixels off"
        else:
            continue
        warn(
            f"{path} {where} {stack.paths[0]}, by their sky coordinates: give `align` wcs, "
            "unless their pixels were registered"
        )
        return


def read_epochs(stack: Stack, words: Sequence[Word]) -> list[Any] | None:
    """Return the label of each image's epoch, where there are several.

    Raises
    ------
    InputError
        There are too few or too many, or a header lacks the keyword, or a date.
    """
    p = len(stack.data)
    if not words:
        return None
    if len(words) == p > 1:
        return list(words)
    if len(words) > 1:
        raise InputError(
            f"{counted(len(words), 'epoch')} for {counted(p, 'image')}; give each, a keyword, "
            "or a label for each image"
        )
    if words[0] == "each":
        return list(range(p))
    labels = []
    for file in map(stack.file_of, range(p)):
        by_night = words[0] == "night"
        labels.append(date_of(*file) if by_night else read_keyword(*file, str(words[0])))
        if labels[-1] is None:
            raise InputError(
                f"{file[0]} has no {'date' if by_night else words[0]} in its header; give "
                "`epoch` each, another keyword, or a label for each image"
            )
    return _nights(labels) if by_night else [str(label) for label in labels]


def _nights(dates: list[Time]) -> list[str]:
    """Return the date of the first image of each night: of those within half a day from it on."""
    labels, first = [""] * len(dates), None
    for j in np.argsort([date.mjd for date in dates]).tolist():
        if first is None or dates[j].mjd > first.mjd + NIGHT:
            first = dates[j]
        labels[j] = first.strftime("%Y-%m-%d")
    return labels
