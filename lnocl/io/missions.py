"""What the files of space telescopes say of themselves: how their images are calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lnocl.core.scene import units
from lnocl.errors import InputError, note
from lnocl.io.fitsread import Contents, read_contents
from lnocl.io.headers import CONVERTERS
from lnocl.io.names import ERR

# Those whose files are known.
TELESCOPES = ("HST", "JWST")
# Detectors that count photons, so that a count is one.
PHOTON_COUNTING = ("SBC", "FUV-MAMA", "NUV-MAMA")


def calibrate(path: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the calibration of an image of JWST or HST, where it is not given.

    Errors and flags are those of the extensions ERR and DQ where there are such; without ERR, as in
    a mosaic of HST, the noise is that of the sky, and pixels of weight 0 are bad. A rate of
    electrons is times EXPTIME; the electrons in a MJy/sr of JWST follow from VAR_POISSON.

    Parameters
    ----------
    path : str
        The first image.
    given : mapping of str to value
        What is given, of the fields of `calibration.Calibration`.

    Returns
    -------
    dict
        Values of other fields; empty for an image of another telescope.

    Raises
    ------
    FileError, InputError
        As `fitsread.read_contents`; counts of HST that may not be electrons.
    """
    contents = read_contents(path)
    telescope = contents.value("TELESCOP").upper()
    if telescope not in TELESCOPES:
        return {}
    found: dict[str, Any] = {}
    if not (given.get("read_noise") or given.get("noise")):
        found = {"noise": [ERR]} if "ERR" in contents.extensions else {"read_noise": ["auto"]}
    word = mask_word(contents)
    found |= {"mask": [word] if word else [], "background": ["auto"]}
    found |= _electrons(path, contents, bool(given.get("gain")))
    found = {name: value for name, value in found.items() if value and not given.get(name)}
    for name, value in found.items():
        words = value if isinstance(value, str) else " ".join(value)
        note("%s: with %s %s, as for images of %s", path, name, words, telescope)
    return found


def mask_word(contents: Contents) -> str:
    """Return which extension of an image of JWST or HST says what is bad: dq, wht, or nothing."""
    held, is_known = contents.extensions, contents.value("TELESCOP").upper() in TELESCOPES
    words = [word for word in ("dq", "wht") if is_known and word.upper() in held]
    return words[0] if words else ""


def _electrons(path: str, contents: Contents, has_gain: bool) -> dict[str, Any]:
    """Return the options that convert the unit of the image to electrons."""
    unit = contents.value("BUNIT")
    counts = units.count_of(units.parse(unit))
    if counts is None:
        return {"gain": "VAR_POISSON"} if "VAR_POISSON" in contents.extensions else {}
    found: dict[str, Any] = {}
    if unit.upper().startswith("COUNT") and contents.value("DETECTOR") not in PHOTON_COUNTING:
        keywords = [keyword for keyword in CONVERTERS if contents.value(keyword)]
        if not (keywords or has_gain):
            raise InputError(
                f"{path} is in counts of its converter; give `gain`, a number or a keyword of its "
                "header"
            )
        found["gain"] = keywords[0] if keywords else None
    if counts[1] and contents.value("EXPTIME"):
        found["exposure"] = ["EXPTIME"]
    return found
