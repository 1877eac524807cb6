"""What is mended of images before anything is fitted to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation

from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import Array, Mask, together
from lnocl.core.scene.detector import psfs_on_detector
from lnocl.core.scene.noise_check import measure_noise
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.star_psfs import owned
from lnocl.errors import counted, in_words, note, warn
from lnocl.process import ignored_notes, ignored_warnings

# Places that a line names.
MOST_NAMED = 3
# Electrons per pixel that noise is of at least, and the share of stars that may be sharp.
LEAST, MOST_STARS = 1e-3, 0.5


def align_images(setup: Setup) -> tuple[Setup, str]:
    """Return a setup with images moved to where their stars are, and that in words.

    `lnocl.core.scene.registration` says by how much.
    """
    from lnocl.core.scene.registration import displacements, turned_otherwise

    observation = setup.observation
    stars = setup.stars[owned(observation, setup.stars) < 0]
    if others := [f"`images[{j}]`" for j in turned_otherwise(observation, stars)]:
        warn(
            f"the stars of {_first(others)} lie as if turned by as much the other way: "
            "give its angle the other sign"
        )
        return setup, ""
    moved = displacements(observation, stars)
    named = [f"`images[{j}]` by ({x:+.2f}, {y:+.2f})" for j, (x, y) in enumerate(moved) if x or y]
    if not named:
        return setup, ""
    words = f"{_first(named)} pixels, by {counted(len(stars), 'star')}"
    note(f"images moved: {words} (`mend_images` False leaves them)")
    return replace(setup, observation=observation.moved(moved)), words


def mask_cores(setup: Setup) -> tuple[Setup, str]:
    """Return a setup with cores of stars masked that images have lost, and that in words.

    `lnocl.core.scene.saturation` says which these are.
    """
    from lnocl.core.scene.saturation import lost_cores

    with ignored_warnings(), ignored_notes():  # the run has them too
        scene = setup.scene(Penalty())
    lost, named = np.zeros(setup.observation.mask.shape, bool), []
    for each in lost_cores(scene):
        lost[each.image, each.rows, each.columns] |= each.lost
        is_flat = np.isfinite(each.level)
        why = f"flat at {each.level:.6g} electrons" if is_flat else "far below what is beside them"
        pixels = counted(int(each.lost.sum()), "pixel")
        named.append(
            f"{pixels} of `images[{each.image}]` at {in_words(scene.stars[each.star])}, {why}"
        )
    return _masked(setup, lost, named, "saturated")


def mask_rays(setup: Setup) -> tuple[Setup, str]:
    """Return a setup with pixels masked that are sharper than their PSF, and that in words.

    `lnocl.core.scene.blemishes.cosmic_rays` says which these are. Noise is that of the counts, or
    as much more as the dark parts of an image have. A star is taken for none; where most stars
    would be, the PSF is wrong and nothing is masked.
    """
    from lnocl.core.scene.blemishes import cosmic_rays

    observation = setup.observation
    rays = np.zeros(observation.mask.shape, bool)
    measured = zip(measure_noise(observation), _psfs_of(observation), strict=True)
    for j, (noise, psfs) in enumerate(measured):
        counts, mask, background = (
            each[j] for each in (observation.images, observation.mask, observation.background)
        )
        factor = 1.0 if noise is None else max(np.exp(noise.log_factor()), 1.0)
        error = np.sqrt(factor * np.maximum(counts, np.maximum(background, LEAST)))
        found = cosmic_rays(np.where(mask, 0.0, counts - background), error, mask, psfs)
        stars = np.round(observation.places(j, setup.stars)).astype(int)
        at_stars = stars[np.all((stars >= 0) & (stars < observation.shape[::-1]), axis=1)]
        near = np.zeros(mask.shape, bool)
        near[at_stars[:, 1], at_stars[:, 0]] = True
        is_ray = found[near]
        if found.any() and not (len(is_ray) and is_ray.mean() > MOST_STARS):
            rays[j] = found & ~binary_dilation(near, np.ones((3, 3)))
    masked = replace(setup, observation=observation.replace(mask=observation.mask | rays))
    if len(setup.stars):
        from lnocl.core.scene.saturation import rays_on_stars

        with ignored_warnings(), ignored_notes():
            rays |= rays_on_stars(masked.scene(Penalty()), rays)
    numbers = enumerate(rays.sum(axis=(1, 2)).tolist())
    named = [f"{counted(n, 'pixel')} of `images[{j}]`" for j, n in numbers if n]
    return _masked(setup, rays, named, "cosmic-ray")


def _psfs_of(observation: Observation) -> list[list[Array]]:
    """Return the PSFs of each image, as its pixels see them."""
    if not observation.psf_fields:
        return [[psf] for psf in psfs_on_detector(observation)]
    return [
        list(psfs_on_detector(observation, np.array([field.at(x, y) for y in ys for x in xs])))
        for field in observation.psf_fields
        for xs, ys in [field.nodes]
    ]


def fit_exposures(setup: Setup) -> tuple[Setup, str]:
    """Return a setup with exposures times the zero points that stars tell, and these in words.

    `lnocl.core.scene.zero_points` says which these are.
    """
    from lnocl.core.scene.zero_points import zero_points

    with ignored_warnings(), ignored_notes():
        found = zero_points(setup.scene(Penalty()))
    if found is None:
        return setup, ""
    factors, observation = np.exp(found.values), setup.observation
    words = "; ".join(
        f"`images[{j}]` {factor:.3f} +- {factor * error:.1g}"
        for j, (factor, error) in enumerate(zip(factors, found.errors, strict=True))
        if factor != 1.0
    )
    words = f"times {words}, by {counted(found.n_stars, 'star')}"
    note(f"exposures fitted: {words} (`mend_images` False leaves them)")
    changed = observation.replace(exposure=np.multiply(*together(observation.exposure, factors)))
    return replace(setup, observation=changed, in_time=setup.is_rate), words


def _masked(setup: Setup, bad: Mask, named: Sequence[str], what: str) -> tuple[Setup, str]:
    """Return a setup with more pixels masked, and in words which; say so where there are any."""
    if not bad.any():
        return setup, ""
    observation = setup.observation
    words = _first(named)
    note(f"{what} pixels masked: {words} (`mend_images` False leaves them)")
    return replace(setup, observation=observation.replace(mask=observation.mask | bad)), words


def _first(named: Sequence[str]) -> str:
    """Return the first of what is named, and the number of others."""
    more = len(named) - MOST_NAMED
    others = [f"and {counted(more, 'other')}"] if more > 0 else []
    return "; ".join([*named[:MOST_NAMED], *others])
