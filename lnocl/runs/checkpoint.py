"""Checkpoints: what a run has come to, in a file that it can go on from, bit for bit."""

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
from numpy.typing import NDArray

from lnocl.errors import FileError, InputError, warn
from lnocl.io.atomic import check_output, whole_file
from lnocl.runs.held_out import NO_CURVE, Choice, HeldOutSelection, curve_of, plain
from lnocl.runs.run import Run, Setup, engine_name
from lnocl.runs.stopping import Rule
from lnocl.scene.observation import Observation, numbers
from lnocl.scene.penalty import Penalty

Arrays = dict[str, NDArray[Any]]

OBSERVED = ("images", "psfs", "background", "mask", "exposure", "offsets")
# The widest value: a SHA-256 in hexadecimal, or the repr of a parameter or name of a device.
WIDTH = 256
# More than there are parameters; a hostile file may have any number, compressed to nothing.
MOST_ROWS = 100


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds.

    Attributes
    ----------
    path : str
        The file it was read from.
    described : dict of str to str
        What the run was bound to, as from `describe`.
    ended : str
        Why the run had ended; empty where it had not.
    arrays : dict of str to ndarray
        Its state.
    """

    path: str
    described: dict[str, str]
    ended: str
    arrays: Arrays

    def choice(self) -> Choice | None:
        """Return what held-out counts had chosen, or what had been given; None if not yet."""
        if "choice" not in self.arrays:
            return None
        mu, smoothing, n_iter = self.arrays["choice"].tolist()
        curve = curve_of(self.arrays.get("curve", plain(NO_CURVE)))
        return Choice(Penalty(mu, smoothing), int(n_iter), curve)

    def refuse_unless(self, described: Mapping[str, str]) -> None:
        """Refuse to go on where anything differs from what the run was bound to.

        Raises
        ------
        InputError
            Something differs; the message names it.
        """
        differing = [name for name in described if self.described.get(name) != described[name]]
        if differing:
            raise InputError(
                f"the checkpoint {self.path} is of another run: {', '.join(differing)} "
                f"differ{'s' * (len(differing) == 1)}; repeat its command as it was, or begin anew"
            )


def describe(observation: Observation, setup: Setup, **parameters: Any) -> dict[str, str]:
    """Return what a run is bound to: checksums of arrays, and the other parameters in words."""
    bound = {
        "version": version("lnocl"),
        **{name: getattr(observation, name) for name in OBSERVED},
        **vars(setup),
        **parameters,
    }
    bound["device"] = engine_name(setup)
    return {name: _describe(name, value) for name, value in bound.items()}


def _describe(name: str, value: Any) -> str:
    if isinstance(value, (Real, np.bool_)):
        value = float(value)  # of whatever kind it is
    if value is None or isinstance(value, (str, float)):
        return ascii(value)[:WIDTH]
    array = numbers(name, value).astype("<f8")
    digest = hashlib.sha256(repr(array.shape).encode())
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def read(path: str) -> Checkpoint:
    """Read a checkpoint.

    Raises
    ------
    FileError
        A file that is missing, no checkpoint, truncated or altered.
    """
    from astropy.io import fits  # which runs without checkpoints need not load

    from lnocl.io.fitsfile import open_fits

    arrays: Arrays = {}
    with open_fits(path, "is no checkpoint, or a damaged one") as file:
        for hdu in file.hdus():
            if isinstance(hdu, fits.PrimaryHDU):
                ended, digest = str(hdu.header["ENDED"]), hdu.header["DIGEST"]
            elif hdu.name == "RUN":
                described = {str(row["name"]): str(row["value"]) for row in hdu.data[:MOST_ROWS]}
            else:
                arrays[hdu.name.lower()] = np.array(hdu.data, hdu.data.dtype.newbyteorder("="))
        if digest != _digest(described, ended, arrays):
            raise FileError(f"the checkpoint {path} is truncated or altered: its digest is wrong")
    return Checkpoint(path, described, ended, arrays)


def _digest(described: Mapping[str, str], ended: str, arrays: Arrays) -> str:
    """Return the SHA-256 of all that a checkpoint holds."""
    digest = hashlib.sha256(repr((sorted(described.items()), ended)).encode())
    for name, array in sorted(arrays.items()):
        digest.update(repr((name, array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def write(
    path: str,
    described: Mapping[str, str],
    ended: str,
    arrays: Arrays,
    overwrite: bool = True,
) -> None:
    """Write a checkpoint; a file of that name is replaced once this one is complete.

    Raises
    ------
    FileError
        The file cannot be written, or is there and must not be overwritten.
    """
    from astropy.io import fits

    kept = {name: array for name, array in arrays.items() if array.size}  # FITS has none of 0
    primary = fits.PrimaryHDU()
    primary.header["ENDED"] = ended, "why the run ended; empty where it goes on"
    primary.header["DIGEST"] = _digest(described, ended, kept)
    table = np.array(list(described.items()), [("name", "U32"), ("value", f"U{WIDTH}")])
    images = [fits.ImageHDU(array, name=name.upper()) for name, array in kept.items()]
    hdus = fits.HDUList([primary, fits.BinTableHDU(table, name="RUN"), *images])
    with whole_file(path, overwrite) as stream:
        hdus.writeto(stream)


class Checkpointer:
    """Keeps the checkpoints of a run, and finds the one that it goes on from.

    Parameters
    ----------
    path : str or None
        File to write; None for no checkpoints.
    every : float
        Seconds between them, zero or more.
    resume : str or None
        The checkpoint that the run goes on from, which may be replaced.
    describe : callable
        Returns what the run is bound to; called where there is a path or a checkpoint.

    Attributes
    ----------
    saved : Checkpoint or None
        What the run goes on from.

    Raises
    ------
    InputError
        `every` is no such number, or the checkpoint is of another run.
    FileError
        The file cannot be written, or exists and is not the one gone on from; the checkpoint
        cannot be read.
    """

    def __init__(
        self,
        path: object,
        every: object,
        resume: object,
        describe: Callable[[], dict[str, str]],
    ) -> None:
        self._path, source = _file_name("checkpoint", path), _file_name("resume", resume)
        self._saved_at = time.monotonic() if path is None else -math.inf
        self._finite: Arrays = {}
        if not (isinstance(every, Real) and cast(float, every) >= 0):
            raise InputError(f"checkpoint_every must be seconds, 0 or more; {every!r} was given")
        self._every = cast(float, every)
        self.saved = None if source is None else read(source)
        self._may_replace = False
        if self._path is not None:
            check_output(self._path, overwrite=True)
            self._path = os.path.abspath(self._path)  # wherever the process goes
            self._may_replace = _are_same(self._path, source)
            self._refuse_to_replace()
        self._described = describe() if self._path is not None or self.saved is not None else {}
        if self.saved is not None:
            self.saved.refuse_unless(self._described)

    def _refuse_to_replace(self) -> None:
        assert self._path is not None
        if os.path.lexists(self._path) and not self._may_replace:
            raise FileError(f"the checkpoint {self._path} exists; resume from it, or remove it")

    def restore(self, run: Run, rule: Rule) -> str:
        """Put a run where its checkpoint was, if any; return why it had ended, if it had.

        A run that a callback has ended, or an interrupt, goes on.

        Raises
        ------
        NotFiniteError
            The start is infinite or not a number.
        """
        ended = ""
        if self.saved is not None and self.saved.choice() is not None:
            run.restore(self.saved.arrays)
            rule.restore(self.saved.arrays.get("rule", np.zeros(0)).tolist())
            ended = "" if self.saved.ended == "callback" else self.saved.ended
        self._finite = run.state()
        return ended

    def redo(self, run: Run) -> None:
        """Put a run whose objective is not finite where it was the last time, from what was kept.

        The checkpoint stays as it is: a run goes on from it as if nothing had happened.

        Raises
        ------
        NotFiniteError
            There is no such estimate.

        Warns
        -----
        LnoclWarning
            Always.
        """
        run.redo(self._finite)
        warn(
            f"the objective became infinite or not a number: the result is that of iteration "
            f"{run.done}, the last before; scale the scene where its values are large beyond "
            "measure, else see what lnocl selftest says of the device"
        )

    def keep(self, run: Run, rule: Rule, choice: Choice, ended: str) -> None:
        """Keep what the run has come to, where it is time to or the run has ended; in the file too.

        Raises
        ------
        FileError
            The first checkpoint cannot be written.
        NotFiniteError
            It has come to what is infinite or not a number; the file stays as it is.

        Warns
        -----
        LnoclWarning
            A later one cannot be written.
        """
        if ended or self._is_time():
            self._finite = run.proven_state()
            chosen = [choice.penalty.mu, choice.penalty.smoothing, choice.n_iter]
            besides = {"rule": rule.state(), "choice": chosen, "curve": plain(choice.curve)}
            arrays = {name: np.array(values, np.float64) for name, values in besides.items()}
            self._write(ended, self._finite | arrays)

    def keep_choosing(self, selection: HeldOutSelection) -> None:
        """Keep what held-out counts have come to, where there is a file and it is time to.

        Raises and warns as `keep`.
        """
        if self._path is not None and self._is_time():
            self._write("", selection.state())

    def _is_time(self) -> bool:
        return time.monotonic() - self._saved_at >= self._every

    def _write(self, ended: str, arrays: Arrays) -> None:
        """Write a checkpoint; what cannot be written later on costs no run that has come so far."""
        try:
            if self._path is not None:
                self._refuse_to_replace()
                write(self._path, self._described, ended, arrays, self._may_replace)
                self._may_replace = True
        except FileError as error:
            if self._saved_at == -math.inf:
                raise
            warn(f"{error}; the run goes on, and what was there before is as it was")
        self._saved_at = time.monotonic()


def _file_name(name: str, file: object) -> str | None:
    if file is None:
        return None
    if not isinstance(file, (str, os.PathLike)) or not isinstance(os.fspath(file), str):
        raise InputError(f"{name} must be the name of a file; {file!r} was given")
    return cast(str, os.fspath(file))


def _are_same(path: str, source: str | None) -> bool:
    return source is not None and os.path.exists(path) and os.path.samefile(path, source)
