"""Checkpoints: the state of a run in a file, from which it resumes bit for bit."""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from numbers import Real
from typing import Any, cast

import numpy as np

from lnocl.errors import FileError, InputError, counted, warn
from lnocl.io.atomic import check_output, whole_file
from lnocl.runs.held_out import HeldOutCounts
from lnocl.runs.run import Run
from lnocl.runs.saved import Saved
from lnocl.runs.start import Setup
from lnocl.runs.stopping import Rule
from lnocl.scene.arrays import numbers
from lnocl.scene.fields import FIELDS
from lnocl.scene.observation import Observation
from lnocl.solvers.engine import State

# The widest value: a SHA-256 in hexadecimal, or the repr of a parameter or name of a device.
WIDTH = 256
# More than there are parameters, and than the state of held-out counts has arrays: a hostile file
# may have any number, compressed to nothing.
MAX_ROWS = 100
MAX_HDUS = 100
ROW_BYTES = 32 + WIDTH
# Seconds between two checkpoints.
EVERY = 60.0


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


def describe(setup: Setup, **parameters: Any) -> dict[str, str]:
    """Return the inputs and parameters of a run: checksums of arrays, other values in words."""
    bound = {
        "version": version("lnocl"),
        **inputs_of(setup.observation),
        **{name: value for name, value in vars(setup).items() if name != "observation"},
        **parameters,
    }
    bound |= {"device": setup.engine_name(), "tuning": setup.tuning_name()}
    return {name: _describe(name, value) for name, value in bound.items()}


def inputs_of(observation: Observation) -> dict[str, Any]:
    """Return the parameters of an observation, by their names."""
    bound = {name: getattr(observation, name) for name in (*FIELDS, "offsets", "turns")}
    if observation.psf_fields:
        bound["psf_fields"] = np.concatenate([each.numbers() for each in observation.psf_fields])
    return bound


def _describe(name: str, value: Any) -> str:
    if isinstance(value, (Real, np.bool_)):
        value = float(value)  # so that 1, True and np.float32(1) are the same
    if value is None or isinstance(value, (str, float)):
        return ascii(value)[:WIDTH]
    array = numbers(name, value).astype("<f8")
    digest = hashlib.sha256(repr(array.shape).encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def read(path: str, most_bytes: float = math.inf) -> Checkpoint:
    """Read a checkpoint.

    Parameters
    ----------
    path : str
        File to read.
    most_bytes : float, optional
        Bytes that its arrays may take together: one that has more is not read.

    Raises
    ------
    FileError
        The file is missing, not a checkpoint, truncated, altered, or too large.
    """
    from astropy.io import fits  # runs without checkpoints need not load it

    from lnocl.io.fitsfile import open_fits

    arrays: State = {}
    ended, digest, described = "", "", dict[str, str]()
    with open_fits(path, "is not a checkpoint, or a damaged one") as file:
        for k, hdu in enumerate(file.hdus()):
            if isinstance(hdu, fits.PrimaryHDU):
                ended, digest = str(hdu.header["ENDED"]), hdu.header["DIGEST"]
            elif hdu.name == "RUN" and hdu.size <= MAX_ROWS * ROW_BYTES:
                described = {str(row["name"]): str(row["value"]) for row in hdu.data[:MAX_ROWS]}
            elif _is_plain(hdu) and hdu.size <= most_bytes and k < MAX_HDUS:
                most_bytes -= hdu.size
                arrays[hdu.name.lower()] = np.array(hdu.data, hdu.data.dtype.newbyteorder("="))
                del hdu.data
            else:
                raise FileError(
                    f"the checkpoint {path} is of no such run: with extension {k}, {hdu.name}, it "
                    "is too large; start anew"
                )
        if digest != _digest(described, ended, arrays):
            raise FileError(f"the checkpoint {path} is truncated or altered: its digest is wrong")
    return Checkpoint(path, described, ended, arrays)


def _is_plain(hdu: Any) -> bool:
    """Return whether an HDU is an image of as many bytes as its header says, as `write` makes."""
    return type(hdu).__name__ == "ImageHDU" and not {"BSCALE", "BZERO", "BLANK"} & set(hdu.header)


def _digest(described: Mapping[str, str], ended: str, arrays: State) -> str:
    """Return the SHA-256 of the content of a checkpoint."""
    digest = hashlib.sha256(repr((sorted(described.items()), ended)).encode())
    for name, array in sorted(arrays.items()):
        digest.update(repr((name, array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


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

    filled = {name: array for name, array in arrays.items() if array.size}  # FITS has no empty ones
    primary = fits.PrimaryHDU()
    primary.header["ENDED"] = ended, "why the run ended; empty where it had not"
    primary.header["DIGEST"] = _digest(described, ended, filled)
    table = np.array(list(described.items()), [("name", "U32"), ("value", f"U{WIDTH}")])
    images = [fits.ImageHDU(array, name=name.upper()) for name, array in filled.items()]
    hdus = fits.HDUList([primary, fits.BinTableHDU(table, name="RUN"), *images])
    with whole_file(path, overwrite) as stream:
        hdus.writeto(stream)


class Checkpointer:
    """Writes the checkpoints of a run, and holds the one that it resumes from.

    Parameters
    ----------
    most_bytes : callable
        Returns the bytes that the state of such a run may take; called where there is a checkpoint.
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
        most_bytes: Callable[[], int],
        describe: Callable[[], dict[str, str]] = dict,
        path: object = None,
        resume: object = None,
    ) -> None:
        self._path, source = _file_name("checkpoint", path), _file_name("resume", resume)
        self._saved_at = time.monotonic() if path is None else -math.inf
        self._best: State = {}
        resumed = None if source is None else read(source, most_bytes())
        self._may_replace = False
        if self._path is not None:
            self._may_replace = _are_same(self._path, source)
            check_output(self._path, overwrite=True, is_updated=self._may_replace)
            self._path = os.path.abspath(self._path)  # wherever the process goes
            self._refuse_to_replace(self._path)
        self._described = describe() if self._path is not None or resumed is not None else {}
        self._ended, self._saved = "", None
        if resumed is not None:
            resumed.refuse_unless(self._described)
            self._ended, self._saved = resumed.ended, Saved(resumed.path, resumed.arrays)

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
        saved, ended = self._saved, self._ended
        if saved is None:
            return ""
        self._saved = None  # which the memory need not hold twice
        state = run.take(saved)
        done = int(state["progress"][0])
        rule.restore(saved, done)
        saved.refuse_others()
        is_possible = ended in ("", "callback", "n_iter", "converged", rule.reason)
        saved.refuse_unless(
            is_possible and (ended != "n_iter" or done == run.n_iter),
            f"it ended by {ended} after {counted(done, 'iteration')}",
        )
        run.restore(state)
        self._remember(*run.proven_state())
        return "" if ended == "callback" else ended

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
            self._write(ended, state | {"rule": np.array(rule.state(), np.float64)})
            if ended:
                self._best = {}  # it is not returned to any more

    def restore_held_out(self, held_out: HeldOutCounts) -> None:
        """Put held-out counts where their checkpoint was, if any.

        Raises
        ------
        FileError
            They cannot have been there.
        """
        saved, self._saved = self._saved, None
        if saved is not None:
            held_out.restore(saved, self._ended)

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


def _are_same(path: str, source: str | None) -> bool:
    return source is not None and os.path.exists(path) and os.path.samefile(path, source)
