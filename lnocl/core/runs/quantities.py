"""The quantities of a reconstruction whose errors replicas give, and how they are measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.replicas import Sky
from lnocl.core.scene.apertures import AMOUNT, FLUX, LENGTH, RATIO, Aperture, Label, Profile
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.components import CONTINUUM
from lnocl.core.scene.detector import on_sky
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.shifting import Cutout
from lnocl.core.scene.texture import CORE

BELOW, UNDER, UNSEEN = "below the resolution", "under a star", "not observed"

Part = Aperture | Profile


class Quantity(NamedTuple):
    """A quantity whose error a bootstrap estimates.

    Attributes
    ----------
    name : str
        Its name, such as "star 1 flux".
    kind : str
        "flux", in electrons, per second where exposures were given; "halo", in electrons of one
        image; "length", a position or a width, in pixels; "ratio", of the light of two components.
    value : float
        Its value in the reconstruction.
    note : str
        Why its error may not hold; else empty.
    at : float or None
        Position along a profile, pixels from its middle; None elsewhere.

    Examples
    --------
    >>> from lnocl.core.runs.bootstrap import Quantity
    >>> Quantity("star 1 flux", "flux", 1000.0)
    Quantity(name='star 1 flux', kind='flux', value=1000.0, note='', at=None)
    """

    name: str
    kind: str
    value: float
    note: str = ""
    at: float | None = None


def measure(outcome: Outcome, sky: Sky, parts: Sequence[Part]) -> Array:
    """Return the values of all quantities in a sky: fluxes, places, then parts."""
    fluxes = in_electrons(outcome, sky.star_fluxes)
    shown = outcome.scene.is_shown[: outcome.scene.n_stars]
    positions = sky.star_positions[shown].ravel() if outcome.moves else np.zeros(0)
    named = outcome.scene.observation.component_names
    of_parts = (measure_part(part, sky.extended, sky.light, named) for part in parts)
    return np.concatenate([fluxes, positions, *of_parts])


def measure_part(part: Part, extended: Array, light: Array, names: Sequence[str]) -> Array:
    """Return what a part has of a sky, or of each of several, and then the ratios of these."""
    if not names:
        return part.measure(extended, light)
    found = np.array([part.measure(*each) for each in zip(extended, light, strict=True)])
    ratios = [found[k, 0] / (found[m, 0] or np.nan) for k, m in _compared(part, names)]
    return np.append(found, ratios)


def propagate(errors: Array, values: Array, parts: Sequence[Part], names: Sequence[str]) -> None:
    """Set errors of ratios, of all quantities (..., k), to what those of their light make of them.

    A drawn sky may have less light than the reconstruction, and its ratio then has another error.
    """
    pairs = [_compared(part, names) for part in parts]
    lights = [len(part.labels()) * (len(names) or 1) for part in parts]
    at = len(values) - sum(lights) - sum(map(len, pairs))
    for n, compared in zip(lights, pairs, strict=True):
        for i, (k, m) in enumerate(compared, start=at + n):
            change = errors[..., at + k] - values[i] * errors[..., at + m]
            errors[..., i] = change / (values[at + m] or np.nan)
        at += n + len(compared)


def _compared(part: Part, names: Sequence[str]) -> list[tuple[int, int]]:
    """Return which components' light in a region is divided by which: all by the continuum's."""
    return [] if isinstance(part, Profile) else compared(names)


def compared(names: Sequence[str]) -> list[tuple[int, int]]:
    """Return which components are divided by which: all others by the continuum, if one is."""
    m = names.index(CONTINUUM) if CONTINUUM in names else -1
    return [(k, m) for k in range(len(names)) if k != m and m >= 0]


def in_electrons(outcome: Outcome, fluxes: Array) -> Array:
    """Return the fluxes of stars that are shown, and of halos in electrons of their images."""
    n, is_shown = outcome.scene.n_stars, outcome.scene.is_shown
    return np.append(fluxes[:n], outcome.halo_amounts(fluxes).ravel())[is_shown]


def quantities_of(
    outcome: Outcome, parts: Sequence[Part], width: float
) -> tuple[tuple[Quantity, ...], Array]:
    """Return the quantities in the order of `measure`, and the share of each star's light in each.

    The shares have a row for each quantity, and a column for each flux and position of those.
    """
    scene = outcome.scene
    n_epochs, images = scene.observation.n_epochs, range(scene.n_images)
    names = scene.observation.component_names
    stars = [f" epoch {e} {{}}" for e in range(n_epochs)] if n_epochs > 1 else [" {}"]
    if names:
        stars = [f" {{}} in images of {each}" for each in scene.observation.epoch_labels]
    shown = np.flatnonzero(scene.is_shown[: scene.n_stars]).tolist()
    called = [f"star {s // n_epochs + 1}{stars[s % n_epochs]}" for s in shown]
    labels = [Label(each.replace("{}", "flux"), FLUX) for each in called]
    halos = range(len(scene.observation.halos))
    labels += [Label(f"halo {k + 1} image {j + 1}", AMOUNT) for k in halos for j in images]
    if outcome.moves:
        labels += [Label(each.replace("{}", axis), LENGTH) for each in called for axis in "xy"]
    n_stated = len(labels)
    notes, shares = [""] * n_stated, [*np.eye(n_stated)]
    if parts:
        observed = _observed(scene)
        cutouts = [[scene.psf_on_sky(j, s) for j in images] for s in shown]
    ratios = list[tuple[int, int, int]]()
    for part in parts:
        own, slices = part.labels(), part.slices if isinstance(part, Profile) else [part]
        held = np.zeros((len(own), n_stated))  # widths hold no light
        for k, i in np.ndindex(len(slices), len(shown)):
            held[k, i] = _light_within(slices[k], cutouts[i], scene.grid)
        own_notes = [_note(each, scene, width, observed) for each in slices]
        if isinstance(part, Aperture) and part.n_pixels < np.pi / 4.0 * width**2:
            own_notes = [BELOW]
        own_notes *= len(own) // len(slices)
        for name, of_filters in zip(names or [""], _shares_of_filters(scene, shown), strict=True):
            named = [each._replace(name=f"{name} {each.name}".lstrip()) for each in own]
            labels, notes = labels + named, notes + own_notes
            filled = np.append(of_filters, np.zeros(n_stated - len(shown)))
            shares = [*shares, *(held * filled)]
        first = len(labels) - len(names)
        for k, m in _compared(part, names):
            ratios.append((len(labels), first + k, first + m))
            labels = [*labels, Label(f"{names[k]} / {names[m]} {part.name}", RATIO)]
            notes, shares = notes + own_notes[:1], [*shares, np.zeros(n_stated)]
    light = outcome.light().sky() if parts else outcome.sky
    sky = Sky(outcome.estimate.observed_sky, light, outcome.star_fluxes, scene.stars)
    values = measure(outcome, sky, parts).tolist()
    for ratio, k, m in ratios:  # what a star's light in both changes
        shares[ratio] = (shares[k] - values[ratio] * shares[m]) / (values[m] or np.nan)
    quantities = tuple(
        Quantity(label.name, label.kind, value, note, label.at)
        for label, value, note in zip(labels, values, notes, strict=True)
    )
    return quantities, np.reshape(shares, (len(labels), n_stated))


def _shares_of_filters(scene: Scene, shown: Sequence[int]) -> Array:
    """Return by how much the light of each star, in its filter, is in each sky, (K, n)."""
    if scene.mixing is None:
        return np.ones((1, len(shown)))
    filters = scene.mixing.filters[scene.shown[list(shown)].argmax(axis=1)]
    return scene.mixing.undone[:, filters]


def _light_within(aperture: Aperture, cutouts: Sequence[Cutout], grid: tuple[int, int]) -> float:
    """Return the mean light of cutouts on the periodic grid within an aperture."""
    light = np.zeros(aperture.weights.shape)
    for cutout in cutouts:
        cutout.add_to(light, (aperture.y, aperture.x), grid, 1.0 / len(cutouts))
    return float((aperture.weights * light).sum())


def _observed(scene: Scene) -> Array:
    """Return 1 where the extended source was observed, and components are told, else 0."""
    (ny, nx), mixing = scene.observation.sky_shape, scene.mixing
    if scene.weights is None:
        return np.ones((ny, nx))
    parts = [scene] if mixing is None else map(scene.of_images, mixing.images)
    models = map(Model, parts)
    seen = [each.scene.observed(each.adjoint(each.weights))[:ny, :nx] for each in models]
    return (seen[0] if mixing is None else mixing.told_by(np.array(seen))).astype(np.float64)


def _note(aperture: Aperture, scene: Scene, width: float, observed: Array) -> str:
    """Return why the error of an aperture may not hold, as where a star's core fills most of it."""
    if aperture.flux(observed) < 0.5 * aperture.n_pixels:
        return UNSEEN
    rows, columns = aperture.places
    stars = on_sky(scene.stars, scene.oversample)
    is_core = [np.hypot(rows - y, columns - x) <= CORE * width for x, y in stars]
    most = max(((aperture.weights * each).sum() for each in is_core), default=0.0)
    return UNDER if most > 0.5 * aperture.n_pixels else ""
