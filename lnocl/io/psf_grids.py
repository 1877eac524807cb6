"""FITS in: PSFs that vary over the field, as STDPSF and STPSF files hold them."""

from __future__ import annotations

from typing import Any

from lnocl.errors import FileError, installed
from lnocl.io.fitsread import read_contents

# Of the headers of STDPSF files, and of the grids of STPSF (once WebbPSF).
KEYWORDS = "NXPSFS", "DET_YX0"


def is_grid(path: str) -> bool:
    """Return whether a file holds PSFs at the nodes of a grid."""
    primary = read_contents(path).primary
    return any(keyword in primary for keyword in KEYWORDS)


def read_grid(path: str) -> Any:
    """Return the `photutils.psf.GriddedPSFModel` of a file.

    Raises
    ------
    FileError
        photutils cannot read it, as where a file holds several detectors.
    LnoclError
        photutils is not installed.
    """
    psf = installed("photutils.psf", f"{path} holds a grid of PSFs, which photutils reads")
    try:
        return psf.GriddedPSFModel.read(path)
    except Exception as error:  # of its readers, which raise any
        raise FileError(f"{path} cannot be read as a grid of PSFs: {error}") from error
