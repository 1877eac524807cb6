"""FITS out and in: the errors of a result, added to its file."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from lnocl.errors import FileError
from lnocl.io.fitsadd import add_hdus
from lnocl.io.fitsfile import FitsFile, open_fits
from lnocl.io.fitswrite import ascii_of
from lnocl.io.saved_results import SavedResult

if TYPE_CHECKING:
    from astropy.table import QTable

# The extensions: what was measured, the regions, the standard error and bias of each pixel, the
# share of replicas in which it has light, and what it takes to continue.
ERRORS, REGIONS, ERROR, BIAS, SHARE = "ERRORS", "REGIONS", "ERROR", "BIAS", "SHARE"
REPLICAS, SUMS = "REPLICAS", "REPLSUMS"
NAMES = ERRORS, REGIONS, ERROR, BIAS, SHARE, REPLICAS, SUMS


def write_errors(
    saved: SavedResult,
    quantities: QTable,
    regions: QTable,
    maps: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    replicas: NDArray[np.float64],
    of_psfs: NDArray[np.float64],
    sums: NDArray[np.float64],
    seed: int,
    resolution: float,
    unit: str,
    before: Held | None,
) -> None:
    """Add the errors of a result to its file, or replace those that it has.

    Of the same replicas the file keeps the more.

    Parameters
    ----------
    saved : SavedResult
        The result; its file is replaced once the new one is complete.
    quantities, regions : QTable
        What was measured, and the regions.
    maps : three ndarray of float64, shape (ny, nx)
        Standard error and bias of each pixel at the resolution, in this unit, and the share of
        replicas in which it has light.
    replicas, of_psfs : ndarray of float64, shapes (n, k), and (n, k) or (0, k)
        The errors of each replica, and the part of them that comes from PSFs.
    sums : ndarray of float64, shape (3, ny, nx)
        The sums of the errors of pixels, and of their squares, electrons; and the number of
        replicas in which they have light.
    seed : int
        Of the replicas.
    resolution : float
        Full width at half maximum of the smoothing of the maps, pixels.
    unit : str
        Of the maps.
    before : Held or None
        Replicas of something else that the file had at first, which are replaced.

    Raises
    ------
    FileError
        The file cannot be read or written, or holds another result now, or replicas of something
        else than at first.
    """
    cards = [
        ("NREPL", len(replicas), "replicas"),
        ("SEED", seed, "of the replicas"),
        ("RESOLUT", resolution, "FWHM that maps are smoothed to, pixels"),
    ]
    numbers = np.arange(1, len(replicas) + 1)
    columns = [
        fits.Column("replica", "K", array=numbers),
        *(
            fits.Column(name, f"{values.shape[1]}D", array=values)
            for name, values in (("errors", replicas), ("of_psfs", of_psfs))
            if values.size
        ),
    ]
    added = [
        *(fits.table_to_hdu(_in_ascii(each)) for each in (quantities, regions)),
        *(fits.ImageHDU(np.asarray(each, np.float64)) for each in maps),
        fits.BinTableHDU.from_columns(columns),
        fits.ImageHDU(sums),
    ]
    for hdu, name in zip(added, NAMES, strict=True):
        hdu.name = name
        hdu.header.extend(cards)
    names = [str(name).strip() for name in _in_ascii(quantities)["name"]]
    values = np.array(quantities["value"], np.float64)
    new = Held(names, values, replicas, of_psfs, sums, seed)

    def are_wanted(file: FitsFile) -> bool:
        try:
            there = _replicas(file)
        except FileError:  # damaged ones, which are replaced
            return True
        if there is None or there.is_start_of(new) or (before and there.is_start_of(before)):
            return True
        if new.is_start_of(there):
            return False
        raise FileError(
            f"{saved.path} has got replicas of another `seed` or of other regions from another "
            "command meanwhile, and these are not added: give one command after the other"
        )

    add_hdus(saved, added, {ERROR: unit, BIAS: unit, SHARE: ""}, are_wanted)


def _in_ascii(table: QTable) -> QTable:
    """Return a table whose names are those that FITS allows."""
    table = table.copy()
    table["name"] = [ascii_of(name) for name in table["name"]]
    return table


def read_errors(path: str) -> Table | None:
    """Return the table of what was measured, with its errors; None where the file has none.

    Raises
    ------
    FileError
        The file is missing or damaged.
    """
    with open_fits(path) as file:
        for hdu in file.hdus():
            if hdu.name == ERRORS and isinstance(hdu, fits.BinTableHDU):
                table = Table.read(hdu)
                for name in ("name", "unit", "note"):
                    table[name] = [str(each).strip() for each in table[name]]
                return table
    return None


class Held(NamedTuple):
    """Replicas that a file has.

    Attributes
    ----------
    names : list of str
        What was measured.
    values : ndarray of float64, shape (k,)
        In the result.
    errors, of_psfs, sums : ndarray of float64
        As `write_errors` takes them.
    seed : int
        Of the replicas.
    """

    names: list[str]
    values: NDArray[np.float64]
    errors: NDArray[np.float64]
    of_psfs: NDArray[np.float64]
    sums: NDArray[np.float64]
    seed: int

    def is_start_of(self, other: Held) -> bool:
        """Return whether others are these, or these and more."""
        return (
            (self.names, self.seed) == (other.names, other.seed)
            and np.array_equal(self.values, other.values, equal_nan=True)
            and np.array_equal(self.errors, other.errors[: len(self.errors)], equal_nan=True)
        )


def read_replicas(path: str) -> Held | None:
    """Return the replicas that a file has; None without them.

    Raises
    ------
    FileError
        The file is missing or damaged.
    """
    with open_fits(path) as file:
        return _replicas(file)


def _replicas(file: FitsFile) -> Held | None:
    held = {hdu.name: hdu for hdu in file.hdus() if hdu.name in (ERRORS, REPLICAS, SUMS)}
    if len(held) < 3:
        return None
    try:
        quantities, replicas = held[ERRORS].data, held[REPLICAS].data
        shape = len(replicas), len(quantities)
        columns = held[REPLICAS].columns.names
        errors = np.zeros(shape)
        if "errors" in columns:
            errors = np.array(replicas["errors"], np.float64).reshape(shape)
        of_psfs = errors[:0]
        if "of_psfs" in columns:
            of_psfs = np.array(replicas["of_psfs"], np.float64).reshape(shape)
        values = np.array(quantities["value"], np.float64)
        names = [str(name).strip() for name in quantities["name"]]
        seed = int(held[REPLICAS].header["SEED"])
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise FileError(f"{file.path} has damaged replicas: {error}; begin anew") from error
    return Held(names, values, errors, of_psfs, file.pixels(held[SUMS]), seed)
