"""Positions on the sky: stars from their coordinates, offsets between images from their WCS."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from astropy.wcs.utils import pixel_to_pixel

from lnocl.core.scene.arrays import Array
from lnocl.errors import InputError
from lnocl.io.headers import make_wcs
from lnocl.process import ignored_notes, ignored_warnings

# Largest variation of the offset between two images over them, in pixels, from rotation, scale and
# distortion.
MAX_OFFSET_VARIATION = 0.1
# Points across an image at which the offset is computed.
POINTS = 5

# The coordinates of an image, its file and its shape.
Image = tuple[WCS, str, tuple[int, int]]


def celestial_wcs(header: fits.Header, path: str, advice: str = "give positions in pixels") -> WCS:
    """Return the celestial coordinates of an image.

    Raises
    ------
    InputError
        An image without celestial coordinates that astropy can use.
    """
    wcs = _find_wcs(header)
    if wcs is None:
        raise InputError(f"{path} has no sky coordinates (WCS) that can be used; {advice}")
    return wcs


def has_celestial(header: fits.Header) -> bool:
    """Return whether an image has celestial coordinates."""
    return _find_wcs(header) is not None


def _find_wcs(header: fits.Header) -> WCS | None:
    with ignored_warnings(), ignored_notes("astropy"):  # of faults that astropy mends
        try:
            wcs = make_wcs(header)
            _ = wcs.pixel_to_world(0, 0).icrs  # those of the Sun are not on the sky
            return wcs
        except Exception:  # astropy may raise any error on a damaged header
            return None


def pixel_scale(header: fits.Header) -> float | None:
    """Return the side of a pixel in arcsec, None where it is unknown.

    It is that of PIXELSCL, of the coordinates, or of PIXSCALE, as in PSFs of Tiny Tim.
    """
    scale = header.get("PIXELSCL")
    if scale is None and "CTYPE1" in header and (wcs := _find_wcs(header)) is not None:
        scale = float(np.sqrt(wcs.proj_plane_pixel_area().to_value("arcsec2")))
    if scale is None and isinstance(scale := header.get("PIXSCALE"), (int, float)):
        scale *= 1e-3 if header.comments["PIXSCALE"].startswith("mas") else 1.0
    if isinstance(scale, (int, float)) and 0 < scale < np.inf:
        return float(scale)
    return None


def oversampling(header: fits.Header) -> float | None:
    """Return how many pixels of a PSF's file make one of the detector's, where OVERSAMP says so."""
    finer = header.get("OVERSAMP")
    return float(finer) if isinstance(finer, (int, float)) and 1 < finer < np.inf else None


def to_sky(positions: Array, header: fits.Header) -> Array:
    """Return right ascension and declination (ICRS, degrees) of pixel positions, shape (n, 2).

    Raises
    ------
    InputError
        An image without celestial coordinates that astropy can use.
    """
    found = (
        celestial_wcs(header, "the image").pixel_to_world(*np.reshape(positions, (-1, 2)).T).icrs
    )
    return np.array([found.ra.deg, found.dec.deg]).T


def parse_sky(texts: Sequence[str]) -> SkyCoord:
    """Return positions RA,DEC (ICRS) with units, or in sexagesimal hours and degrees.

    Raises
    ------
    InputError
        A text that is not such a position.

    Examples
    --------
    >>> from lnocl.io.sky import parse_sky
    >>> parse_sky(["15.25d,-3.5d", "1:01:00,-3:30:00"]).to_string()
    ['15.25 -3.5', '15.25 -3.5']
    """
    return SkyCoord([_parse_sky(text) for text in texts])


def _parse_sky(text: str) -> SkyCoord:
    ra, _, dec = text.partition(",")
    with contextlib.suppress(ValueError):
        if set(ra) - set("+-.0123456789"):  # degrees, and not hours, would be meant by a number
            return SkyCoord(ra, dec, unit=("hourangle", "deg"))
    raise InputError(
        f"{text!r} is neither X,Y in pixels nor RA,DEC with units, as in 65d,19.5d or "
        "4:20:00,19:30:00"
    )


def to_pixels(coordinates: SkyCoord, wcs: WCS, path: str) -> Array:
    """Return the pixel positions (x, y), 0-based, of positions on the sky, shape (n, 2).

    Raises
    ------
    InputError
        A position outside the projection of the image.
    """
    found = _pixel_to(wcs.world_to_pixel, coordinates).reshape(2, -1).T
    for position, pixels in zip(coordinates.ravel(), found, strict=True):
        if not np.isfinite(pixels).all():
            raise InputError(
                f"the star at RA, Dec {position.to_string(precision=5)} lies in another part of "
                f"the sky than {path}"
            )
    return found


def _pixel_to(convert: Callable[..., Any], *given: Any) -> Array:
    with ignored_warnings():  # of SIP that does not converge far from the image
        return np.array(convert(*given), float)


def finest(
    headers: Sequence[fits.Header], paths: Sequence[str], shapes: Sequence[tuple[int, int]]
) -> int:
    """Return which image has the smallest pixels: the first, unless others differ over an image.

    Raises
    ------
    InputError
        An image without sky coordinates, or whose pixels have no area by them.
    """
    scales = []
    for header, path in zip(headers, paths, strict=True):
        wcs = celestial_wcs(header, path, "leave align out")
        with np.errstate(invalid="ignore"):
            area = float(wcs.proj_plane_pixel_area().to_value("arcsec2"))
        if not 0.0 < area < math.inf:
            raise InputError(f"the pixels of {path} have no area by its WCS; leave align out")
        scales.append(math.sqrt(area))
    smallest = int(np.argmin(scales))
    change = (scales[0] / scales[smallest] - 1.0) * math.hypot(*shapes[smallest]) / 2.0
    return smallest if change > MAX_OFFSET_VARIATION else 0


def transforms(
    headers: Sequence[fits.Header],
    paths: Sequence[str],
    shapes: Sequence[tuple[int, int]],
    of_sky: int = 0,
) -> Array:
    """Return the map from one image, by default the first, to each, shape (p, 2, 3), pixels.

    It is a shift, the mean over that image of ``pixel_j(sky(pixel)) - pixel``, where this is the
    same all over the image within a tenth of a pixel; else the nearest rotation, with or without a
    flip, and shift; with a scale where that leaves more.

    Raises
    ------
    InputError
        An image without sky coordinates; one that shows another part of the sky than that one;
        one that no rotation, scale and shift brings within a tenth of a pixel.
    """
    all_wcs = [celestial_wcs(*each, "leave align out") for each in zip(headers, paths, strict=True)]
    images = list(zip(all_wcs, paths, shapes, strict=True))
    first = images[of_sky]
    found = [np.eye(2, 3) if each is first else _transform(first, each) for each in images]
    return np.array(found)


def _transform(first_image: Image, image: Image) -> Array:
    (first, first_path, (ny, nx)), (wcs, path, shape) = first_image, image
    size = np.array(shape[::-1])
    x, y = np.meshgrid(np.linspace(0, nx - 1, POINTS), np.linspace(0, ny - 1, POINTS))
    moved = _pixel_to(pixel_to_pixel, first, wcs, x, y)
    # NaN is where a projection has no pixel.
    meets = np.isfinite(moved).all() and (moved.max(axis=(1, 2)) > -0.5).all()
    if not (meets and (moved.min(axis=(1, 2)) < size - 0.5).all()):
        raise InputError(
            f"{path} shows another part of the sky than {first_path}, by its sky coordinates; "
            "leave one of them out"
        )
    change = moved - (x, y)
    mean = change.mean(axis=(1, 2))
    if abs(change - mean[:, None, None]).max() <= MAX_OFFSET_VARIATION:
        return np.column_stack([np.eye(2), mean])
    middle = np.array([nx - 1, ny - 1]) / 2.0
    points = np.array([x, y]).reshape(2, -1) - middle[:, None]
    there = moved.reshape(2, -1) - (middle + mean)[:, None]
    u, stretches, v = np.linalg.svd(there @ points.T)
    for scale in (1.0, stretches.sum() / (points**2).sum()):
        nearest = scale * (u @ v)
        left = abs(there - nearest @ points).max()
        if left <= MAX_OFFSET_VARIATION:
            return np.column_stack([nearest, middle + mean - nearest @ middle])
    turn = "mirrored"
    if np.linalg.det(u @ v) > 0:
        turn = f"rotated by {rotation_angle(nearest):z.2f} degrees and scaled by {scale:.4f}"
    raise InputError(
        f"{path} is {turn} relative to {first_path}, and after rotation, scale and shift pixels "
        f"are up to {left:.2g} off: images are never resampled; cut them to where it is less"
    )


def rotation_angle(transform: Array) -> float:
    """Return by how many degrees a map turns, from the x axis towards the y axis."""
    return float(np.degrees(np.arctan2(transform[1, 0], transform[0, 0])))
