"""Names of images in files: ``FILE``, ``FILE[SCI]``, ``FILE[SCI,2]`` or ``FILE[1]``.

Files of several kinds are named as ``KIND=FILE``.
"""

from __future__ import annotations

import os
import re
from typing import NamedTuple

_NAMED = re.compile(
    r"(?P<file>.+)\[((?P<number>\d+)|(?P<name>[^\[\],\s][^\[\],]*)(,\s*(?P<version>\d+))?)\]"
)

# The kinds of maps of noise, and the class of astropy.nddata for each.
NOISE = {
    "ivar": "InverseVariance",
    "var": "VarianceUncertainty",
    "rms": "StdDevUncertainty",
    "err": "StdDevUncertainty",
}
# The kind that has the noise of the source's own counts too; alone it is the extension ERR.
ERR = "err"
# The kinds of files that tell how PSFs may be wrong, and the parameter of `Observation` for each.
PSF_ERRORS = {
    "ideal": "ideal_psfs",
    "pupil": "pupils",
    "modes": "psf_modes",
    "scatter": "psf_scatter",
}
# Those of stars that have their own are named by the place.
STAR_PSFS = {"X,Y": "star_psfs"}


class ImageName(NamedTuple):
    """An image in a file.

    Attributes
    ----------
    file : str
        The file.
    hdu : int or None
        The number of its HDU, counted from 0, where that is given.
    extension : str
        The name of its extension, EXTNAME, in capital letters; empty where none is given.
    version : int or None
        Its EXTVER, where that is given.
    """

    file: str
    hdu: int | None = None
    extension: str = ""
    version: int | None = None

    @property
    def is_chosen(self) -> bool:
        """Whether one of the images of the file is named."""
        return self.hdu is not None or bool(self.extension)


def parse_name(path: str) -> ImageName:
    """Return the image that a name means, as astropy and fitsio write it.

    A file that is called so is taken whole.

    Examples
    --------
    >>> from lnocl.io.names import parse_name
    >>> parse_name("a.fits[sci, 2]")
    ImageName(file='a.fits', hdu=None, extension='SCI', version=2)
    >>> parse_name("a.fits[0]").hdu
    0
    """
    match = None if os.path.exists(path) else _NAMED.fullmatch(path)
    if match is None:
        return ImageName(path)
    number, version = match["number"], match["version"]
    return ImageName(
        match["file"],
        None if number is None else int(number),
        (match["name"] or "").strip().upper(),
        None if version is None else int(version),
    )


def file_of(path: str) -> str:
    """Return the file that the name of an image begins with."""
    return parse_name(path).file


def parse_kind(word: str) -> tuple[str, str]:
    """Return kind and file of ``KIND=FILE``; the file is empty where there is none.

    Examples
    --------
    >>> from lnocl.io.names import parse_kind
    >>> parse_kind("rms=a.fits"), parse_kind("err")
    (('rms', 'a.fits'), ('err', ''))
    """
    kind, _, path = word.partition("=")
    return kind, path
