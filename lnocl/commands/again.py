"""What the run of a result has found, from its file, or from its command that is run again."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lnocl.commands import deconvolve
from lnocl.commands.parser import Parser
from lnocl.errors import FileError, InputError, note
from lnocl.process import ignored_notes, ignored_warnings
from lnocl.result.kept import from_parts

if TYPE_CHECKING:
    from lnocl.core.runs.outcome import Outcome
    from lnocl.io.frames import Frames
    from lnocl.io.saved_results import SavedResult

# The run is taken for the same where pixels and fluxes are to this share of them, and pixels to
# this share of the brightest: another device rounds otherwise.
SAME, ROUNDING = 1e-3, 1e-5


@dataclass(frozen=True)
class RerunOfFile:
    """A result in a file, and what its run was made of.

    Attributes
    ----------
    saved : SavedResult
        The result.
    frames : Frames
        Its images.
    run : Namespace
        The arguments of its run.
    given : object
        What else was read for it.
    """

    saved: SavedResult
    frames: Frames
    run: argparse.Namespace
    given: Any

    @classmethod
    def read(cls, path: str, quiet: bool, check: Callable[[], object] = int) -> RerunOfFile:
        """Read a result and its images; before these, check what is to be written.

        Raises
        ------
        InputError
            The run was made in tiles, or its command is not known.
        FileError
            The result cannot be read or written, or its folder is not there.
        """
        from lnocl.io import atomic
        from lnocl.io.saved_results import read_result

        saved = read_result(path)
        atomic.check_fits_output(path, overwrite=True, is_updated=True)
        folder, run = _run_of(saved)
        run.quiet = quiet
        inputs = deconvolve.COMMAND.inputs(run)
        with atomic.kept(os.path.join(folder, each) for each in inputs):
            check()
        try:
            with contextlib.chdir(folder), ignored_warnings(), ignored_notes():  # shown once
                frames, given = deconvolve.read(run)
        except (FileNotFoundError, NotADirectoryError, PermissionError) as error:
            raise FileError(
                f"{folder}, where {path} was made, is not there: deconvolve again"
            ) from error
        if deconvolve.in_tiles(run, frames.observation):
            raise InputError(
                f"{path} was made in tiles, and this is of one run: deconvolve a cut-out without "
                "tiles"
            )
        return cls(saved, frames, run, given)

    def outcome(self) -> Outcome:
        """Return the outcome of the run: as the file holds it, else of the run made again.

        Raises
        ------
        InputError
            It is not that of the file; or the run was interrupted, and has to be made again.
        """
        from lnocl.io.parts import read_parts

        path = self.saved.path
        held = read_parts(path, ["ESTIMATE"]).values()
        parts = {
            name: np.asarray(rows[0])
            for each in held
            for name, rows in each.values.items()
            if len(rows)
        }
        run = self.run.device, self.run.precision
        found = from_parts(parts, self.frames.observation, *run)
        if found is None:
            if self.saved.header.get("STOPPED") == "interrupt":
                raise InputError(
                    f"the run of {path} was interrupted, and its command gives another result: "
                    "deconvolve to the end"
                )
            why = (
                f"what {path} holds of its run is of other images, or of another version of lnocl"
                if parts
                else f"{path} does not hold what its run has found"
            )
            note("%s: the run is made again", why)
            with ignored_warnings(), ignored_notes():
                found = deconvolve.solve(self.run, self.frames, self.given)._outcome
        self._refuse_another(found)
        return found

    def _refuse_another(self, found: Outcome) -> None:
        expected = self.saved.extended * self.frames.electrons
        fluxes = self.saved.star_fluxes * self.frames.electrons
        observation = found.observation
        ny, nx = observation.sky_shape
        if (
            expected.shape != observation.skies_shape
            or found.fluxes_of_stars.size != fluxes.size
            or not np.allclose(
                found.sky[..., :ny, :nx], expected, SAME, ROUNDING * abs(expected).max()
            )
            or not np.allclose(found.fluxes_of_stars, fluxes, SAME, equal_nan=True)
        ):
            raise InputError(
                f"the run of {self.saved.path} gives another result now: its images, PSFs or "
                "options have changed; deconvolve again"
            )


def _run_of(saved: SavedResult) -> tuple[str, argparse.Namespace]:
    """Return the folder that a result was made in, and the arguments of its run."""
    parser = Parser(prog="lnocl")
    deconvolve.COMMAND.add_arguments(parser)
    lines = saved.command_words()
    folder = next((words[1] for words in lines if words[:1] == ["cd"] and words[1:]), os.curdir)
    words = next((words for words in lines if words[:2] == ["lnocl", "deconvolve"]), None)
    if words is None:
        raise InputError(
            f"{saved.path} has no command of lnocl deconvolve in its header; in Python, the "
            "methods of Result do the same"
        )
    return folder, parser.parse_args(words[2:])
