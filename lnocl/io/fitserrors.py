"""The errors of a result and its replicas, in its file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lnocl.errors import FileError
from lnocl.io.fitsadd import add_parts
from lnocl.io.fitsfile import FitsFile, open_fits
from lnocl.io.fitswrite import Card
from lnocl.io.parts import Column, parts_of
from lnocl.io.saved_results import SavedResult

if TYPE_CHECKING:
    from astropy.table import QTable

ERRORS, REPLICAS, SUMS = "ERRORS", "REPLICAS", "REPLSUMS"
# Values are those of the same run to this share: another version may round otherwise.
SAME = 1e-6


class Held(NamedTuple):
    """Replicas that a file has.

    Attributes
    ----------
    names : list of str
        What was measured.
    values : ndarray of float64, shape (k,)
        In the result.
    errors, of_psfs : ndarray of float64, shapes (n, k), and (n, k) or (0, k)
        The errors of each replica, and the part of them that comes from PSFs.
    sums : ndarray of float64, shape (3, ny, nx)
        The sums of the errors of pixels, and of their squares, electrons; and the number of
        replicas in which they have light.
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
            and self.sums.shape == other.sums.shape
            and np.allclose(self.values, other.values, SAME, 0.0, equal_nan=True)
            and np.array_equal(self.errors, other.errors[: len(self.errors)], equal_nan=True)
        )


def write_errors(
    saved: SavedResult,
    quantities: QTable,
    found: Held,
    parts: Mapping[str, Any],
    cards: Iterable[Card],
    unit: str,
    before: Held | None,
) -> None:
    """Add the errors of a result to its file, or replace those that it has.

    Of the same replicas the file keeps the more.

    Parameters
    ----------
    saved : SavedResult
        The result; its file is replaced once the new one is complete.
    quantities : QTable
        What was measured.
    found : Held
        The replicas.
    parts : mapping of str to ndarray or Table
        The regions, and the standard error and bias of each pixel, by their names.
    cards : iterable of (keyword, value, comment)
        Header cards of all.
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
    columns = [Column("replica", np.arange(1, len(found.errors) + 1))]
    arrays = {"errors": found.errors, "of_psfs": found.of_psfs}
    columns += [Column(name, values) for name, values in arrays.items() if values.size]

    def are_wanted(file: FitsFile, hdus: Sequence[Any]) -> bool:
        try:
            there = _held(file, hdus)
        except FileError:  # damaged ones, which are replaced
            return True
        if there is None or there.is_start_of(found) or (before and there.is_start_of(before)):
            return True
        if found.is_start_of(there):
            return False
        raise FileError(
            f"{saved.path} has got replicas of another `seed` or of other regions from another "
            "command meanwhile, and these are not added: give one command after the other"
        )

    added = {ERRORS: quantities, **parts, REPLICAS: columns, SUMS: found.sums}
    add_parts(saved, added, [*cards, ("SEED", found.seed, "of the replicas")], unit, are_wanted)


def read_replicas(path: str) -> Held | None:
    """Return the replicas that a file has; None without them.

    Raises
    ------
    FileError
        The file is missing or damaged.
    """
    with open_fits(path) as file:
        return _held(file, file.hdus())


def _held(file: FitsFile, hdus: Iterable[Any]) -> Held | None:
    try:
        found = parts_of(file, hdus, (ERRORS, REPLICAS, SUMS))
        if len(found) < 3:
            return None
        quantities, replicas = found[ERRORS].values, found[REPLICAS].values
        shape = len(replicas["replica"]), len(quantities["name"])
        arrays = {"errors": np.zeros(shape), "of_psfs": np.zeros((0, shape[1]))}
        for name in arrays.keys() & replicas.keys():
            arrays[name] = replicas[name].astype(np.float64).reshape(shape)
        return Held(
            quantities["name"].tolist(),
            quantities["value"].astype(np.float64),
            **arrays,
            sums=found[SUMS].values,
            seed=int(found[REPLICAS].header["SEED"]),
        )
    except (FileError, AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise FileError(f"{file.path} has damaged replicas: {error}; begin anew") from error
