"""FITS in: results that `lnocl.io.fitswrite.write_result` has written."""

from __future__ import annotations

import os
import re
import shlex
from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.fields import OVERSAMPLES
from lnocl.errors import FileError
from lnocl.io.fitsfile import open_fits
from lnocl.io.headers import number, readable
from lnocl.io.parts import no_result, parts_of
from lnocl.io.selection import has_pixels

Columns = dict[str, NDArray[np.float64]]

TABLES = "STARS", "HALOS", "HISTORY", "CURVE", "HELDOUT"
CUBES = ("MODELS", "RESIDUALS", "ELECTRONS")
READ = *TABLES, *CUBES, "DOUBTFUL", "MESSAGES", "EPOCHS", "COMPONENTS", "NOISE"
# Words of a shell with bytes that FITS does not allow, as `fitswrite.history_lines` writes them.
QUOTED = re.compile(r"\$'((?:[^'\\]|\\.)*)'")


@dataclass(frozen=True, eq=False)
class SavedResult:
    """A result, or a truth, that was read.

    Attributes
    ----------
    path : str
        The file.
    header : astropy.io.fits.Header
        Header of the extended source.
    extended : ndarray of float64, shape (ny, nx) or (K, ny, nx)
        Extended source, in the unit of BUNIT per pixel; with components a sky each.
    tables : dict of str to dict of str to ndarray of float64
        Columns of the tables `TABLES` that are there; ``STARS`` always is.
    cubes : dict of str to ndarray of float64, shape (p, ny, nx)
        ``MODELS``, ``RESIDUALS`` and ``ELECTRONS``, where all are there; the last may have the
        shape (p, 1, 1).
    offsets : ndarray of float64, shape (p, 2)
        Of the images, pixels; 0 where the cubes have none.
    turns : ndarray of float64, shape (p, 2, 2), or None
        Rotations and flips of the images, where the cubes have them.
    doubtful : ndarray of bool, of the shape of `extended`, or None
        The image ``DOUBTFUL``, where it is there.
    messages : list of str
        The table ``MESSAGES``: messages of the run.
    epoch_labels : list of str
        The table ``EPOCHS``: the labels of several epochs, or filters.
    component_names : list of str
        The names in the table ``COMPONENTS``; none where there is one sky.
    noise : ndarray of float64, shape (K, ny, nx), or None
        The image ``NOISE``, where it is there.
    """

    path: str
    header: fits.Header
    extended: NDArray[np.float64]
    tables: dict[str, Columns]
    cubes: dict[str, NDArray[np.float64]]
    offsets: NDArray[np.float64]
    turns: NDArray[np.float64] | None
    doubtful: NDArray[np.bool_] | None
    messages: list[str]
    epoch_labels: list[str]
    component_names: list[str]
    noise: NDArray[np.float64] | None

    @property
    def stars(self) -> list[tuple[float, float]]:
        """Positions (x, y) of the stars, pixels of the images, 0-based."""
        stars = self.tables["STARS"]
        return list(zip(stars["x"].tolist(), stars["y"].tolist(), strict=True))

    @property
    def sky_stars(self) -> list[tuple[float, float]]:
        """Positions (x, y) of the stars, pixels of the extended source."""
        places = on_sky(np.reshape(self.stars, (-1, 2)), self.oversample)
        return [(x, y) for x, y in places.tolist()]

    @property
    def oversample(self) -> int:
        """Pixels of the extended source to one of the images, along each axis."""
        return int(self.number("OVERSAMP") or 1)

    @property
    def star_fluxes(self) -> NDArray[np.float64]:
        """Fluxes of the stars, in the unit of the extended source."""
        return self.tables["STARS"]["flux"]

    def commands(self) -> str:
        """Return the lines of a shell that repeat the run in its folder, which is left out."""
        commands = re.split(r"(?<!\\)\n", "\n".join(map(str, self.header.get("HISTORY", ()))))
        return "\n".join(command for command in commands if not command.startswith("cd "))

    def command_words(self) -> list[list[str]]:
        """Return the commands that repeat the run, as words: ``cd`` to its folder, and it.

        Raises
        ------
        FileError
            The header holds no such commands.
        """
        text = "\n".join(map(str, self.header.get("HISTORY", ()))).replace("\\\n", "")
        try:
            return [shlex.split(line) for line in QUOTED.sub(_unquoted, text).split("\n")]
        except ValueError as error:
            raise FileError(f"{self.path} has a damaged command in its header") from error

    def number(self, keyword: str) -> float | None:
        """Return the number that a keyword of the header gives; None where it is missing.

        Raises
        ------
        InputError
            Its value is not a finite number.
        """
        return number(self.path, self.header, keyword)

    def _fault(self) -> str:
        """Return why these are not the parts of a result; nothing where they are."""
        if "STARS" not in self.tables:
            return "there is no table STARS"
        n_labels = len(self.epoch_labels)
        n_epochs = int(np.max(self.tables["STARS"].get("epoch", 0.0), initial=0.0)) + 1
        if n_labels != n_epochs and (n_labels or n_epochs > 1) and self.stars:
            return f"EPOCHS has {n_labels} labels of {n_epochs} epochs"
        n_skies, shape = len(self.component_names), self.extended.shape
        if shape[:-2] != (n_skies,) * bool(n_skies) or len(shape) < 2:
            return f"the image has the shape {shape}, with {n_skies} names in COMPONENTS"
        ny, nx = shape[-2:]
        oversample = self.number("OVERSAMP") or 1.0
        if oversample not in OVERSAMPLES or ny % oversample or nx % oversample:
            return f"OVERSAMP is {oversample:g}"
        for name, cube in self.cubes.items():
            shape = len(self.cubes["MODELS"]), int(ny // oversample), int(nx // oversample)
            if cube.shape != shape and (name, cube.shape) != ("ELECTRONS", (*shape[:1], 1, 1)):
                return f"{name} has the shape {cube.shape}"
        for name, each in {"DOUBTFUL": self.doubtful, "NOISE": self.noise}.items():
            if each is not None and each.shape != self.extended.shape:
                return f"{name} has the shape {each.shape}"
        return ""


def read_result(path: str) -> SavedResult:
    """Read a result, or a truth.

    Parameters
    ----------
    path : str
        File with an image (ny, nx) and a table ``STARS`` with the columns x, y and flux.

    Raises
    ------
    FileError
        A file that is missing, damaged or not FITS, or whose images and tables are not those of a
        result.
    """
    with open_fits(path) as file:
        hdus = list(file.hdus())
        image = next((hdu for hdu in hdus if has_pixels(hdu)), None)
        if image is None:
            raise FileError(f"{path} holds no image")
        extended, header = file.pixels(image), readable(image.header)
        parts = parts_of(file, (hdu for hdu in hdus if hdu is not image), READ)
        tables = {name: file.numbers(name, parts[name].values) for name in TABLES if name in parts}
    found = {name: part.values for name, part in parts.items()}
    cubes = {name: found[name] for name in CUBES} if {*CUBES} <= {*found} else {}
    doubtful = found["DOUBTFUL"] != 0 if "DOUBTFUL" in found else None
    labels = found["EPOCHS"]["label"].tolist() if "EPOCHS" in found else []
    components = found["COMPONENTS"]["name"].tolist() if "COMPONENTS" in found else []
    cards = readable(parts["RESIDUALS"].header) if cubes else fits.Header()
    p = len(cubes["MODELS"]) if cubes else 0
    offsets = [
        [number(path, cards, f"OFF{axis}{j}") or 0.0 for axis in "XY"] for j in range(1, p + 1)
    ]
    names = [f"R{a}{b}_{j}" for j in range(1, p + 1) for a in (1, 2) for b in (1, 2)]
    turns = [number(path, cards, name) for name in names]
    is_turned = p > 0 and None not in turns
    result = SavedResult(
        path,
        header,
        extended,
        tables,
        cubes,
        np.reshape(offsets, (p, 2)),
        np.array(turns, float).reshape(p, 2, 2) if is_turned else None,
        doubtful,
        found["MESSAGES"]["message"].tolist() if "MESSAGES" in found else [],
        labels,
        components,
        found.get("NOISE"),
    )
    if fault := result._fault():
        raise no_result(path, fault)
    return result


def _unquoted(quoted: re.Match[str]) -> str:
    raw = quoted[1].encode("ascii").decode("unicode_escape").encode("latin-1")
    return shlex.quote(os.fsdecode(raw))
