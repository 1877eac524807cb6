"""The outcome of a run as parts of a file, from which errors and detections begin.

Images are not among them: they are read again as for the run. Of what the run has changed in its
observation, such as PSFs that were refined or levels that were fitted, the parts have the new
values. A digest binds them to the images and to the version of lnocl.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lnocl.core.runs.inputs import digest_of, inputs_of
from lnocl.core.runs.outcome import CURVE_DTYPE, Outcome, PsfRefinement
from lnocl.core.runs.start import Setup
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.fields import FIELDS
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.star_prior import StarPrior
from lnocl.process import ignored_warnings

Parts = dict[str, NDArray[Any]]
Built = TypeVar("Built")

DIGEST = "digest"
# Of texts of one part, which have none of it.
SEPARATOR = "; "
# What the command of a run names, whether it was given or chosen.
BY_COMMAND = "device", "precision"


def to_parts(outcome: Outcome, given: Observation) -> Parts:
    """Return what a run has found of an observation that it was given.

    Parameters
    ----------
    outcome : Outcome
        The outcome of the run.
    given : Observation
        As `lnocl.deconvolve` was given it.

    Returns
    -------
    dict of str to ndarray
        Arrays, and numbers and texts as arrays of no dimension.
    """
    scene, before = outcome.scene, given.upright()
    parts = {**dict(_flat(outcome)), **dict(_flat(scene.penalty, "penalty"))}
    parts["positions"] = scene.stars
    for name in BY_COMMAND:
        parts.pop(f"setup.{name}", None)
    if (moved := scene.observation.offsets - before.offsets).any():
        parts["moved"] = moved
        before = before.moved(moved)
    mask = scene.observation.mask
    if not np.array_equal(mask, before.mask):
        parts["observation.mask"] = mask
    # Of what is normalised over good pixels, the run began with this too.
    masked = _masked(before, parts)
    for name in FIELDS:
        old, new = (np.asarray(getattr(each, name)) for each in (masked, scene.observation))
        if not (old is new or np.array_equal(old, new)):
            is_shared = new.ndim > 2 and new.strides[0] == 0  # one for all images
            parts[f"observation.{name}"] = new[:1] if is_shared else new
    return {**parts, DIGEST: np.asarray(_digest(parts, given.upright()))}


def from_parts(
    parts: Mapping[str, NDArray[Any]], given: Observation, device: str | None, precision: str
) -> Outcome | None:
    """Return the outcome of a run, bit for bit, from the parts and the observation it was given.

    None where they are of another observation, or another version of lnocl, or damaged. The scene
    does not hold the halos that the run has held; runs that are like it find what they hold.
    """
    parts, before = dict(parts), given.upright()
    if DIGEST not in parts or str(parts.pop(DIGEST)) != _digest(parts, before):
        return None
    if "moved" in parts:
        before = before.moved(parts["moved"])
    changes = _part(parts, "observation.")
    changes.pop("mask", None)
    observation = _masked(before, parts).replace(**changes)
    setup = _built(
        Setup, parts, "setup.", observation=observation, device=device, precision=precision
    )
    has_prior = bool(_part(parts, "penalty.stars."))
    prior = _built(StarPrior, parts, "penalty.stars.") if has_prior else None
    with ignored_warnings():  # which the run has given
        known: dict[str, Any] = {"stars": prior}
        for name in ("shares", "edges"):  # each is text where there are none
            each = parts.get(f"penalty.{name}", np.array(""))
            known[name] = tuple(each.tolist()) if each.ndim else ()
        scene = setup.scene(_built(Penalty, parts, "penalty.", **known))
        if setup.refine_positions and scene.n_stars:
            scene.move_stars(parts["positions"])
    return _built(
        Outcome,
        parts,
        "",
        setup=setup,
        estimate=_built(Estimate, parts, "estimate.", scene=scene),
        curve=_curve(parts),
        plan=_words(parts["plan"]),
        psf_refinement=_refinement(_part(parts, "psf_refinement.")),
    )


def _masked(given: Observation, parts: Parts) -> Observation:
    """Return an observation with the pixels masked that a run has."""
    mask = parts.get("observation.mask")
    return given if mask is None else given.replace(mask=mask)


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the parts of a value; none of an observation and its scene, nor of None."""
    if is_dataclass(value):
        members = {each.name: getattr(value, each.name) for each in fields(value)}
    elif isinstance(value, np.ndarray) and value.dtype.names:
        members = {column: value[column] for column in value.dtype.names}
    else:
        if value is not None and not isinstance(value, (Observation, Scene)):
            is_words = isinstance(value, tuple) and all(isinstance(each, str) for each in value)
            yield name, np.asarray(SEPARATOR.join(value) if is_words else value)
        return
    for key, member in members.items():
        yield from _flat(member, f"{name}.{key}".lstrip("."))


def _part(parts: Mapping[str, NDArray[Any]], prefix: str) -> Parts:
    return {name[len(prefix) :]: parts[name] for name in parts if name.startswith(prefix)}


def _built(kind: type[Built], parts: Mapping[str, NDArray[Any]], prefix: str, **more: Any) -> Built:
    """Return an instance of a dataclass: its fields are parts, or None where there are none."""
    held = _part(parts, prefix)
    values = {name: each if each.ndim else each.item() for name, each in held.items()}
    names = [each.name for each in fields(kind)]  # type: ignore[arg-type]
    return kind(**{name: values.get(name) for name in names} | more)


def _words(joined: NDArray[np.str_]) -> tuple[str, ...]:
    return tuple(joined.item().split(SEPARATOR)) if joined.item() else ()


def _curve(parts: Mapping[str, NDArray[Any]]) -> NDArray[np.void]:
    columns = _part(parts, "curve.")
    curve = np.zeros(len(columns["iteration"]), CURVE_DTYPE)
    for name, values in columns.items():
        curve[name] = values
    return curve


def _refinement(parts: Parts) -> PsfRefinement | None:
    if not parts:
        return None
    misfit = tuple(parts["misfit"].tolist())
    return _built(PsfRefinement, parts, "", parameters=_words(parts["parameters"]), misfit=misfit)


def _digest(parts: Mapping[str, NDArray[Any]], observation: Observation) -> str:
    """Return the SHA-256 of parts, of the observation that they are of, and of the version."""
    return digest_of({"version": version("lnocl")}, parts, inputs_of(observation))
