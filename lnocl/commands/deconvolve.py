"""The command ``deconvolve``: load images and PSFs, run, write the result."""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from lnocl.commands import checkpoints, messages, options, pictures, record
from lnocl.commands.deconvolve_options import ALL_OPTIONS, OPTIONS, PARAMETERS
from lnocl.commands.parser import Command
from lnocl.core.scene.counts import means
from lnocl.deconvolution import deconvolve
from lnocl.errors import InputError, MisfitWarning, detail, warn
from lnocl.progress import Progress
from lnocl.result import Callback, Result, view_of
from lnocl.result.summary import Unit, details, summary_lines
from lnocl.tiles import deconvolve_tiles, for_the_whole

if TYPE_CHECKING:
    from lnocl.core.scene.observation import Observation
    from lnocl.io.frames import Frames


def read(arguments: argparse.Namespace) -> tuple[Frames, dict[str, Any]]:
    """Read what the arguments of ``lnocl deconvolve`` name; return it, and the values given."""
    from lnocl.core.scene.uncertainties import OtherNoiseError
    from lnocl.io import missions
    from lnocl.io.calibration import Calibration
    from lnocl.io.frames import read_frames

    given = {**vars(arguments), "device": _device_spec(arguments)}
    given |= missions.calibrate(arguments.images[0], given)
    paths = arguments.images, arguments.psfs
    try:
        frames = read_frames(*paths, Calibration(**_given(given, Calibration._fields)))
    except OtherNoiseError as error:
        if arguments.noise:
            raise
        warn(f"{error.message}: `noise` err is not taken, and the sky measured: `read_noise` auto")
        given |= {"noise": arguments.noise, "read_noise": ["auto"]}
        frames = read_frames(*paths, Calibration(**_given(given, Calibration._fields)))
    given["stars"] = options.star_places(
        arguments.stars, arguments.star_table, frames.header, arguments.images[0]
    )
    return frames, given


def solve(
    arguments: argparse.Namespace,
    frames: Frames,
    given: Mapping[str, Any],
    callback: Callback | None = None,
) -> Result:
    """Reconstruct what `read` has returned."""
    # Each process that makes replicas or tiles takes a device of its own, unless one was named.
    parameters = _parameters({**given, "device": arguments.device})
    parameters["progress"] = not arguments.quiet
    if not in_tiles(arguments, frames.observation):
        if arguments.parallel:
            raise InputError(
                "`parallel` does nothing without tiles: give `tile` too, or leave it out"
            )
        return deconvolve(frames.observation, **parameters, callback=callback)
    for name in ("checkpoint", "resume"):
        if parameters.pop(name, None):
            raise InputError(f"`{name}` is not for tiles; leave it out")
    how = {"tile": arguments.tile, "parallel": arguments.parallel}
    return deconvolve_tiles(frames.observation, **how, **parameters)


def in_tiles(arguments: argparse.Namespace, observation: Observation) -> bool:
    """Return whether a run is tile by tile, as is asked for, or as PSFs that vary may be."""
    varies = bool(observation.psf_fields)
    return arguments.tile is not None or (varies and for_the_whole(observation) is None)


def _run(arguments: argparse.Namespace) -> Iterator[str]:
    from lnocl.io import atomic
    from lnocl.parallel import check_parallel

    atomic.check_fits_output(arguments.output, arguments.overwrite)
    pictures.check(arguments)
    checkpoints.check(arguments)
    check_parallel(arguments.parallel)
    with (
        messages.recorded(COMMAND.flags(), partial(_is_shown, arguments)) as recorded,
        checkpoints.Interrupts() as interrupts,
    ):
        frames, given = read(arguments)
        result = solve(arguments, frames, given, interrupts.callback)
        interrupts.listen()  # a run that was resumed at its end has no iteration to start from
        if result.stop_reason == "callback":
            result = dataclasses.replace(result, stop_reason="interrupt")
        lines = _answer(arguments, result, frames, recorded)
        _write(arguments, result, frames, given, [*lines, "", *recorded])
        if arguments.plot is not None:
            from lnocl.plotting.result import draw_result

            pictures.draw(arguments, draw_result(view_of(result, _unit(frames))))
        *lines, end = lines
        files = [each for each in (arguments.output, arguments.plot) if each is not None]
        yield from [*lines, f"{end}; {', '.join(files)}"]
    interrupts.explain(arguments, result)


def _is_shown(arguments: argparse.Namespace, warning: Warning) -> bool:
    """Return whether a warning is shown: that the model does not fit is in the answer."""
    return arguments.quiet or not isinstance(warning, MisfitWarning)


def _unit(frames: Frames) -> Unit:
    return Unit(re.sub(r"^(electron|photon)\b", r"\1s", frames.unit), frames.electrons)


def _answer(
    arguments: argparse.Namespace, result: Result, frames: Frames, recorded: Sequence[str]
) -> list[str]:
    """Return what is said of a result, after what was recorded; log the details."""
    with Progress(None, "", not arguments.quiet, "measuring errors"):
        for line in details(result):
            detail("%s", line)
        is_warned = any(line.startswith("warning: ") for line in recorded)
        lines = summary_lines(result, _unit(frames), is_warned)
        return [messages.in_shell(each, COMMAND.flags()) for each in lines]


def _write(
    arguments: argparse.Namespace,
    result: Result,
    frames: Frames,
    given: Mapping[str, Any],
    lines: Sequence[str],
) -> None:
    """Write the result with the command that repeats it."""
    from lnocl.io.fitsread import read_contents
    from lnocl.io.headers import observed_cards
    from lnocl.result.file import write_file

    primary = read_contents(arguments.images[0]).primary
    repeated = {**given, **_repeated(given, frames)}
    used = repeated | _used(repeated, frames, result)
    write_file(
        result,
        arguments.output,
        # With field rotation the sky has north up, as no image has.
        None if arguments.angle else frames.header,
        arguments.overwrite,
        cards=[
            *observed_cards(frames.header, primary),
            *record.make_cards(ALL_OPTIONS, used, frames.sha256),
        ],
        unit=(frames.unit, frames.electrons),
        has_cubes=arguments.residuals,
        commands=record.make_commands("deconvolve", ALL_OPTIONS, repeated, os.getcwd()),
        messages=lines,
        given=frames.observation,
    )


def _given(values: Mapping[str, Any], names: Any) -> dict[str, Any]:
    """Return the values that are given, of these names; the others have defaults elsewhere."""
    return {name: values[name] for name in names if values.get(name) is not None}


def _parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of `lnocl.deconvolve`; in the shell, no rule has a name."""
    rule = None if given["stop"] == "none" else given["stop"]
    parameters = _given(given, PARAMETERS) | {"stop": rule}
    if parameters.get("refine_psfs") == ["none"]:
        parameters["refine_psfs"] = []
    return parameters


def _repeated(given: Mapping[str, Any], frames: Frames) -> dict[str, Any]:
    """Return the values of the command that repeats the run, where others were given."""
    words = given["background"] or []
    return {
        # A level that was measured is measured again: a number would be taken as known.
        "background": words if "auto" in words else frames.background,
        "read_noise": frames.read_noise,
        "star_table": None,
        "precision": given["precision"] if given["engine"] == "opencl" else "double",
    }


def _used(repeated: Mapping[str, Any], frames: Frames, result: Result) -> dict[str, Any]:
    """Return the values that were computed with, where rules and keywords were given."""
    from lnocl.core.scene.grid import pad_of

    exposure = frames.observation.exposure
    return {
        "gain": frames.gain,
        "background": _levels(frames, result),
        "pad": pad_of(result._observation, result._findings.setup.pad),
        **({"exposure": exposure.tolist()} if repeated["exposure"] and exposure.ndim == 1 else {}),
    }


def _levels(frames: Frames, result: Result) -> list[Any]:
    """Return the background as given, with the levels that were fitted."""
    before, after = frames.observation, result._observation
    changed = means(after.background, after.mask) - means(before.background, before.mask)
    return [
        float(word + changed[j]) if before.background_error[j] > 0 else word
        for j, word in enumerate(frames.background)
    ]


def _device_spec(arguments: argparse.Namespace) -> str | None:
    """Return the OpenCL device as indices, so that the run can be repeated on the same."""
    if arguments.engine != "opencl":
        return arguments.device
    from lnocl.core.opencl import device

    return device.spec_of(device.choose(arguments.device).device)


COMMAND = Command(
    "reconstruct the sky from images of it, as stars plus an extended source",
    OPTIONS,
    _run,
    "Example: lnocl deconvolve image.fits --psf psf.fits --background auto --star 60,32 -o a.fits",
)
