"""Checkpoints: the state of a run in a file, from which it resumes bit for bit."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from lnocl.core.engines.engine import State
from lnocl.core.runs.held_out import HeldOutCounts
from lnocl.core.runs.inputs import WIDTH, digest_of
from lnocl.core.runs.run import Run
from lnocl.core.runs.stopping import Rule
from lnocl.errors import FileError, InputError, warn
from lnocl.io.atomic import check_output, whole_file

# Seconds between two checkpoints.
EVERY = 60.0
# Arrays whose lengths follow what a run has done, and where its stars are.
GROWING = "objectives", "rule", "cross_values", "star_information"


@dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint.

    Attributes
    ----------
    path : str
        The file that it was read from.
    described : dict of str to str
        The inputs and parameters of the run, as from `describe`.
    ended : str
        Why the run had ended; empty where it had not.
    arrays : dict of str to ndarray
        The state of the run.
    """

    path: str
    described: dict[str, str]
    ended: str
    arrays: State

    def refuse_unless(self, described: Mapping[str, str]) -> None:
        """Refuse to resume a run of other inputs or parameters.

        Raises
        ------
        InputError
            An input or a parameter differs; the message names it.
        """
        differing = [name for name in described if self.described.get(name) != described[name]]
        if differing == ["tuning"]:
            raise InputError(
                f"the checkpoint {self.path} is of a run before lnocl devices --tune, which has "
                "changed the tuning since: start anew, or remove the file that it named"
            )
        if differing:
            raise InputError(
                f"the checkpoint {self.path} is of another run: {', '.join(differing)} "
                f"differ{'s' * (len(differing) == 1)}; repeat its command as it was, or start anew"
            )

    def state(self, own: State) -> State:
        """Return the arrays, once they are known to be of the kind of those that a run has.

        Raises
        ------
        FileError
            One is missing, or of another type or shape: a run of another lnocl had it.
        """
        for name, array in own.items():
            found = self.arrays.get(name, np.zeros(()))
            grows = name.endswith(GROWING)
            is_like = found.ndim == array.ndim if grows else found.shape == array.shape
            if not (is_like and found.dtype == array.dtype):
                raise FileError(
                    f"the checkpoint {self.path} is of no such run, by its array {name}; start anew"
                )
        return self.arrays


def read(path: str) -> Checkpoint:
    """Read a checkpoint.

    Raises
    ------
    FileError
        The file is missing, not a checkpoint, truncated or altered.
    """
    from lnocl.io.fitsfile import open_fits  # runs without checkpoints need not load it

    arrays: State = {}
    with open_fits(path, "is not a checkpoint, or a damaged one") as file:
        hdus = list(file.hdus())
        ended, digest = str(hdus[0].header["ENDED"]), hdus[0].header["DIGEST"]
        described = {str(row["name"]): str(row["value"]) for row in hdus[1].data}
        for hdu in hdus[2:]:
            arrays[hdu.name.lower()] = _array(hdu)
            del hdu.data
        is_sound = digest == digest_of({"ended": ended}, described, arrays)
        # Another version, which is refused as that, may have made it otherwise.
        if not is_sound and described.get("version") == ascii(version("lnocl")):
            raise FileError(f"the checkpoint {path} is truncated or altered: its digest is wrong")
    return Checkpoint(path, described, ended, arrays)


def _array(hdu: Any) -> NDArray[Any]:
    """Return the array of an image; FITS has no empty ones, and the header says their shapes."""
    if "EMPTY" in hdu.header:
        shape = [int(length) for length in hdu.header["EMPTY"].split()]
        return np.empty(shape, hdu.header["DTYPE"])
    return np.array(hdu.data, hdu.data.dtype.newbyteorder("="))


def _image(name: str, array: NDArray[Any]) -> Any:
    from astropy.io import fits

    image = fits.ImageHDU(array if array.size else None, name=name.upper())
    if not array.size:
        image.header.update(EMPTY=" ".join(map(str, array.shape)), DTYPE=array.dtype.str)
    return image


def write(
    path: str,
    described: Mapping[str, str],
    ended: str,
    arrays: State,
    overwrite: bool = True,
) -> None:
    """Write a checkpoint; a file of that name is replaced once this one is complete.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    from astropy.io import fits

    primary = fits.PrimaryHDU()
    primary.header["ENDED"] = ended, "why the run ended; empty where it had not"
    primary.header["DIGEST"] = digest_of({"ended": ended}, described, arrays)
    table = np.array(list(described.items()), [("name", "U32"), ("value", f"U{WIDTH}")])
    images = [_image(name, array) for name, array in arrays.items()]
    hdus = fits.HDUList([primary, fits.BinTableHDU(table, name="RUN"), *images])
    with whole_file(path, overwrite) as stream:
        hdus.writeto(stream)


class Checkpointer:
    """Writes the checkpoints of a run, and holds the one that it resumes from.

    Parameters
    ----------
    describe : callable
        Returns the inputs and parameters of the run; called where there is a path or a checkpoint.
    path : str, optional
        File to write; None for no checkpoints.
    resume : str, optional
        The checkpoint to resume from, which may be replaced.

    Raises
    ------
    InputError
        The checkpoint is of another run.
    FileError
        The file cannot be written, or exists and is not the one to resume from; the checkpoint
        cannot be read.
    """

    def __init__(
        self,
        describe: Callable[[], dict[str, str]] = dict,
        path: object = None,
        resume: object = None,
    ) -> None:
        self._path, source = _file_name("checkpoint", path), _file_name("resume", resume)
        self._saved_at = time.monotonic() if path is None else -math.inf
        self._best: State = {}
        resumed = None if source is None else read(source)
        self._may_replace = False
        if self._path is not None:
            if source is not None and os.path.exists(self._path):
                self._may_replace = os.path.samefile(self._path, source)
            check_output(self._path, overwrite=True, is_updated=self._may_replace)
            self._path = os.path.abspath(self._path)  # wherever the process goes
            self._refuse_to_replace(self._path)
        self._described = describe() if self._path is not None or resumed is not None else {}
        if resumed is not None:
            resumed.refuse_unless(self._described)
        self._resumed = resumed

    def _refuse_to_replace(self, path: str) -> None:
        if os.path.lexists(path) and not self._may_replace:
            raise FileError(f"the checkpoint {path} exists; resume from it, or remove it")

    def restore(self, run: Run, rule: Rule) -> str:
        """Put a run where its checkpoint was, if any; return why it had ended, if it had.

        A run that a callback or an interrupt has ended continues.

        Raises
        ------
        FileError
            The run cannot have been there.
        NotFiniteError
            The start is infinite or not a number.
        """
        self._best = run.state()
        resumed, self._resumed = self._resumed, None  # the memory need not hold it twice
        if resumed is None:
            return ""
        state = resumed.state(self._best | {"rule": rule.state()})
        rule.restore(state["rule"])
        run.restore(state)
        self._remember(*run.proven_state())
        return "" if resumed.ended == "callback" else resumed.ended

    def _remember(self, state: State, is_best: bool) -> None:
        """Hold the state of the least objective, for `return_to_best` to iterate from."""
        if is_best:
            self._best = state

    def return_to_best(self, run: Run) -> None:
        """Put a run back where its objective was least, by iterating again from a state before.

        The file stays as it is.

        Raises
        ------
        NotFiniteError
            The run has no finite objective.
        """
        run.return_to_best(self._best)

    def save(self, run: Run, rule: Rule, ended: str) -> None:
        """Save the state of a run where that is due or the run has ended, in the file too.

        Raises
        ------
        FileError
            The first checkpoint cannot be written.
        NotFiniteError
            The state is infinite or not a number; the file stays as it is.

        Warns
        -----
        LnoclWarning
            A later checkpoint cannot be written.
        """
        if ended or self._is_due():
            state, is_best = run.proven_state()
            self._remember(state, is_best)
            self._write(ended, state | {"rule": rule.state()})
            if ended:
                self._best = {}  # it is not returned to any more

    def restore_held_out(self, held_out: HeldOutCounts) -> None:
        """Put held-out counts where their checkpoint was, if any.

        Raises
        ------
        FileError
            They cannot have been there.
        """
        resumed, self._resumed = self._resumed, None
        if resumed is not None:
            is_over = resumed.ended == "held-out"
            held_out.restore(resumed.state({} if is_over else held_out.state()), is_over)

    def save_held_out(self, held_out: HeldOutCounts, ended: str = "") -> None:
        """Save the state of held-out counts where there is a file, and that is due or they ended.

        Raises and warns as `save`.
        """
        if self._path is not None and (ended or self._is_due()):
            self._write(ended, held_out.state())

    def _is_due(self) -> bool:
        return time.monotonic() - self._saved_at >= EVERY

    def _write(self, ended: str, arrays: State) -> None:
        """Write a checkpoint; a failure to write ends the run only where it is the first one."""
        try:
            if self._path is not None:
                self._refuse_to_replace(self._path)
                write(self._path, self._described, ended, arrays, self._may_replace)
                self._may_replace = True
        except FileError as error:
            if self._saved_at == -math.inf:
                raise
            warn(f"{error}; the run continues, and the last checkpoint is as it was")
        self._saved_at = time.monotonic()


def _file_name(name: str, file: object) -> str | None:
    if file is None:
        return None
    if not isinstance(file, (str, os.PathLike)) or not isinstance(os.fspath(file), str):
        raise InputError(f"`{name}` must be the name of a file; {file!r} was given")
    return cast(str, os.fspath(file))
