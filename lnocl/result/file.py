"""The file of a result: one writer of it, for Python and the shell."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from astropy.io import fits

from lnocl.core.runs.outcome import Outcome, PsfRefinement
from lnocl.core.scene.observation import Observation
from lnocl.errors import note
from lnocl.io import sky
from lnocl.io.fitsread import wcs_cards
from lnocl.io.fitswrite import Card, column_unit, write_result
from lnocl.io.parts import PARTS, Column
from lnocl.result import Result
from lnocl.result.kept import to_parts
from lnocl.result.views import electrons_in, noise_of

# The table ESTIMATE has this many bytes at most.
MOST_BYTES = 2**26


def write_file(
    result: Result,
    path: str,
    header: fits.Header | None,
    overwrite: bool,
    *,
    cards: Iterable[Card] = (),
    unit: tuple[str, float] | None = None,
    has_cubes: bool = True,
    commands: Iterable[Sequence[str]] = (),
    messages: Sequence[str] = (),
    given: Observation | None = None,
) -> None:
    """Write a result: the file is there complete, or not at all.

    Parameters
    ----------
    result : Result
        What is written.
    path : str
        File to write.
    header : astropy.io.fits.Header or None
        Of the sky: its coordinates are copied, and stars have places on the sky by them.
    overwrite : bool
        Whether an existing file may be replaced.
    cards : iterable of (keyword, value, comment), optional
        What was observed, and how the file was made.
    unit : (str, float), optional
        Unit of the file, and the electrons in it; by default that of the result.
    has_cubes : bool, optional
        Whether the models and the residuals of the images are added.
    commands : iterable of sequence of str, optional
        As for `lnocl.io.fitswrite.write_result`.
    messages : sequence of str, optional
        The messages of the run, a line each.
    given : Observation, optional
        What the result is of, where the commands lead to it: what the run has found is added then,
        so that errors and detections begin there.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    name, electrons = unit or (result._unit, 1.0)
    fluxes, errors = (np.atleast_1d(each) / electrons for each in result.extended_flux)
    refinement, observation = result.psf_refinement, result._observation
    own: list[Card] = [
        ("CREATOR", f"lnocl {version('lnocl')}", "program that wrote this file"),
        ("NITER", result.n_iter, "iterations done"),
        ("STOPPED", result.stop_reason, "why it stopped"),
        ("MU", result.mu, "weight of the Tikhonov term, per electron"),
        ("SMOOTHIN", result.smoothing, "weight of the edge-preserving term"),
        ("DEVICE", result.device, "device"),
        ("EXTFLUX", float(fluxes[0]), "flux of the extended source, or first component"),
        ("EXTERROR", float(errors[0]), "its standard error"),
        ("ONEUNIT", f"{float(electrons)} {result._unit}", "what one BUNIT is"),
        ("RESIDRMS", result.fit().rms, "rms residual, 1 by noise"),
        ("VERDICT", "; ".join(result.verdict()), ""),
        *([] if refinement is None else _psf_cards(refinement)),
    ]
    parts: dict[str, Any] = {
        "HALOS": _halos(result) if result.halo_fluxes.size else None,
        "HISTORY": result.history,
        "HELDOUT": result.held_out if result.held_out.size else None,
    }
    if names := result.component_names:
        light = column_unit(name)
        parts["COMPONENTS"] = [
            Column("name", names),
            Column("flux", fluxes, light),
            Column("flux_error", errors, light, "standard error"),
        ]
        parts["NOISE"] = noise_of(result, electrons)
    if has_cubes:
        models = result.models()
        parts |= {"MODELS": models, "RESIDUALS": result._residuals(models)}
        parts["ELECTRONS"] = electrons_in(result, electrons)
    if refinement is not None:
        parts |= _psf_parts(result, refinement)
    steps = zip(*(line.split(": ", 1) for line in result.plan.splitlines()), strict=True)
    parts["PLAN"] = list(map(Column, ("step", "done"), steps))
    parts["MESSAGES"] = [Column("message", messages)] if messages else None
    if observation.n_epochs > 1:
        parts["EPOCHS"] = [Column("label", observation.epoch_labels)]
    outcome = result._findings
    if given is not None and isinstance(outcome, Outcome):
        # It is in memory more than once while it is written.
        kept = to_parts(outcome, given) if outcome.sky.nbytes <= MOST_BYTES else {}
        if kept and sum(value.nbytes for value in kept.values()) <= MOST_BYTES:
            parts["ESTIMATE"] = [Column(name, value[None]) for name, value in kept.items()]
        else:
            note("the table ESTIMATE is left out, as it is large: errors make the run again")
    write_result(
        path,
        result.extended / electrons,
        result.star_positions,
        result.star_fluxes / electrons,
        parts,
        star_columns=_star_columns(result, header, name, electrons),
        unit=name,
        wcs=None if header is None else wcs_cards(header),
        transforms=observation.transforms,
        oversample=observation.oversample,
        # A card cannot hold what is not finite.
        cards=[*cards, *(c for c in own if isinstance(c[1], str) or math.isfinite(c[1]))],
        commands=commands,
        overwrite=overwrite,
    )


def _psf_cards(refinement: PsfRefinement) -> list[Card]:
    """Return whether PSFs were refined, their misfits and their error."""
    before, after = refinement.misfit
    return [
        ("PSFUSED", refinement.is_accepted, "whether refined PSFs are used"),
        ("PSFMIS1", before, "chi squared at stars, PSFs as given"),
        ("PSFMIS2", after, "chi squared at stars, PSFs used"),
        ("PSFERR", refinement.psf_error, "relative error that the PSFs used have"),
    ]


def _psf_parts(result: Result, refinement: PsfRefinement) -> dict[str, Any]:
    """Return the parameters of the PSFs, the PSFs, their error in rings, and what it may fake."""
    names = [name.replace(" ", "_") for name in refinement.parameters]
    edges, errors = refinement.edges, refinement.errors_in_rings
    return {
        "PSFFIT": [
            Column("image", np.arange(1, len(refinement.values) + 1)),
            *map(Column, names, refinement.values.T),
        ],
        "PSFS": result.psfs,
        "PSFERRORS": [*map(Column, ("from", "to", "error"), (edges[:-1], edges[1:], errors))],
        "DOUBTFUL": result.doubtful,
    }


def _halos(result: Result) -> list[Column]:
    """Return the amounts of halos, a row for each halo and image, both counted from 1."""
    numbers = np.indices(result.halo_fluxes.shape) + 1
    columns = [*numbers, result.halo_fluxes, result.halo_flux_errors]
    units = "", "", *[column_unit("electron")] * 2
    return [*map(Column, PARTS["HALOS"].columns, map(np.ravel, columns), units)]


def _star_columns(
    result: Result, header: fits.Header | None, unit: str, electrons: float
) -> list[Column]:
    """Return the columns of the table of stars after positions and fluxes."""
    columns, positions = [], result.star_positions
    if np.isfinite(result.star_position_errors).any():
        for axis, each in zip("xy", result.star_position_errors.T, strict=True):
            columns.append(Column(f"{axis}_error", each, "pix", "standard error"))
    flux_errors = result.star_flux_errors / electrons
    columns.append(Column("flux_error", flux_errors, column_unit(unit), "standard error"))
    if (n_epochs := result._observation.n_epochs) > 1:
        epochs, what = np.arange(len(positions)) % float(n_epochs), "row of EPOCHS, from 0 on"
        columns.append(Column("epoch", epochs, "", what))
        if not result.component_names:
            changes = result.star_variation_errors / electrons
            comment = "standard error against the star's mean"
            columns.append(Column("variation_error", changes, column_unit(unit), comment))
    if header is not None and sky.has_celestial(header):
        ra, dec = sky.to_sky(positions, header).T
        columns += [
            Column("ra", ra, "deg", "right ascension, ICRS"),
            Column("dec", dec, "deg", "declination, ICRS"),
        ]
    at_stars = result.star_residuals()
    for part in ("core", "wings"):
        values = [getattr(found, part).rms for found in at_stars]
        comment = f"rms residual in the {part}, 1 by noise"
        columns.append(Column(f"{part}_rms", values, "", comment))
    halos = [found.halo for found in at_stars]
    return [*columns, Column("halo", halos, "", "light all round it over its flux")]
