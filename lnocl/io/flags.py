"""Flags of pixels: which of them mean that a pixel is bad."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import InputError

# Flags that are no fault, as astropy spells them, by the words of TELESCOP, INSTRUME and DETECTOR:
# of JWST all but DO_NOT_USE and NON_SCIENCE; of HST hot and warm pixels, whose dark current was
# subtracted, and on the infrared detector blobs, a signal in the first read, and cosmic rays, which
# its ramps show.
GOOD_BITS = {
    "JWST": "~1,512",
    "HST ACS": "16,64",
    "HST WFC3 UVIS": "16,64",
    "HST WFC3 IR": "16,512,2048,8192",
}
# None are.
NO_BITS = "0"


def good_bits_of(telescope: str, instrument: str, detector: str) -> str:
    """Return the flags that are no fault in an image; those of unknown ones all are.

    Examples
    --------
    >>> from lnocl.io.flags import good_bits_of
    >>> good_bits_of("JWST", "NIRCAM", "NRCALONG"), good_bits_of("Keck", "", "")
    ('~1,512', '0')
    """
    words = f"{telescope} {instrument} {detector} ".upper()
    found = (bits for name, bits in GOOD_BITS.items() if words.startswith(f"{name} "))
    return next(found, NO_BITS)


def most_common_flag(sums: NDArray[Any]) -> tuple[int, int]:
    """Return the flag that most sums of flags have, and how many have it.

    Examples
    --------
    >>> import numpy as np
    >>> from lnocl.io.flags import most_common_flag
    >>> most_common_flag(np.array([1 + 4, 4, 16]))
    (4, 2)
    """
    whole = np.asarray(sums).astype(np.int64)
    counts = {1 << bit: int(((whole >> bit) & 1).sum()) for bit in range(32)}
    flag = max(counts, key=lambda each: counts[each])
    return flag, counts[flag]


def bad_pixels(flags: NDArray[Any], good_bits: str, path: str) -> NDArray[np.bool_]:
    """Return where flags have any that are a fault.

    Parameters
    ----------
    flags : ndarray
        Sums of flags, whole numbers; each flag is a power of 2.
    good_bits : str
        Those that are no fault, as `astropy.nddata.bitmask.interpret_bit_flags` reads them:
        ``"16,64"``, or ``"~1"`` for all but 1.
    path : str
        Their file, for messages.

    Raises
    ------
    InputError
        Flags that are not whole numbers, or good bits that are no flags.
    """
    # Which takes its time to load.
    from astropy.nddata.bitmask import bitfield_to_boolean_mask, interpret_bit_flags

    if not (np.isfinite(flags).all() and (np.floor(flags) == flags).all()):
        raise InputError(
            f"the extension DQ of {path} does not hold whole numbers; give `mask` as a file"
        )
    try:
        good = None if "-" in good_bits else interpret_bit_flags(good_bits)
    except ValueError:
        good = None
    if good is None:
        raise InputError(
            f"`mask` dq:{good_bits} names no flags; give powers of 2, as in dq:16,64, or dq:~1 for "
            "all but 1"
        )
    sums = np.array(flags).astype(np.int64)
    return np.asarray(bitfield_to_boolean_mask(sums, ignore_flags=good), bool)
