"""The file of a result: one writer of it, for Python and the shell."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING

import numpy as np

from lnocl.io import sky
from lnocl.io.fitsread import wcs_cards
from lnocl.io.fitswrite import Card, StarColumn, column_unit, write_result
from lnocl.result.kept import Parts, to_parts
from lnocl.runs.outcome import Outcome

if TYPE_CHECKING:
    from astropy.io import fits

    from lnocl.result import Result
    from lnocl.scene.observation import Observation


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
    commands, messages
        As for `lnocl.io.fitswrite.write_result`.
    given : Observation, optional
        What the result is of, where the commands lead to it: what the run has found is added then,
        so that errors and detections begin there.

    Raises
    ------
    FileError
        The file cannot be written, or exists and must not be overwritten.
    """
    name, electrons = unit or (result._unit, 1.0)
    flux, error = (each / electrons for each in result.extended_flux)
    refinement, observation = result.psf_refinement, result._observation
    own: list[Card] = [
        ("CREATOR", f"lnocl {version('lnocl')}", "program that wrote this file"),
        ("NITER", result.n_iter, "iterations done"),
        ("STOPPED", result.stop_reason, "why it stopped"),
        ("MU", result.mu, "weight of the Tikhonov term, per electron"),
        ("SMOOTHIN", result.smoothing, "weight of the edge-preserving term"),
        ("DEVICE", result.device, "device"),
        ("EXTFLUX", flux, "flux of the extended source"),
        ("EXTERROR", error, "its standard error"),
        ("ONEUNIT", f"{float(electrons)} {result._unit}", "what one BUNIT is"),
        ("RESIDRMS", result.fit().rms, "rms residual, 1 by noise"),
        ("VERDICT", "; ".join(result.verdict()), ""),
        *([] if refinement is None else refinement.cards()),
    ]
    models = result.models() if has_cubes else None
    write_result(
        path,
        result.extended / electrons,
        result.star_positions,
        result.star_fluxes / electrons,
        history=result.history,
        wcs=None if header is None else wcs_cards(header),
        # A card cannot hold what is not finite.
        cards=[*cards, *(c for c in own if isinstance(c[1], str) or math.isfinite(c[1]))],
        commands=commands,
        overwrite=overwrite,
        held_out=result.held_out if result.held_out.size else None,
        unit=name,
        star_columns=_star_columns(result, header, name, electrons),
        cubes={}
        if models is None
        else {"MODELS": (models, "electron"), "RESIDUALS": (result._residuals(models), "")},
        transforms=observation.transforms,
        oversample=observation.oversample,
        psf_fit=None if refinement is None else refinement.table(),
        psfs=None if refinement is None else result.psfs,
        psf_errors=None if refinement is None else refinement.errors_table(),
        doubtful=None if refinement is None else result.doubtful,
        messages=messages,
        halos=result._halo_table() if result.halo_fluxes.size else None,
        estimate=_estimate(result, given),
    )


def _estimate(result: Result, given: Observation | None) -> Parts:
    """Return what the run has found; nothing of tiles, nor where nothing leads to the images."""
    outcome = result._findings
    return {} if given is None or not isinstance(outcome, Outcome) else to_parts(outcome, given)


def _star_columns(
    result: Result, header: fits.Header | None, unit: str, electrons: float
) -> list[StarColumn]:
    """Return the columns of the table of stars after positions and fluxes."""
    columns, positions = [], result.star_positions
    if np.isfinite(result.star_position_errors).any():
        x_error, y_error = result.star_position_errors.T
        columns += [
            StarColumn("x_error", x_error, "pix", "standard error"),
            StarColumn("y_error", y_error, "pix", "standard error"),
        ]
    flux_errors = result.star_flux_errors / electrons
    columns.append(StarColumn("flux_error", flux_errors, column_unit(unit), "standard error"))
    if (n_epochs := result._observation.n_epochs) > 1:
        epochs = np.arange(len(positions)) % n_epochs
        columns.append(StarColumn("epoch", epochs, "", "number of the epoch, from 0 on"))
    if header is not None and sky.has_celestial(header):
        ra, dec = sky.to_sky(positions, header).T
        columns += [
            StarColumn("ra", ra, "deg", "right ascension, ICRS"),
            StarColumn("dec", dec, "deg", "declination, ICRS"),
        ]
    at_stars = result.star_residuals()
    for part in ("core", "wings"):
        values = [getattr(found, part).rms for found in at_stars]
        comment = f"rms residual in the {part}, 1 by noise"
        columns.append(StarColumn(f"{part}_rms", values, "", comment))
    halos = [found.halo for found in at_stars]
    return [*columns, StarColumn("halo", halos, "", "light all round it over its flux")]
