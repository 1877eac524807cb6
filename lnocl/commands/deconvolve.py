"""The command ``deconvolve``: load images and PSFs, run, write the result."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lnocl.commands import checkpoints, messages, options, pictures, record
from lnocl.commands.deconvolve_options import ALL_OPTIONS, OPTIONS, PARAMETERS
from lnocl.commands.parser import Command
from lnocl.commands.summary import summarise, verdict_on
from lnocl.deconvolution import deconvolve
from lnocl.errors import InputError
from lnocl.residuals import Fit, StarResiduals
from lnocl.result import Callback, Result, saved_parts, view_of
from lnocl.runs.progress import Progress

if TYPE_CHECKING:
    from astropy.io import fits

    from lnocl.io.fitswrite import Card, StarColumn
    from lnocl.io.frames import Frames
    from lnocl.plotting.result import ResultView
    from lnocl.scene.observation import Observation


def read(arguments: argparse.Namespace) -> tuple[Frames, dict[str, Any]]:
    """Read what the arguments of ``lnocl deconvolve`` name; return it, and the values given."""
    from lnocl.io import missions
    from lnocl.io.frames import Calibration, read_frames

    given = {**vars(arguments), "device": _device_spec(arguments)}
    given |= missions.calibrate(arguments.images[0], given)
    calibration = Calibration(**_given(given, Calibration._fields))
    frames = read_frames(arguments.images, arguments.psfs, calibration)
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
    if arguments.tile is None and not frames.observation.psf_fields:
        if arguments.parallel:
            raise InputError(
                "`parallel` does nothing without tiles: give `tile` too, or leave it out"
            )
        return deconvolve(frames.observation, **parameters, callback=callback)
    return _solve_tiles(arguments, frames.observation, parameters)


def _solve_tiles(
    arguments: argparse.Namespace, observation: Observation, parameters: dict[str, Any]
) -> Result:
    """Run tile by tile; refuse what is for one run alone."""
    from lnocl.tiles import deconvolve_tiles

    for name in ("checkpoint", "resume", "refine_psfs"):
        if parameters.pop(name, PARAMETERS[name]) not in (PARAMETERS[name], []):
            raise InputError(f"`{name}` is not for tiles; leave it out")
    return deconvolve_tiles(
        observation, tile=arguments.tile, parallel=arguments.parallel, **parameters
    )


def _run(arguments: argparse.Namespace) -> None:
    from lnocl.io import atomic, fitsread
    from lnocl.parallel import check_parallel

    inputs = options.input_paths(ALL_OPTIONS, vars(arguments))
    atomic.check_fits_output(arguments.output, arguments.overwrite, inputs)
    pictures.check(arguments, inputs)
    checkpoints.check(arguments, inputs)
    check_parallel(arguments.parallel)
    with (
        messages.shown_log(arguments.quiet, COMMAND.flags()),
        messages.recorded_warnings(COMMAND.flags()) as warned,
        checkpoints.Interrupts() as interrupts,
    ):
        frames, given = read(arguments)
        result = solve(arguments, frames, given, interrupts.callback)
        interrupts.listen()  # a run that was resumed at its end has no iteration to start from
        if result.stop_reason == "callback":
            result = dataclasses.replace(result, stop_reason="interrupt")
        with Progress(None, "", not arguments.quiet, "measuring errors", stays=False):
            at_stars = result.star_residuals()
            view = view_of(result) if arguments.residuals or arguments.plot else None
            overall = Fit.of(view.residuals, view.models) if view else result.fit()
            verdict = verdict_on(
                arguments, result, frames, given["stars"], at_stars, overall, bool(warned)
            )
            lines = [*summarise(arguments, result, frames, at_stars, overall), *verdict]
            measured = _measured(result, frames, overall, verdict)
        # With field rotation the sky has north up, as no image has.
        wcs = None if arguments.angle else fitsread.wcs_cards(frames.header)
        _write(arguments, result, frames, given, at_stars, view, wcs, measured, [*warned, *lines])
        lines.append(f"written to {arguments.output}")
        if arguments.plot is not None and view is not None:
            from lnocl.plotting.result import draw_result

            lines.append(pictures.draw(arguments, draw_result(view)))
        if not arguments.quiet:
            messages.say(lines)
    interrupts.explain(arguments, result)


def _write(
    arguments: argparse.Namespace,
    result: Result,
    frames: Frames,
    given: Mapping[str, Any],
    at_stars: Sequence[StarResiduals],
    view: ResultView | None,
    wcs: fits.Header | None,
    measured: Sequence[Card],
    lines: Sequence[str],
) -> None:
    """Write the result with the command that repeats it."""
    from lnocl.io import fitsread, fitswrite
    from lnocl.io.headers import observed_cards

    primary = fitsread.read_contents(arguments.images[0]).primary
    parts, has_places = saved_parts(result), bool(arguments.align or arguments.angle)
    repeated = {**given, **_repeated(given, frames)}
    fitswrite.write_result(
        arguments.output,
        result.extended / frames.electrons,
        result.star_positions,
        result.star_fluxes / frames.electrons,
        wcs=wcs,
        cards=[
            *observed_cards(frames.header, primary),
            *record.make_cards(
                ALL_OPTIONS,
                repeated | _used(repeated, frames, result),
                frames.sha256,
                [
                    *measured,
                    *parts.pop("cards"),
                    *(fitswrite.place_cards(parts["transforms"]) if has_places else []),
                ],
            ),
        ],
        commands=record.make_commands("deconvolve", ALL_OPTIONS, repeated, os.getcwd()),
        overwrite=arguments.overwrite,
        unit=frames.unit,
        star_columns=_star_columns(arguments, result, frames, at_stars),
        cubes={"MODELS": (view.models, "electron"), "RESIDUALS": (view.residuals, "")}
        if arguments.residuals and view
        else {},
        messages=lines,
        **parts,
    )


def _measured(result: Result, frames: Frames, overall: Fit, verdict: Sequence[str]) -> list[Card]:
    """Return the cards of what is in no table, but for values that a card cannot hold."""
    flux, error = (each / frames.electrons for each in result.extended_flux)
    cards: list[Card] = [
        ("EXTFLUX", flux, "flux of the extended source"),
        ("EXTERROR", error, "its standard error"),
        ("ONEUNIT", f"{float(frames.electrons)} {result._unit}", "what one BUNIT is"),
        ("RESIDRMS", overall.rms, "rms residual, 1 by noise"),
        ("VERDICT", "; ".join(verdict), ""),
    ]
    return [card for card in cards if isinstance(card[1], str) or math.isfinite(card[1])]


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
    from lnocl.scene.padding import choose_pad

    exposure = frames.observation.exposure
    return {
        "n_iter": result.n_iter,
        "stop": result.stop_reason,
        "mu": result.mu,
        "smoothing": result.smoothing,
        "device": result.device,
        "gain": frames.gain,
        "background": _levels(frames, result),
        "pad": choose_pad(frames.observation) if repeated["pad"] == "auto" else repeated["pad"],
        **({"exposure": exposure.tolist()} if repeated["exposure"] and exposure.ndim == 1 else {}),
    }


def _levels(frames: Frames, result: Result) -> list[Any]:
    """Return the background as given, with the levels that were fitted."""
    before, after = frames.observation.background, result._observation.background
    errors = frames.observation.background_error
    return [
        float(word + after[j].mean() - before[j].mean()) if errors[j] > 0 else word
        for j, word in enumerate(frames.background)
    ]


def _star_columns(
    arguments: argparse.Namespace,
    result: Result,
    frames: Frames,
    at_stars: Sequence[StarResiduals],
) -> list[StarColumn]:
    """Return the columns of the table of stars after positions and fluxes."""
    from lnocl.io import sky
    from lnocl.io.fitswrite import StarColumn, error_columns

    header, flux_errors = frames.header, result.star_flux_errors / frames.electrons
    columns = error_columns(result.star_position_errors, flux_errors, frames.unit)
    if (n_epochs := frames.observation.n_epochs) > 1:
        epochs = [k % n_epochs for k in range(len(flux_errors))]
        columns.append(StarColumn("epoch", epochs, "", "number of the epoch, from 0 on"))
    if sky.has_celestial(header):
        ra, dec = sky.to_sky(result.star_positions, header).T
        columns += [
            StarColumn("ra", ra, "deg", "right ascension, ICRS"),
            StarColumn("dec", dec, "deg", "declination, ICRS"),
        ]
    core, wings, halo, _ = map(list, zip(*at_stars, strict=True) if at_stars else [()] * 4)
    for name, found in (("core", core), ("wings", wings)):
        values = [fit.rms for fit in found]
        comment = f"rms residual in the {name}, 1 by noise"
        columns.append(StarColumn(f"{name}_rms", values, "", comment))
    columns.append(StarColumn("halo", halo, "", "light all round it over its flux"))
    return columns


def _device_spec(arguments: argparse.Namespace) -> str | None:
    """Return the OpenCL device as indices, so that the run can be repeated on the same."""
    if arguments.engine != "opencl":
        return arguments.device
    from lnocl.opencl import device

    return device.spec_of(device.choose(arguments.device).device)


COMMAND = Command(
    "reconstruct the sky from images of it, as stars plus an extended source", OPTIONS, _run
)
