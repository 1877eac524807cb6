"""Regions in, by astropy-regions: the shares of pixels that lie within each."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits

from lnocl.core.scene.apertures import Aperture, Profile
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.shifting import Cutout
from lnocl.errors import FileError, InputError, installed, note
from lnocl.io.fitsread import sky_header
from lnocl.io.sky import celestial_wcs
from lnocl.process import recorded_warnings

# The share of a region that rounding may leave outside an image.
ROUNDING = 1e-9


Given = str | os.PathLike[str] | Iterable[Any]


def read_parts(
    regions: Given, profiles: Given, header: fits.Header | None, observation: Observation
) -> list[Aperture | Profile]:
    """Return the regions and profiles in the extended source of an observation.

    Parameters
    ----------
    regions, profiles : str, path or iterable of regions.Region
        As for `read_apertures` and `read_profiles`, in pixels of the extended source.
    header : astropy.io.fits.Header or None
        Header of an image of the observation.
    observation : Observation
        What the extended source is of.

    Raises
    ------
    InputError, FileError, LnoclError
        As `read_apertures` and `read_profiles`.
    """
    where = None if header is None else sky_header(header, observation.oversample)
    parts: list[Aperture | Profile] = []
    for given, read in ((regions, read_apertures), (profiles, read_profiles)):
        listed = given if isinstance(given, (str, os.PathLike)) else list(given)
        parts += read(listed, where, observation.sky_shape) if listed else []
    return parts


def read_apertures(
    given: Given, header: fits.Header | None, shape: tuple[int, int]
) -> list[Aperture]:
    """Return the shares of pixels that lie within regions.

    Parameters
    ----------
    given : str, path or iterable of regions.Region
        A file of regions, such as DS9 writes, or these. Pixels are those of an array, 0-based.
    header : astropy.io.fits.Header or None
        Header of the image, for regions on the sky.
    shape : tuple of int
        Shape (ny, nx) of the image.

    Raises
    ------
    LnoclError
        The package regions is missing.
    FileError
        A file that is missing, or holds no regions.
    InputError
        A region that encloses nothing, lies outside the image, or on the sky without coordinates.
    """
    return [_aperture(each, shape) for each in _in_pixels(given, header)]


def read_profiles(
    given: Given, header: fits.Header | None, shape: tuple[int, int]
) -> list[Profile]:
    """Return boxes cut into slices of about a pixel along their longer sides.

    Parameters
    ----------
    given, header, shape
        As for `read_apertures`; all regions are boxes.

    Raises
    ------
    LnoclError, FileError, InputError
        As `read_apertures`; a region that is not a box.
    """
    found = _in_pixels(given, header)
    for each in found:
        if not isinstance(each.region, _regions().RectanglePixelRegion):
            raise InputError(
                f"{each.described} is not a box: a profile is along the longer side of a box"
            )
    return [_profile(each, shape) for each in found]


class _Found(NamedTuple):
    """A region in pixels, its name, and what messages call it."""

    region: Any
    name: str
    described: str


def _in_pixels(given: Given, header: fits.Header | None) -> list[_Found]:
    if isinstance(given, (str, os.PathLike)):
        path = os.fspath(given)
        found = _read(path)
    else:
        path, found = "regions", list(given)
    words = _regions().TextPixelRegion, _regions().TextSkyRegion
    found = [region for region in found if not isinstance(region, words)]
    if not found:
        raise FileError(
            f"{path} holds no regions: draw circles, ellipses, boxes, annuli or polygons"
        )
    listed = [_one_in_pixels(region, k, path, header) for k, region in enumerate(found, 1)]
    names = [each.name for each in listed]
    return [
        each._replace(name=f"{each.name} {k}") if names.count(each.name) > 1 else each
        for k, each in enumerate(listed, 1)
    ]


def _regions() -> Any:
    return installed("regions", "`regions` are read by the package regions")


def _read(path: str) -> list[Any]:
    regions = _regions()
    if not os.path.isfile(path):
        raise FileError(f"{path} is not there: give a file of regions, such as DS9 writes")
    try:
        with recorded_warnings() as skipped:
            found = list(regions.Regions.read(path))
        if not found:
            return _read_without_frame(path)
        for each in skipped:
            warnings.warn(each.message, stacklevel=2)
        return found
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # its parsers raise many
        words = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path} holds no regions as DS9 writes them: {words}") from error


def _read_without_frame(path: str) -> list[Any]:
    """Return regions of a file of DS9 that names no coordinates but physical ones: pixels."""
    with open(path, encoding="utf-8") as file:
        text = "image\n" + re.sub(r"(?im)^[ \t]*physical\b", "image", file.read())
    found = list(_regions().Regions.parse(text, format="ds9"))
    if found:
        note(f"{path} names no coordinates: its regions are taken in pixels of the image")
    return found


def _one_in_pixels(region: Any, number: int, path: str, header: fits.Header | None) -> _Found:
    regions = _regions()
    if not isinstance(region, regions.Region):
        raise InputError(f"`regions` must be those of the package regions; {region!r} was given")
    named = region.meta.get("text") or region.meta.get("label") or ""
    name = str(named).strip() or f"region {number}"
    kind = type(region).__name__.replace("PixelRegion", "").replace("SkyRegion", "").lower()
    described = f"{name} of {path} ({kind})" if name != f"region {number}" else f"{name} ({kind})"
    if not region.meta.get("include", True):
        raise InputError(
            f"{described} is an exclusion region, which is not supported: draw the region to sum"
        )
    if isinstance(region, regions.SkyRegion):
        if header is None:
            raise InputError(f"{described} is on the sky, and the image has no header: give pixels")
        wcs = celestial_wcs(header, "the image", "give regions in image coordinates")
        region = region.to_pixel(wcs)
    return _Found(region, name, described)


def _profile(found: _Found, shape: tuple[int, int]) -> Profile:
    """Cut a box into slices."""
    regions, box = _regions(), found.region
    is_wide = box.width > box.height
    length, breadth = (box.width, box.height) if is_wide else (box.height, box.width)
    turn = float(box.angle.to_value("rad"))
    cos, sin = np.cos(turn), np.sin(turn)
    along, across = ((cos, sin), (-sin, cos)) if is_wide else ((-sin, cos), (cos, sin))
    n = max(round(length), 1)
    at = (np.arange(n) + 0.5) * length / n - length / 2.0
    slices, distances = [], []
    for distance in at:
        x, y = box.center.x + distance * along[0], box.center.y + distance * along[1]
        sides = (length / n, breadth) if is_wide else (breadth, length / n)
        part = regions.RectanglePixelRegion(regions.PixCoord(x, y), *sides, angle=box.angle)
        slices.append(_aperture(found._replace(region=part), shape))
        y, x = slices[-1].places
        distances.append((x - box.center.x) * across[0] + (y - box.center.y) * across[1])
    return Profile(found.name, at.tolist(), slices, distances)


def _refuse_outside(described: str, region: Any, shape: tuple[int, int]) -> None:
    """Refuse a region of which a mask would be larger than the image, or none can be made."""
    try:
        box = region.bounding_box
    except NotImplementedError:
        return  # which is refused for that
    except (ValueError, OverflowError):  # it is on another part of the sky
        box = None
    ny, nx = shape
    if box is None or not (
        -2 <= box.ixmin <= box.ixmax <= nx + 2 and -2 <= box.iymin <= box.iymax <= ny + 2
    ):
        raise _outside(described, shape)


def _outside(described: str, shape: tuple[int, int]) -> InputError:
    ny, nx = shape
    return InputError(f"{described} lies outside the image of {nx} x {ny} pixels, or partly")


def _filled(region: Any, which: str) -> Any:
    """Return the outer or the inner shape of an annulus, whose difference it is; else None."""
    kind, is_annulus, end = type(region).__name__.partition("Annulus")
    if not is_annulus:
        return None
    lengths = ("radius",) if kind == "Circle" else ("width", "height")
    sides = [getattr(region, f"{which}_{each}") for each in lengths]
    turned = {} if kind == "Circle" else {"angle": region.angle}
    return getattr(_regions(), kind + end)(region.center, *sides, **turned)


def _aperture(found: _Found, shape: tuple[int, int]) -> Aperture:
    region, name, described = found
    _refuse_outside(described, region, shape)
    outer, inner = _filled(region, "outer"), _filled(region, "inner")
    try:
        mask = (outer or region).to_mask(mode="exact")
    except NotImplementedError as error:
        raise InputError(
            f"{described} cannot be summed over: give circles, ellipses, boxes, annuli or polygons"
        ) from error
    weights = np.asarray(mask.data, np.float64)
    if inner is not None:
        hole = inner.to_mask(mode="exact")
        rows, columns = hole.bbox.iymin - mask.bbox.iymin, hole.bbox.ixmin - mask.bbox.ixmin
        height, width = hole.data.shape
        weights[rows : rows + height, columns : columns + width] -= hole.data
    inside = mask.cutout(np.ones(shape), fill_value=0.0)
    total = weights.sum()
    if inside is None or (weights * (inside == 0)).sum() > ROUNDING * total:
        raise _outside(described, shape)
    if total == 0:
        raise InputError(f"{described} encloses no part of a pixel")
    trimmed = Cutout(weights, mask.bbox.iymin, mask.bbox.ixmin).trimmed(0.0)
    return Aperture(name, trimmed.y, trimmed.x, trimmed.values)
