"""The image of a FITS file that may hold several: which HDU it is, and how it is called."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from lnocl.errors import InputError
from lnocl.io.names import ImageName

# Names of extensions that go before all others: the image, and STPSF's PSF as the detector sees it.
SCIENCE = ("SCI", "DET_DIST")

# Extensions that belong to an image: errors, flags, weights, exposures, backgrounds, PSFs and
# tables of distortions, as telescopes, surveys and astropy's CCDData name them.
AUXILIARY = re.compile(
    r"ERRS?|ERROR|STAT|SIGMA|STD|RMS|UNC(ERT(AINTY)?)?|VAR(IANCE)?(_\w+)?|IV(AR|M)|INVVAR"
    r"|\w*DQ|DQ_\w+|QUAL(ITY)?|FLAGS?|FLG|MA?SK|BPM"
    r"|WHT|WGT|WT|WEIGHTS?|CON|CTX|TIME|EXP(OSURE|TIME|MAP)?|N?SAMP|COVERAGE|COV|AREA"
    r"|BKG|BACKGROUND|PSF(IMAGE)?|WCSDVARR|D2IMARR|WAVELENGTH"
)
DIMENSIONS = (2, 3)


def has_pixels(hdu: Any) -> bool:
    """Return whether an HDU is an image with at least one pixel."""
    return hdu.is_image and len(getattr(hdu, "shape", ())) > 0 and 0 not in hdu.shape


def name_of(hdu: Any) -> str:
    """Return the EXTNAME of an HDU in upper case, empty where it has none."""
    return str(hdu.header.get("EXTNAME", "")).strip().upper()


def describe(index: int, hdu: Any) -> str:
    """Return how messages name an HDU, such as ``HDU 1 (SCI)``."""
    name = name_of(hdu)
    return f"HDU {index} ({name})" if name else f"HDU {index}"


def choose(path: str, hdus: Sequence[Any]) -> int | None:
    """Return the index of the HDU with the image of a file; None where no HDU has pixels.

    The extensions SCI and DET_DIST come first. Without them it is the primary HDU, which may be
    followed by other images of its height and width; else the only image extension that is not
    auxiliary, by its name; else the only image of the file.

    Parameters
    ----------
    path : str
        Name of the file, for messages.
    hdus : sequence of HDU of astropy.io.fits
        All HDUs of the file, in order.

    Raises
    ------
    InputError
        Several HDUs have an equal claim.
    """
    images = [i for i, hdu in enumerate(hdus) if has_pixels(hdu)]
    images = [i for i in images if len(hdus[i].shape) in DIMENSIONS] or images
    science = [i for i in images if name_of(hdus[i]) in SCIENCE]
    others = [i for i in images if not AUXILIARY.fullmatch(name_of(hdus[i]))]
    claims = science or others or images
    if claims[:1] == [0] and not science:
        claims = [i for i in claims if i == 0 or hdus[i].shape[-2:] != hdus[0].shape[-2:]]
    return _one_of(path, hdus, claims)


def find(name: ImageName, hdus: Sequence[Any]) -> int:
    """Return the index of the HDU that the name of an image means.

    Raises
    ------
    InputError
        The file lacks it; several extensions have the name.
    """
    if name.hdu is None:
        found = only(name.file, hdus, name.extension, name.version)
    else:
        is_image = name.hdu < len(hdus) and has_pixels(hdus[name.hdu])
        found = name.hdu if is_image else None
    if found is None:
        wanted = f"HDU {name.hdu}" if name.hdu is not None else f"extension {name.extension}"
        version = "" if name.version is None else f",{name.version}"
        held = [describe(i, hdu) for i, hdu in enumerate(hdus) if has_pixels(hdu)]
        raise InputError(
            f"{name.file} has no image {wanted}{version}; it has {', '.join(held) or 'none'}"
        )
    return found


def only(path: str, hdus: Sequence[Any], name: str, version: int | None = None) -> int | None:
    """Return the index of the one image extension of this name; None where the file lacks it.

    Where a version is given, EXTVER, it is the one with that; without it any.

    Raises
    ------
    InputError
        Several extensions have the name.
    """
    claims = [
        i
        for i, hdu in enumerate(hdus)
        if has_pixels(hdu)
        and name_of(hdu) == name
        and version in (None, hdu.header.get("EXTVER", 1))
    ]
    return _one_of(path, hdus, claims)


def _one_of(path: str, hdus: Sequence[Any], claims: Sequence[int]) -> int | None:
    """Return the one index of an image that may be meant, None of none; refuse several."""
    if len(claims) < 2:
        return claims[0] if claims else None
    named = [
        f"{describe(i, hdus[i])} of {' x '.join(map(str, hdus[i].shape))} pixels" for i in claims
    ]
    raise InputError(
        f"{path} holds {len(claims)} images that may be meant: {', '.join(named)}; name the one to "
        f"use, as in '{path}[{_word(hdus, claims)}]'"
    )


def _word(hdus: Sequence[Any], claims: Sequence[int]) -> str:
    """Return the name of the first of these HDUs, with its version, or else its number."""
    names = [name_of(hdus[i]) for i in claims]
    versions = [
        f"{name},{hdus[i].header.get('EXTVER', 1)}" for name, i in zip(names, claims, strict=True)
    ]
    for words in (names, versions):
        if names[0] and words.count(words[0]) == 1:
            return words[0]
    return f"{claims[0]}"
